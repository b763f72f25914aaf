"""The model that an FMU is made from, and its modelDescription.xml."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree as ET

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from exlinn_fmi.errors import ModelError
from exlinn_fmi.export.contents import fmu_members
from exlinn_fmi.export.model import StateSpaceModel, plant_model, system_model
from exlinn_fmi.export.model_description import model_description
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, _round_down, evaluate
from exlinn_fmi.plants import plant

PLANT = plant("dc_motor_cart")
MODEL = plant_model(PLANT)
Z = ca.SX.sym("z", len(MODEL.known))


def oscillator(stiffness: float = 4.0, unit: str = "m") -> LagrangianSystem:
    """A mass on a spring, without parameters of its own."""
    return LagrangianSystem.build(
        (Coordinate("s", unit, input="f", input_unit="N"),),
        lambda q, v, p: v[0] ** 2 / 2 - stiffness * q[0] ** 2 / 2,
        lambda v, p: 0.1 * v[0] ** 2 / 2,
    )


@pytest.fixture(scope="module")
def xml() -> ET.Element:
    return ET.fromstring(model_description(MODEL, "{token}"))


def unknowns(xml: ET.Element, section: str) -> dict[str, set[str]]:
    """Names of a section's entries and of what each depends on."""
    names = [v.get("name", "") for v in xml.iter("ScalarVariable")]
    return {
        names[int(u.get("index", "")) - 1]: {names[int(k) - 1] for k in u.get("dependencies", "").split()}
        for u in xml.iterfind(f"ModelStructure/{section}/Unknown")
    }


# ── the model ────────────────────────────────────────────────────────────────────────────────────────────


def test_equations_of_a_plant_are_its_derivative_and_its_own_outputs() -> None:
    z = np.random.default_rng(0).uniform(0.5, 1.5, len(MODEL.known))
    x, u, p = np.split(z, [3, 5])
    expected = np.concatenate(
        [evaluate(PLANT.system.derivative, x, u, p)[0], evaluate(PLANT.output, x, u, p)[0, 5:]]
    )
    np.testing.assert_allclose(evaluate(MODEL.equations, z)[0], expected, rtol=1e-14)


def test_a_plants_outputs_are_states_accelerations_and_its_own() -> None:
    visible = [q.name for q in (*MODEL.states, *MODEL.unknown) if not q.name.startswith("der(")]
    assert visible == [o.name for o in PLANT.output_list]


def test_any_system_exports_with_its_energy_as_output() -> None:
    model = system_model(oscillator(), "Oscillator", start={"s": 0.5})
    assert [q.name for q in model.variables] == [
        "s",
        "s_dot",
        "f",
        "solver_step",
        "solver_tolerance",
        "der(s)",
        "s_ddot",
        "energy",
        "time",
    ]
    assert [q.start for q in model.states] == [0.5, 0.0]
    np.testing.assert_allclose(evaluate(model.equations, [0.5, 2.0, 1.0])[0], [2.0, 1.0 - 2.0 - 0.2, 2.5])


def test_start_state_of_a_plant_is_the_fmus() -> None:
    assert plant_model(replace(PLANT, start={"alpha": 0.3})).states[0].start == 0.3


def test_solver_step_of_the_case_study_is_a_millisecond() -> None:
    assert MODEL.solver_step == 1e-3


@pytest.mark.parametrize(("stiffness", "step"), [(1e12, 1e-8), (4e4, 5e-5), (4.0, 1e-3)])
def test_solver_step_follows_the_fastest_pole(stiffness: float, step: float) -> None:
    assert system_model(oscillator(stiffness), "Oscillator").solver_step == step


@given(st.floats(1e-9, 1e9))
def test_rounding_down_stays_below_by_less_than_the_next_figure(value: float) -> None:
    rounded = _round_down(value)
    assert rounded <= value * (1 + 1e-8)
    assert value < 2.5 * rounded * (1 + 1e-8)


def test_equations_that_are_not_finite_at_the_start_are_refused() -> None:
    singular = LagrangianSystem.build(
        (Coordinate("s", "m"),),
        lambda q, v, p: p[0] * v[0] ** 2,
        lambda v, p: v[0] ** 2,
        (Parameter("m", 0.0, "kg"),),
    )
    with pytest.raises(ModelError, match="not finite at the start state and default parameters"):
        model_description(system_model(singular, "Singular"), "")


def test_a_name_that_is_no_c_identifier_is_refused() -> None:
    with pytest.raises(ModelError, match="'my model' cannot name an FMU; use letters, digits and _"):
        system_model(oscillator(), "my model")


def test_two_variables_of_one_name_are_refused() -> None:
    with pytest.raises(ModelError, match="two variables are named 'alpha'"):
        replace(MODEL, outputs=(replace(MODEL.outputs[0], name="alpha"), *MODEL.outputs[1:]))


# ── modelDescription.xml ─────────────────────────────────────────────────────────────────────────────────


def test_both_interfaces_save_their_state_and_know_derivatives(xml: ET.Element) -> None:
    for kind in ("ModelExchange", "CoSimulation"):
        element = xml.find(kind)
        assert element is not None
        for capability in ("canGetAndSetFMUstate", "canSerializeFMUstate", "providesDirectionalDerivative"):
            assert element.get(capability) == "true"
        assert [f.get("name") for f in element.iterfind("SourceFiles/File")] == ["all.c"]


def test_value_reference_is_the_position(xml: ET.Element) -> None:
    references = [int(v.get("valueReference", "")) for v in xml.iter("ScalarVariable")]
    assert references == list(range(len(MODEL.variables) - 1))  # the last one is the time, which FMI 3 names


def test_parameters_are_tunable_with_the_plants_values(xml: ET.Element) -> None:
    found = {
        v.get("name"): (v.get("variability"), float(v[0].get("start", "")), v[0].get("unit"))
        for v in xml.iter("ScalarVariable")
        if v.get("causality") == "parameter"
    }
    expected = {p.name: ("tunable", p.value, p.unit) for p in PLANT.parameters}
    settings = {"solver_step": ("fixed", 1e-3, "s"), "solver_tolerance": ("fixed", 0.0, "1")}
    assert found == {**expected, **settings}


def test_states_can_be_given_a_start_value(xml: ET.Element) -> None:
    states = [v for v in xml.iter("ScalarVariable") if v.get("name") in PLANT.system.state_names]
    found = {(v.get("causality"), v.get("initial"), v[0].get("start")) for v in states}
    assert found == {("output", "exact", "0.0")}


def test_every_unit_is_defined_in_base_units(xml: ET.Element) -> None:
    defined = {u.get("name") for u in xml.iterfind("UnitDefinitions/Unit") if u.find("BaseUnit") is not None}
    assert defined == {v[0].get("unit") for v in xml.iter("ScalarVariable")}


def test_each_derivative_names_its_state(xml: ET.Element) -> None:
    names = [v.get("name") for v in xml.iter("ScalarVariable")]
    states = {v.get("name"): v[0].get("derivative") for v in xml.iter("ScalarVariable")}
    pairs = {name: names[int(k) - 1] for name, k in states.items() if k}
    assert pairs == {"der(alpha)": "alpha", "alpha_ddot": "alpha_dot", "i_dot": "i"}
    assert list(unknowns(xml, "Derivatives")) == list(pairs)


def test_direct_feed_through_is_the_plants(xml: ET.Element) -> None:
    inputs = set(PLANT.system.input_names)
    outputs = unknowns(xml, "Outputs")
    assert list(outputs) == [o.name for o in PLANT.output_list]
    for output, known in outputs.items():
        assert known & inputs == set(PLANT.feed_through(output)), output


def test_initial_unknowns_depend_on_parameters_too(xml: ET.Element) -> None:
    initial = unknowns(xml, "InitialUnknowns")
    assert initial["tau_e"] == {"i", "k_e"}
    assert initial["i_dot"] == {"alpha_dot", "i", "v", "l", "k_e", "r"}
    assert set(initial) == {q.name for q in MODEL.unknown}


def test_a_variable_without_unit_or_description_says_none() -> None:
    bare = replace(MODEL.outputs[0], unit="", description="")
    xml = ET.fromstring(model_description(replace(MODEL, outputs=(bare, *MODEL.outputs[1:])), ""))
    (variable,) = (v for v in xml.iter("ScalarVariable") if v.get("name") == bare.name)
    assert variable.get("description") is None
    assert variable[0].get("unit") is None


def test_a_unit_that_is_no_si_unit_is_refused() -> None:
    with pytest.raises(ModelError, match="unit 'inch'"):
        fmu_members(system_model(oscillator(unit="inch"), "Oscillator"))


# ── the sources ──────────────────────────────────────────────────────────────────────────────────────────


def token(model: StateSpaceModel) -> str:
    return ET.fromstring(fmu_members(model)["modelDescription.xml"]).get("guid", "")


def test_the_token_binds_sources_and_description() -> None:
    header = fmu_members(MODEL)["sources/model.h"].decode()
    assert f'#define MODEL_TOKEN "{token(MODEL)}"' in header


@pytest.mark.parametrize(
    "other",
    [
        replace(MODEL, description="another one"),
        replace(MODEL, states=(replace(MODEL.states[0], start=1.0), *MODEL.states[1:])),
        replace(MODEL, equations=ca.Function("twice", [Z], [2 * MODEL.equations(Z)])),
    ],
    ids=["description", "start", "equations"],
)
def test_another_model_has_another_token(other: StateSpaceModel) -> None:
    assert token(other) != token(MODEL)

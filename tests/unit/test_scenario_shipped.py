"""The scenarios that come with exlinn, and the JSON Schema that editors check them by."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from scenario_helpers import SCENARIO

from exlinn_fmi.components.base import Variable
from exlinn_fmi.components.fmu import read_variables
from exlinn_fmi.components.lagrangian import variables_of
from exlinn_fmi.components.python import load_python_component
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.control import Linear, Nmpc, Reference, ScotchYoke
from exlinn_fmi.scenario.derived import derived_variables, model_variables, nmpc_variables, reference_unit
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.load import json_schema, load_scenario, named_files
from exlinn_fmi.scenario.schema import FmuComponent, ModelComponent, NmpcComponent, PythonComponentSpec
from exlinn_fmi.scenario.signals import Sine, Table

FOLDER = Path(__file__).parents[2] / "scenarios"
FILES = sorted(FOLDER.glob("*.yaml"))
SHIPPED_SCHEMA = Path(__file__).parents[2] / "exlinn_fmi" / "scenario" / "scenario.schema.json"
VALIDATOR = Draft202012Validator(json_schema())


def inspect(spec: object, folder: Path) -> tuple[Variable, ...]:
    """Variables of the motor's FMU as fmus/README.md lists them, and of everything else as they are."""
    if isinstance(spec, PythonComponentSpec):
        return load_python_component(spec.python, "part", spec.options, folder).variables
    assert isinstance(spec, FmuComponent)
    if Path(spec.fmu).stem not in ("DCMotorCart", "Theirs"):
        return read_variables(folder / spec.fmu)
    inputs = {"tau_ext": "N.m", "v": "V"}
    states = {"alpha": "rad", "alpha_dot": "rad/s", "i": "A"}
    outputs = {"alpha_ddot": "rad/s2", "i_dot": "A/s", "x": "m", "x_dot": "m/s", "tau_e": "N.m"}
    return (
        *(Variable(name, "input", unit=unit, start=0.0) for name, unit in inputs.items()),
        *(Variable(name, "output", unit=unit, start=0.0) for name, unit in states.items()),
        *(Variable(name, "output", unit=unit) for name, unit in outputs.items()),
        *(Variable(p.name, "parameter", "tunable", unit=p.unit, start=p.value) for p in PLANT.parameters),
    )


def by_name(name: str) -> Any:
    return load_scenario(FOLDER / f"{name}.yaml", inspect=inspect).scenario


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_a_shipped_scenario_has_no_problem(file):
    assert load_scenario(file, inspect=inspect).scenario.name == file.stem


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_a_shipped_scenario_leads_the_editor_to_the_schema(file):
    hint = file.read_text(encoding="utf-8").splitlines()[0]
    assert hint.startswith("# yaml-language-server: $schema=")
    assert (FOLDER / hint.partition("=")[2]).resolve() == SHIPPED_SCHEMA.resolve()


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_a_shipped_scenario_fits_the_json_schema(file):
    assert [e.message for e in VALIDATOR.iter_errors(parse(file.read_text(encoding="utf-8")).data)] == []


def test_the_papers_excitation_is_the_papers():
    signal = by_name("dcwc_paper").learn.training[0].inputs["plant.v"]
    omega = 2 * 3.141592653589793 * signal.frequency
    assert (signal.offset, signal.amplitude, signal.phase) == (4, 1, 0)
    assert omega == pytest.approx(2, rel=1e-15)


@pytest.mark.parametrize("name", ["dcwc_paper", "dcwc_tracking"])
def test_the_cart_starts_where_its_reference_does(name):
    scenario = by_name(name)
    reference = scenario.components["controller"].nmpc.reference
    position = reference.through.crank * math.cos(scenario.components["plant"].start["alpha"])
    assert position == pytest.approx(reference.trajectory.amplitude * math.sin(reference.trajectory.phase))


def test_connections_are_pairs_from_to():
    assert by_name("two_fmus").connection_list()[:2] == [
        ("supply.y", "left.v"),
        ("left.alpha", "shaft.angle_left"),
    ]


def test_an_external_fmu_is_given_from_outside(tmp_path):
    (tmp_path / "Theirs.fmu").touch()
    override = f"components.fmu.fmu={tmp_path / 'Theirs.fmu'}"
    loaded = load_scenario(FOLDER / "external_fmu.yaml", [override], inspect)
    assert named_files(loaded.scenario) == [str(tmp_path / "Theirs.fmu")]


# ── the JSON Schema ──────────────────────────────────────────────────────────────────────────────────────


def test_the_schema_is_valid_itself():
    Draft202012Validator.check_schema(json_schema())


def test_the_shipped_schema_is_made_from_the_models():
    written = json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
    message = "run: exlinn schema --out exlinn_fmi/scenario/scenario.schema.json"
    assert SHIPPED_SCHEMA.read_text(encoding="utf-8") == written, message


def test_a_right_scenario_fits_the_schema():
    assert VALIDATOR.is_valid(parse(SCENARIO).data)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("step: 0.01", "stepp: 0.01"),
        ("step: 0.01", "step: ten"),
        ("step: 0.01", "step: 0"),
        ("seed: 3", "seed: 3.5"),
        ("name: valid", "nmae: valid"),
        ("name: valid", "name: a b"),
        ("  stop: 10\n", ""),
        ("fmu: Motor.fmu", "fmuu: Motor.fmu"),
        ("fmu: Motor.fmu", "fmu: Motor.fmu\n    plant: x"),
        ("  load:\n", "  2load:\n"),
        ("signal: constant", "signal: constnat"),
        ("signal: constant, ", ""),
        ("band: [0.1, 5], unit: V", "band: [0.1]"),
        ("band: [0.1, 5], unit: V", "band: [0.1, 5, 6]"),
        ("inputs: 1e-3", "inputs: off"),
        ("terminal: dare", "terminal: dara"),
        ("alpha: 1.5", "alpha: {up: 1}"),
        ("  ctl.v: plant.v", "  ctl: plant.v"),
        ("  ctl.v: plant.v", "  ctl.v: plant"),
        ("preset: paper", "preset: papers"),
        ("[alpha_dot^2, i*alpha]", "[]"),
        ("algorithm: jacobi", "algorithm: jakobi"),
        ("topology: circle", "topology: round"),
        ("python: meter:Meter", "python: meter"),
    ],
)
def test_a_broken_scenario_does_not_fit_the_schema(old, new):
    assert SCENARIO.count(old) == 1
    assert not VALIDATOR.is_valid(parse(SCENARIO.replace(old, new)).data)


def walk(node: Any) -> Any:
    """All objects of a schema."""
    if isinstance(node, dict):
        yield node
    for child in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from walk(child)


def test_the_schema_holds_nothing_of_pydantic():
    for node in walk(json_schema()):
        assert not {"discriminator", "prefixItems", "propertyNames"} & node.keys()
        assert "Spec" not in str(node.get("title"))


def test_a_kind_key_explains_what_it_makes():
    chirp = json_schema()["$defs"]["Chirp"]["properties"]["signal"]
    assert chirp["description"].startswith("A sine whose frequency sweeps")


def test_every_setting_has_a_description():
    for section in walk(json_schema()):
        for name, setting in section.get("properties", {}).items():
            assert "description" in setting, name


def test_every_kind_of_component_is_known_by_a_key_of_its_own():
    (components,) = json_schema()["properties"]["components"]["patternProperties"].values()
    definitions = json_schema()["$defs"]
    kinds = [definitions[c["$ref"].rpartition("/")[2]]["required"] for c in components["oneOf"]]
    assert kinds == [["fmu"], ["plant"], ["python"], ["source"], ["sensor"], ["model"], ["nmpc"]]


# ── what the scenario settles by itself ──────────────────────────────────────────────────────────────────

SIGNAL = Sine(signal="sine", amplitude=1.0, frequency=1.0)


def test_a_controller_has_the_variables_that_are_derived_for_it(tmp_path):
    reference = Reference(
        coordinate="alpha", trajectory=SIGNAL, through=ScotchYoke(map="scotch_yoke", crank=0.2)
    )
    options, system = Nmpc(reference=reference, horizon=2, solver="ipopt"), PLANT.system
    controller = NmpcController("ctl", system, options, 0.01, tmp_path)
    assert nmpc_variables(system.coordinates, options) == controller.variables


def test_a_model_has_the_variables_that_are_derived_for_it():
    derived, real = model_variables(PLANT.coordinates), variables_of(replace(PLANT.system, parameters=()))
    assert [(v.name, v.causality, v.unit, v.start) for v in derived] == [
        (v.name, v.causality, v.unit, v.start) for v in real
    ]
    assert all(set(r.depends_on) <= set(d.depends_on) for d, r in zip(derived, real, strict=True))


@pytest.mark.parametrize(
    ("through", "stated", "unit"),
    [(None, None, "rad"), (None, "deg", "deg"), (Linear(map="linear"), None, None)],
)
def test_unit_of_the_reference(through, stated, unit):
    trajectory = Sine(signal="sine", amplitude=1.0, frequency=1.0, unit=stated)
    reference = Reference(coordinate="alpha", trajectory=trajectory, through=through)
    assert reference_unit(reference, {"alpha": "rad"}) == unit


def test_what_is_not_learned_yet_is_not_derived():
    assert derived_variables(ModelComponent(model="learned"), ()) is None
    assert derived_variables(ModelComponent(model="folder"), PLANT.coordinates) is None


def test_named_files_are_those_that_results_depend_on(tmp_path):
    table = Table(signal="table", file="signal.csv", column="v")
    reference = Reference(coordinate="alpha", trajectory=table)
    sections = [
        FmuComponent(fmu="a.fmu"),
        [FmuComponent(fmu="a.fmu"), ModelComponent(model="learned"), ModelComponent(model="old")],
        NmpcComponent(nmpc=Nmpc(model="plant:dc_motor_cart", reference=reference)),
        PythonComponentSpec(python="parts.spring:Spring", options={"file": "unknown.txt"}),
        PythonComponentSpec(python="installed:Part"),
    ]
    files = ["a.fmu", "old/model.json", "old/model.safetensors", "signal.csv"]
    assert named_files(*sections) == files
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "spring.py").touch()
    assert named_files(*sections, folder=tmp_path) == [*files, "parts/spring.py"]

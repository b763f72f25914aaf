"""Generic terms, pruning, and the learner that finds a short sum of physical terms."""

from __future__ import annotations

import importlib

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from learn_helpers import multisine, simulate
from test_learn_noise_trajectory import COORDINATES, FAMILY, STATES, TRUE, clean, noisy

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.errors import TrainingError
from exlinn_fmi.learn.basis import entry, generic_basis, position_functions, written
from exlinn_fmi.learn.discover import discover, least_mass, negative_friction, prune, spread, start
from exlinn_fmi.learn.terms import choose, formula, iterate_terms, term_table, terms_spec
from exlinn_fmi.learn.train import train
from exlinn_fmi.learn.trajectory import Fit, Information, cut
from exlinn_fmi.learn.weights import load_model, save_model
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.friction import log_cosh
from exlinn_fmi.mechanics.monomials import MonomialBasis, parse_monomial
from exlinn_fmi.scenario.learning import Terms

FOUND = {
    "0.5*alpha_dot^2",
    "0.5*sin(alpha)^2*alpha_dot^2",
    "0.5*i^2",
    "alpha*i",
}
CANDIDATES = Terms(
    preset="terms",
    lagrangian=[*FAMILY.lagrangian, "-1*cos(alpha)", "cos(alpha)*i"],
    dissipation=[*FAMILY.dissipation, "abs(alpha_dot)^3"],
)


def candidates(data: Dataset) -> MonomialBasis:
    """Nine candidates, six of them true."""
    spec = terms_spec(data, CANDIDATES)
    return spec.basis


def line() -> Dataset:
    """A mass on a spring that stiffens, under a force."""
    coordinates = (Coordinate("x", "m", input="f", input_unit="N"),)
    system = LagrangianSystem.build(
        coordinates,
        lambda q, v, p: v[0] ** 2 - 3 * q[0] ** 2 - q[0] ** 4,
        lambda v, p: v[0] ** 2 / 4,
    )
    t = np.arange(800) * 0.01
    return Dataset(simulate(system, 2 * np.sin(t**1.5)[:, None], 0.01), coordinates)


# ── terms ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("make", [clean, line])
def test_no_direction_of_the_generic_terms_is_a_gauge(make) -> None:
    basis = generic_basis(make())
    random, n = np.random.default_rng(3), len(basis.coordinates)
    at = random.uniform(-1, 1, (3, 400, n)) * np.abs([x.max(axis=0) + 1 for x in make().arrays[:3]])[:, None]
    columns = evaluate(basis.regressor, *at, basis.start).reshape(-1, len(basis.start))[:, : basis.size]
    singular = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), compute_uv=False)
    assert singular[-1] > 1e-4


def test_generic_terms_hold_the_motor_with_cart() -> None:
    basis = generic_basis(clean())
    assert set(basis.lagrangian) >= FOUND
    assert set(basis.dissipation) >= set(FAMILY.dissipation)
    assert "-1*sin(alpha)" in basis.lagrangian


def test_mechanical_and_electrical_masses_are_not_coupled() -> None:
    assert not any("alpha_dot*i" in text for text in generic_basis(clean()).lagrangian)


def test_a_line_has_powers_and_rational_functions_whose_shapes_are_found() -> None:
    functions = position_functions((Coordinate("x", "m"),))
    assert functions[:3] == [("", 0), ("x", 1), ("x^2", 2)]
    assert ("lorentz(x/a_x)", 3) in functions


def test_degrees_are_turned_into_radians() -> None:
    functions = position_functions((Coordinate("a", "deg", topology="circle"),))
    assert float(parse_monomial(functions[1][0], ["a"]).evaluate({"a": 90.0})) == pytest.approx(1)


def test_products_of_coordinates_stay_below_the_third_order() -> None:
    functions = position_functions(
        (Coordinate("a", "rad", topology="circle"), Coordinate("b", "rad", topology="circle"))
    )
    assert ("sin(a)*sin(b)", 2) in functions
    assert max(order for text, order in functions if "a" in text and "b" in text) == 3


def test_functions_of_monomials_are_what_they_are_called() -> None:
    x = 0.3
    for text, expected in {
        "T1(2*x-0.1)": 0.5,
        "T3(x)": 4 * x**3 - 3 * x,
        "2*abs(-1*x)^3": 2 * x**3,
        "logcosh(10*x)": np.log(np.cosh(3)),
        "sin(2*x)*cos(x)^2": np.sin(0.6) * np.cos(0.3) ** 2,
    }.items():
        assert float(ca.DM(parse_monomial(text, ["x"]).evaluate({"x": x}))) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["sin(2*x-0.5)^2", "T4(0.25*x+1)", "abs(x)", "x^3"])
def test_factors_are_written_as_they_are_read(text) -> None:
    assert written(parse_monomial(text, ["x"]).factors[0]) == text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.5*sin(alpha)^2*alpha_dot^2", ("M_11", "sin(alpha)^2", 1.0)),
        ("2*alpha_dot*i", ("M_12", "", 2.0)),
        ("alpha*i", ("A_2", "alpha", 1.0)),
        ("-1*cos(alpha)", ("V", "cos(alpha)", 1.0)),
        ("alpha_dot^4", ("L", "alpha_dot^4", 1.0)),
    ],
)
def test_each_term_has_its_place(text, expected) -> None:
    assert entry(text, COORDINATES) == expected


# ── pruning ──────────────────────────────────────────────────────────────────────────────────────────────


def test_only_terms_that_are_worth_their_price_stay() -> None:
    fit = Fit(np.array([10.0, 1.0, 0.0]), np.zeros((0, 0)), 0.0, Information(np.eye(3)), np.ones(1))
    assert prune(fit, 100.0, 3).tolist() == [True, False, False]


def test_one_of_two_terms_that_say_the_same_is_pruned() -> None:
    matrix = np.array([[1.0, 1 - 1e-6], [1 - 1e-6, 1.0]]) * 1e4
    fit = Fit(np.array([1.0, 0.0]), np.zeros((0, 0)), 0.0, Information(matrix), np.ones(1))
    assert prune(fit, 100.0, 2).sum() == 1


def test_the_start_has_a_mass_matrix_whatever_the_noise() -> None:
    data = noisy(0.05)
    basis = candidates(data)
    p = start(basis, data, cut(data, STATES, ["v"]))
    assert least_mass(basis, p, data) > 0


def test_terms_that_predict_nothing_are_refused_with_what_to_do() -> None:
    basis = MonomialBasis(COORDINATES, ("0.5*i^2",), ("0.5*i^2",))
    data = noisy(0.01)
    with pytest.raises(TrainingError, match="mass matrix"):
        start(basis, data, cut(data, STATES, ["v"]))


def test_a_negative_mass_is_told() -> None:
    assert least_mass(FAMILY, -TRUE, clean()) == -1


@pytest.mark.parametrize("level", [0.01, 0.05])
def test_true_terms_and_no_others_are_found_in_noise(level) -> None:
    data = noisy(level, seed=2)
    basis = candidates(data)
    *_, found = discover(basis, None, data)
    assert set(np.array(basis.terms)[found.chosen]) == {*FAMILY.terms}
    assert found.p[[0, 1, 2, 3]] == pytest.approx(TRUE[:4], rel=level)


# ── the learner ──────────────────────────────────────────────────────────────────────────────────────────


def test_clean_data_are_learned_to_rounding_from_generic_terms() -> None:
    model = train(*split(clean(), 0.8, 4, 0), Terms(preset="terms"), seed=0)
    kept = np.concatenate([model.weights[f"{part}.terms"] for part in ("lagrangian", "dissipation")])
    assert sorted(kept[kept != 0]) == pytest.approx(sorted(TRUE), rel=1e-9)
    assert model.provenance["objective"].startswith("inverse")


def test_a_stiffening_spring_is_learned_on_a_line() -> None:
    data = line()
    model = train(*split(data, 0.8, 4, 0), Terms(preset="terms"), seed=0)
    q, v, a, force = data.arrays
    assert evaluate(model.system.inverse, q, v, a, np.zeros(0)) == pytest.approx(force, abs=1e-5)


def test_terms_are_saved_and_loaded(tmp_path) -> None:
    model = train(*split(clean(), 0.8, 4, 0), CANDIDATES, seed=0, objective="weak")
    save_model(tmp_path, model)
    loaded = load_model(tmp_path)
    assert loaded.spec == model.spec
    assert loaded.provenance["deviations"] == model.provenance["deviations"]
    x, u = np.array([0.3, 1.0, 0.2]), np.array([2.0])
    assert np.array_equal(loaded.system.derivative(x, u, []).full(), model.system.derivative(x, u, []).full())
    assert loaded.system.mass_matrix([0.3, 0], [0, 0], []).full() == pytest.approx(
        np.diag([0.1 + 0.04 * np.sin(0.3) ** 2, 1]), rel=1e-3
    )


@pytest.mark.parametrize(
    ("objective", "data", "chosen", "reason"),
    [
        ("auto", clean, "inverse", "clean"),
        ("auto", lambda: noisy(0.01), "trajectory", "% noise"),
        ("weak", clean, "weak", "scenario"),
        (
            "auto",
            lambda: Dataset(clean().frame.assign(i_dot=lambda f: 1.1 * f["i_dot"] + 1), COORDINATES),
            "trajectory",
            "accelerations",
        ),
    ],
)
def test_the_objective_follows_the_data_and_says_why(objective, data, chosen, reason) -> None:
    found, why = choose(objective, FAMILY, data())
    assert found == chosen
    assert reason in why


def test_terms_are_reported_as_formulas_with_intervals() -> None:
    data = noisy(0.01)
    spec = terms_spec(data, CANDIDATES)
    *_, last = iterate_terms(spec, data, data, "auto")
    p = np.concatenate(list(last.weights.values()))
    table = term_table(spec, p, np.array(last.notes["deviations"]))
    coefficients = table.set_index(["entry", "function"])
    inertia = coefficients.loc[("M_11", "1")]
    assert inertia["low"] < 0.1 < inertia["high"]
    assert formula(table).startswith("M_11 = 0.")
    assert "sin(alpha)^2" in formula(table)


def test_coefficients_are_spread_over_all_terms() -> None:
    assert spread(np.array([2.0]), np.array([False, True])).tolist() == [0, 2]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("magnetic_levitation", {"M_22": {"": 0.2, "lorentz(x/0.02)": 0.1}, "V": {"x": -0.4905}}),
        ("mems_actuator", {"V": {"x^2": 10, "Q^2": 7.0588e9, "x*Q^2": -1.41176e12}}),
    ],
)
def test_inductance_and_capacitance_are_found_as_formulas(name, expected) -> None:
    module = importlib.import_module(f"exlinn_fmi.plants.{name}")
    system, time = module.PLANT.system, np.arange(2001) * 2e-3
    coil = name == "magnetic_levitation"
    force, volt = (0.15, (8.0, 0.6)) if coil else (5e-3, (700.0, 250.0))
    frames = [
        simulate(
            system,
            np.column_stack(
                [
                    multisine(force, (0.3, 8), 20, 0, seed, time),
                    sign * multisine(volt[1], (0.1, 6), 20, volt[0], seed, time),
                ]
            ),
            2e-3,
            np.array([4e-3, 0, 0.9]) if coil else np.array([0, sign * 5e-8, 0, 0]),
            seed,
        )
        for seed, sign in ((1, 1), (2, -1))
    ]
    data = Dataset(pd.concat(frames), system.coordinates)
    model = train(*split(data, 0.8, 4, 0), Terms(preset="terms"), seed=0)
    p = np.concatenate(list(model.weights.values()))
    table = term_table(model.spec, p, np.array(model.provenance["deviations"]))
    for place, functions in expected.items():
        rows = table[table["entry"] == place]
        assert dict(zip(rows["function"].replace("1", ""), rows["coefficient"], strict=True)) == {
            function: pytest.approx(value, rel=1e-4) for function, value in functions.items()
        }
    assert model.provenance["validation_loss"] < 1e-20


def test_friction_is_found_with_the_speed_where_it_sets_in() -> None:
    coordinates = (Coordinate("x", "m", input="f", input_unit="N"),)
    system = LagrangianSystem.build(
        coordinates,
        lambda q, v, p: v[0] ** 2 - 3 * q[0] ** 2,
        lambda v, p: v[0] ** 2 / 4 + 0.3 * 0.05 * log_cosh(v[0] / 0.05),
    )
    t = np.arange(1600) * 5e-3
    data = Dataset(simulate(system, 2 * np.sin(t**1.5)[:, None], 5e-3), coordinates)
    model = train(*split(data, 0.8, 4, 0), Terms(preset="terms"), seed=0)
    p = np.concatenate(list(model.weights.values()))
    table = term_table(model.spec, p, np.array(model.provenance["deviations"])).set_index("term")
    assert table.loc["s_x_dot", "coefficient"] == pytest.approx(0.05, rel=1e-6)
    assert table.loc["s_x_dot*logcosh(x_dot/s_x_dot)", "coefficient"] == pytest.approx(0.3, rel=1e-6)
    assert "0.05*logcosh(x_dot/0.05)" in formula(table.reset_index())
    assert (table["coefficient"].loc[["0.5*x_dot^2"]] > 0).all()


def test_a_term_that_would_push_instead_of_rub_is_left_out() -> None:
    basis = MonomialBasis(COORDINATES, ("0.5*i^2",), ("0.5*i^2", "abs(i)^3"))
    assert negative_friction(basis, np.array([1.0, 2.0, -0.1]), clean()).tolist() == [False, False, True]


@pytest.mark.parametrize(("noise", "said"), [(0.0, "of the forces unexplained"), (0.01, "times the noise")])
def test_where_no_short_formula_is_true_the_report_says_so(noise, said) -> None:
    coordinates = (Coordinate("x", "m", input="f", input_unit="N"),)
    system = LagrangianSystem.build(
        coordinates,
        lambda q, v, p: v[0] ** 2 / 2 + 0.5 * ca.cos(8 * q[0]) - q[0] ** 2,
        lambda v, p: v[0] ** 2 / 4,
    )
    time = np.arange(1500) * 0.01
    frame = simulate(system, multisine(3, (0.1, 1), 9, 0, 0, time)[:, None], 0.01)
    for k, name in enumerate(("x", "x_dot")):
        frame[name] += noise * frame[name].std() * np.random.default_rng(k).standard_normal(len(frame))
    data = Dataset(frame, coordinates)
    candidates = Terms(preset="terms", lagrangian=["0.5*x_dot^2", "x^2", "x^4"], dissipation=["0.5*x_dot^2"])
    model = train(data, data, candidates, seed=0)
    assert said in model.provenance["objective"]
    assert "no short sum of these terms" in model.provenance["objective"]

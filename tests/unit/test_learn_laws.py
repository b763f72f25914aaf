"""Laws that every structured model obeys, however it was trained: passivity, and freedom from units."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from itertools import product

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.learn.card import force_error
from exlinn_fmi.learn.guarantee import KEPT, doubts, told
from exlinn_fmi.learn.identify import identify
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.train import TrainedModel, train
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.learned import FAITHFUL, ModelSpec, Weights, learned_system
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.scenario.learning import Identify, Structured
from tests.learn_helpers import MOTOR_CART, SOLENOID, motor_cart, random_model, solenoid_dataset

SECONDS = 1000.0
HOLD = 0.5
"""Inputs change so often [s]."""
KINDS = {
    "circle": (Coordinate("a", "rad", topology="circle", input="u"),),
    "line": (Coordinate("x", "m", input="u"),),
    "motor": MOTOR_CART,
    "solenoid": SOLENOID,
    "charge": (
        Coordinate("x", "m"),
        Coordinate("Q", "C", "electrical", "line", "i", "A", input="v", input_unit="V"),
    ),
    "arm": (
        Coordinate("a", "rad", topology="circle", input="u"),
        Coordinate("b", "rad", topology="circle", input="w"),
    ),
}


# ── passivity ────────────────────────────────────────────────────────────────────────────────────────────


def positions(spec: ModelSpec) -> NDArray:
    """A grid over all that M(q) and V(q) can see: turns of circles, lines to where they are saturated."""
    assert spec.scales is not None
    axes, count = [], 61 if len(spec.layout.positions) > 1 else 801
    for i, c in enumerate(spec.coordinates):
        centre, reach = spec.scales.centre[i], spec.scales.reach[i] * (FAITHFUL + 8)
        spans = {
            "cyclic": (0.0, 0.0, 1),
            "circle": (0.0, 2 * np.pi, count),
            "line": (centre - reach, centre + reach, count),
        }
        axes.append(np.linspace(*spans[c.topology]))
    return np.array(list(product(*axes)))


def energy_bound(
    spec: ModelSpec, weights: Weights, system: LagrangianSystem, force: NDArray
) -> tuple[float, float]:
    """Energy that no motion from rest exceeds under |F_i| ≤ force_i, and the least potential energy.

    dE/dt = q̇ᵀF − q̇ᵀ∂D/∂q̇ ≤ ‖c‖‖w‖ − ‖w‖² with w_i = b_i q̇_i and c_i = F_i/b_i, b_i² viscous friction: so E
    falls wherever ‖w‖ > ‖c‖, and where it is not, E ≤ ½ λmax(B⁻¹MB⁻¹) ‖c‖² + max V.
    """
    none, q = np.zeros(0), positions(spec)
    rest = np.zeros_like(q)
    b = np.abs(weights["dissipation.viscous"]) * np.sqrt(
        spec.scales.energy / spec.scales.time / spec.scales.velocity**2
    )
    mass = evaluate(system.mass_matrix, q, rest, none).reshape(-1, system.n, system.n)
    potential = evaluate(system.energy, q, rest, none)
    speed = np.linalg.norm(force / b)
    most = np.linalg.eigvalsh(mass / np.outer(b, b)).max() * speed**2 / 2
    return float(most + potential.max()), float(potential.min())


def fastest(system: LagrangianSystem, q: NDArray, speed: NDArray) -> float:
    """Largest |pole| at random states within given positions and speeds."""
    random = np.random.default_rng(0)
    kept = [i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"]
    rows = random.integers(0, len(q), 400)
    x = np.hstack([q[rows][:, kept], random.uniform(-1, 1, (400, system.n)) * speed])
    poles = evaluate(system.state_jacobian, x, np.zeros(len(system.input_names)), np.zeros(0))
    return float(np.abs(np.linalg.eigvals(poles)).max())


def energies_of_long_run(
    system: LagrangianSystem, step: float, inputs: NDArray, x0: NDArray
) -> tuple[NDArray, NDArray]:
    """States and energies at the ends of each hold."""
    count = int(np.ceil(HOLD / step))
    x, u = ca.SX.sym("x", len(x0)), ca.SX.sym("u", inputs.shape[1])
    once = ca.Function("once", [x, u], [system.rk4()(x, u, ca.SX(0, 1), HOLD / count)])
    end = once.mapaccum(count) if count > 1 else once
    X, U = ca.MX.sym("x", len(x0)), ca.MX.sym("u", inputs.shape[1])
    held = ca.Function("held", [X, U], [end(X, ca.repmat(U, 1, count))[:, -1]])
    states = np.array(held.mapaccum(len(inputs))(x0, inputs.T)).T
    split_ = ca.Function("split", [x], list(system.split_state(x)))
    q, v = (np.array(part.T) for part in split_.map(len(states))(states.T))
    return states, evaluate(system.energy, q, v, np.zeros(0))[:, 0]


def assert_bounded(spec: ModelSpec, weights: Weights, seed: int) -> None:
    """A thousand seconds from rest under bounded inputs stay within the energy that passivity allows."""
    system = learned_system(spec, weights)
    driven = np.array([c.input is not None for c in spec.coordinates])
    most, least = energy_bound(spec, weights, system, 2 * spec.scales.force * driven)
    step = min(HOLD, 1 / fastest(system, positions(spec), 3 * spec.scales.velocity))
    random = np.random.default_rng(seed)
    inputs = random.uniform(-1, 1, (int(SECONDS / HOLD), driven.sum()))
    inputs[: len(inputs) // 4] = 1  # what drives it furthest away
    start = np.zeros(len(system.state_names))
    states, energy = energies_of_long_run(system, step, inputs * 2 * spec.scales.force[driven], start)
    assert np.isfinite(states).all()
    assert energy.max() <= most
    assert energy.min() >= least - 1e-6 * (most - least)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_bounded_inputs_move_any_model_within_its_energy_for_ever(kind: str, seed: int) -> None:
    spec, drawn = random_model(seed, KINDS[kind])
    viscous = drawn["dissipation.viscous"]
    # A bound holds wherever all coordinates have some viscous friction: a rail without any has none.
    assert_bounded(spec, {**drawn, "dissipation.viscous": viscous + 0.3 * np.sign(viscous)}, seed)


def test_a_model_trained_on_noise_is_passive_too() -> None:
    data = motor_cart_data(noise=0.05, seconds=2.0)
    model = train(
        *split(data, 0.8, 10, 0),
        Structured(preset="structured", hidden=4, iterations=30),
        0,
        objective="inverse",
    )
    assert_bounded(model.spec, model.weights, 0)


def test_a_potential_that_falls_ever_steeper_leads_nowhere() -> None:
    spec, drawn = random_model(0, KINDS["line"])
    output = np.zeros_like(drawn["lagrangian.output"])
    output[0, 0] = 1.0  # M = 1
    output[-1, 3] = -1.0  # V = −z³: in finite time at infinity, were it not for `saturate`
    weights = {**drawn, "lagrangian.output": output, "dissipation.viscous": np.ones(1)}
    assert (spec.layout.outputs[-1], spec.layout.products[1]) == (("V", 0, 0), (0, 0, 0))
    assert_bounded(spec, weights, 0)


# ── terms: what is guaranteed is kept, what is not is said ───────────────────────────────────────────────

SHAPES = {
    "circle": ("-1*cos({q})", "0.1*sin({q})^2*{v}^2", "0.2*cos({q})*{v}^2"),
    "line": ("-0.3*{q}^2", "-0.1*{q}^4", "0.2*lorentz(2*{q})*{v}^2"),
}


def random_terms(seed: int, topology: str) -> tuple[LagrangianSystem, Dataset]:
    """A sum of terms with coefficients drawn at random, some of them wrong, and data of its range."""
    random = np.random.default_rng(seed)
    coordinates = (
        Coordinate("q", "rad" if topology == "circle" else "m", topology=topology, input="f"),
        Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),
    )
    lagrangian = ["0.5*q_dot^2", "0.5*i^2", "q*i", *(t.format(q="q", v="q_dot") for t in SHAPES[topology])]
    dissipation = ["0.5*q_dot^2", "0.2*logcosh(5*q_dot)", "abs(q_dot)^3", "0.5*i^2"]
    p = random.uniform(-0.3, 1.5, len(lagrangian) + len(dissipation))
    rows = 200
    names = ["q", "q_dot", "i", "q_ddot", "i_dot", "f", "v"]
    frame = pd.DataFrame(random.uniform(-1, 1, (rows, len(names))), columns=names)
    frame.insert(0, "time", np.arange(rows) * 0.01)
    frame.insert(0, "trajectory", 0)
    system = MonomialBasis(coordinates, tuple(lagrangian), tuple(dissipation)).system().bound(p)
    return system, Dataset(frame, coordinates)


@pytest.mark.parametrize("topology", SHAPES)
def test_sums_of_terms_without_doubts_stay_bounded_under_bounded_inputs(topology: str) -> None:
    kept = 0
    for seed in range(40):
        system, data = random_terms(seed, topology)
        if kept == 4 or doubts(system, data):
            continue
        kept += 1
        inputs = np.random.default_rng(seed).uniform(-1, 1, (int(SECONDS / HOLD), 2))
        inputs[: len(inputs) // 4] = 1
        around = np.column_stack([np.linspace(-4, 4, 81), np.zeros(81)])
        step = min(5e-3, 0.5 / fastest(system, around, np.array([5.0, 5.0])))
        states, energy = energies_of_long_run(system, step, inputs, np.zeros(3))
        assert np.isfinite(states).all()
        # A circle has a potential of no account, and b q̇ ≤ 1 + k i; a line is held by its V.
        second = energy[len(energy) // 2 :]
        assert second.max() <= 1.5 * energy[: len(energy) // 2].max() + 1
    assert kept >= 3


@pytest.mark.parametrize(
    ("lagrangian", "dissipation", "reason"),
    [
        (["0.5*q_dot^2", "cos(q)*q_dot^2"], ["q_dot^2"], "M is not positive definite at q = "),
        (["0.5*q_dot^2"], ["logcosh(q_dot)"], "q_dot has no viscous friction"),
        (["0.5*q_dot^2"], ["q_dot^2", "-1*abs(q_dot)"], "friction pushes at some speeds"),
        (["0.5*q_dot^2", "q_dot^4"], ["q_dot^2"], "M depends on velocities"),
        (["0.5*x_dot^2", "x^3"], ["x_dot^2"], "V falls without bound along a line"),
        (["0.5*x_dot^2", "0.5*x^2*x_dot^2"], ["x_dot^2"], "M grows without bound along a line"),
    ],
)
def test_the_card_says_why_a_model_might_not_stay_bounded(lagrangian, dissipation, reason) -> None:
    line = "x_dot" in lagrangian[0]
    name = "x" if line else "q"
    coordinates = (
        Coordinate(name, "m" if line else "rad", topology="line" if line else "circle", input="f"),
    )
    system = (
        MonomialBasis(coordinates, tuple(lagrangian), tuple(dissipation))
        .system()
        .bound(np.ones(len(lagrangian) + len(dissipation)))
    )
    values = np.random.default_rng(0).uniform(-1, 1, (30, 4))
    frame = pd.DataFrame(values, columns=[name, f"{name}_dot", f"{name}_ddot", "f"])
    frame.insert(0, "time", np.arange(30) * 0.01)
    frame.insert(0, "trajectory", 0)
    assert any(text.startswith(reason) for text in doubts(system, Dataset(frame, coordinates)))


def test_structured_models_give_no_doubts() -> None:
    for seed in range(3):
        spec, drawn = random_model(seed, KINDS["motor"])
        viscous = drawn["dissipation.viscous"]
        weights = {**drawn, "dissipation.viscous": viscous + 0.3 * np.sign(viscous)}
        assert told(learned_system(spec, weights), Dataset(motor_cart(), MOTOR_CART)) == KEPT


# ── units ────────────────────────────────────────────────────────────────────────────────────────────────

UNITS = {
    "milliseconds": (1e3, (1.0, 1.0)),
    "kiloseconds": (1e-3, (1.0, 1.0)),
    "millirads": (1.0, (1e3, 1.0)),
    "milliamperes": (1.0, (1.0, 1e3)),
    "kiloamperes": (1.0, (1.0, 1e-3)),
    "all": (1e-3, (1e3, 1e-3)),
}
LENGTHS = {"millimetres": (1.0, (1e3, 1.0)), "kilometres": (1.0, (1e-3, 1.0)), "all": (1e3, (1e-3, 1e3))}


def motor_cart_data(noise: float, seconds: float = 4.0) -> Dataset:
    """The motor under two multisines, with noise on all states and accelerations, a share of their size."""
    random = np.random.default_rng(0)
    frame = pd.concat([motor_cart(sign * 2.9, seconds, 1 + k, k) for k, sign in enumerate((1, -1))])
    for name in ("alpha", "alpha_dot", "i", "alpha_ddot", "i_dot"):
        frame[name] += noise * frame[name].std() * random.standard_normal(len(frame)) * (name != "alpha")
    return Dataset(frame.reset_index(drop=True), MOTOR_CART)


def rescaled(data: Dataset, time: float, position: tuple[float, ...]) -> Dataset:
    """The same recording where a second is `time` units of time, and a unit of each q so many new ones.

    Energy keeps its unit: forces are energy over position.
    """
    frame, coordinates = data.frame.copy(), []
    frame["time"] *= time
    for c, size in zip(data.coordinates, position, strict=True):
        for name, factor in ((c.velocity, size / time), (c.acceleration, size / time**2)):
            frame[name] *= factor
        if c.topology != "cyclic":
            frame[c.name] *= size
        if c.input is not None:
            frame[c.input] /= size
        unit = {("rad", 1e3): "mrad"}.get((c.unit, size), c.unit)
        coordinates.append(dataclasses.replace(c, unit=unit))
    return Dataset(frame, tuple(coordinates))


def parameters(model: TrainedModel, data: Dataset, time: float, position: tuple[float, ...]) -> NDArray:
    """The motor's six, back in s, rad and A."""
    a, i = position
    terms = Identify(
        lagrangian={
            "j": "0.5*alpha_dot^2",
            "m": f"0.5*sin({1 / a:g}*alpha)^2*alpha_dot^2",
            "l": "0.5*i^2",
            "k": "i*alpha",
        },
        dissipation={"b": "0.5*alpha_dot^2", "r": "0.5*i^2"},
    )
    found = identify(model.system, data, terms, {}).parameters["identified"].to_numpy()
    return found * np.array([a**2, a**2, i**2, a * i, a**2, i**2]) / time ** np.array([2, 2, 2, 1, 1, 1])


def judged(data: Dataset, test: Dataset, time: float, position: tuple[float, ...]) -> NDArray:
    """Force error relative to the forces, errors of the free run, and the motor's parameters in SI units."""
    data, test = rescaled(data, time, position), rescaled(test, time, position)
    part, held = split(data, 0.8, 10, 0)
    options = Structured(preset="structured", hidden=4, iterations=40)
    model = train(part, held, options, 0, objective="inverse")
    error = force_error(model.system, test) / model.spec.scales.force
    run = nrmse(model.system, test, free_run(model.system, test), float(np.ptp(test.frame["time"])))
    found = parameters(model, part, time, position) if data.coordinates[0].name == "alpha" else []
    return np.array([float(np.mean(error**2)), *run.values(), *found])


@lru_cache
def motor_judged(noise: float, time: float, position: tuple[float, ...]) -> NDArray:
    """The motor learned in these units."""
    test = Dataset(motor_cart(2.9, 0.2, 11), MOTOR_CART)
    return judged(motor_cart_data(noise, 2.0), test, time, position)


@pytest.mark.parametrize("units", UNITS)
def test_what_is_learned_from_noise_does_not_depend_on_units(units: str) -> None:
    np.testing.assert_allclose(
        motor_judged(0.05, *UNITS[units]), motor_judged(0.05, 1.0, (1.0, 1.0)), rtol=1e-6
    )


@pytest.mark.parametrize("units", ["milliseconds", "all"])
def test_what_is_learned_from_clean_data_is_exact_in_all_units(units: str) -> None:
    error, *rest = motor_judged(0.0, *UNITS[units])
    assert error < 1e-12
    assert max(rest[:2]) < 1e-6
    np.testing.assert_allclose(rest[2:], [0.1, 0.04, 1.0, 1.0, 0.5, 5.0], rtol=1e-6)


@lru_cache
def solenoid_judged(time: float, position: tuple[float, ...]) -> NDArray:
    """The solenoid learned in these units: its L(x) takes hidden units."""
    data = solenoid_dataset()
    test = Dataset(data.frame[:100], data.coordinates)
    return judged(data, test, time, position)


@pytest.mark.parametrize("units", LENGTHS)
def test_hidden_units_learn_alike_in_all_units_of_length(units: str) -> None:
    # Free runs take internal steps of 1e-3 units of time at most: other units, other errors of integration.
    here, there = solenoid_judged(1.0, (1.0, 1.0)), solenoid_judged(*LENGTHS[units])
    np.testing.assert_allclose(there[0], here[0], rtol=1e-5)
    np.testing.assert_allclose(there[1:], here[1:], rtol=1e-3, atol=1e-7)

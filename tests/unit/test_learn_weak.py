"""Networks against test functions: the equations of motion without accelerations."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pandas as pd
import pytest
from learn_helpers import (
    MOTOR_CART,
    SOLENOID,
    motor_cart,
    motor_cart_dataset,
    random_model,
    solenoid_dataset,
)

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.errors import DataError
from exlinn_fmi.learn.assembly import inverse_assembly
from exlinn_fmi.learn.card import report_card
from exlinn_fmi.learn.curves import curves
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Objective, loss
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.structured import iterate_structured, structured_spec
from exlinn_fmi.learn.tested import Weak, usual_accelerations
from exlinn_fmi.learn.train import TrainedModel, train
from exlinn_fmi.learn.windows import INTEGRAL, windows
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.scenario.learning import Identify, Structured

OPTIONS = Structured(preset="structured")
STATES = {"alpha": "alpha_dot", "x": "x_dot"}


def blind(data: Dataset, level: float = 0.0) -> Dataset:
    """Noise on all states, and accelerations that say nothing."""
    frame, random = data.frame.copy(), np.random.default_rng(0)
    position = data.coordinates[0].name
    states = [position, STATES[position], "i"]
    frame[states] += level * frame[states].std().to_numpy() * random.standard_normal((len(frame), 3))
    accelerations = [c.acceleration for c in data.coordinates]
    frame[accelerations] = random.standard_normal((len(frame), len(accelerations)))
    return Dataset(frame, data.coordinates)


@lru_cache
def learned(level: float) -> TrainedModel:
    parts = split(blind(motor_cart_dataset(), level), 0.8, 10, 0)
    return train(*parts, OPTIONS, 0, objective="weak")


def rollout(model: TrainedModel, test: Dataset, seconds: float) -> float:
    return max(nrmse(model.system, test, free_run(model.system, test), seconds).values())


# ── the rows ─────────────────────────────────────────────────────────────────────────────────────────────


def smooth(coordinates: tuple[Coordinate, ...], seconds: float = 1.0) -> Dataset:
    """Random smooth motion with exact accelerations and the inputs 0."""
    random, time = np.random.default_rng(0), np.linspace(0, seconds, 401)
    frame = pd.DataFrame({"trajectory": 0, "time": time})
    for c in coordinates:
        rates, sizes, phases = random.uniform(3, 9, 4), random.uniform(0.2, 1, 4), random.uniform(0, 6, 4)
        arguments = np.outer(time, rates) + phases
        frame[c.name] = np.sin(arguments) @ sizes
        frame[c.velocity] = np.cos(arguments) @ (sizes * rates)
        frame[c.acceleration] = -np.sin(arguments) @ (sizes * rates**2)
        if c.input is not None:
            frame[c.input] = 0.0
    return Dataset(frame, coordinates)


SYSTEMS = [MOTOR_CART, SOLENOID, (Coordinate("phi", "rad", topology="circle"), Coordinate("x", "m"))]


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=["cart", "solenoid", "two positions"])
def test_rows_are_the_forces_of_the_inverse_model_in_the_mean_over_each_window(
    coordinates: tuple[Coordinate, ...],
) -> None:
    data = smooth(coordinates)
    spec, weights = random_model(1, coordinates)
    networks = StructuredNetworks(spec)
    theta = networks.pack(dict(weights))
    rows = Weak.all(networks, data)
    force = networks.residual(theta, inverse_assembly(spec, data.arrays))
    expected = np.zeros((len(rows.windows), len(coordinates)))
    for piece in rows.windows.pieces():
        expected[piece.windows] += piece.phi @ force[piece.rows]
    assert rows.residual(theta) == pytest.approx(expected, abs=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=["cart", "solenoid", "two positions"])
def test_jacobian_and_gradient_are_those_of_the_objective(coordinates: tuple[Coordinate, ...]) -> None:
    spec, weights = random_model(2, coordinates)
    networks = StructuredNetworks(spec)
    theta = networks.pack(dict(weights))
    rows = Weak.all(networks, smooth(coordinates, 0.5))
    slopes, inertial = rows.jacobian(theta)[1], rows.inertia_jacobian(theta)[1]
    objective = Objective(rows, 1e-3)
    value, gradient = objective.gradient(theta)
    triangle = objective.linearise(theta)
    assert value == pytest.approx(objective.value(theta), rel=1e-10)
    assert triangle.value == pytest.approx(value, rel=1e-10)
    assert 2 * triangle.factor.T @ triangle.right == pytest.approx(
        gradient, rel=1e-6, abs=1e-9 * np.abs(gradient).max()
    )
    for k in range(len(theta)):
        step = np.zeros_like(theta)
        step[k] = 1e-6
        for found, make in ((slopes, rows.residual), (inertial, rows.inertia)):
            expected = (make(theta + step) - make(theta - step)) / 2e-6
            assert found[..., k] == pytest.approx(expected, rel=1e-4, abs=1e-6 * np.abs(found).max())


def test_a_total_time_derivative_in_the_lagrangian_changes_no_row() -> None:
    """𝓛 + d/dt χ(q) with χ = y²: A_y is linear in y."""
    lines = (Coordinate("x", "m"), Coordinate("y", "m"))
    spec, weights = random_model(3, lines)
    assert spec.scales is not None
    scales = replace(spec.scales, position=(1.0, 1.0), centre=(0.0, 0.0), reach=(3.0, 3.0))
    networks = StructuredNetworks(replace(spec, scales=scales))
    rows = Weak.all(networks, smooth(lines))
    gauge = {name: array.copy() for name, array in weights.items()}
    gauge["lagrangian.output"][spec.layout.outputs.index(("A", 1, 1)), 2] += 5.0
    here, there = (networks.pack(w) for w in (dict(weights), gauge))
    assert np.abs(here - there).max() == 5.0
    assert rows.residual(there) == pytest.approx(rows.residual(here), abs=1e-10)
    assert rows.inertia(there) == pytest.approx(rows.inertia(here), abs=1e-12)


def test_accelerations_are_not_looked_at() -> None:
    data = motor_cart_dataset(1.0)
    one, other = (structured_spec(x, OPTIONS, 0, objective="weak") for x in (data, blind(data)))
    assert one[0] == other[0]
    assert all((one[1].weights[name] == array).all() for name, array in other[1].weights.items())


# ── windows ──────────────────────────────────────────────────────────────────────────────────────────────


def test_windows_integrate_over_uneven_steps() -> None:
    data = smooth(SOLENOID)
    uneven = Dataset(
        data.frame[np.random.default_rng(0).random(len(data)) < 0.8].reset_index(drop=True), SOLENOID
    )
    tested = windows(uneven)
    time = tested.time
    one, other, held = (np.zeros(len(tested)) for _ in range(3))
    for piece in tested.pieces():
        one[piece.windows] += piece.slope @ np.sin(5 * time[piece.rows])
        other[piece.windows] += piece.phi @ (5 * np.cos(5 * time[piece.rows]))
        held[piece.windows] += piece.held.sum(axis=1)
    assert one == pytest.approx(-other, abs=0.05 * np.abs(one).max())  # ∫ (φ f)˙ dt = 0
    assert held == pytest.approx(float(INTEGRAL(1) - INTEGRAL(-1)), rel=1e-12)


def test_short_trajectories_have_windows_of_their_own() -> None:
    frames = [motor_cart(seconds=4.0), motor_cart(seconds=0.2, trajectory=1), motor_cart(trajectory=2)[:5]]
    tested = windows(Dataset(pd.concat(frames), MOTOR_CART))
    second = (tested.first >= 2001) & (tested.end <= 2001 + 101)
    assert second.sum() > 10
    assert tested.end.max() <= 2001 + 101  # five rows beside thousands would be noise alone
    assert 13 < tested.overlap <= 17
    assert len(tested.thin(20)) <= 20


def test_data_without_a_window_are_an_error() -> None:
    frames = [motor_cart(seconds=1.0, trajectory=k).iloc[4 * k : 4 * k + 4] for k in range(20)]
    data = Dataset(pd.concat(frames), MOTOR_CART)
    with pytest.raises(DataError, match="the longest trajectory has 4 rows, expected at least 5"):
        train(data, data, OPTIONS, 0, objective="weak")


def test_usual_accelerations_are_seen_through_noise() -> None:
    data = motor_cart_dataset()
    expected = np.sqrt(np.mean(data.arrays.a**2, axis=0))
    for level in (0.0, 0.01, 0.05):
        assert usual_accelerations(blind(data, level))[0] == pytest.approx(expected, rel=0.5)


# ── what is learned ──────────────────────────────────────────────────────────────────────────────────────


def test_the_motor_cart_is_learned_without_accelerations() -> None:
    model, test = learned(0.0), Dataset(motor_cart(2.0, seconds=10.0, seed=99), MOTOR_CART)
    assert model.provenance["objective"] == "weak: as the scenario says"
    assert rollout(model, test, 10.0) < 3e-4
    assert loss(Weak.all(StructuredNetworks(model.spec), blind(test)), pack(model)) < 1e-7


def pack(model: TrainedModel) -> np.ndarray:
    return StructuredNetworks(model.spec).pack(dict(model.weights))


def test_noise_is_averaged_over_windows() -> None:
    test = Dataset(motor_cart(2.0, seconds=10.0, seed=99), MOTOR_CART)
    assert rollout(learned(0.01), test, 10.0) < 0.15


def test_a_solenoid_is_learned_without_accelerations() -> None:
    data = solenoid_dataset()
    model = train(*split(blind(data), 0.8, 10, 1), OPTIONS, 1, objective="weak")
    mass = evaluate(model.system.mass_matrix, *data.arrays[:2], np.zeros(0))
    expected = 0.05 + 0.05 / (1 + data.frame["x"].to_numpy() / 0.03)
    inner = data.frame["x"].between(*np.quantile(data.frame["x"], [0.02, 0.98])).to_numpy()
    assert np.abs(mass[inner, 1, 1] / expected[inner] - 1).max() < 1e-2
    assert np.abs(mass[inner, 0, 0] / 0.1 - 1).max() < 1e-2


@pytest.mark.parametrize(
    "factors",
    [
        {"i": 1e3, "i_dot": 1e3, "v": 1e-3},  # A → mA, and V → W/mA
        {"time": 1e3, "alpha_dot": 1e-3, "i": 1e-3, "alpha_ddot": 1e-6, "i_dot": 1e-6},  # s → ms
    ],
    ids=["amperes", "seconds"],
)
def test_units_do_not_change_what_is_learned(factors: dict[str, float]) -> None:
    data = blind(motor_cart_dataset(1.0))
    other = data.frame.assign(**{name: factor * data.frame[name] for name, factor in factors.items()})
    losses = []
    for parts in (split(data, 0.8, 10, 0), split(Dataset(other, MOTOR_CART), 0.8, 10, 0)):
        spec, start = structured_spec(parts[0], OPTIONS, 0, objective="weak")
        iterates = iterate_structured(spec, start, *parts, OPTIONS, "weak")
        losses.append([now.loss for now, _ in zip(iterates, range(6), strict=False)])
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)


def test_curves_have_bands_that_hold_the_truth() -> None:
    data = blind(motor_cart_dataset(), 0.0)
    table = curves(learned(0.0), data)
    mass = table[table["curve"] == "M_11"]
    true = 0.1 + 0.04 * np.sin(mass["at"].to_numpy()) ** 2
    assert mass["value"].to_numpy() == pytest.approx(true, rel=3e-3)
    noisy = curves(learned(0.01), blind(motor_cart_dataset(), 0.01))
    wide, narrow = (
        (t[t["curve"] == "M_11"]["high"] - t[t["curve"] == "M_11"]["low"]).max() for t in (noisy, table)
    )
    assert 0 < narrow < 0.1 * wide


def test_the_report_card_tells_the_objective() -> None:
    data = blind(motor_cart_dataset())
    card = report_card(learned(0.0), data, [data], Identify(), {}, "weak")
    assert card.texts["learn.objective"] == "weak: as the scenario says"

"""Networks too large for Levenberg–Marquardt: which optimiser, whether it is right, within what memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pandas as pd
import pytest
from learn_helpers import MOTOR_CART, motor_cart_dataset, multisine, simulate, solenoid_dataset

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.learn import structured
from exlinn_fmi.learn.assembly import inverse_assembly
from exlinn_fmi.learn.lbfgs import ROUND, lbfgs
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Inverse, Objective
from exlinn_fmi.learn.structured import LARGE, optimiser, structured_spec
from exlinn_fmi.learn.train import TrainProgress, train
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.scenario.learning import Structured

OPTIONS = Structured(preset="structured")
DRIVEN = (Coordinate("phi", "rad", topology="circle", input="tau", input_unit="N*m"),)


def cogging_dataset(seed: int = 1) -> Dataset:
    """A motor with magnets: a potential of many harmonics, which the direct path cannot hold."""
    import casadi as ca

    def lagrangian(q: ca.SX, v: ca.SX, p: ca.SX) -> ca.SX:
        magnets = sum(ca.cos(k * q[0] + k**2) / k for k in range(2, 9))
        return (0.05 + 0.01 * ca.cos(3 * q[0])) * v[0] ** 2 - 0.2 * magnets

    system = LagrangianSystem.build(DRIVEN, lagrangian, lambda v, p: 0.05 * v[0] ** 2)
    time = np.arange(1601) * 5e-3
    frames = [
        simulate(
            system, multisine(1.0, (0.3, 4), 20, sign * 0.5, seed + k, time)[:, None], 5e-3, trajectory=k
        )
        for k, sign in enumerate((1, -1))
    ]
    return Dataset(pd.concat(frames), DRIVEN)


def objective(
    data: Dataset, hidden: int = 8, regularisation: float = 1e-3, off: float = 0.1
) -> tuple[Objective, np.ndarray]:
    """The objective of networks, and weights off their start."""
    spec, start = structured_spec(data, OPTIONS.model_copy(update={"hidden": hidden}), 0)
    networks = StructuredNetworks(spec)
    theta = networks.pack(start.weights)
    theta += off * np.random.default_rng(0).standard_normal(len(theta))
    return Objective(Inverse(networks, inverse_assembly(spec, data.arrays)), regularisation), theta


# ── which ────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_number_of_weights_chooses() -> None:
    assert optimiser(OPTIONS, LARGE)[0] == "levenberg-marquardt"
    assert optimiser(OPTIONS, LARGE + 1) == ("l-bfgs", f"l-bfgs: {LARGE + 1} weights, more than {LARGE}")


@pytest.mark.parametrize("word", ["levenberg-marquardt", "l-bfgs"])
def test_the_scenario_has_the_last_word(word: str) -> None:
    options = OPTIONS.model_copy(update={"optimiser": word, "iterations": 2})
    assert optimiser(options, 10) == optimiser(options, 10**6) == (word, f"{word}: as the scenario says")


# ── whether it is right ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("data", [motor_cart_dataset(1.0), solenoid_dataset(), cogging_dataset()])
def test_gradient_and_value_are_those_of_the_linearised_objective(data: Dataset) -> None:
    whole, theta = objective(data)
    value, gradient = whole.gradient(theta)
    at = whole.linearise(theta)
    assert value == pytest.approx(whole.value(theta), rel=1e-9)
    expected = 2 * at.factor.T @ at.right
    assert gradient == pytest.approx(expected, rel=1e-6, abs=1e-9 * np.abs(expected).max())


def test_sizes_are_those_of_the_columns() -> None:
    whole, theta = objective(cogging_dataset())
    assert whole.sizes(theta) + whole.regularisation == pytest.approx(whole.linearise(theta).sizes, rel=1e-9)


def test_lbfgs_finds_the_minimum_of_a_narrow_valley() -> None:
    def rosenbrock(x: np.ndarray) -> tuple[float, np.ndarray]:
        bend = x[1:] - x[:-1] ** 2
        slope = np.zeros_like(x)
        slope[1:] += 200 * bend
        slope[:-1] -= 400 * bend * x[:-1] + 2 * (1 - x[:-1])
        return float(np.sum(100 * bend**2 + (1 - x[:-1]) ** 2)), slope

    steps = list(lbfgs(np.full(20, -1.0), rosenbrock, np.ones_like))
    assert steps[-1].theta == pytest.approx(np.ones(20), abs=1e-6)
    values = [step.value for step in steps]
    assert values == sorted(values, reverse=True)
    assert len(steps) < 200 / ROUND


def test_lbfgs_stays_where_nothing_is_gained() -> None:
    assert len(list(lbfgs(np.zeros(3), lambda x: (float(x @ x), 2 * x), np.ones_like))) == 1


def test_lbfgs_ends_where_the_objective_is_not_finite() -> None:
    assert len(list(lbfgs(np.ones(3), lambda x: (np.nan, x), np.ones_like))) == 1


# ── how far, and within what memory ──────────────────────────────────────────────────────────────────────


def peak() -> float:
    """Most memory since `tracemalloc.start` [MB]."""
    return tracemalloc.get_traced_memory()[1] / 2**20


def test_thousands_of_weights_descend_without_a_matrix_of_their_square() -> None:
    whole, theta = objective(cogging_dataset(), 300, 0.0, off=0.0)
    before = whole.value(theta)
    tracemalloc.start()
    steps = [step for step, _ in zip(lbfgs(theta, whole.gradient, whole.sizes), range(6), strict=False)]
    held = peak()
    tracemalloc.stop()
    assert len(theta) > 1.5 * LARGE
    assert steps[-1].value < 1e-2 * before
    assert held * 2**20 < 8 * len(theta) ** 2  # Levenberg–Marquardt holds several of this size


def test_a_large_network_is_trained_to_a_small_validation_loss_in_bounded_memory() -> None:
    parts = split(cogging_dataset(), 0.8, 10, 0)
    tracemalloc.start()
    model = train(*parts, OPTIONS.model_copy(update={"hidden": 300, "iterations": 6}), 0)
    held = peak()
    tracemalloc.stop()
    assert model.provenance["optimiser"].startswith("l-bfgs")
    assert model.provenance["validation_loss"] < 1e-9
    assert held < 200


def test_a_stop_keeps_the_best_weights_so_far() -> None:
    seen: list[TrainProgress] = []
    options = OPTIONS.model_copy(update={"optimiser": "l-bfgs"})
    model = train(
        *split(cogging_dataset(), 0.8, 10, 0), options, 0, seen.append, lambda: seen[-1].iteration == 20
    )
    assert model.status == "interrupted"
    assert model.history["stage"].iloc[-1] == "hidden"
    assert model.provenance["loss"] * model.provenance["validation_loss"] == min(
        p.loss * p.validation_loss for p in seen
    )


def test_under_noise_a_large_network_is_fitted_to_trajectories_but_for_its_hidden_units(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(structured, "LARGE", 20)
    frame = motor_cart_dataset(1.0).frame.copy()
    states = ["alpha", "alpha_dot", "i"]
    random = np.random.default_rng(0)
    frame[states] += 0.01 * frame[states].std().to_numpy() * random.standard_normal((len(frame), 3))
    parts = split(Dataset(frame, MOTOR_CART), 0.8, 10, 0)
    options = OPTIONS.model_copy(update={"hidden": 2, "iterations": 12})
    spec, start = structured_spec(parts[0], options, 0)
    iterates = list(structured.iterate_structured(spec, start, *parts, options))
    assert "only the direct path's are fitted to trajectories" in iterates[-1].notes["objective"]

"""Networks refined on noisy trajectories: when, how, and whether it helps."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
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
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.structured import begin, choose
from exlinn_fmi.learn.train import TrainedModel, train
from exlinn_fmi.learn.trajectory import Shooting, cut
from exlinn_fmi.scenario.learning import Objective, Structured

OPTIONS = Structured(preset="structured", hidden=2, iterations=20)
STATES = ["alpha", "alpha_dot", "i"]


@lru_cache
def noisy(level: float) -> Dataset:
    """Two runs of the motor with noise on all states, and no accelerations."""
    frame = motor_cart_dataset(2.0).frame.copy()
    frame[STATES] += (
        level * frame[STATES].std().to_numpy() * np.random.default_rng(0).standard_normal((len(frame), 3))
    )
    columns = {name: frame[name] for name in ("time", "trajectory", *STATES, "v")}
    return Dataset.from_columns(columns, MOTOR_CART)


@lru_cache
def learned(objective: Objective) -> TrainedModel:
    return train(*split(noisy(0.02), 0.8, 10, 0), OPTIONS, 0, objective=objective)


def rollout(model: TrainedModel) -> float:
    test = Dataset(motor_cart(seconds=2.0, seed=9), MOTOR_CART)
    return max(nrmse(model.system, test, free_run(model.system, test), 2.0).values())


def test_noise_makes_auto_go_on_to_trajectories_and_the_model_better() -> None:
    model = learned("auto")
    assert list(dict.fromkeys(model.history["stage"]))[-1].startswith("trajectory")
    assert "noise, the most of all states" in model.provenance["objective"]
    assert rollout(model) < rollout(learned("inverse")) / 1.5


def test_noise_is_begun_with_by_the_weak_form() -> None:
    assert learned("auto").provenance["objective"].endswith("; from a start by 'weak'")
    exact, short = motor_cart_dataset(1.0), noisy(0.02).select([0])
    assert begin("auto", exact, exact) == begin("trajectory", exact, exact) == "inverse"
    assert begin("auto", short, Dataset(short.frame[:4], MOTOR_CART)) == "inverse"  # no window to judge by
    assert begin("inverse", short, short) == "inverse"


def test_a_noisy_solenoid_is_learned_from_there() -> None:
    frame, random = solenoid_dataset().frame, np.random.default_rng(0)
    states = ["x", "x_dot", "i"]
    frame[states] += 0.01 * frame[states].std().to_numpy() * random.standard_normal((len(frame), 3))
    columns = {name: frame[name] for name in ("time", "trajectory", *states, "v")}
    options = Structured(preset="structured", iterations=100)
    model = train(*split(Dataset.from_columns(columns, SOLENOID), 0.8, 10, 0), options, 0)
    test = solenoid_dataset(seed=7)
    assert max(nrmse(model.system, test, free_run(model.system, test), 2.0).values()) < 0.02


def test_the_losses_are_those_of_noise() -> None:
    assert learned("auto").provenance["loss"] == pytest.approx(1, abs=0.15)
    assert learned("auto").provenance["validation_loss"] == pytest.approx(1, abs=0.25)


def test_hidden_units_stay_out_where_the_direct_path_explains_all() -> None:
    model = learned("auto")
    hidden = model.spec.layout.basis - model.spec.layout.hidden
    assert not model.weights["lagrangian.output"][:, hidden:].any()


def test_the_scenario_has_the_last_word() -> None:
    model = learned("inverse")
    assert model.provenance["objective"] == "inverse: as the scenario says"
    assert not model.history["stage"].str.contains("trajectory").any()
    model = learned("weak")
    assert model.provenance["objective"] == "weak: as the scenario says"
    assert not model.history["stage"].str.contains("trajectory").any()


def test_clean_looking_states_that_do_not_fit_the_accelerations_are_told_of() -> None:
    clean = motor_cart_dataset(1.0)
    assert (
        choose("auto", clean)[1]
        == "inverse: the states are clean and the accelerations do not contradict them"
    )
    chosen, why = choose("auto", clean, loss=0.01)
    assert chosen == "inverse"
    assert "10 % of forces do not fit the accelerations: noise that was filtered looks like motion" in why


def test_weights_that_are_not_chosen_stay_0() -> None:
    spec, weights = random_model(0, MOTOR_CART)
    whole = StructuredNetworks(spec)
    mask = whole.pack_mask(spec.layout.direct)
    part = StructuredNetworks(spec, mask)
    assert part.size == mask.sum()
    assert (whole.pack(part.unpack(whole.pack(dict(weights))[mask]))[~mask] == 0).all()


def test_gradient_and_matrix_of_networks_are_those_of_the_sum_of_squares() -> None:
    spec, weights = random_model(0, MOTOR_CART, hidden=1)
    networks = StructuredNetworks(spec)
    data = Dataset(noisy(0.02).frame[:60], MOTOR_CART)
    shooting = Shooting(networks, cut(data, STATES, ["v"]), prior=3.0)
    theta = shooting.start(networks.pack(dict(weights)))
    at = shooting.normal(theta)
    assert at.value == pytest.approx(shooting.value(theta))
    for k in range(len(theta)):
        step = np.zeros_like(theta)
        step[k] = 1e-6
        slope = (shooting.value(theta + step) - shooting.value(theta - step)) / 2e-6
        assert 2 * at.gradient[k] == pytest.approx(slope, rel=1e-3, abs=1e-5 * np.abs(at.gradient).max())
    assert np.linalg.eigvalsh(at.matrix).min() > 0  # the prior holds what the data leave free

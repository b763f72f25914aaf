"""The paper's learner: features into ReLU networks, trained by Adam."""

from __future__ import annotations

from functools import cache

import numpy as np
import pandas as pd
import pytest
import torch
from learn_helpers import MOTOR_CART, simulate

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.card import force_error
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.paper import _Data, _Pair, paper_spec
from exlinn_fmi.learn.train import TrainedModel, train
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.learning import Paper

OPTIONS = Paper(
    preset="paper",
    lagrangian_features=["alpha_dot^2", "sin(alpha)^2*alpha_dot^2", "i^2", "i*alpha"],
    dissipation_features=["alpha_dot^2", "i^2"],
)


def excited(voltage: np.ndarray, step: float) -> pd.DataFrame:
    return simulate(PLANT.system, np.column_stack([0 * voltage, voltage]), step)


@cache
def data() -> Dataset:
    """The paper's excitation, every fifth sample."""
    return Dataset(excited(4 + np.sin(2 * np.arange(0, 10, 5e-3)), 5e-3), MOTOR_CART)


@cache
def learned() -> TrainedModel:
    return train(*split(data(), 0.8, 10, 0), OPTIONS.model_copy(update={"epochs": 60}), 0)


def test_forces_are_learned() -> None:
    time = np.arange(0, 2, 5e-3)
    test = Dataset(excited(4 + np.cos(7 * time), 5e-3), MOTOR_CART)
    assert np.mean(force_error(learned().system, test) ** 2) < 1e-2


def test_mass_matrix_is_positive_definite_even_at_rest() -> None:
    mass = evaluate(learned().system.mass_matrix, np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(0))
    assert np.linalg.eigvalsh(mass[0]).min() > 0


def test_every_epoch_is_in_the_history() -> None:
    assert list(learned().history["iteration"]) == list(range(61))
    assert learned().status == "iterations"


def test_the_fast_residual_is_that_of_the_casadi_system() -> None:
    spec = paper_spec(data(), OPTIONS)
    pair = _Pair(spec, 3)
    from exlinn_fmi.mechanics.learned import learned_system

    residual, _ = pair.residual(_Data.of(spec, data()))
    expected = force_error(learned_system(spec, pair.weights()), data())
    assert residual.numpy() == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())


def test_the_gradient_by_hand_is_that_of_autograd() -> None:
    spec = paper_spec(data(), OPTIONS)
    pair, batch = _Pair(spec, 4), _Data.of(spec, data()).rows(slice(100, 164))
    pair.backward(batch)
    by_hand = pair.gradient.clone()
    flat = pair.flat.clone().requires_grad_()
    start = 0
    slopes = []
    for network in pair.networks:
        own = flat[start : start + network.size]
        weight, output = own[: -spec.hidden].view(spec.hidden, -1), own[-spec.hidden :]
        inputs = batch.features[:, network.features].clone().requires_grad_()
        value = torch.relu(inputs @ weight.T + network.bias) @ output
        slopes.append(torch.autograd.grad(value.sum(), inputs, create_graph=True)[0])
        start += network.size
    force = (batch.terms @ torch.cat(slopes, 1).unsqueeze(2)).squeeze(2)
    (force - batch.force).square().mean().backward()
    assert by_hand.numpy() == pytest.approx(flat.grad.numpy(), rel=1e-4, abs=1e-6)


def test_a_feature_that_cannot_be_read_is_refused() -> None:
    with pytest.raises(ModelError, match="unknown name 'beta'"):
        paper_spec(data(), OPTIONS.model_copy(update={"lagrangian_features": ["beta^2"]}))


def test_a_proper_mass_matrix_goes_before_a_smaller_loss() -> None:
    improper, proper = Iterate({}, 0.0, 0.1, "epoch", False), Iterate({}, 0.0, 0.2, "epoch", True)
    assert proper.rank < improper.rank

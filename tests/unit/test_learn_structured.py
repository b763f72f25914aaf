"""The structured learner on systems that it knows nothing of but their coordinates."""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import numpy as np
import pandas as pd
import pytest
from learn_helpers import MOTOR_CART, motor_cart, motor_cart_dataset, solenoid_dataset

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.errors import DataError, TrainingError
from exlinn_fmi.learn.card import force_error
from exlinn_fmi.learn.identify import identify
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Inverse
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.start import linear_start
from exlinn_fmi.learn.structured import iterate_structured, structured_spec
from exlinn_fmi.learn.train import TrainedModel, TrainProgress, train
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.scenario.learning import Identify, Structured

OPTIONS = Structured(preset="structured")
SHORT = OPTIONS.model_copy(update={"iterations": 5})


@cache
def learned(seed: int) -> TrainedModel:
    return train(*split(motor_cart_dataset(), 0.8, 10, seed), OPTIONS, seed)


@cache
def unseen() -> Dataset:
    return Dataset(motor_cart(2.0, seconds=10.0, seed=99), MOTOR_CART)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_forces_of_the_motor_cart_are_learned_from_any_seed(seed: int) -> None:
    assert np.mean(force_error(learned(seed).system, unseen()) ** 2) < 1e-15


def test_a_free_run_stays_with_the_plant_for_ten_seconds() -> None:
    system = learned(0).system
    errors = nrmse(system, unseen(), free_run(system, unseen()), 10.0)
    assert max(errors.values()) < 1e-6


def test_training_says_how_it_ended_and_what_it_was_made_of() -> None:
    model = learned(0)
    assert model.status == "converged"
    assert list(model.history["iteration"]) == list(range(len(model.history)))
    assert model.provenance["seed"] == 0
    assert model.provenance["method"]["preset"] == "structured"
    rank = model.history["loss"] * model.history["validation_loss"]
    assert model.provenance["loss"] * model.provenance["validation_loss"] == rank.min()
    assert len(model.provenance["data_sha256"]) == 64


def test_the_same_seed_gives_the_same_weights() -> None:
    again = train(*split(motor_cart_dataset(), 0.8, 10, 1), OPTIONS, 1)
    assert all((again.weights[name] == array).all() for name, array in learned(1).weights.items())


@pytest.mark.parametrize("seed", range(6))
def test_a_solenoid_is_learned_by_the_same_code_from_any_seed(seed: int) -> None:
    options = OPTIONS.model_copy(update={"iterations": 60})
    model = train(*split(solenoid_dataset(), 0.8, 10, seed), options, seed)
    test = solenoid_dataset(seed=7)
    inner = test.frame["x"].between(*np.quantile(solenoid_dataset().frame["x"], [0.02, 0.98]))
    error = force_error(model.system, test)[inner.to_numpy()]
    assert np.mean(error[:, 1] ** 2) < 1e-8 * test.frame["v"].var()
    mass = evaluate(model.system.mass_matrix, *test.arrays[:2], np.zeros(0))
    assert np.abs(mass[:, 0, 0] / 0.1 - 1).max() < 1e-3


def test_parameters_are_found_without_accelerations_though_inputs_jump_from_row_to_row() -> None:
    full = motor_cart_dataset()
    columns = {name: full.frame[name] for name in full.frame if name not in ("alpha_ddot", "i_dot")}
    data = Dataset.from_columns(columns, MOTOR_CART)
    model = train(*split(data, 0.8, 10, 0), OPTIONS, 0, objective="inverse")
    terms = Identify(
        lagrangian={"j": "0.5*alpha_dot^2", "l": "0.5*i^2", "k": "i*alpha"},
        dissipation={"b": "0.5*alpha_dot^2", "r": "0.5*i^2"},
    )
    terms.lagrangian["m"] = "0.5*sin(alpha)^2*alpha_dot^2"
    found = identify(model.system, data, terms, {}).parameters.set_index("name")["identified"]
    expected = {"j": 0.1, "l": 1.0, "k": 1.0, "m": 0.04, "b": 0.5, "r": 5.0}
    assert found.to_dict() == pytest.approx(expected, rel=1e-3)


def test_units_do_not_change_what_is_learned() -> None:
    millis = motor_cart_dataset().frame.copy()
    coordinates = (MOTOR_CART[0], MOTOR_CART[1])
    for name, factor in {"i": 1e3, "i_dot": 1e3, "v": 1e-3}.items():  # A → mA, and V → W/mA
        millis[name] *= factor
    scaled = train(*split(Dataset(millis, coordinates), 0.8, 10, 0), OPTIONS, 0)
    one, other = (learned(0).history, scaled.history)
    assert other["loss"].head(10).to_numpy() == pytest.approx(one["loss"].head(10).to_numpy(), rel=1e-6)


# ── progress and stopping ────────────────────────────────────────────────────────────────────────────────


def test_progress_is_told_after_every_iteration() -> None:
    seen: list[TrainProgress] = []
    model = train(*split(motor_cart_dataset(1.0), 0.8, 10, 0), SHORT, 0, seen.append)
    assert [p.loss for p in seen] == list(model.history["loss"])
    assert all(0 <= p.fraction <= 1 for p in seen)


def test_a_stop_keeps_the_best_weights_so_far() -> None:
    seen: list[TrainProgress] = []
    parts = split(motor_cart_dataset(1.0), 0.8, 10, 0)
    model = train(*parts, OPTIONS, 0, seen.append, lambda: len(seen) == 4)
    assert model.status == "interrupted"
    assert len(model.history) == 4
    assert model.provenance["validation_loss"] in [p.validation_loss for p in seen]
    spec, start = structured_spec(parts[0], OPTIONS, 0)
    iterates = [it for it, _ in zip(iterate_structured(spec, start, *parts, OPTIONS), range(4), strict=False)]
    best = min(iterates, key=lambda it: it.rank)
    assert all((model.weights[name] == array).all() for name, array in best.weights.items())


def test_iterations_end_training() -> None:
    model = train(
        *split(motor_cart_dataset(1.0), 0.8, 10, 0), OPTIONS.model_copy(update={"iterations": 3}), 0
    )
    assert model.status == "iterations"
    assert model.history["iteration"].iloc[-1] == 3


def test_training_refuses_data_without_excitation() -> None:
    still = motor_cart_dataset(1.0).frame.assign(alpha=1.0)
    with pytest.raises(DataError, match="'alpha' is 1 in all"):
        train(Dataset(still, MOTOR_CART), Dataset(still, MOTOR_CART), OPTIONS, 0)


def test_training_that_is_never_finite_is_an_error() -> None:
    good = motor_cart_dataset(1.0)
    huge = Dataset(good.frame.assign(i_dot=good.frame["i_dot"] * 1e200), MOTOR_CART)
    with pytest.raises(TrainingError, match="not finite in any iteration"), np.errstate(all="ignore"):
        train(good, huge, SHORT, 0)


def test_the_structured_learner_does_without_torch() -> None:
    code = "import sys, exlinn_fmi.learn.structured, exlinn_fmi.learn.card, exlinn_fmi.learn.weights; "
    code += "raise SystemExit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# ── the start ────────────────────────────────────────────────────────────────────────────────────────────


def test_a_start_on_noise_has_a_mass_matrix_nevertheless() -> None:
    noise = motor_cart_dataset(1.0).frame.copy()
    random = np.random.default_rng(0)
    for name in ("alpha_ddot", "i_dot", "v", "i"):
        noise[name] = random.standard_normal(len(noise))
    data = Dataset(noise, MOTOR_CART)
    spec, start = structured_spec(data, OPTIONS, 0)
    assert min(start.epsilon) > 0
    assert all(np.isfinite(array).all() for array in start.weights.values())
    assert spec.epsilon == start.epsilon


def test_a_negative_mass_in_the_data_is_not_believed() -> None:
    from exlinn_fmi.learn.assembly import inverse_assembly

    data = motor_cart_dataset(1.0)
    odd = Dataset(data.frame.assign(i_dot=-data.frame["i_dot"]), MOTOR_CART)
    spec, _ = structured_spec(odd, OPTIONS, 0)
    start = linear_start(Inverse(StructuredNetworks(spec), inverse_assembly(spec, odd.arrays)), 0)
    rows = spec.layout.rows[1]
    assert start.weights["lagrangian.output"][rows, 0].any()


def test_history_holds_the_stages_in_order() -> None:
    stages = pd.unique(learned(0).history["stage"])
    assert list(stages) == ["direct", "all"]

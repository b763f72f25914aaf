"""Identification and report card, judged on the plant itself: as good as a learned model can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from learn_helpers import MOTOR_CART, motor_cart, motor_cart_dataset, random_model

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.card import report_card
from exlinn_fmi.learn.identify import identify, true_value
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.train import TrainedModel
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.learning import Identify

TRUTH = {p.name: p.value for p in PLANT.parameters}
OPTIONS = Identify(
    lagrangian={
        "j_m": "0.5*alpha_dot^2",
        "m_c*d^2": "0.5*sin(alpha)^2*alpha_dot^2",
        "l": "0.5*i^2",
        "k_e": "i*alpha",
    },
    dissipation={"b_m": "0.5*alpha_dot^2", "r": "0.5*i^2"},
)


def plant() -> LagrangianSystem:
    """The plant with its parameters built in and without a torque from outside, as if it had been learned."""
    p = PLANT.system.parameter_values
    return LagrangianSystem.build(
        MOTOR_CART,
        lambda q, v, _: PLANT.system.lagrangian(q, v, p),
        lambda v, _: PLANT.system.dissipation(v, p),
    )


class Known(TrainedModel):
    """A learned model that is the plant."""

    system = plant()  # type: ignore[assignment]


def known(kind: type[TrainedModel] = Known) -> TrainedModel:
    spec, weights = random_model(0, MOTOR_CART)
    return kind(spec, dict(weights), pd.DataFrame(), "converged", 1.5, {})


TRAIN = motor_cart_dataset(1.0)
TEST = Dataset(motor_cart(seconds=10.0, seed=5), MOTOR_CART)
CARD = report_card(known(), TRAIN, [TEST], OPTIONS, TRUTH)


# ── identification ───────────────────────────────────────────────────────────────────────────────────────


def test_the_plants_parameters_are_read_off_the_plant() -> None:
    table = identify(plant(), TRAIN, OPTIONS, TRUTH).parameters
    assert list(table["name"]) == ["j_m", "m_c*d^2", "l", "k_e", "b_m", "r"]
    assert table["rel_error"].max() < 1e-10


def test_the_misfit_of_the_true_monomials_is_nil() -> None:
    assert identify(plant(), TRAIN, OPTIONS, TRUTH).misfit < 1e-12


def test_monomials_that_do_not_explain_the_model_have_a_misfit() -> None:
    few = Identify(lagrangian={"l": "0.5*i^2"}, dissipation={})
    assert identify(plant(), TRAIN, few, TRUTH).misfit > 0.1


def test_what_cannot_be_told_apart_is_no_number() -> None:
    lagrangian = OPTIONS.lagrangian | {"extra": "cos(alpha)^2*alpha_dot^2"}
    twofold = OPTIONS.model_copy(update={"lagrangian": lagrangian})
    table = identify(plant(), TRAIN, twofold, TRUTH).parameters.set_index("name")
    lost = {"j_m", "m_c*d^2", "extra"}
    assert table["identified"].isna().to_dict() == {name: name in lost for name in table.index}
    assert table.loc["l", "rel_error"] < 1e-10


def test_a_monomial_without_effect_is_no_number() -> None:
    table = identify(plant(), TRAIN, Identify(lagrangian={"idle": "i"}), {}).parameters
    assert table["identified"].isna().all()


def test_an_unknown_monomial_is_refused() -> None:
    with pytest.raises(ModelError, match="did you mean 'alpha_dot'"):
        identify(plant(), TRAIN, Identify(lagrangian={"j": "alpha_dt^2"}), {})


@pytest.mark.parametrize(("name", "value"), [("j_m", 0.1), ("m_c*d^2", 0.04), ("2*l", 2.0)])
def test_true_values_of_products_are_computed(name: str, value: float) -> None:
    assert true_value(name, TRUTH) == pytest.approx(value)


@pytest.mark.parametrize("name", ["unknown", "m_c*unknown", "j_m+l"])
def test_a_true_value_that_is_not_known_is_none(name: str) -> None:
    assert np.isnan(true_value(name, TRUTH))


# ── free runs ────────────────────────────────────────────────────────────────────────────────────────────


def test_a_free_run_of_the_plant_is_the_plant() -> None:
    run = free_run(plant(), TEST)
    assert run == pytest.approx(TEST.frame[["alpha", "alpha_dot", "i"]].to_numpy(), abs=1e-7)


def test_a_trajectory_that_is_too_short_is_not_judged() -> None:
    errors = nrmse(plant(), TRAIN.select([0]), free_run(plant(), TRAIN.select([0])), 2.0)
    assert all(np.isnan(value) for value in errors.values())


def test_a_single_row_is_a_run_of_no_step() -> None:
    single = Dataset(TEST.frame.head(1), MOTOR_CART)
    assert free_run(plant(), single).shape == (1, 3)
    assert all(np.isnan(value) for value in nrmse(plant(), single, free_run(plant(), single), 2.0).values())


def test_a_run_that_diverges_is_infinitely_bad() -> None:
    states = TEST.frame[["alpha", "alpha_dot", "i"]].to_numpy().copy()
    states[50:] = np.nan
    assert nrmse(plant(), TEST, states, 10.0) == {"alpha_dot": float("inf"), "i": float("inf")}


# ── the card ─────────────────────────────────────────────────────────────────────────────────────────────


def test_the_plant_gets_full_marks() -> None:
    metrics = CARD.metrics
    for name in ("force_mse_train", "force_mse_test", "force_mse_test_Q", "acceleration_mse_test"):
        assert metrics[f"learn.{name}"] < 1e-20
    assert metrics["learn.rollout_nrmse_2s"] < 1e-7
    assert metrics["learn.rollout_nrmse_10s"] < 1e-7
    assert metrics["learn.rollout_diverged"] == 0
    assert metrics["learn.mass_matrix_min_eigenvalue"] == pytest.approx(0.1, rel=1e-3)
    assert metrics["learn.seconds"] == 1.5
    assert metrics["identify.max_rel_error"] < 1e-10
    assert metrics["identify.m_c*d^2"] == pytest.approx(0.04)
    assert metrics["identify.r_rel_error"] < 1e-10


def test_the_worst_velocity_counts() -> None:
    each = [CARD.metrics[f"learn.rollout_nrmse_10s_{name}"] for name in ("alpha_dot", "i")]
    assert CARD.metrics["learn.rollout_nrmse_10s"] == max(each)


def test_a_horizon_takes_the_first_test_that_is_long_enough() -> None:
    metrics = report_card(known(), TRAIN, [TRAIN.select([0]), TEST], OPTIONS, TRUTH).metrics
    assert metrics["learn.rollout_nrmse_10s"] == CARD.metrics["learn.rollout_nrmse_10s"]


def test_without_tests_nothing_is_claimed() -> None:
    metrics = report_card(known(), TRAIN, [], Identify(), {}).metrics
    for name in ("force_mse_test", "acceleration_mse_test", "rollout_nrmse_2s", "rollout_nrmse_10s_i"):
        assert np.isnan(metrics[f"learn.{name}"])
    assert np.isnan(metrics["identify.max_rel_error"])


def test_an_error_that_should_be_known_and_is_not_is_not_hidden() -> None:
    options = OPTIONS.model_copy(update={"lagrangian": OPTIONS.lagrangian | {"d": "i"}})
    assert np.isnan(report_card(known(), TRAIN, [TEST], options, TRUTH).metrics["identify.max_rel_error"])


class Runaway(TrainedModel):
    """A learned model whose friction feeds energy in."""

    system = replace(
        plant(),
        dissipation=LagrangianSystem.build(
            MOTOR_CART, lambda q, v, _: 0, lambda v, _: -50 * (v[0] ** 4 + v[1] ** 4)
        ).dissipation,
    )  # type: ignore[assignment]


def test_a_model_that_runs_away_is_said_to() -> None:
    metrics = report_card(known(Runaway), TRAIN, [TEST], Identify(), {}).metrics
    assert metrics["learn.rollout_diverged"] == 1
    assert metrics["learn.rollout_nrmse_10s"] == float("inf")


def test_measured_and_learned_stand_side_by_side() -> None:
    pairs = ["alpha_dot", "i", "alpha_ddot", "i_dot", "v", "L", "D"]
    assert list(CARD.evaluation) == ["time", *(f"{n}{s}" for n in pairs for s in ("", "_learned"))]
    for name in pairs:
        assert CARD.evaluation[f"{name}_learned"].to_numpy() == pytest.approx(
            CARD.evaluation[name].to_numpy(), abs=1e-6
        )
    assert CARD.units["L_learned"] == "J"
    assert CARD.units["i_dot"] == "A/s"


def test_energies_that_were_not_measured_stand_alone() -> None:
    bare = Dataset(TEST.frame.drop(columns=["L", "D"]), MOTOR_CART)
    evaluation = report_card(known(), TRAIN, [bare], Identify(), {}).evaluation
    assert "L" not in evaluation
    assert "L_learned" in evaluation

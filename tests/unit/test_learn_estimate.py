"""Physical parameters from the data themselves: deviations, intervals, and what cannot be told."""

from __future__ import annotations

import numpy as np
import pytest
from test_learn_noise_trajectory import COORDINATES, clean, noisy

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.card import report_card
from exlinn_fmi.learn.estimate import estimate
from exlinn_fmi.learn.train import train
from exlinn_fmi.scenario.learning import Identify, Terms

OPTIONS = Identify(
    lagrangian={
        "j_m": "0.5*alpha_dot^2",
        "m_c*d^2": "0.5*sin(alpha)^2*alpha_dot^2",
        "l": "0.5*i^2",
        "k_e": "i*alpha",
    },
    dissipation={"b_m": "0.5*alpha_dot^2", "r": "0.5*i^2"},
)
TRUTH = {"j_m": 0.1, "m_c": 1.0, "d": 0.2, "l": 1.0, "k_e": 1.0, "b_m": 0.5, "r": 5.0}


@pytest.mark.parametrize(("objective", "width"), [("auto", 0.02), ("weak", 0.4), ("trajectory", 0.02)])
def test_intervals_hold_the_truth_and_are_narrow(objective, width) -> None:
    found = estimate(noisy(0.01, seed=4), OPTIONS, TRUTH, objective).identified
    assert found is not None
    table = found.parameters
    assert np.array(table["high"] - table["low"]) == pytest.approx(np.array(2 * 1.96 * table["std"]))
    assert ((table["high"] - table["low"]) / table["true"]).max() < width
    assert (np.abs(table["identified"] - table["true"]) < 5 * table["std"]).all() or objective == "weak"


def test_clean_data_are_fitted_to_rounding() -> None:
    found = estimate(clean(), OPTIONS, TRUTH, "inverse").identified
    assert found is not None
    assert found.parameters["rel_error"].max() < 1e-9


def test_what_cannot_be_told_apart_is_named_and_has_no_number() -> None:
    options = OPTIONS.model_copy(update={"lagrangian": OPTIONS.lagrangian | {"k_t": "2*alpha*i"}})
    identified, note = estimate(noisy(0.01), options, TRUTH, "auto")
    assert identified is not None
    table = identified.parameters.set_index("name")
    assert "k_e and k_t" in note
    assert table.loc[["k_e", "k_t"], ["identified", "std", "low"]].isna().all(axis=None)
    assert table.loc["j_m", "rel_error"] < 0.01


@pytest.mark.parametrize(
    ("lagrangian", "reason"),
    [
        ({"j_m": "0.5*alpha_dot^2", "l": "0.5*i^2"}, "predict nothing"),
        ({"j_m": "0.5*alpha_dot^2", "l": "0.5*i^2", "k_e": "alpha*i"}, "times the noise"),
    ],
)
def test_monomials_that_do_not_explain_the_data_give_no_estimate(lagrangian, reason) -> None:
    options = Identify(lagrangian=lagrangian, dissipation=OPTIONS.dissipation)
    identified, note = estimate(noisy(0.01), options, TRUTH, "auto")
    assert identified is None
    assert reason in note


def test_the_report_card_says_what_was_done_and_how_noisy_the_data_are() -> None:
    data = noisy(0.01)
    candidates = Terms(
        preset="terms",
        lagrangian=list(OPTIONS.lagrangian.values()),
        dissipation=list(OPTIONS.dissipation.values()),
    )
    model = train(data, data, candidates, seed=0)
    card = report_card(model, data, [clean()], OPTIONS, TRUTH)
    assert card.metrics["learn.noise_i"] == pytest.approx(0.01, rel=0.2)
    assert card.metrics["identify.k_e_std"] == pytest.approx(0.001, rel=0.9)
    assert card.texts["learn.objective"].startswith("trajectory")
    assert card.texts["identify.objective"].startswith("trajectory")
    assert "M_11 = 0.1" in card.texts["learn.terms"] or "M_11 = 0.09" in card.texts["learn.terms"]
    assert card.terms is not None
    assert len(card.terms) == 6


def test_steps_of_different_length_are_no_obstacle() -> None:
    left_out = np.random.default_rng(0).choice(np.arange(1, len(clean()) - 1), 100, replace=False)
    frame = clean().frame.drop(index=left_out)
    model = train(Dataset(frame, COORDINATES), clean(), Terms(preset="terms"), seed=0)
    assert model.provenance["objective"].startswith("inverse")
    assert model.provenance["validation_loss"] < 1e-15
    rough = noisy(0.01).frame.drop(index=left_out)
    assert estimate(Dataset(rough, COORDINATES), OPTIONS, TRUTH, "auto").note.startswith("trajectory")

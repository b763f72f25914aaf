"""The scenario with noisy data: the true terms, no others, and narrow intervals that hold the truth."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from exlinn_fmi.cli import exit_code

TRUE = {"j_m": 0.1, "m_c*d^2": 0.04, "l": 1.0, "k_e": 1.0, "b_m": 0.5, "r": 5.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("noisy")
    scenario = Path(__file__).parents[2] / "scenarios/dcwc_noisy.yaml"
    assert exit_code(["train", str(scenario), "--out", str(out)]) == 0
    assert exit_code(["report", str(out)]) == 0
    return out


def test_the_true_terms_and_no_others_are_found(folder) -> None:
    terms = pd.read_csv(folder / "terms.csv")
    assert set(terms["term"]) == {
        "0.5*alpha_dot^2",
        "0.5*i^2",
        "alpha*i",
        "0.5*sin(alpha)^2*alpha_dot^2",
    }
    assert len(terms) == 6


def test_parameters_come_with_narrow_intervals_near_the_truth(folder) -> None:
    table = pd.read_csv(folder / "parameters.csv").set_index("name")
    for name, true in TRUE.items():
        row = table.loc[name]
        assert abs(row["identified"] - true) < 4 * row["std"]
        assert row["high"] - row["low"] < 0.01 * true


def test_free_runs_stay_close(folder) -> None:
    metrics = json.loads((folder / "metrics.json").read_text("utf-8"))
    assert metrics["learn.rollout_nrmse_10s"] < 1e-3
    assert metrics["learn.noise_i"] == pytest.approx(0.01, rel=0.2)


def test_the_report_says_what_was_done_and_found(folder) -> None:
    html = (folder / "report.html").read_text("utf-8")
    assert "sin(alpha)^2" in html
    assert "trajectory:" in html
    assert "standard deviation" in html

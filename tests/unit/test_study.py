"""Robustness studies: what is drawn, and what the runs tell."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scenario_helpers import SCENARIO, problem, problems
from scipy.stats import kstest

from exlinn_fmi.results.robustness import study_charts
from exlinn_fmi.scenario.study import Choice, Normal, Range, Relative, Study
from exlinn_fmi.study import draw, summary, wilson

VARY = {
    "a": Relative(relative=0.1),
    "b": Relative(relative=0.1, shape="normal"),
    "c": Range(min=-1.0, max=3.0),
    "d": Normal(mean=2.0, std=0.5),
    "e": Choice(values=["none", 3, True]),
}
STUDY = Study(vary=VARY, seed=5)
NOMINAL = {"a": 2.0, "b": -4.0}


@pytest.fixture(scope="module")
def drawn() -> pd.DataFrame:
    return pd.DataFrame([draw(STUDY, NOMINAL, number) for number in range(1000)])


@pytest.mark.parametrize(
    ("name", "law"),
    [
        ("a", ("uniform", (1.8, 0.4))),
        ("b", ("norm", (-4.0, 0.4))),
        ("c", ("uniform", (-1.0, 4.0))),
        ("d", ("norm", (2.0, 0.5))),
    ],
)
def test_values_are_distributed_as_they_should(drawn, name, law):
    assert kstest(drawn[name].to_numpy(dtype=float), *law).pvalue > 1e-3


def test_choices_are_as_likely_as_each_other(drawn):
    assert sorted(map(str, drawn["e"].unique())) == ["3", "True", "none"]
    assert drawn["e"].map(str).value_counts().min() > 270


def test_values_do_not_hang_on_each_other(drawn):
    assert np.abs(np.corrcoef(drawn[list("abcd")].to_numpy(dtype=float).T) - np.eye(4)).max() < 0.12


def test_a_draw_depends_on_seed_and_number_alone():
    assert draw(STUDY, NOMINAL, 7) == draw(STUDY, NOMINAL, 7)
    assert draw(STUDY, NOMINAL, 7) != draw(STUDY, NOMINAL, 8)
    assert draw(STUDY, NOMINAL, 7) != draw(STUDY.model_copy(update={"seed": 6}), NOMINAL, 7)


def test_interval_of_a_share_is_wilsons():
    # R: binom::binom.confint(8, 10, methods = "wilson")
    assert wilson(8, 10) == pytest.approx((0.4901625, 0.9433178), abs=1e-6)
    assert wilson(0, 20)[0] == 0.0
    assert wilson(20, 20)[1] == 1.0


def runs() -> pd.DataFrame:
    """Ten runs, one of which failed."""
    return pd.DataFrame(
        {
            "run": range(10),
            "components.plant.start.r": np.linspace(4.5, 5.5, 10),
            "components.controller.nmpc.delay": ["none", "computation"] * 5,
            "control.rmse_x_m": [*np.arange(1.0, 10.0), np.nan],
            "control.violations": [0.0] * 8 + [3.0, np.nan],
            "control.decrease": [0.9] * 9 + [np.nan],
            "control.iterations_mean": 1.0,
            "success": [1.0] * 8 + [0.0, 0.0],
            "error": [""] * 9 + ["t = 1 s: NaN"],
        }
    )


def test_a_study_tells_successes_and_percentiles():
    found = summary(runs())
    assert (found["study.runs"], found["study.success_rate"], found["study.failed"]) == (10, 0.8, 1)
    assert found["study.success_rate_low"] == pytest.approx(0.4901625, abs=1e-6)
    assert (found["study.rmse_x_m_p50"], found["study.rmse_x_m_max"]) == (5.0, 9.0)
    assert found["study.runs_with_violations"] == 1
    assert (found["study.decrease_p50"], found["study.decrease_min"]) == (0.9, 0.9)
    assert not any("iterations" in key for key in found)


def test_charts_show_runs_and_what_the_error_hangs_on():
    varied = ["components.controller.nmpc.delay", "components.plant.start.r"]
    distribution, causes = study_charts(runs(), varied)
    assert [panel.name for panel in distribution.panels] == ["rmse x", "violations", "decrease"]
    assert len(distribution.panels[0].lines[0].y) == 9
    assert causes.panels[0].note == "plant.start.r: 4.5 … 5.5"
    assert causes.panels[1].note == "controller.nmpc.delay: computation … none"
    assert (causes.panels[0].name, causes.panels[0].unit) == ("rmse x", "m")


def test_a_study_without_results_has_no_charts():
    assert study_charts(pd.DataFrame({"run": []}), ["a"]) == [None, None]


# ── in a scenario ────────────────────────────────────────────────────────────────────────────────────────

STUDIED = SCENARIO + "study:\n  vary:\n    components.plant.start.b_m: {relative: 0.1}\n"
ENTRY = "components.plant.start.b_m: {relative: 0.1}"


def test_a_right_study_has_no_problem(tmp_path):
    assert problems(tmp_path, STUDIED) == ()


@pytest.mark.parametrize(
    ("new", "message"),
    [
        ("components.plant.start.b_n: {relative: 0.1}", "plant has no variable 'b_n'; did you mean 'b_m'?"),
        ("components.ctl.nmpc.horizn: {values: [20, 30]}", "no key 'horizn' in 'components.ctl.nmpc'"),
        ("components.plant.start.b_m: {min: 2, max: 1}", "expected min < max, found min 2 and max 1"),
        (
            "components.plant.start.b_m: {}",
            "nothing says how this is distributed; give one of the keys",
        ),
        ("components.plant.start.b_m: {relatve: 0.1}", "unknown key 'relatve'; did you mean 'relative'?"),
    ],
)
def test_what_varies_must_be_there(tmp_path, new, message):
    assert message in problem(tmp_path, ENTRY, new, STUDIED).message


def test_a_study_needs_a_closed_loop_to_run(tmp_path):
    at = STUDIED.index("simulate:\n")
    text = STUDIED[:at] + STUDIED[STUDIED.index("study:\n") :]
    assert any("there is no `simulate` section" in p.message for p in problems(tmp_path, text))

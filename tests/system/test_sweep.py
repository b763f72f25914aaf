"""A robustness study through the command line: in processes, resumed, judged and reported."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from exlinn_fmi.cli import exit_code

SCENARIO = """\
name: small
seed: 2
components:
  plant:
    plant: dc_motor_cart
    start: {alpha: 1.5}
  sensor: {step: 0.01, sensor: {alpha: {noise: 1e-5, unit: rad}, i: {unit: A}}}
  load: {source: {signal: step, time: 0, before: 0, after: 0.05, unit: N.m}}
  controller:
    step: 0.01
    nmpc:
      model: plant:dc_motor_cart
      inputs: {v: {min: -24, max: 24}}
      reference:
        coordinate: alpha
        trajectory: {signal: constant, value: 1.5, unit: rad}
connections:
  plant.alpha: sensor.alpha
  plant.i: sensor.i
  sensor.alpha_measured: controller.alpha
  sensor.i_measured: controller.i
  controller.v: plant.v
  load.y: plant.tau_ext
simulate: {stop: 0.5, step: 0.01}
metrics: {settle: 0.2}
study:
  repetitions: 2
  workers: 1
  vary:
    components.plant.start.r: {relative: 0.1}
    components.load.source.after: {min: -0.1, max: 0.1}
    components.controller.nmpc.delay: {values: [none, computation]}
  success: {rmse_alpha_rad: 0.01, violations: 0}
"""


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a study of two runs, beside its scenario."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "small.yaml").write_text(SCENARIO)
    assert sweep(folder) == 0
    return folder


def sweep(folder: Path, *overrides: str) -> int:
    settings = [word for override in overrides for word in ("--set", override)]
    return exit_code(["sweep", str(folder / "small.yaml"), "--out", str(folder / "run"), *settings])


def test_each_run_is_a_row_with_what_was_drawn_and_what_came_of_it(swept: Path) -> None:
    frame = pd.read_csv(swept / "run/study.csv")
    assert frame["run"].tolist() == [0, 1]
    assert frame["components.plant.start.r"].between(4.5, 5.5).all()
    assert frame["components.plant.start.r"].nunique() == 2
    assert (frame["control.rmse_alpha_rad"] < 0.01).all()
    assert frame["control.decrease"].between(0.5, 1.0).all()
    assert frame["success"].tolist() == [1.0, 1.0]


def test_metrics_and_report_tell_of_the_study(swept: Path) -> None:
    metrics = json.loads((swept / "run/metrics.json").read_text())
    assert metrics["study.success_rate"] == 1.0
    assert metrics["study.runs"] == 2
    report = (swept / "run/report.html").read_text("utf-8")
    assert "Worst runs" in report
    assert "Share of successes" in report
    assert (swept / "run/figures/study_causes.png").exists()


def test_a_longer_study_goes_on_with_the_runs_that_there_are(
    swept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = pd.read_csv(swept / "run/study.csv")
    stamped = json.loads((swept / "run/study.json").read_text())
    stamped["runs"][0]["components.plant.start.r"] = 5.0  # a run that were done again would draw anew
    (swept / "run/study.json").write_text(json.dumps(stamped))
    assert sweep(swept, "study.repetitions=3") == 0
    after = pd.read_csv(swept / "run/study.csv")
    assert after["run"].tolist() == [0, 1, 2]
    assert after["components.plant.start.r"][0] == 5.0
    assert after["control.rmse_alpha_rad"][1] == before["control.rmse_alpha_rad"][1]
    capsys.readouterr()
    assert sweep(swept, "study.repetitions=3") == 0
    assert "unchanged since the last run" in capsys.readouterr().err


def test_a_run_that_fails_is_a_row_and_no_success(swept: Path) -> None:
    wild = "study.vary={components.controller.step: {values: [0.015]}}"  # no multiple of the master's
    assert sweep(swept, wild, "study.repetitions=1") == 0
    (row,) = pd.read_csv(swept / "run/study.csv").to_dict("records")
    assert row["success"] == 0.0
    assert "expected a multiple of simulate.step" in row["error"]
    assert json.loads((swept / "run/metrics.json").read_text())["study.failed"] == 1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("study.success={rmse_y: 1}", "study.success.rmse_y: no such metric"),
        ("study.vary={components.controller.nmpc.model: {relative: 0.1}}", "there is no number to vary"),
    ],
)
def test_what_cannot_be_judged_or_drawn_is_told(
    override: str, message: str, swept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sweep(swept, override, "study.repetitions=1") == 1
    assert message in capsys.readouterr().err

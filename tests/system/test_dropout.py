"""A sensor that loses its samples in a scenario: event, controller, metrics."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from exlinn_fmi import cli

SCENARIO = """\
name: dropout
seed: 2
components:
  motor: {plant: dc_motor_cart, start: {alpha: 1.5707963}}
  controller:
    step: 0.01
    nmpc:
      model: plant:dc_motor_cart
      inputs: {v: {min: -24, max: 24}}
      estimator: {type: ekf}
      safe_input: {v: 1}
      dropout: %s
      reference:
        coordinate: alpha
        trajectory: {signal: sine, amplitude: 0.15, frequency: 0.4, unit: m}
        through: {map: scotch_yoke, crank: 0.2}
connections:
  motor.alpha: controller.alpha
  motor.i: controller.i
  controller.v: motor.v
simulate: {stop: 2, step: 0.01}
metrics: {settle: 1, output: motor.x}
events:
  - {on: controller.alpha, at: 1, until: 1.3, drop: 1}
"""


def simulate(folder: Path, dropout: str) -> tuple[pd.DataFrame, dict[str, float]]:
    file = folder / "dropout.yaml"
    file.write_text(SCENARIO % dropout)
    assert cli.exit_code(["run", str(file), "--out", str(folder / "run")]) == 0
    metrics = json.loads((folder / "run" / "metrics.json").read_text())
    return pd.read_csv(folder / "run" / "trajectories.csv"), metrics


def test_lost_samples_are_predicted_and_counted(tmp_path: Path) -> None:
    _, blind = simulate(tmp_path, "{}")
    table, metrics = simulate(tmp_path, "{stale: 1}")
    assert "control.missing_measurements" not in blind
    assert metrics["control.missing_measurements"] == table["controller.missing"].sum() == 30
    assert metrics["control.fallbacks"] == 0
    assert metrics["control.rmse_x_m"] < 0.01 * blind["control.rmse_x_m"]


def test_after_a_while_without_measurements_the_safe_input_is_applied_and_told(tmp_path: Path) -> None:
    table, metrics = simulate(tmp_path, "{stale: 1, timeout: 0.1}")
    lost = table["controller.solve_status"] == 3
    np.testing.assert_allclose(table["time"][lost], np.arange(1.1, 1.295, 0.01))
    assert np.all(table["motor.v"][lost] == 1)
    assert metrics["control.lost_samples"] == metrics["control.fallbacks"] == 20
    assert "lost_samples" not in simulate(tmp_path, "{stale: 1}")[1]


def test_a_closed_loop_that_has_not_changed_is_not_run_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    simulate(tmp_path, "{}")
    left = tmp_path / "run" / "simulate.part"
    left.mkdir()  # as if it had been killed when it was just done
    capsys.readouterr()
    simulate(tmp_path, "{}")
    assert "simulate  unchanged since the last run" in capsys.readouterr().err
    assert not left.exists()

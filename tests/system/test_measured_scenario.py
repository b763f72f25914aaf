"""Learning from recordings: from CSV files to a controller, and bad ones to an error instead of a model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from exlinn_fmi.cli import exit_code

QUICK = "learn.method={preset: structured, hidden: 2, iterations: 3}"
TRUE = {"j_m": 0.1, "m_c*d^2": 0.04, "l": 1.0, "k_e": 1.0, "b_m": 0.5, "r": 5.0}


@pytest.fixture
def scenario(root: Path, tmp_path: Path) -> Path:
    """A copy of the shipped scenario that only learns, with its recordings."""
    shutil.copytree(root / "scenarios/data", tmp_path / "data")
    text = (root / "scenarios/measured.yaml").read_text("utf-8")
    learn, simulate = text.index("\nlearn:"), text.index("\nsimulate:")
    file = tmp_path / "measured.yaml"
    file.write_text(f"name: measured\n{text[learn:simulate]}", "utf-8")
    return file


def command(verb: str, scenario: Path, *overrides: str) -> int:
    settings = [word for override in overrides for word in ("--set", override)]
    return exit_code([verb, str(scenario), "--out", str(scenario.parent / "out"), *settings])


def provenance(scenario: Path) -> dict:
    return json.loads((scenario.parent / "out/provenance.json").read_text("utf-8"))


def damage(scenario: Path, line: int, text: str, name: str = "motor_2.csv") -> None:
    """Put another text in the place of a line of a recording, counted from 1."""
    file = scenario.parent / "data" / name
    lines = file.read_text("utf-8").splitlines()
    lines[line - 1] = text
    file.write_text("\n".join(lines) + "\n", "utf-8")


@pytest.fixture(scope="module")
def shipped(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the shipped scenario, its co-simulation shortened."""
    out = tmp_path_factory.mktemp("measured")
    scenario = root / "scenarios/measured.yaml"
    assert exit_code(["run", str(scenario), "--out", str(out), "--set", "simulate.stop=3"]) == 0
    return out


def test_a_model_of_noisy_recordings_runs_freely_beside_an_unseen_one(shipped: Path) -> None:
    metrics = json.loads((shipped / "metrics.json").read_text())
    assert metrics["learn.rollout_nrmse_2s"] <= 0.03
    assert metrics["learn.rollout_diverged"] == 0


def test_parameters_are_read_off_noisy_recordings(shipped: Path) -> None:
    table = pd.read_csv(shipped / "parameters.csv").set_index("name")["identified"]
    assert table.to_dict() == pytest.approx(TRUE, rel=0.08)


def test_a_controller_around_a_model_of_recordings_tracks(shipped: Path) -> None:
    metrics = json.loads((shipped / "metrics.json").read_text())
    assert metrics["control.rmse_x_m"] <= 1e-3
    assert metrics["control.violations"] == 0


def test_the_shipped_recordings_raise_no_doubt(shipped: Path) -> None:
    assert json.loads((shipped / "provenance.json").read_text("utf-8"))["warnings"] == []


def test_the_recordings_are_among_the_files_that_the_result_is_from(shipped: Path) -> None:
    files = json.loads((shipped / "provenance.json").read_text("utf-8"))["files"]
    assert {"motor_1.csv", "motor_2.csv", "motor_3.csv", "motor_test.csv"} <= set(files)


def test_the_report_compares_with_the_recording_that_was_held_out(shipped: Path) -> None:
    frame = pd.read_csv(shipped / "evaluation.csv")
    assert frame["time"].iloc[-1] > 7.9
    assert "measured" in (shipped / "report.html").read_text("utf-8")


def test_the_data_set_is_in_the_units_of_the_model(root: Path, scenario: Path) -> None:
    assert command("collect", scenario, "learn.data.resample=2e-3") == 0
    frame = pd.read_csv(scenario.parent / "out/dataset.csv")
    raw = pd.read_csv(root / "scenarios/data/motor_1.csv", sep=";", decimal=",", comment="#")
    first = frame[frame["trajectory"] == 0]
    current = np.interp(first["time"], raw["t [ms]"] / 1e3, raw["i [mA]"] / 1e3)
    assert np.abs(first["i"] - current).max() < 0.015
    assert first["alpha"].iloc[0] == pytest.approx(np.radians(raw["phi [deg]"].iloc[0]), abs=0.01)


def test_a_changed_recording_is_imported_again_and_an_unchanged_one_is_not(scenario: Path) -> None:
    assert command("train", scenario, QUICK) == 0
    assert command("train", scenario, QUICK) == 0
    assert {s["status"] for s in provenance(scenario)["stages"].values()} == {"cached"}
    damage(scenario, 4, "0;57,57;0,2;9;9,99")
    assert command("train", scenario, QUICK) == 0
    assert {s["status"] for s in provenance(scenario)["stages"].values()} == {"ran"}


def test_another_seed_holds_out_another_file(scenario: Path) -> None:
    text = scenario.read_text("utf-8").replace("test: [data/motor_test.csv]", "hold_out: 1")
    scenario.write_text(text, "utf-8")
    means = set()
    for seed in range(6):
        assert command("collect", scenario, f"learn.seed={seed}") == 0
        frame = pd.read_csv(scenario.parent / "out/dataset.csv")
        means.add(round(frame[frame["trajectory"] == 2]["v"].mean(), 6))
    assert len(means) > 1


def test_what_is_doubtful_reaches_the_user_and_the_report(
    scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    overrides = (QUICK, "learn.data.columns.alpha_dot={column: 'n [rpm]', unit: rpm, scale: 1.25}")
    assert command("run", scenario, *overrides) == 0
    warning = "'alpha_dot' is 1.25 times the derivative of 'alpha'"
    assert warning in capsys.readouterr().err.replace("\n", " ")
    assert any(warning in text for text in provenance(scenario)["warnings"])
    assert "is 1.25 times the derivative of" in (scenario.parent / "out/report.html").read_text("utf-8")


def test_doubts_are_told_again_when_the_import_is_unchanged(
    scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    override = "learn.data.test=[]"
    for _ in range(2):
        assert command("collect", scenario, override) == 0
        assert capsys.readouterr().err.count("no file is held out") == 1


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (100, "194;;2,5;1;3", "motor_2.csv:100: column 'phi [deg]': found nothing, expected a finite number"),
        (100, "194;1,5;2,5;1;ERR", "motor_2.csv:100: column 'u [V]': found 'ERR', expected a finite number"),
        (100, "3;1,5;2,5;1;3", "motor_2.csv:100: column 't [ms]': 0.003 s after 0.19 s; time goes backwards"),
        (100, "190;1,5;2,5;1;3", "motor_2.csv:100: column 't [ms]': 0.19 s after 0.19 s; time stands still"),
        (100, "194;1,5;2,5;1", "motor_2.csv:100: 4 cells, expected 5 as there are names; repair the line"),
    ],
)
def test_no_model_comes_of_unusable_data(
    scenario: Path, capsys: pytest.CaptureFixture[str], line: int, text: str, message: str
) -> None:
    damage(scenario, line, text)
    assert command("run", scenario, QUICK) == 1
    assert message in capsys.readouterr().err
    written = {path.name for path in (scenario.parent / "out").iterdir()}
    assert not written & {"model.json", "model.safetensors", "metrics.json", "dataset.csv"}
    assert message in provenance(scenario)["error"]


def test_a_scenario_of_recordings_alone_is_described(
    scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["info", str(scenario)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "measured",
        "learns from measured files in alpha, Q: 3 for training, 1 held out",
    ]

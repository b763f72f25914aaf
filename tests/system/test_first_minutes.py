"""The first minutes with an FMU or a file of one's own: run it, draft a scenario, learn a model."""

from __future__ import annotations

import json
from pathlib import Path

import fmpy
import numpy as np
import pandas as pd
import pytest
from fmu_helpers import other_fmus

from exlinn_fmi.cli import exit_code


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present folder, empty, with a name that makes trouble."""
    place = tmp_path / "Prüfstand 1"
    place.mkdir()
    monkeypatch.chdir(place)
    return place


def metrics(name: str) -> dict[str, float]:
    return json.loads(Path("runs", name, "metrics.json").read_text())


@pytest.mark.parametrize("name", ["Mass_Damper", "MassSpringSystem", "ramp", "FMU3Model"])
def test_an_fmu_by_itself_gives_the_trajectory_that_fmpy_gives(folder: Path, name: str) -> None:
    file = other_fmus()[name]
    assert exit_code(["simulate", str(file), "--stop", "1", "--step", "1e-3"]) == 0
    ours = pd.read_csv(f"runs/{name}_fmu/trajectories.csv")
    theirs = fmpy.simulate_fmu(str(file), stop_time=1.0, step_size=1e-3, output_interval=1e-3)
    compared = [n for n in theirs.dtype.names if f"plant.{n}" in ours]
    assert compared
    for variable in compared:
        reference = np.interp(ours["time"], theirs["time"], theirs[variable])
        assert ours[f"plant.{variable}"].to_numpy() == pytest.approx(reference, rel=1e-9, abs=1e-9)


def test_inputs_parameters_and_what_is_recorded_are_set_in_one_line(folder: Path, root: Path) -> None:
    options = ["--stop", "2", "--step", "0.01", "--set", "plant.v=12", "--set", "plant.r=4"]
    command = [
        "run",
        str(root / "fmus/DCMotorCart.fmu"),
        *options,
        "--record",
        "plant.i",
        "--record",
        "plant.x",
    ]
    assert exit_code(command) == 0
    frame = pd.read_csv("runs/DCMotorCart_fmu/trajectories.csv")
    assert list(frame.columns) == ["time", "plant.i", "plant.x"]
    assert len(frame) == 201
    assert frame["plant.i"].max() > 1.0
    assert Path("runs/DCMotorCart_fmu/report.html").exists()


def test_inputs_that_are_held_are_named(folder: Path, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["simulate", str(root / "fmus/DCMotorCart.fmu"), "--stop", "0.1"]
    assert exit_code(command) == 0
    assert "held at their start values: plant.tau_ext, plant.v (--set" in capsys.readouterr().err
    assert exit_code([*command, "--set", "plant.v=1"]) == 0
    assert "held" not in capsys.readouterr().err


def test_a_draft_of_a_modelica_fmu_learns_it_as_it_stands(folder: Path) -> None:
    assert exit_code(["init", str(other_fmus()["Mass_Damper"])]) == 0
    assert exit_code(["train", "Mass_Damper.yaml", "--set", "learn.test[0].duration=2"]) == 0
    assert metrics("Mass_Damper")["learn.rollout_nrmse_2s"] < 1e-6
    assert metrics("Mass_Damper")["learn.mass_matrix_min_eigenvalue"] == pytest.approx(1.0, rel=1e-6)


def test_an_fmu_that_takes_euler_steps_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["init", str(other_fmus()["Mass_Damper"]), "--out", "m.yaml"]) == 0
    assert exit_code(["collect", "m.yaml"]) == 0
    assert "Euler" not in capsys.readouterr().err
    assert exit_code(["collect", "m.yaml", "--set", "components.plant.interface=co_simulation"]) == 0
    assert "'mass.s' goes by Euler steps" in capsys.readouterr().err


def test_a_draft_of_recordings_learns_them_as_it_stands(folder: Path, root: Path) -> None:
    files = [str(root / f"scenarios/data/motor_{k}.csv") for k in (1, 2, "test")]
    assert exit_code(["init", *files, "--out", "motor.yaml"]) == 0
    assert exit_code(["collect", "motor.yaml"]) == 0
    frame = pd.read_csv("runs/motor_1/dataset.csv")
    assert {"phi", "n", "i", "u"} <= set(frame.columns)
    assert frame["i"].abs().max() < 10  # A, of mA in the files


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (["init", "none.fmu"], "no such file"),
        (["init", "notes.docx"], "expected an FMU (.fmu), or recordings"),
        (["init", "a.csv", "b.fmu"], "one FMU, or one recording or more"),
        (["init", "a.csv", "--out", "there.yaml"], "is there already"),
        (["run", "a.csv"], "exlinn init a.csv"),
        (["train", "b.fmu"], "exlinn init b.fmu"),
    ],
)
def test_what_cannot_be_drafted_or_run_says_what_can(
    folder: Path, root: Path, command: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.csv", "notes.docx", "there.yaml"):
        Path(name).write_text("a,b\n1,2\n")
    Path("b.fmu").write_bytes((root / "fmus/DCMotorCart.fmu").read_bytes())
    assert exit_code(command) == 1
    assert text in capsys.readouterr().err
    assert Path("there.yaml").read_text() == "a,b\n1,2\n"

"""What is read from a run folder, and where a result says it came from."""

from __future__ import annotations

import hashlib
import json
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from results_helpers import evaluation, make_run, write_learning, write_trajectories

from exlinn_fmi.data.tables import write_table
from exlinn_fmi.errors import DataError, ScenarioError
from exlinn_fmi.results import tables
from exlinn_fmi.results.tables import Table, provenance, read_run, write_provenance


def test_a_run_is_read_with_units(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True, learn=True)
    frame, learned = write_trajectories(folder), write_learning(folder)
    run = read_run(folder)
    assert run.trajectories is not None
    assert run.evaluation is not None
    assert run.trajectories.frame.equals(frame)
    assert run.trajectories.unit("plant.x") == "m"
    assert np.array_equal(run.evaluation.frame["i_learned"], learned["i_learned"])
    assert run.metrics["learn.force_mse_test"] == 3.1e-10
    assert run.scenario.name == "demo"


def test_parts_that_did_not_happen_are_none(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, learn=True))
    assert (run.evaluation, run.training, run.parameters, run.trajectories) == (None, None, None, None)
    assert run.metrics == {}


def test_tables_without_rows_count_as_missing(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    frame, units = evaluation()
    write_table(folder / "evaluation", frame.head(0), units)
    (folder / "training.csv").write_text("iteration,loss\n")
    run = read_run(folder)
    assert run.evaluation is None
    assert run.training is None


def test_files_that_the_scenario_names_may_be_gone(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    file = folder / "scenario.yaml"
    file.write_text(file.read_text().replace("plant: dc_motor_cart", "fmu: ../nowhere/Plant.fmu"))
    assert read_run(folder).scenario.name == "demo"


def test_a_folder_without_scenario_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"found no scenario.yaml.*exlinn run"):
        read_run(tmp_path)


def test_a_scenario_with_mistakes_is_refused_with_the_line(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    with (folder / "scenario.yaml").open("a") as file:
        file.write("sed: 3\n")
    with pytest.raises(ScenarioError, match=r"scenario.yaml:10: sed"):
        read_run(folder)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("metrics.json", "{", "cannot be read"),
        ("metrics.json", "[1]", "found list where a JSON object is expected"),
        ("training.csv", "", "cannot be read as CSV"),
        ("evaluation.parquet", "no table", "evaluation.parquet"),
    ],
)
def test_a_broken_file_is_named(name: str, content: str, message: str, tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    (folder / name).write_text(content)
    with pytest.raises(DataError, match=message):
        read_run(folder)


def test_dimensionless_and_unknown_units_are_empty() -> None:
    table = Table(evaluation()[0], {"i": "1"})
    assert table.unit("i") == ""
    assert table.unit("L") == ""


def test_provenance_says_what_went_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario, fmu = tmp_path / "s.yaml", tmp_path / "Plant.fmu"
    scenario.write_text("name: s")
    fmu.write_bytes(b"an fmu")
    monkeypatch.setattr(sys, "argv", ["exlinn", "run", "s.yaml"])
    stages = {
        "collect": {"status": "ran", "seconds": 1.5},
        "train": {"status": "cached", "seconds": None},
        "simulate": {"status": "ran", "seconds": 2.0},
    }
    record = provenance(scenario, [fmu, fmu], 11, stages)
    assert record["files"]["Plant.fmu"] == hashlib.sha256(b"an fmu").hexdigest()
    assert set(record["files"]) == {"s.yaml", "Plant.fmu"}
    assert record["duration_s"] == 3.5
    assert record["seed"] == 11
    assert record["command"] == ["exlinn", "run", "s.yaml"]
    assert record["packages"]["numpy"] == metadata.version("numpy")
    assert {"casadi", "torch", "fmpy", "scipy"} <= set(record["packages"])
    assert "pytest" not in record["packages"]


def test_files_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    files = [tmp_path / folder / "Plant.fmu" for folder in "ab"]
    for file in files:
        file.parent.mkdir()
        file.write_text(file.parent.name)
    hashes = provenance(files[0], files[1:], 0, {})["files"]
    assert list(hashes) == [file.as_posix() for file in files]
    assert len(set(hashes.values())) == 2


def test_provenance_of_a_missing_input_names_it(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone.fmu: cannot be read"):
        provenance(tmp_path / "gone.fmu", [], 0, {})


def test_provenance_works_without_installed_metadata(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "DISTRIBUTION", "not-installed-anywhere")
    file = tmp_path / "s.yaml"
    file.write_text("")
    record = provenance(file, [], 0, {})
    assert record["exlinn"] is None
    assert record["packages"] == {}


def test_provenance_is_written_as_json(tmp_path: Path) -> None:
    write_provenance(tmp_path, {"seed": 3, "error": "x"})
    assert json.loads((tmp_path / "provenance.json").read_text()) == {"seed": 3, "error": "x"}

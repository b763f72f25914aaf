"""The commands `exlinn export …`: what they write and say."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from exlinn_fmi.cli import exit_code
from exlinn_fmi.export import platforms
from exlinn_fmi.export.check import check_fmu
from exlinn_fmi.learn.train import HISTORY, TrainedModel
from exlinn_fmi.learn.weights import save_model
from exlinn_fmi.mechanics.learned import ModelSpec, Scales
from exlinn_fmi.plants import plant


def test_a_plant_is_written_for_this_machine_and_passes_the_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "Motor.fmu"
    asked = [
        "export",
        "plant",
        "dc_motor_cart",
        "--fmi",
        "3",
        "--arrays",
        "--platform",
        "host",
        "--out",
        str(file),
    ]
    assert exit_code(asked) == 0
    assert exit_code(["export", "check", str(file)]) == 0
    assert "valid, CoSimulation within" in capsys.readouterr().out


def test_without_ziglang_it_says_which_platforms_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(platforms, "has_zig", lambda: False)
    assert exit_code(["export", "plant", "dc_motor_cart", "--out", str(tmp_path / "M.fmu")]) == 0
    said = capsys.readouterr().err
    assert "built for" in said
    assert "without" in said
    assert "pip install ziglang" in said


def test_a_file_that_is_not_there_and_a_broken_one_end_differently(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["export", "check", str(tmp_path / "none.fmu")]) == 1
    assert "no such file" in capsys.readouterr().err
    (tmp_path / "x.fmu").write_text("no zip")
    assert exit_code(["export", "check", str(tmp_path / "x.fmu")]) == 1


def test_a_model_of_a_run_needs_a_run(tmp_path: Path) -> None:
    assert exit_code(["export", "model", str(tmp_path)]) == 1
    assert exit_code(["export", "controller", str(tmp_path)]) == 1
    assert exit_code(["export", "loop", str(tmp_path)]) == 1


def test_a_learned_model_is_written_with_its_card(tmp_path: Path) -> None:
    coordinates = plant("dc_motor_cart").coordinates
    spec = ModelSpec(
        "structured", coordinates, 2, Scales(0.2, 1.0, (1.0, 0.5), (0.0,) * 2, (1.0,) * 2), (0.3, 0.3)
    )
    rng = np.random.default_rng(0)
    weights = {name: 0.2 * rng.normal(size=shape) for name, shape in spec.shapes().items()}
    provenance = {"data_sha256": "beef", "ranges": {"i": (-1.0, 1.0), "v": (-9.0, 9.0)}}
    save_model(
        tmp_path, TrainedModel(spec, weights, pd.DataFrame(columns=HISTORY), "converged", 0.1, provenance)
    )
    (tmp_path / "parameters.csv").write_text("name,identified,low,high\nk_e,1.01,0.98,1.04\n")
    (tmp_path / "metrics.json").write_text('{"learn.force_mse_test": 1e-9}')
    file = tmp_path / "Learned.fmu"
    assert exit_code(["export", "model", str(tmp_path), "--platform", "host", "--out", str(file)]) == 0
    assert check_fmu(file).problems == ()
    with zipfile.ZipFile(file) as archive:
        page = archive.read("documentation/index.html").decode()
    for text in ("beef", "0.98 … 1.04", "-9 … 9", "1e-09"):
        assert text in page, text

"""Every scenario of the checkout runs as it is, shortened where long, and shows the numbers it promises."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from exlinn_fmi import Run
from exlinn_fmi import run as pipeline_run
from exlinn_fmi.cli import exit_code
from exlinn_fmi.workspace import Silent
from tests.fmu_helpers import description_2, other_fmus, probe


def run(scenario: Path, out: Path, *overrides: str, verb: str = "run") -> dict[str, Any]:
    """Run a scenario through the command line; its metrics."""
    settings = [word for override in overrides for word in ("--set", override)]
    assert exit_code([verb, str(scenario), "--out", str(out), *settings]) == 0
    return json.loads((out / "metrics.json").read_text())


@pytest.fixture(scope="session")
def tracking(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the main job, its co-simulation shortened to 4 s."""
    out = tmp_path_factory.mktemp("tracking")
    run(root / "scenarios/dcwc_tracking.yaml", out, "simulate.stop=4")
    return out


def test_main_job_learns_the_plant(tracking: Path) -> None:
    metrics = json.loads((tracking / "metrics.json").read_text())
    assert metrics["learn.force_mse_test"] <= 1e-8
    assert metrics["learn.rollout_nrmse_10s"] <= 1e-3
    assert metrics["identify.max_rel_error"] <= 1e-3


def test_main_job_tracks_within_bounds(tracking: Path) -> None:
    metrics = json.loads((tracking / "metrics.json").read_text())
    assert metrics["control.rmse_x_m"] <= 1e-3
    assert metrics["control.violations"] == 0
    assert metrics["control.fallbacks"] == 0
    assert metrics["control.solver_backend"] == "compiled"


def test_main_job_leaves_all_its_files(tracking: Path) -> None:
    names = {str(p.relative_to(tracking)) for p in tracking.rglob("*") if p.is_file()}
    tables = {
        f"{t}.{s}" for t in ("dataset", "evaluation", "trajectories") for s in ("csv", "parquet", "meta.json")
    }
    figures = {
        f"figures/{f}.{s}" for f in ("fig3_learning", "fig4_control", "training") for s in ("png", "svg")
    }
    others = {"model.safetensors", "model.json", "training.csv", "parameters.csv", "metrics.json"}
    others |= {"provenance.json", "scenario.yaml", "stages.json", "report.html"}
    assert tables | figures | others <= names
    assert not [name for name in names if name.startswith(".")]


def test_plant_and_controller_share_a_row(tracking: Path) -> None:
    frame = pd.read_csv(tracking / "trajectories.csv")
    assert frame["time"].iloc[0] == 0
    due = frame.iloc[::10]
    np.testing.assert_array_equal(due["plant.v"], due["controller.v"])
    np.testing.assert_array_equal(due["plant.alpha"], due["controller.alpha"])


def test_learned_model_runs_as_a_component_in_place_of_the_plant(
    tracking: Path, root: Path, tmp_path: Path
) -> None:
    scenario = tmp_path / "learned.yaml"
    scenario.write_text(f"""\
name: learned
components:
  plant: {{fmu: {root / "fmus/DCMotorCart.fmu"}}}
  learned: {{model: {tracking}}}
  source: {{source: {{signal: multisine, rms: 2.0, offset: 3.0, band: [0.2, 4], unit: V}}}}
connections: {{source.y: [plant.v, learned.v]}}
simulate: {{stop: 5, step: 1e-3}}
""")
    run(scenario, tmp_path / "out", verb="simulate")
    frame = pd.read_csv(tmp_path / "out/trajectories.csv")
    np.testing.assert_allclose(frame["learned.alpha"], frame["plant.alpha"], atol=1e-6)


def test_learned_model_is_an_fmu_that_moves_as_it_does(tracking: Path, root: Path, tmp_path: Path) -> None:
    assert exit_code(["export", "model", str(tracking), "--out", str(tmp_path / "Learned.fmu")]) == 0
    scenario = tmp_path / "exported.yaml"
    scenario.write_text(f"""\
name: exported
components:
  fmu: {{fmu: Learned.fmu}}
  learned: {{model: {tracking}}}
  source: {{source: {{signal: sine, amplitude: 5.0, frequency: 1.0, unit: V}}}}
connections: {{source.y: [fmu.v, learned.v]}}
simulate: {{stop: 2, step: 1e-3}}
""")
    run(scenario, tmp_path / "out", verb="simulate")
    frame = pd.read_csv(tmp_path / "out/trajectories.csv")
    np.testing.assert_allclose(frame["fmu.alpha"], frame["learned.alpha"], rtol=0, atol=1e-12)


def test_run_without_training_loads_no_torch(tracking: Path, root: Path, tmp_path: Path) -> None:
    import subprocess
    import sys

    code = f"""
import sys
from exlinn_fmi.cli import exit_code
assert exit_code(["simulate", {str(root / "scenarios/dcwc_tracking.yaml")!r}, "--out", {str(tracking)!r},
                  "--set", "simulate.stop=0.5"]) == 0
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_the_papers_scenario_reaches_its_figure(root: Path, tmp_path: Path) -> None:
    metrics = run(root / "scenarios/dcwc_paper.yaml", tmp_path, "simulate.stop=1", "metrics.settle=0.5")
    assert metrics["learn.force_mse_test"] <= 1e-2
    assert metrics["learn.mass_matrix_min_eigenvalue"] > 0
    assert metrics["control.rmse_x_m"] <= 5e-3


def test_external_fmu_is_anybodys(root: Path, tmp_path: Path) -> None:
    for name, path in other_fmus().items():
        metrics = run(
            root / "scenarios/external_fmu.yaml",
            tmp_path / name,
            f"components.fmu.fmu={path}",
            "simulate.stop=1",
        )
        assert metrics["simulate.steps"] == 100
        assert pd.read_csv(tmp_path / name / "trajectories.csv").shape[1] > 1


def test_two_fmus_on_one_shaft_pull_at_each_other(root: Path, tmp_path: Path) -> None:
    run(root / "scenarios/two_fmus.yaml", tmp_path, "simulate.stop=2")
    frame = pd.read_csv(tmp_path / "trajectories.csv")
    np.testing.assert_array_equal(frame["left.tau_ext"], -frame["right.tau_ext"])
    assert frame["right.alpha"].iloc[-1] > 0.5


# ── FMUs that are at fault ───────────────────────────────────────────────────────────────────────────────


def simulate_fmu(root: Path, fmu: Path, out: Path, *overrides: str) -> int:
    settings = [word for o in (f"components.fmu.fmu={fmu}", *overrides) for word in ("--set", o)]
    return exit_code(["simulate", str(root / "scenarios/external_fmu.yaml"), "--out", str(out), *settings])


def test_fmu_that_returns_an_error_exits_with_2_and_keeps_the_rows_so_far(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = probe(tmp_path, "FAULT=fmi2Error")
    assert simulate_fmu(root, fmu, tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert "fmu at t = 0.49 s: " in err
    assert "fmi2DoStep" in err
    assert pd.read_csv(tmp_path / "out/trajectories.csv")["time"].iloc[-1] == 0.49


def test_fmu_that_returns_nan_exits_with_2_and_names_the_variable(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fmu = probe(tmp_path, "FAULT_NAN")
    assert simulate_fmu(root, fmu, tmp_path / "out") == 2
    assert "fmu.y at t = 0.5 s: the value is nan" in capsys.readouterr().err


def foreign(folder: Path) -> Path:
    """An FMU for Windows alone."""
    with zipfile.ZipFile(folder / "Foreign.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", description_2())
        archive.writestr("binaries/win64/probe.dll", b"MZ")
    return folder / "Foreign.fmu"


def truncated(folder: Path) -> Path:
    """The first half of an FMU."""
    whole = probe(folder).read_bytes()
    (folder / "Half.fmu").write_bytes(whole[: len(whole) // 2])
    return folder / "Half.fmu"


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (foreign, "Foreign.fmu: no binary for linux64 in it (found: win64)"),
        (truncated, "Half.fmu"),
        (lambda folder: folder / "Missing.fmu", "Missing.fmu"),
    ],
)
def test_fmu_that_cannot_be_used_exits_with_1_and_says_where_it_is_named(
    make: Any, text: str, root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate_fmu(root, make(tmp_path), tmp_path / "out") == 1
    err = capsys.readouterr().err
    assert text in err
    assert "components.fmu.fmu" in err
    assert not (tmp_path / "out").exists()


def test_unknown_start_variable_exits_with_1(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate_fmu(root, root / "fmus/DCMotorCart.fmu", tmp_path, "components.fmu.start.j_n=1.0") == 1
    assert "did you mean 'j_m'" in capsys.readouterr().err


def test_scenario_with_a_built_in_plant_as_the_controllers_model(root: Path, tmp_path: Path) -> None:
    text = (root / "scenarios/dcwc_tracking.yaml").read_text().replace("../fmus", str(root / "fmus"))
    text = text.replace("model: learned", "model: plant:dc_motor_cart")
    text = text[: text.index("learn:\n")] + text[text.index("simulate:\n") :]
    (tmp_path / "perfect.yaml").write_text(text)
    metrics = run(tmp_path / "perfect.yaml", tmp_path / "out", "simulate.stop=3", verb="simulate")
    assert metrics["control.rmse_x_m"] <= 1e-5


def test_exporting_a_folder_without_a_model_exits_with_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["export", "model", str(tmp_path)]) == 1
    assert "model.json" in capsys.readouterr().err


def test_stopped_training_keeps_the_best_so_far_and_the_next_run_trains_again(
    root: Path, tmp_path: Path
) -> None:
    work = Run.open(root / "scenarios/dcwc_tracking.yaml", tmp_path, ["simulate.stop=0.1"])
    trained: list[str] = []

    class Impatient(Silent):
        """Asks to stop as soon as training shows progress."""

        def update(self, fraction: float, text: str = "") -> None:
            if text.startswith("loss"):
                work.stop.requested = True

        def stage(self, name: str, detail: str) -> None:
            trained.append(f"{name} {detail}")

    work.reporter = Impatient()
    pipeline_run(work)
    assert [text for text in trained if text.startswith("train")] == ["train preset structured"]
    assert (
        json.loads((tmp_path / "provenance.json").read_text())["stages"]["train"]["status"] == "interrupted"
    )
    assert json.loads((tmp_path / "metrics.json").read_text())["simulate.steps"] == 100
    again = Run.open(root / "scenarios/dcwc_tracking.yaml", tmp_path, ["simulate.stop=0.1"])
    assert again.stages.key("collect") is not None
    assert again.stages.key("train") is None

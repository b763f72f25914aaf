"""The command line as a user meets it: verbs, exit codes, error texts, Ctrl-C, nothing lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

import exlinn_fmi
from exlinn_fmi import cli
from exlinn_fmi.cli import exit_code

LAG = """
from exlinn_fmi import PythonComponent, Variable

class Lag(PythonComponent):
    '''First-order lag x' = (u - x)/T; breaks at t = `fail` in the way that `how` says.'''

    def __init__(self, name: str, fail: float = 1e9, how: str = "nan", slow: float = 0.0) -> None:
        u, x = Variable("u", "input", unit="V", start=0.0), Variable("x", "output", unit="V", start=0.0)
        super().__init__(name, [u, x])
        self.fail, self.how, self.slow = fail, how, slow

    def advance(self, t: float, h: float) -> None:
        import time

        time.sleep(self.slow)
        if t >= self.fail and self.how == "raise":
            raise ValueError("the bearing seized")
        self["x"] += h * (self["u"] - self["x"]) if t < self.fail else float("nan")
"""

SCENARIO = """\
name: lag
components:
  source: {source: {signal: constant, value: 1.0, unit: V}}
  plant: {python: lag:Lag, options: {}}
connections: {source.y: plant.u}
simulate: {stop: 1.0, step: 0.01}
"""


@pytest.fixture
def lag(tmp_path: Path) -> Path:
    """A small scenario with a component of the user's own."""
    (tmp_path / "lag.py").write_text(LAG)
    (tmp_path / "lag.yaml").write_text(SCENARIO)
    return tmp_path / "lag.yaml"


def rows(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "trajectories.csv")


# ── verbs ────────────────────────────────────────────────────────────────────────────────────────────────


def test_public_names_are_sorted_and_there() -> None:
    assert list(exlinn_fmi.__all__) == sorted(exlinn_fmi.__all__)
    assert all(getattr(exlinn_fmi, name).__name__ for name in exlinn_fmi.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = exlinn_fmi.nonsense


@pytest.mark.parametrize(
    "verb",
    ["run", "init", "validate", "info", "collect", "train", "simulate", "report", "schema", "export plant"],
)
def test_help_of_every_verb_has_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code([*verb.split(), "--help"]) == 0
    assert f"Example: exlinn {verb}" in capsys.readouterr().out


def test_help_loads_no_heavy_library() -> None:
    code = (
        "import sys; from exlinn_fmi.cli import exit_code; exit_code(['--help']); print(sorted(sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not [
        name for name in ("numpy", "casadi", "torch", "pandas", "pydantic", "fmpy") if f"'{name}'" in out
    ]


def test_run_simulates_and_reports(lag: Path, tmp_path: Path) -> None:
    assert exit_code(["run", str(lag), "--out", str(tmp_path / "out")]) == 0
    frame = rows(tmp_path / "out")
    assert len(frame) == 101
    assert frame["plant.x"].iloc[-1] == pytest.approx(1 - 0.99**100, rel=1e-12)
    for name in ("report.html", "metrics.json", "provenance.json", "trajectories.parquet", "scenario.yaml"):
        assert (tmp_path / "out" / name).stat().st_size > 0


def test_out_is_runs_and_the_name_if_not_given(
    lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code(["simulate", str(lag)]) == 0
    assert (tmp_path / "runs/lag/trajectories.csv").exists()


def test_second_run_changes_nothing_and_says_so(
    lag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulate", str(lag), "--out", str(tmp_path / "out")]
    assert exit_code(command) == 0
    before = (tmp_path / "out/trajectories.csv").stat().st_mtime_ns
    capsys.readouterr()
    assert exit_code(command) == 0
    assert (tmp_path / "out/trajectories.csv").stat().st_mtime_ns == before
    assert "unchanged" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["file", "component", "result"])
def test_changed_input_or_result_brings_the_stage_back(lag: Path, tmp_path: Path, change: str) -> None:
    command = ["simulate", str(lag), "--out", str(tmp_path / "out")]
    assert exit_code(command) == 0
    trajectories = tmp_path / "out/trajectories.csv"
    before = trajectories.stat().st_mtime_ns
    if change == "file":
        lag.write_text(SCENARIO.replace("value: 1.0", "value: 2.0"))
    elif change == "component":
        (tmp_path / "lag.py").write_text(LAG + "\n# edited\n")
    else:
        trajectories.write_text("damaged")
    assert exit_code(command) == 0
    assert trajectories.stat().st_mtime_ns != before
    assert len(rows(tmp_path / "out")) == 101


def test_set_overrides_a_value(lag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert exit_code(["simulate", str(lag), "--out", str(out), "--set", "simulate.stop=0.5"]) == 0
    assert rows(out)["time"].iloc[-1] == 0.5
    assert "0.5" in (out / "scenario.yaml").read_text()


def test_info_of_a_scenario_shows_the_order(lag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["info", str(lag)]) == 0
    out = capsys.readouterr().out
    assert out.index("source") < out.index("plant")


def test_info_of_a_run_folder_shows_metrics(
    lag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["simulate", str(lag), "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert exit_code(["info", str(tmp_path / "out")]) == 0
    assert "simulate.steps" in capsys.readouterr().out


def test_info_of_an_fmu_shows_its_variables(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["info", str(root / "fmus/DCMotorCart.fmu")]) == 0
    out = capsys.readouterr().out
    assert all(word in out for word in ("alpha_ddot", "rad/s2", "tau_ext", "kg.m2"))


def test_info_of_a_controller_scenario_needs_no_training(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["info", str(root / "scenarios/dcwc_tracking.yaml")]) == 0
    assert "controller" in capsys.readouterr().out


def test_validate_says_valid(lag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["validate", str(lag)]) == 0
    assert "valid (2 components, 1 connections)" in capsys.readouterr().out


def test_schema_is_printed_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["schema"]) == 0
    printed = capsys.readouterr().out
    assert exit_code(["schema", "--out", str(tmp_path / "s.json")]) == 0
    assert (tmp_path / "s.json").read_text() == printed


def test_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["--version"]) == 0
    assert capsys.readouterr().out.startswith("exlinn ")


def test_report_is_made_again(lag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert exit_code(["run", str(lag), "--out", str(out)]) == 0
    (out / "report.html").unlink()
    assert exit_code(["report", str(out)]) == 0
    assert (out / "report.html").exists()


# ── exit code 1: the input is at fault ───────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (["run"], "Missing argument"),
        (["rum"], "No such command"),
        (["run", "missing.yaml"], "missing.yaml"),
        (["info", "missing.fmu"], "no such file"),
        (["info", "."], "not a run folder"),
        (["report", "."], "not a run folder"),
        (["run", "."], "is a folder; give a scenario"),
        (["export", "plant", "dc_motor"], "there are: dc_motor_cart"),
    ],
)
def test_wrong_command_exits_with_1(
    command: list[str],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_code(command) == 1
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "line", "text"),
    [
        ("plant.u}", "plant.v}", 5, "plant has no variable 'v'; its inputs: u"),
        ("unit: V", "unit: rad", 5, "unit mismatch: source.y [rad] → plant.u [V]"),
        ("stop: 1.0", "stopp: 1.0", 6, "did you mean 'stop'"),
        ("lag:Lag", "lag:Lagg", 4, "did you mean 'Lag'"),
        ("options: {}", "options: {tau: 1}", 4, "tau"),
    ],
)
def test_mistake_in_a_scenario_exits_with_1_and_names_line_and_fix(
    lag: Path, old: str, new: str, line: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lag.write_text(SCENARIO.replace(old, new))
    assert exit_code(["run", str(lag)]) == 1
    err = capsys.readouterr().err
    assert text in err
    assert f"lag.yaml:{line}: " in err


@pytest.mark.parametrize("stage", ["collect", "train"])
def test_learning_without_a_learn_section_exits_with_1(
    lag: Path, stage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code([stage, str(lag)]) == 1
    assert "`learn` section" in capsys.readouterr().err


def test_simulating_without_a_simulate_section_exits_with_1(
    lag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lag.write_text(SCENARIO.replace("simulate: {stop: 1.0, step: 0.01}\n", ""))
    assert exit_code(["simulate", str(lag)]) == 1
    assert "`simulate` section" in capsys.readouterr().err


# ── exit code 2: the run failed ──────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("options", "text"),
    [("{fail: 0.5}", "plant.x at t = 0.51 s"), ("{fail: 0.5, how: raise}", "the bearing seized")],
)
def test_failing_component_exits_with_2_and_keeps_the_rows_so_far(
    lag: Path, tmp_path: Path, options: str, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lag.write_text(SCENARIO.replace("options: {}", f"options: {options}"))
    assert exit_code(["run", str(lag), "--out", str(tmp_path / "out")]) == 2
    assert text in capsys.readouterr().err
    frame = rows(tmp_path / "out")
    assert frame["time"].iloc[-1] == pytest.approx(0.5)
    assert frame.notna().all().all()
    assert text in (tmp_path / "out/report.html").read_text()


def test_full_disk_exits_with_2_and_leaves_no_half_file(
    lag: Path, tiny_disk: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["simulate", str(lag), "--out", str(tiny_disk / "out"), "--set", "simulate.step=0.00001"]
    assert exit_code(command) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert not list((tiny_disk / "out").glob("*trajectories*"))


def test_bug_exits_with_3_and_asks_for_a_report(
    lag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "show_metrics", lambda *a: 1 / 0)
    assert exit_code(["simulate", str(lag), "--out", str(lag.parent / "out")]) == 3
    assert "ZeroDivisionError" in (err := capsys.readouterr().err)
    assert "bug in exlinn" in err


# ── Ctrl-C ───────────────────────────────────────────────────────────────────────────────────────────────


def start(lag: Path, slow: float) -> subprocess.Popen[str]:
    """Start a slow simulation in a process of its own and wait until it steps."""
    lag.write_text(SCENARIO.replace("options: {}", f"options: {{slow: {slow}}}"))
    code = "import sys; from exlinn_fmi.cli import main; print('up', flush=True); main(sys.argv[1:])"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "simulate", str(lag), "--out", str(lag.parent / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    deadline = time.monotonic() + 60
    while not (lag.parent / "out/scenario.yaml").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.0)
    return process


def test_ctrl_c_keeps_the_rows_so_far_and_exits_with_2(lag: Path) -> None:
    process = start(lag, 0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "will be kept" in err
    assert 2 <= len(rows(lag.parent / "out")) < 101


def test_second_ctrl_c_ends_at_once_and_leaves_no_half_file(lag: Path) -> None:
    process = start(lag, 30.0)
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 2
    assert "Stopping" in err
    assert "error: stopped" in err
    assert "Traceback" not in err
    assert not [f for f in (lag.parent / "out").iterdir() if f.name.startswith(".")]

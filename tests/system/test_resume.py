"""A run that is killed at any instant goes on from its last checkpoint as if nothing had happened."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from exlinn_fmi.cli import exit_code
from exlinn_fmi.errors import Interrupted
from exlinn_fmi.interrupts import StopRequest
from exlinn_fmi.pipeline import simulate
from exlinn_fmi.workspace import Run

ROOT = Path(__file__).parents[2]

SCENARIO = """
name: long
components:
  drive: {source: {signal: multisine, rms: 4, band: [0.1, 5], offset: 3, seed: 1, unit: V}}
  motor: {plant: dc_motor_cart}
  lag: {python: "parts:Lag", step: 4.0e-3}
connections: {drive.y: motor.v, motor.i: lag.u}
simulate: {stop: 20, step: 1.0e-3, record: ["*.i", "lag.y", "drive.y", "motor.alpha"], CHECKPOINT}
"""

PARTS = """
from exlinn_fmi import PythonComponent, Variable

class Lag(PythonComponent):
    variables = (Variable("u", "input", unit="A"), Variable("y", "output", unit="A", depends_on=()))

    def initialize(self, start_time, stop_time):
        self.x = 0.0

    def outputs(self, t):
        self["y"] = self.x

    def advance(self, t, h):
        self.x += h / 0.3 * (self["u"] - self.x)

    def get_state(self):
        return self.x

    def set_state(self, state):
        self.x = state
"""


def write(folder: Path, checkpoint: str) -> Path:
    (folder / "parts.py").write_text(PARTS)
    file = folder / "long.yaml"
    file.write_text(SCENARIO.replace("CHECKPOINT", checkpoint))
    return file


def start(file: Path, out: Path, *more: str) -> subprocess.Popen[bytes]:
    code = "from exlinn_fmi.cli import main; main()"
    command = [sys.executable, "-c", code, "simulate", str(file), "--out", str(out), *more]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def test_a_killed_run_goes_on_to_the_same_last_bit(tmp_path: Path):
    file, out = write(tmp_path, "checkpoint: 0.05"), tmp_path / "killed"
    assert exit_code(["simulate", str(file), "--out", str(tmp_path / "whole")]) == 0
    chance, kills, more = random.Random(5), 0, []
    for _ in range(4):
        process = start(file, out, *more)
        checkpoint = out / "simulate.part" / "checkpoint.json"
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
        deadline = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            now = checkpoint.stat().st_mtime_ns if checkpoint.exists() else None
            if now != before:  # it has begun; from now on at any instant
                time.sleep(chance.uniform(0.05, 0.4))
                break
            time.sleep(0.01)
        if process.poll() is None:
            process.kill()
            kills += 1
        process.communicate()
        more = ["--resume"]
        if process.returncode == 0:
            break
    if process.returncode != 0:
        assert start(file, out, "--resume").wait(timeout=120) == 0
    assert kills >= 1
    assert (out / "trajectories.csv").read_bytes() == (tmp_path / "whole" / "trajectories.csv").read_bytes()
    assert not (out / "simulate.part").exists()


TEXTS = """
import os, signal
from exlinn_fmi import PythonComponent, Variable

class Phases(PythonComponent):
    variables = (Variable("name", "output", "discrete", type="String", depends_on=()),)

    def outputs(self, t):
        self["name"] = f'phase {int(t / 0.4 + 1e-9)}, "öffnen"'

    def advance(self, t, h):
        if t > 1.0 and not os.path.exists("again"):
            open("again", "w").close()
            os.kill(os.getpid(), signal.SIGKILL)

class Reader(PythonComponent):
    variables = (Variable("given", "input", "discrete", type="String"), Variable("length", "output"))

    def outputs(self, t):
        self["length"] = float(len(self.text("given")))
"""


@pytest.mark.parametrize("stream", ["false", "true"])
def test_texts_that_change_are_recorded_also_by_a_run_that_goes_on_after_it_was_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stream: str
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "parts.py").write_text(TEXTS)
    file = tmp_path / "texts.yaml"
    file.write_text(
        "name: texts\ncomponents: {a: {python: 'parts:Phases'}, b: {python: 'parts:Reader'}}\n"
        "connections: {a.name: b.given}\n"
        f"simulate: {{stop: 2, step: 0.1, stream: {stream}, checkpoint: 1e-9}}\n"
    )
    assert start(file, tmp_path / "out").wait(timeout=60) < 0
    assert start(file, tmp_path / "out", "--resume").wait(timeout=60) == 0
    table = pd.read_parquet(tmp_path / "out" / "trajectories.parquet")
    expected = [f'phase {int(0.1 * k / 0.4 + 1e-9)}, "öffnen"' for k in range(21)]
    assert table["a.name"].tolist() == table["b.given"].tolist() == expected
    assert list(pd.read_csv(tmp_path / "out" / "trajectories.csv")) == ["time", "b.length"]
    told = pd.read_csv(tmp_path / "out" / "trajectories.texts.csv")
    changes = told[told["variable"] == "b.given"]
    assert changes["time"].tolist() == pytest.approx([0.0, 0.4, 0.8, 1.2, 1.6, 2.0])
    assert changes["text"].tolist() == list(dict.fromkeys(expected))


def test_without_a_checkpoint_there_is_nothing_to_resume(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = write(tmp_path, "start: 0.0")
    assert exit_code(["simulate", str(file), "--out", str(tmp_path / "out"), "--resume"]) == 1
    assert "there is no checkpoint to go on from; say `checkpoint: 60`" in capsys.readouterr().err


def test_rows_stream_into_the_same_files(tmp_path: Path):
    out = {}
    for stream in ("true", "false"):
        file = write(tmp_path, f"stream: {stream}, record_every: 10")
        out[stream] = tmp_path / stream
        assert exit_code(["simulate", str(file), "--out", str(out[stream]), "--set", "simulate.stop=2"]) == 0
    assert (out["true"] / "trajectories.csv").read_bytes() == (out["false"] / "trajectories.csv").read_bytes()
    frames = [pd.read_parquet(folder / "trajectories.parquet") for folder in out.values()]
    assert frames[0].equals(frames[1])
    assert len(frames[0]) == 201
    meta = [json.loads((folder / "trajectories.meta.json").read_text()) for folder in out.values()]
    assert meta[0] == meta[1]


def test_what_is_recorded_can_be_said_on_the_command_line(tmp_path: Path):
    file = write(tmp_path, "start: 0.0")
    line = ["simulate", str(file), "--out", str(tmp_path / "out"), "--set", "simulate.stop=0.1"]
    assert exit_code([*line, "--record", "motor.al*", "--record", "drive.y"]) == 0
    columns = list(pd.read_csv(tmp_path / "out" / "trajectories.csv"))
    assert columns == ["time", "motor.alpha", "motor.alpha_dot", "motor.alpha_ddot", "drive.y"]


def test_a_paced_run_reports_its_deadlines(tmp_path: Path):
    file = write(tmp_path, "pace: 2, profile: true")
    line = ["simulate", str(file), "--out", str(tmp_path / "out"), "--set", "simulate.stop=0.5"]
    assert exit_code(line) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["simulate.seconds"] >= 0.25
    assert "simulate.missed_deadlines" in metrics
    assert metrics["simulate.late_steps.motor"] >= 0
    table = pd.read_csv(tmp_path / "out" / "trajectories.csv")
    assert metrics["simulate.longest_step.motor"] == pytest.approx(table["timing.motor"].max())
    assert metrics["simulate.stepping"] == "plain"
    assert 0 < metrics["simulate.component_seconds.motor"] < metrics["simulate.seconds"]


def test_algorithms_are_set_in_the_scenario(tmp_path: Path):
    file = write(
        tmp_path, "loops: solve, extrapolation: {order: 2, smooth: true}, adaptive: {tolerance: 1e-3}"
    )
    line = ["simulate", str(file), "--out", str(tmp_path / "out"), "--set", "simulate.stop=0.1"]
    assert exit_code([*line, "--set", "simulate.step=4e-3"]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["simulate.communication_steps"] >= 50
    assert len(pd.read_csv(tmp_path / "out" / "trajectories.csv")) == 26


CLOSED_LOOP = """
name: loop
components:
  plant: {fmu: DCMotorCart.fmu, start: {alpha: 1.5707963}}
  ctl:
    step: 0.01
    nmpc:
      model: plant:dc_motor_cart
      horizon: 12
      inputs: {v: {min: -24, max: 24}}
      weights: {states: {alpha: 1.0e+4, i: 1.0e-2}, inputs: 1.0e-4}
      safe_input: {v: 0}
      reference:
        coordinate: alpha
        trajectory: {signal: sine, amplitude: 0.1, frequency: 1, offset: 1.5, unit: rad}
connections: {plant.alpha: ctl.alpha, plant.alpha_dot: ctl.alpha_dot, plant.i: ctl.i, ctl.v: plant.v}
simulate: {stop: 0.4, step: 1.0e-3, checkpoint: 1000}
"""


class Impatient(StopRequest):
    """A user who stops the run at one of the communication points."""

    def __init__(self, left: int) -> None:
        super().__init__()
        self.left = left

    def __call__(self) -> bool:
        self.left -= 1
        return self.left < 0


def test_a_controller_goes_on_with_what_it_had_in_mind(tmp_path: Path):
    (tmp_path / "DCMotorCart.fmu").write_bytes((ROOT / "fmus" / "DCMotorCart.fmu").read_bytes())
    file = tmp_path / "loop.yaml"
    file.write_text(CLOSED_LOOP)
    frames = {}
    for name in ("whole", "parted"):
        work = Run.open(file, tmp_path / name)
        if name == "parted":
            work.stop = Impatient(173)
            with pytest.raises(Interrupted, match="--resume goes on from there"):
                simulate(work)
            work = Run.open(file, tmp_path / name)
        simulate(work, resume=name == "parted")
        frames[name] = pd.read_parquet(tmp_path / name / "trajectories.parquet")
    timed = [c for c in frames["whole"] if c.endswith("_time")]
    whole, parted = (frame.drop(columns=timed) for frame in frames.values())
    assert whole["ctl.fallbacks"].max() == 0
    assert parted.to_numpy().tobytes() == whole.to_numpy().tobytes()

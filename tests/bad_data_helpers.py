"""The ways in for data: as a measured file, or from a plant that plays them back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from learn_helpers import motor_cart

from exlinn_fmi.cli import exit_code

STATES = ["alpha", "alpha_dot", "i"]

PLAYER = '''\
"""A plant that plays a recording back."""

import pandas as pd

from exlinn_fmi import PythonComponent, Variable


class Player(PythonComponent):
    variables = (
        Variable("v", "input", unit="V", start=0.0),
        Variable("alpha", "output", unit="rad", start=0.0),
        Variable("alpha_dot", "output", unit="rad/s", start=0.0),
        Variable("i", "output", unit="A", start=0.0),
    )

    def __init__(self, name, file):
        super().__init__(name)
        self.rows = pd.read_csv(file)

    def outputs(self, t):
        row = self.rows.iloc[min(round(t / 2e-3), len(self.rows) - 1)]
        for name in ("alpha", "alpha_dot", "i"):
            self[name] = row[name]
'''

LEARN = """\
name: bad
learn:
  method: {method}
  objective: {objective}
  identify:
    lagrangian: {{j_m: 0.5*alpha_dot^2, m: 0.5*sin(alpha)^2*alpha_dot^2, l: 0.5*i^2, k_e: i*alpha}}
    dissipation: {{b_m: 0.5*alpha_dot^2, r: 0.5*i^2}}
"""

FILE = """\
  data: {{files: [{files}]}}
  coordinates:
    - {{name: alpha, unit: rad, topology: circle}}
    - {{name: Q, unit: C, kind: electrical, topology: cyclic, velocity: i, velocity_unit: A,
       input: v, input_unit: V}}
"""

PLANT = """\
  plant: plant
  coordinates:
    - {{name: alpha, unit: rad, topology: circle, position: plant.alpha, velocity: plant.alpha_dot}}
    - {{name: Q, unit: C, kind: electrical, topology: cyclic, velocity: plant.i, velocity_unit: A,
       input: plant.v, input_unit: V}}
  training:
    - duration: {duration}
      step: 2e-3
      inputs: {{plant.v: {{signal: table, file: run.csv, column: v, interpolation: hold}}}}
components:
  plant: {{python: "player:Player", options: {{file: "{file}"}}}}
"""

METHODS = {
    "structured": "{preset: structured, hidden: 3, iterations: 10}",
    "default": "{preset: structured}",
    "terms": "{preset: terms}",
    "paper": "{preset: paper, lagrangian_features: [alpha_dot^2, sin(alpha)^2*alpha_dot^2, i^2, i*alpha], "
    "dissipation_features: [alpha_dot^2, i^2], epochs: 20}",
}


class Result(NamedTuple):
    """What a command did.

    Args:
        code: exit code.
        said: on standard error, and what it left as warnings.
        out: the run folder.
    """

    code: int
    said: str
    out: Path

    @property
    def has_model(self) -> bool:
        """Whether there is a model, or anything that one would be judged by."""
        traces = ("model.json", "model.safetensors", "metrics.json", "parameters.csv")
        return any((self.out / name).exists() for name in traces)

    @property
    def warnings(self) -> list[str]:
        """Those of the report."""
        return list(json.loads((self.out / "provenance.json").read_text("utf-8"))["warnings"])


def good(seconds: float = 4.0) -> pd.DataFrame:
    """A recording of the motor with cart that is fit to learn from."""
    return motor_cart(7.0, seconds)[["time", *STATES, "v"]]


def scenario(
    way: str,
    folder: Path,
    frame: pd.DataFrame | None = None,
    method: str = "structured",
    objective: str = "auto",
    files: str = "run.csv",
) -> Path:
    """Lay a scenario that learns from a frame by way of a file, or of a plant."""
    if frame is not None:
        frame.to_csv(folder / "run.csv", index=False)
    text = LEARN.format(method=METHODS[method], objective=objective)
    if way == "file":
        text += FILE.format(files=files)
    else:
        assert frame is not None
        (folder / "player.py").write_text(PLAYER, "utf-8")
        text += PLANT.format(duration=(len(frame) - 1) * 2e-3, file=folder / "run.csv")
    path = folder / "bad.yaml"
    path.write_text(text, "utf-8")
    return path


def run(path: Path, capsys, verb: str = "train") -> Result:  # type: ignore[no-untyped-def]
    """Do what a verb of the command line does."""
    out = path.parent / "out"
    code = exit_code([verb, str(path), "--out", str(out)])
    return Result(code, " ".join(capsys.readouterr().err.split()), out)

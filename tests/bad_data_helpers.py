"""Data that are bad in one way each, and the two ways in: played back by a plant, or as a measured file."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from learn_helpers import motor_cart

COLUMNS = ["time", "alpha", "alpha_dot", "i", "v"]
STEP = 2e-3

PLAYER = '''\
"""A plant that plays a recording back."""

from pathlib import Path

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

HEAD = """\
name: bad
learn:
  method: {method}
  objective: {objective}
  identify:
    lagrangian: {{j_m: 0.5*alpha_dot^2, m: 0.5*sin(alpha)^2*alpha_dot^2, l: 0.5*i^2, k_e: i*alpha}}
    dissipation: {{b_m: 0.5*alpha_dot^2, r: 0.5*i^2}}
"""

MEASURED = (
    HEAD
    + """\
  data: {{files: [{files}]}}
  coordinates:
    - {{name: alpha, unit: rad, topology: circle}}
    - {{name: Q, unit: C, kind: electrical, topology: cyclic, velocity: i, velocity_unit: A,
       input: v, input_unit: V}}
"""
)

PLANT = (
    HEAD
    + """\
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
)

METHODS = {
    "default": "{preset: structured}",
    "structured": "{preset: structured, hidden: 3, iterations: 10}",
    "terms": "{preset: terms}",
    "paper": "{preset: paper, lagrangian_features: [alpha_dot^2, sin(alpha)^2*alpha_dot^2, i^2, i*alpha], "
    "dissipation_features: [alpha_dot^2, i^2], epochs: 2}",
}


def good(seconds: float = 4.0) -> pd.DataFrame:
    """A recording of the motor with cart that is fit to learn from."""
    return motor_cart(7.0, seconds)[COLUMNS]


def measured(
    folder: Path, method: str = "structured", objective: str = "auto", files: str = "run.csv"
) -> Path:
    scenario = folder / "measured.yaml"
    scenario.write_text(MEASURED.format(method=METHODS[method], objective=objective, files=files), "utf-8")
    return scenario


def plant(folder: Path, rows: int, method: str = "structured", objective: str = "auto") -> Path:
    (folder / "player.py").write_text(PLAYER, "utf-8")
    scenario = folder / "plant.yaml"
    text = PLANT.format(
        method=METHODS[method], objective=objective, duration=(rows - 1) * STEP, file=folder / "run.csv"
    )
    scenario.write_text(text, "utf-8")
    return scenario

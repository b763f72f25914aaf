"""Recordings as a test bench might leave them, and their import."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.data.measured import import_measured
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.scenario.learning import Measured

COORDINATES = (
    Coordinate("alpha", "rad", topology="circle"),
    Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v", input_unit="V"),
)
COLUMNS = {"alpha": "phi", "v": "u"}


def recording(rows: int = 2001, step: float = 2e-3, phase: float = 0.0) -> pd.DataFrame:
    """Angle, speed, current and voltage of a shaft that turns: smooth, and consistent with each other."""
    t = step * np.arange(rows)
    return pd.DataFrame(
        {
            "time": t,
            "phi": 2.0 * t + 0.8 * np.sin(5 * t + phase),
            "alpha_dot": 2.0 + 4.0 * np.cos(5 * t + phase),
            "i": np.cos(7 * t + phase) + 0.3 * np.sin(23 * t),
            "u": 3.0 + 5.0 * np.sin(6 * t + phase) + 2 * np.cos(17 * t),
        }
    )


def write(folder: Path, **frames: pd.DataFrame) -> None:
    """Save frames as CSV files under their names."""
    for name, frame in frames.items():
        frame.to_csv(folder / f"{name}.csv", index=False)


def load(folder: Path, seed: int = 0, **settings: Any) -> Dataset:
    """Import ``run.csv``, or the files that the settings name."""
    settings = {"files": ["run.csv"], "columns": COLUMNS} | settings
    return import_measured(Measured.model_validate(settings), COORDINATES, folder, seed)


def load_frame(folder: Path, frame: pd.DataFrame, **settings: Any) -> Dataset:
    """Import a frame by way of a CSV file."""
    write(folder, run=frame)
    return load(folder, **settings)

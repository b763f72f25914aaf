"""Data of a plant under given signals, without an FMU between: for training and for tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np
import pandas as pd

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.scenario.signals import Signal

SUBSTEPS = 2
"""RK4 steps in a row: the data are exact to about 1e-13."""


def record(
    plant: Plant, source: str, signals: Sequence[Signal], duration: float, step: float = 1e-3
) -> Dataset:
    """Run a plant from rest, once for each signal, the other inputs 0.

    Args:
        plant: the ground truth.
        source: name of the input that is driven.
        signals: one trajectory each.
        duration: of each trajectory [s].
        step: from row to row [s]; inputs are held that long.
    """
    system, rows = plant.system, round(duration / step)
    roll = system.rk4(SUBSTEPS).mapaccum(rows)
    kept = [i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"]
    x0 = np.array([plant.start.get(name, 0.0) for name in system.state_names])
    frames = []
    for number, signal in enumerate(signals):
        time = np.arange(rows) * step
        u = np.zeros((rows, len(system.input_names)))
        u[:, system.input_names.index(source)] = signal_function(signal, Path())(time)
        p = np.tile(system.parameter_values[:, None], rows)
        after = roll(x0, u.T, ca.DM(p), step * np.ones((1, rows))).full().T
        x = np.vstack([x0, after[:-1]])
        q, v = np.zeros((rows, system.n)), x[:, len(kept) :]
        q[:, kept] = x[:, : len(kept)]
        frame = pd.DataFrame({"trajectory": number, "time": time})
        frame[system.state_names] = x
        names = [c.acceleration for c in system.coordinates]
        frame[names] = evaluate(system.forward, q, v, u, system.parameter_values)
        frame[system.input_names] = u
        frames.append(frame)
    return Dataset(pd.concat(frames), system.coordinates)

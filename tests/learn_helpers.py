"""Data for the tests of learning: plants simulated by RK4 under given inputs."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate


def multisine(
    rms: float, band: tuple[float, float], lines: int, offset: float, seed: int, t: NDArray
) -> NDArray:
    """offset + a sum of sines with random phases."""
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, lines)
    frequencies = np.linspace(*band, lines)
    return offset + rms * np.sqrt(2 / lines) * np.sin(2 * np.pi * np.outer(t, frequencies) + phases).sum(
        axis=1
    )


def simulate(
    system: LagrangianSystem, inputs: NDArray, step: float, start: NDArray | None = None, trajectory: int = 0
) -> pd.DataFrame:
    """Run a system by RK4, inputs (rows, m) held over each step; gives a data set's columns, and L, D."""
    rows, nx = inputs.shape[0], len(system.state_names)
    p = system.parameter_values
    x0 = np.zeros(nx) if start is None else start
    roll = system.rk4(2).mapaccum(rows - 1)
    x = np.vstack([x0, np.array(roll(x0, inputs[:-1].T, ca.DM(p), step)).T]) if rows > 1 else x0[None]
    positions = [i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"]
    q, v = np.zeros((rows, system.n)), x[:, len(positions) :]
    q[:, positions] = x[:, : len(positions)]
    a = evaluate(system.forward, q, v, inputs, p)
    frame = pd.DataFrame({"trajectory": trajectory, "time": np.arange(rows) * step})
    frame[system.state_names] = x
    frame[[c.acceleration for c in system.coordinates]] = a
    frame[system.input_names] = inputs
    frame["L"] = evaluate(system.lagrangian, q, v, p)[:, 0]
    frame["D"] = evaluate(system.dissipation, v, p)[:, 0]
    return frame

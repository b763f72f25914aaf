"""Free runs of a model beside a recorded trajectory: inputs as recorded, states from the model alone."""

from __future__ import annotations

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem


def free_run(system: LagrangianSystem, data: Dataset) -> Float[NDArray[np.float64], "N nx"]:
    """Run the forward model (16) by RK4 from the first recorded state, inputs held from row to row.

    Args:
        system: the model.
        data: one trajectory.

    Returns:
        States at the rows of the data, not finite from where the run diverged.
    """
    frame = data.frame
    x0 = frame[system.state_names].to_numpy(dtype=float)[0]
    if len(frame) == 1:
        return np.array(x0[None])
    inputs = frame[system.input_names].to_numpy(dtype=float)[:-1]
    steps = np.diff(frame["time"].to_numpy(dtype=float))
    run = system.rk4().mapaccum(len(steps))
    parameters = np.tile(system.parameter_values[:, None], len(steps))
    states = run(x0, inputs.T, parameters, steps[None])
    return np.vstack([x0, np.array(states).T])


def nrmse(
    system: LagrangianSystem, data: Dataset, states: Float[NDArray[np.float64], "N nx"], duration: float
) -> dict[str, float]:
    """Root mean square error of each velocity over the standard deviation of the measured one.

    Args:
        system: the model.
        data: one trajectory.
        states: its free run.
        duration: how much of it counts [s].

    Returns:
        By velocity; NaN where the trajectory is shorter than that or the velocity constant, ∞ where the run
        diverged.
    """
    time = data.frame["time"].to_numpy(dtype=float)
    names = [c.velocity for c in system.coordinates]
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if time[-1] - time[0] < duration - 1.5 * step:  # the last row may be one step short of the duration
        return dict.fromkeys(names, float("nan"))
    counted = time - time[0] <= duration + 0.5 * step
    run = pd.DataFrame(states, columns=system.state_names)
    result = {}
    for name in names:
        measured = data.frame[name].to_numpy(dtype=float)[counted]
        with np.errstate(over="ignore", invalid="ignore"):
            error = float(np.sqrt(np.mean((run[name].to_numpy()[counted] - measured) ** 2)))
        spread = float(measured.std())
        result[name] = (
            (error if np.isfinite(error) else float("inf")) / spread if spread > 0 else float("nan")
        )
    return result

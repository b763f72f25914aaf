"""Free runs of a model beside a recorded trajectory: inputs as recorded, states from the model alone."""

from __future__ import annotations

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.components.lagrangian import LagrangianComponent
from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem


def free_run(system: LagrangianSystem, data: Dataset) -> Float[NDArray[np.float64], "N nx"]:
    """Run the forward model (16) from the first recorded state, inputs held from row to row.

    It moves as it would in a co-simulation, in internal steps that its fastest pole allows.

    Args:
        system: the model.
        data: one trajectory.

    Returns:
        States at the rows of the data, not finite from where the run diverged.
    """
    columns = (["time"], system.state_names, system.input_names)
    time, states, inputs = (data.frame[names].to_numpy(dtype=float) for names in columns)
    return run_from(system, time[:, 0], states[0], inputs)


def run_from(
    system: LagrangianSystem,
    time: Float[NDArray[np.float64], " N"],
    start: Float[NDArray[np.float64], " nx"],
    inputs: Float[NDArray[np.float64], "N nu"],
) -> Float[NDArray[np.float64], "N nx"]:
    """The same from any state.

    Args:
        system: the model.
        time: of the rows [s].
        start: state at the first row.
        inputs: held from each row to the next.
    """
    model = LagrangianComponent("model", system)
    model.enter_initialization(time[0], time[-1], dict(zip(system.state_names, start, strict=True)))
    model.exit_initialization()
    driven, moved = model.indices("input"), [model.index(name) for name in system.state_names]
    run = start[None].repeat(len(time), axis=0)
    for k, step in enumerate(np.diff(time)):
        model.set(driven, inputs[k])
        model.step(time[k], step)
        run[k + 1] = model.values[moved]
    return run


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

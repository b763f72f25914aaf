"""Whether a model has learned anything: short free runs beside the data that it was fitted to.

The learners make residuals small, whatever the data; how large what is left is to be called depends on the
learner, its objective and the noise. Here all are measured alike: from states as they were recorded the
forward model (16) runs for as long as it takes the velocities to move well beyond their noise, and its error
is put beside that movement. A model that is no better than one in which nothing moves has learned nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.noise import noise_levels
from exlinn_fmi.learn.rollout import free_run
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, internal_steps

Array = NDArray[np.float64]

NOTHING, POOR = 0.9, 0.1
"""Errors above this share of the movement tell of a model that learned nothing, or too little."""
MOVED = 1.0
"""Runs are so long that each velocity moves by this share of its standard deviation, …"""
BEYOND = 10.0
"""… and by so many times its noise; …"""
TOLD = 5.0
"""… one that never moves by so many is not judged."""
UNSURE = 0.01
"""States that runs begin in are sure to this share of their standard deviation, or to their noise: …"""
EXCUSED, MOST = 2.0, 0.5
"""… so many times what that does to a run, which is much where the motion is unstable, is no error, up to
this share of the movement's square."""
FIRST, LAST = 8, 1000
"""Fewest and most steps of a run."""
RUNS, STEPS = 30, 20_000
"""About as many runs are made, unless they are more internal steps in all."""


class Verdict(NamedTuple):
    """The velocity that is predicted worst.

    Args:
        velocity: its name, empty where none could be judged.
        error: root mean square error as a share of its movement, ∞ where the model diverged.
        duration: of a run [s].
        time: when the worst run began [s].
    """

    velocity: str
    error: float
    duration: float
    time: float

    def __str__(self) -> str:
        share = f"{self.error:.0%} of" if self.error < 10 else f"{self.error:.2g} times"
        return (
            f"the model mispredicts the data that it was trained on: {self.velocity!r} by {share} its "
            f"movement within {self.duration:.3g} s, the most from t = {self.time:.6g} s on"
        )


def judge(system: LagrangianSystem, data: Dataset) -> Verdict:
    """Run a model beside data.

    Args:
        system: the model.
        data: trajectories.
    """
    velocities = [c.velocity for c in system.coordinates]
    parts = [data.select([number]) for number in data.trajectories]
    measured = [part.frame[velocities].to_numpy(dtype=float) for part in parts]
    spread = data.frame[system.state_names].to_numpy(dtype=float).std(axis=0)
    unsure = np.maximum(noise_levels(data), UNSURE * spread) * (-1.0) ** np.arange(len(spread))
    noise, spread = (x[-len(velocities) :] for x in (noise_levels(data), spread))
    steps = _steps(measured, np.maximum(MOVED * spread, BEYOND * noise))
    apart = max(steps // 2, 1)
    starts = [(k, row) for k, v in enumerate(measured) for row in range(0, len(v) - steps, apart)]
    count = max(min(RUNS, STEPS // (steps * _internal(system, data))), 1)
    errors, moves, shifts, times, durations = [], [], [], [], []
    for index in np.unique(np.linspace(0, len(starts) - 1, count).astype(int)):
        k, row = starts[index]
        window = slice(row, row + steps + 1)
        frame = parts[k].frame[window]
        other = frame.copy()
        other.loc[frame.index[0], system.state_names] += unsure
        run, shaken = (
            free_run(system, Dataset(part, data.coordinates))[:, -len(velocities) :]
            for part in (frame, other)
        )
        with np.errstate(over="ignore", invalid="ignore"):
            errors.append(np.mean((run - measured[k][window]) ** 2, axis=0))
            shifts.append(np.mean((run - shaken) ** 2, axis=0))
        moves.append(np.mean((measured[k][window] - measured[k][row]) ** 2, axis=0))
        times.append(float(frame["time"].iloc[0]))
        durations.append(float(np.ptp(frame["time"])))
    error, moved = np.nan_to_num(np.array(errors), nan=np.inf), np.mean(moves, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        excused = np.fmin(EXCUSED**2 * np.mean(shifts, axis=0), MOST * moved)
        rest = np.maximum(error.mean(axis=0) - excused, 0)
        share = np.where(np.sqrt(moved) > TOLD * noise, np.sqrt(rest / moved), 0.0)
    worst = int(np.argmax(share))
    name = velocities[worst] if (np.sqrt(moved) > TOLD * noise).any() else ""
    return Verdict(
        name, float(share[worst]), float(np.median(durations)), times[int(np.argmax(error[:, worst]))]
    )


def _internal(system: LagrangianSystem, data: Dataset) -> int:
    """Internal steps of a run from row to row, as far as can be told at rest."""
    usual = float(np.median(np.abs(np.diff(data.frame["time"].to_numpy(dtype=float)))))
    try:
        return internal_steps(usual, system.solver_step({}))
    except ModelError:
        return 1


def _steps(measured: list[Array], enough: Float[Array, " n"]) -> int:
    """Steps in which every velocity moves enough, as far as the trajectories are long."""
    longest = max(map(len, measured)) - 1
    steps = min(FIRST, longest)
    while 2 * steps <= min(longest, LAST):
        moves = [v[steps:] - v[:-steps] for v in measured if len(v) > steps]
        if (np.sqrt(np.mean(np.concatenate(moves) ** 2, axis=0)) >= enough).all():
            break
        steps *= 2
    return steps

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
from exlinn_fmi.learn.noise import noise_levels
from exlinn_fmi.learn.rollout import free_run
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem

Array = NDArray[np.float64]

NOTHING, POOR = 0.9, 0.1
"""Errors above this share of the movement tell of a model that learned nothing, or too little."""
MOVED = 0.3
"""Runs are so long that each velocity moves by this share of its standard deviation, …"""
BEYOND = 10.0
"""… and by so many times its noise; …"""
TOLD = 5.0
"""… one that never moves by so many is not judged."""
FIRST, LAST = 8, 1000
"""Fewest and most steps of a run."""
RUNS, STEPS = 30, 6000
"""About as many runs are made, unless they are more steps in all."""


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
    noise = noise_levels(data)[-len(velocities) :]
    spread = np.concatenate(measured).std(axis=0)
    steps = _steps(measured, np.maximum(MOVED * spread, BEYOND * noise))
    apart = max(steps // 2, 1)
    starts = [(k, row) for k, v in enumerate(measured) for row in range(0, len(v) - steps, apart)]
    count = max(min(RUNS, STEPS // steps), 1)
    errors, moves, times, durations = [], [], [], []
    for index in np.unique(np.linspace(0, len(starts) - 1, count).astype(int)):
        k, row = starts[index]
        window = slice(row, row + steps + 1)
        frame = parts[k].frame[window]
        run = free_run(system, Dataset(frame, data.coordinates))[:, -len(velocities) :]
        with np.errstate(over="ignore", invalid="ignore"):
            errors.append(np.mean((run - measured[k][window]) ** 2, axis=0))
        moves.append(np.mean((measured[k][window] - measured[k][row]) ** 2, axis=0))
        times.append(float(frame["time"].iloc[0]))
        durations.append(float(np.ptp(frame["time"])))
    error, moved = np.nan_to_num(np.array(errors), nan=np.inf), np.mean(moves, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(np.sqrt(moved) > TOLD * noise, np.sqrt(error.mean(axis=0) / moved), 0.0)
    worst = int(np.argmax(share))
    name = velocities[worst] if (np.sqrt(moved) > TOLD * noise).any() else ""
    return Verdict(
        name, float(share[worst]), float(np.median(durations)), times[int(np.argmax(error[:, worst]))]
    )


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

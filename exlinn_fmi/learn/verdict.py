"""Whether a model has learned anything: short free runs beside the data that it was fitted to.

The learners make residuals small, whatever the data; how large what is left is to be called depends on the
learner, its objective and the noise. Here all are measured alike: from states as they were recorded the
forward model (16) runs for as long as it takes the velocities to move well beyond their noise, and its error
is put beside that movement. A model that is no better than one in which nothing moves has learned nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.rollout import run_from
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
    n, names = len(velocities), ["time", *system.state_names, *system.input_names]
    table, numbers = data.frame[names].to_numpy(dtype=float), data.frame["trajectory"].to_numpy()
    recorded = [table[numbers == k] for k in data.trajectories]
    last = len(system.state_names) + 1
    time, states, inputs = (
        [part[:, cut] for part in recorded] for cut in (0, slice(1, last), slice(last, None))
    )
    spread, noise = table[:, 1:last].std(axis=0), data.noise
    unsure = np.maximum(noise, UNSURE * spread) * (-1.0) ** np.arange(len(spread))
    noise, spread = noise[-n:], spread[-n:]
    steps = _steps([x[:, -n:] for x in states], np.maximum(MOVED * spread, BEYOND * noise))
    apart = max(steps // 2, 1)
    starts = [(k, row) for k, x in enumerate(states) for row in range(0, len(x) - steps, apart)]
    count = max(min(RUNS, STEPS // (steps * _internal(system, data))), 1)
    chosen = [starts[i] for i in np.unique(np.linspace(0, len(starts) - 1, count).astype(int))]
    windows = [(k, slice(row, row + steps + 1)) for k, row in chosen]

    def runs(off: Array) -> list[Array]:
        """Velocities from states that are so far off."""
        return [
            run_from(system, time[k][rows], states[k][rows][0] + off, inputs[k][rows])[:, -n:]
            for k, rows in windows
        ]

    def squares(pairs: Iterable[tuple[Array, Array]]) -> Float[Array, "r n"]:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.array([np.mean((one - other) ** 2, axis=0) for one, other in pairs])

    found, measured = runs(0 * unsure), [states[k][rows][:, -n:] for k, rows in windows]
    error = np.nan_to_num(squares(zip(found, measured, strict=True)), nan=np.inf)
    moved = squares((x, x[:1]) for x in measured).mean(axis=0)
    rest = error.mean(axis=0)
    if (rest > POOR**2 * moved).any():  # only then is there anything to excuse
        shifts = squares(zip(found, runs(unsure), strict=True)).mean(axis=0)
        rest = np.maximum(rest - np.fmin(EXCUSED**2 * shifts, MOST * moved), 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(np.sqrt(moved) > TOLD * noise, np.sqrt(rest / moved), 0.0)
    worst = int(np.argmax(share))
    began = [float(time[k][rows][0]) for k, rows in windows]
    duration = float(np.median([np.ptp(time[k][rows]) for k, rows in windows]))
    name = velocities[worst] if (np.sqrt(moved) > TOLD * noise).any() else ""
    return Verdict(name, float(share[worst]), duration, began[int(np.argmax(error[:, worst]))])


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

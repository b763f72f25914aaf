"""Whether a plant was integrated finely enough for its data to be believed.

Some tools' Co-Simulation FMUs take one explicit Euler step per communication step. Forces and accelerations
at an instant are right all the same, so that a model learned of them is right and the plant's motion is not.
"""

from __future__ import annotations

import numpy as np

from exlinn_fmi.data.dataset import Dataset

TOLD = 1e-3
"""Error of a step, as a share of the usual motion in it, from which on the user is told."""


def euler_steps(data: Dataset) -> list[str]:
    """What is to be said of positions that went by Euler steps.

    Over two steps a position moves by Simpson's rule over its velocity, to the fourth order. What is left is
    -h/2 times the change of the velocity for explicit and h/2 for implicit Euler steps; a sensor's noise is
    not in proportion to that.

    Args:
        data: trajectories of a plant, on regular grids.
    """
    notes = []
    for c in (c for c in data.coordinates if c.topology != "cyclic"):
        left, change, motion, step = [], [], [], 0.0
        for _, run in data.frame.groupby("trajectory"):
            t, x, v = (run[name].to_numpy() for name in ("time", c.name, c.velocity))
            h = np.diff(t)[:-1]
            left.append(x[2:] - x[:-2] - h / 3 * (v[:-2] + 4 * v[1:-1] + v[2:]))
            change.append(0.5 * h * (v[2:] - v[:-2]))
            motion.append(2 * h * v[1:-1])
            step = float(h.max(initial=step))
        residual, half, moved = map(np.concatenate, (left, change, motion))
        size, usual = float(np.linalg.norm(half)), float(np.linalg.norm(moved))
        if 0 < size < np.inf and TOLD * usual < size and 0.5 < abs(float(residual @ half)) / size**2 < 2:
            notes.append(
                f"{c.name!r} goes by Euler steps as long as the communication step, {step:g} s, each "
                f"{size / usual:.1%} off: this is not the motion of the plant's equations. Use `interface: "
                "model_exchange` where its FMU has that, or a smaller `step`"
            )
    return notes

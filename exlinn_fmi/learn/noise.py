"""How noisy the measured channels are, and what the fits make of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.data.derivatives import noise_level
from exlinn_fmi.mechanics.coordinates import state_names

Array = NDArray[np.float64]

SHORTEST = 20
"""Fewest rows of a trajectory that its noise is estimated from."""
CLEAN = 1e-5
"""Noise below this share of a channel's standard deviation is none: held inputs alone look like as much."""
FLOOR = 1e-12
"""Least noise that a channel is taken to have, as a share of its size: that of floating point, summed up."""


def noise_levels(data: Dataset) -> Float[Array, " nx"]:
    """Standard deviation of the white noise on each state, in its unit.

    Args:
        data: trajectories; those too short to tell are left out.
    """
    names = state_names(data.coordinates)
    squares, rows = np.zeros(len(names)), 0
    for _, part in data.frame.groupby("trajectory"):
        if len(part) >= SHORTEST:
            values = part[names].to_numpy(dtype=float)
            squares += len(part) * np.array([noise_level(column) ** 2 for column in values.T])
            rows += len(part)
    size = np.abs(data.frame[names].to_numpy(dtype=float)).max(axis=0)
    return np.maximum(np.sqrt(squares / max(rows, 1)), FLOOR * np.where(size > 0, size, 1))


def relative_noise(data: Dataset) -> dict[str, float]:
    """Noise of each state by name, as a share of the channel's standard deviation."""
    names = state_names(data.coordinates)
    spread = data.frame[names].to_numpy(dtype=float).std(axis=0)
    return dict(zip(names, (noise_levels(data) / np.where(spread > 0, spread, 1)).tolist(), strict=True))

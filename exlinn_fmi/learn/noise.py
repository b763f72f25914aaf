"""The noise of the measured channels (`Dataset.noise`) as learners look at it: as a share of the signal."""

from __future__ import annotations

import numpy as np

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.mechanics.coordinates import state_names

CLEAN = 1e-5
"""Noise below this share of a channel's standard deviation is none: held inputs alone look like as much."""


def relative_noise(data: Dataset) -> dict[str, float]:
    """Noise of each state by name, as a share of the channel's standard deviation."""
    names = state_names(data.coordinates)
    spread = data.frame[names].to_numpy(dtype=float).std(axis=0)
    return dict(zip(names, (data.noise / np.where(spread > 0, spread, 1)).tolist(), strict=True))

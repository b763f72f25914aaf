"""Measurements that are lost: those that say so, and those that hold their last value instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.control.estimator import Belief, Estimator
from exlinn_fmi.scenario.control import Dropout


@dataclass(frozen=True)
class Heard:
    """What came of the measurements so far.

    Args:
        values: the last ones as they came, shape (n,).
        repeats: how often each came again to the last bit, shape (n,).
        silent: for how many samples each has been missing, shape (n,).
    """

    values: NDArray[np.float64]
    repeats: NDArray[np.float64]
    silent: NDArray[np.float64]


class Listener:
    """Tells which measurements are missing, and which for too long.

    Args:
        estimator: what expects them.
        options: what counts as lost.
        step: sampling time [s].
    """

    def __init__(self, estimator: Estimator, options: Dropout, step: float) -> None:
        self._estimator, self._step = estimator, step
        self.stale, self.timeout = options.stale, options.timeout

    def hear(
        self, before: Heard | None, belief: Belief | None, values: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Heard]:
        """The measurements, NaN where missing, and what is to be remembered of them.

        A sensor that holds its last value is told from a plant at rest by the model: the value repeats to the
        last bit while it is expected to have changed by more than its noise.

        Args:
            before: what the call before gave.
            belief: what is expected of the state at their time.
            values: as they came, shape (n,).
        """
        measured, y, none = self._estimator.noise.measured, values.copy(), np.zeros(len(values))
        if before is None:
            before = Heard(np.full_like(values, np.nan), none, none)
        repeats = np.where(values == before.values, before.repeats + 1.0, 0.0)
        if self.stale is not None and belief is not None:
            seen, off = self._estimator.innovation(belief.mean, values)
            moved = seen[np.abs(off) > self._estimator.noise.measurement[seen]]
            y[moved[repeats[moved] >= self.stale]] = np.nan
        silent = np.where(measured & ~np.isfinite(y), before.silent + 1.0, 0.0)
        return y, Heard(values.copy(), repeats, silent)

    def lost(self, heard: Heard) -> Bool[np.ndarray, " n"]:
        """Which measurements have been missing for longer than predictions stand in for them."""
        if self.timeout is None:
            return np.zeros(len(heard.silent), dtype=bool)
        return heard.silent * self._step > self.timeout * (1.0 + 1e-9)

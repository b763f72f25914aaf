"""Windows in time with a smooth test function φ on each: the Euler–Lagrange equations against them need no q̈.

    ∫ φ F dt = ∫ (−φ̇ ∂𝓛/∂q̇ − φ ∂𝓛/∂q + φ ∂D/∂q̇) dt,  φ = 0 at both ends of a window.

Integrals over functions of the states are trapezoidal sums, which φ makes exact to its smoothness; those over
inputs, which are held from row to row and jump there, are exact.

References: Messenger, Bortz (2021), Multiscale Model. Simul. 19, 1474 (weak form).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import DataError

Array = NDArray[np.float64]

LONGEST = 1600
"""Rows in a window, …"""
WINDOWS = 6
"""… unless that many windows do not fit into the longest trajectory beside one another."""
OVERLAP = 16
"""Windows begin a 16th of their length apart."""
LEAST = 150
"""More windows than that many ask for this many rows in each: over fewer, sums are poor integrals."""
SHORTEST = 5
"""Rows that a window has at least."""
PIECE = 512
"""Rows that are looked at at once."""
BUMP: Polynomial = Polynomial([1, 0, -1]) ** 7
"""φ(s) on [−1, 1], six times differentiable at the ends."""
SLOPE, INTEGRAL = BUMP.deriv(), BUMP.integ()


class Piece(NamedTuple):
    """What some rows of the data, B, contribute to the windows that hold any of them, C.

    Args:
        rows: of the data.
        windows: which.
        phi: weights that make ∫ φ f dt of a function f of the states.
        slope: the same for ∫ φ̇ f dt.
        held: the same for ∫ φ u dt of an input u that is held from row to row.
    """

    rows: Int[NDArray[np.intp], " B"]
    windows: slice
    phi: Float[Array, "C B"]
    slope: Float[Array, "C B"]
    held: Float[Array, "C B"]


@dataclass(frozen=True)
class Windows:
    """Windows that overlap; dt is in units of half a window.

    Args:
        time: of all rows [s].
        first: row that each window begins with, in their order.
        end: row that comes after its last.
    """

    time: Float[Array, " N"]
    first: Int[NDArray[np.intp], " W"]
    end: Int[NDArray[np.intp], " W"]

    def __len__(self) -> int:
        return len(self.first)

    @property
    def overlap(self) -> float:
        """How many windows hold a row, in the mean over those that any holds."""
        ends = np.maximum.accumulate(self.end)
        held = self.end - np.maximum(self.first, np.concatenate([[0], ends[:-1]]))
        return float((self.end - self.first).sum() / held.sum())

    def thin(self, most: int) -> Windows:
        """At most so many of them, evenly."""
        kept = slice(None, None, -(-len(self) // most))
        return replace(self, first=self.first[kept], end=self.end[kept])

    def pieces(self) -> Iterator[Piece]:
        """All rows that a window holds, `PIECE` at a time."""
        last = len(self.time) - 1
        ends = np.stack([self.time[self.first], self.time[self.end - 1]])
        middle, half = ends.mean(axis=0)[:, None], np.ptp(ends, axis=0)[:, None] / 2
        for start in range(0, len(self.time), PIECE):
            rows = np.arange(start, min(start + PIECE, last + 1))
            some = slice(
                int(np.searchsorted(self.end, start, "right")),
                int(np.searchsorted(self.first, rows[-1], "right")),
            )
            if some.start == some.stop:
                continue
            inside = (rows >= self.first[some, None]) & (rows < self.end[some, None])
            rows, inside = rows[inside.any(axis=0)], inside[:, inside.any(axis=0)]
            before, now, after = (
                np.clip((self.time[np.clip(at, 0, last)] - middle[some]) / half[some], -1, 1)
                for at in (rows - 1, rows, rows + 1)
            )
            step = np.where(inside, (after - before) / 2, 0)
            held = np.where(inside & (rows < self.end[some, None] - 1), INTEGRAL(after) - INTEGRAL(now), 0)
            yield Piece(rows, some, BUMP(now) * step, SLOPE(now) * step / half[some], held)


def windows(data: Dataset, beside: int = WINDOWS) -> Windows:
    """Windows in all trajectories, as long as the longest one asks for, shorter in those that are shorter.

    Args:
        data: trajectories.
        beside: so many fit into the longest one beside one another, where each has `LEAST` rows.

    Raises:
        DataError: no trajectory is long enough for a single window.
    """
    numbers = data.frame["trajectory"].to_numpy()
    begins = np.concatenate([[0], np.flatnonzero(np.diff(numbers)) + 1, [len(numbers)]])
    longest = int(np.diff(begins).max())
    if longest < SHORTEST:
        raise DataError(
            f"data set: the longest trajectory has {longest} rows, expected at least {SHORTEST} for the "
            "objective 'weak'; record for longer, or choose 'inverse'"
        )
    most = max(min(LONGEST, longest // WINDOWS, max(longest // beside, LEAST)) // 2, 2)
    firsts, lengths = [], []
    for begin, end in pairwise(begins.tolist()):
        half = most if 2 * most < end - begin else (end - begin - 1) // 4
        if half < max(most // OVERLAP, 2):
            continue  # derivatives of test functions grow as windows become short, and noise with them
        firsts.append(np.arange(begin, end - 2 * half, max(2 * half // OVERLAP, 1)))
        lengths.append(np.full(len(firsts[-1]), 2 * half + 1))
    first = np.concatenate(firsts)
    return Windows(data.frame["time"].to_numpy(dtype=float), first, first + np.concatenate(lengths))

"""Faults that a recorded signal shows by itself: cut off at a limit, stuck for a while, struck by spikes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.derivatives import SHORTEST, noise_level

Signal = Float[NDArray[np.float64], " N"]

LONG = 10
"""Rows of one value that count as a plateau …"""
SHARE = 0.02
"""… and what share of a recording must be in plateaus to be told of."""
LEAP = 5.0
"""A signal that was stuck goes on with a leap of so many times its usual moves, …"""
USUAL = 95
"""… which are no greater than this percentile of all."""
ALONE = 10.0
"""A spike is so many times higher above both its neighbours than …"""
ORDINARY = 99
"""… this percentile of all rows, …"""
SEEN = 0.1
"""… and higher than this share of the range of all other rows."""


class Plateau(NamedTuple):
    """Where a signal is cut off.

    Args:
        row: first row of the longest plateau at this extreme.
        rows: its length.
        level: the extreme.
        share: of all rows that are in plateaus.
    """

    row: int
    rows: int
    level: float
    share: float


def plateaus(values: Signal) -> list[Plateau]:
    """Extremes at which a signal is cut off, the upper one first.

    A plateau is a run at the extreme that the signal enters with a bend: half of its length before it began
    the signal was further away than a parabola that stays so long within the noise (or the resolution of the
    sensor) of its vertex can be. One that is entered by a jump belongs to a signal that goes in steps.
    """
    moves = np.abs(np.diff(values))
    real = moves[moves > 1e-9 * np.ptp(values)]
    if not len(real) or len(values) < SHORTEST:
        return []
    noise = 8 * noise_level(values)
    thickness = max(noise, float(real.min()))
    found = []
    for sign in (1.0, -1.0):
        x = sign * values
        inside = x >= x.max() - noise
        edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
        runs = [(int(a), int(b - a)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        cut = [(length, start) for start, length in runs if length >= LONG and start > 0]
        cut = [run for run in cut if _bends(x.max() - x, *run, 6 * thickness)]
        share = sum(length for length, _ in cut) / len(values)
        if share > SHARE:
            length, start = max(cut)
            found.append(Plateau(start, length, float(values[start]), share))
    return found


def _bends(away: Signal, length: int, start: int, least: float) -> bool:
    """Whether a signal comes to its extreme with a bend, neither gently nor by a jump.

    Args:
        away: distance from the extreme.
        length: of the plateau.
        start: its first row.
        least: distance, half a length before, that no gentle arrival has.
    """
    before = float(away[max(start - length // 2, 0)])
    return before > least and float(away[start - 1]) < before / 2


class Stuck(NamedTuple):
    """Where a signal stays as it was and goes on with a leap: the longest such place.

    Args:
        row: first row that repeats the value.
        rows: how many rows hold it.
        level: the value.
    """

    row: int
    rows: int
    level: float


def stuck(values: Signal) -> Stuck | None:
    """Where a signal is stuck, None where it never is.

    A sensor that has failed for a while goes on where the motion is by then. One that resolves no more, and a
    motion that rests, go on gently; a signal that goes in steps always leaps.
    """
    moves = np.abs(np.diff(values))
    real = moves[moves > 0]
    if len(real) < LONG:
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moves == 0, [False]]).astype(int)))
    leap = LEAP * float(np.percentile(real, USUAL))
    found = [
        Stuck(int(start), int(end - start), float(values[start]))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
        if end - start >= LONG and end < len(moves) and moves[end] > leap
    ]
    return max(found, key=lambda place: place.rows, default=None)


class Spike(NamedTuple):
    """The highest of the spikes of a signal.

    Args:
        row: where it is.
        value: what the signal is there.
        height: above the nearer of its neighbours, as a multiple of the range of all other rows.
        rows: how many spikes there are.
    """

    row: int
    value: float
    height: float
    rows: int


def spike(values: Signal) -> Spike | None:
    """Single rows that stick out from both their neighbours as no motion does, None if there are none."""
    with np.errstate(over="ignore", invalid="ignore"):
        before, after = np.diff(values)[:-1], -np.diff(values)[1:]
        lower = np.minimum(np.abs(before), np.abs(after))
    height = np.where(np.sign(before) == np.sign(after), lower, 0.0)
    if len(height) < LONG:
        return None
    resolved = np.abs(before[before != 0]).min(initial=np.inf)  # a coarse sensor flickers by that much
    usual = max(float(np.percentile(height, ORDINARY, method="lower")), float(resolved))
    high = np.flatnonzero(height > ALONE * usual)
    if not len(high):
        return None
    rest = float(np.ptp(np.delete(values, high + 1)))
    high = high[height[high] > SEEN * rest]
    if not len(high):
        return None
    row = int(high[np.argmax(height[high])])
    share = float(height[row]) / rest if rest > 0 else float("inf")
    return Spike(row + 1, float(values[row + 1]), share, len(high))

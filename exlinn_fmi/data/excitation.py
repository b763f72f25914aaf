"""Signals over time: from the signal section of a scenario to a function of time.

A signal depends on time alone: it does not matter in which order or in what pieces it is evaluated, and a
seed gives the same signal always.

**Time at jumps.** Communication points are t0 + k·h, rounded: 3·0.1 is not 0.3. A signal that jumps at 0.3 s
must jump at that point all the same. So wherever a signal decides on which side of an instant it is, times
less than a nanosecond (or eight units in the last place of t) apart are one, and the jump has happened.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.errors import DataError, nearest
from exlinn_fmi.scenario.signals import Chirp, Constant, Multisine, Prbs, Ramp, Signal, Sine, Step, Table

Times = NDArray[np.float64]
SignalFunction = Callable[[Times], NDArray[np.float64]]
"""Values (k,) of a signal at times (k,) [s]."""

SAME_TIME = 1e-9
"""Two times closer than this [s] are the same time."""

TAPS = {
    3: (3, 2), 4: (4, 3), 5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4), 9: (9, 5), 10: (10, 7),
    11: (11, 9), 12: (12, 6, 4, 1), 13: (13, 4, 3, 1), 14: (14, 5, 3, 1), 15: (15, 14), 16: (16, 15, 13, 4),
    17: (17, 14), 18: (18, 11), 19: (19, 6, 2, 1), 20: (20, 17),
}  # fmt: skip
"""Register positions whose sum is fed back, by register length: primitive polynomials, period 2^n − 1."""


def signal_function(spec: Signal, folder: Path) -> SignalFunction:
    """The function of time that a signal section describes.

    Args:
        spec: the section.
        folder: folder of the scenario, which file names start from.

    Returns:
        A function that takes times (k,) [s] and gives values (k,) in the unit of `spec`. A table that is not
        to be used outside its rows raises DataError there.

    Raises:
        DataError: a table cannot be used, or a multisine's band is empty.
    """
    match spec:
        case Constant():
            value = spec.value
            return lambda t: np.full(t.shape, value)
        case Step():
            return lambda t: np.where(_not_before(t) >= spec.time, spec.after, spec.before)
        case Ramp():
            length = np.inf if spec.stop is None else max(0.0, spec.stop - spec.start)
            return lambda t: spec.offset + spec.slope * np.clip(t - spec.start, 0.0, length)
        case Sine():
            return lambda t: (
                spec.offset + spec.amplitude * np.sin(2 * np.pi * spec.frequency * t + spec.phase)
            )
        case Multisine():
            return _multisine(spec)
        case Chirp():
            return _chirp(spec)
        case Prbs():
            return _prbs(spec)
        case Table():
            return _table(spec, folder / spec.file)


def _not_before(t: Times) -> Times:
    """Times moved on by the width of an instant: `>= jump` then holds at the jump whatever the rounding."""
    moved: Times = t + np.maximum(SAME_TIME, 8 * np.spacing(np.abs(t)))
    return moved


def _multisine(spec: Multisine) -> SignalFunction:
    low, high = spec.band
    if spec.lines > 1 and not low < high:
        raise DataError(
            f"multisine: band {low:g} … {high:g} Hz holds no {spec.lines} different frequencies; "
            "give the lower one first"
        )
    omega = 2 * np.pi * np.linspace(low, high, spec.lines)
    phase = np.random.default_rng(spec.seed).uniform(0.0, 2 * np.pi, spec.lines)
    amplitude = spec.rms * np.sqrt(2.0 / spec.lines)
    rows = max(1, 2**18 // spec.lines)  # at a time: keeps the table of all sines at all times small

    def values(t: Times) -> NDArray[np.float64]:
        parts = [
            np.sin(np.multiply.outer(t[k : k + rows], omega) + phase).sum(axis=1)
            for k in range(0, len(t), rows)
        ]
        oscillation: NDArray[np.float64] = amplitude * np.concatenate([*parts, np.empty(0)])
        return oscillation + spec.offset

    return values


def _chirp(spec: Chirp) -> SignalFunction:
    first, last = spec.band
    duration, ratio = spec.duration, last / first

    def values(t: Times) -> NDArray[np.float64]:
        # The sweep that t lies in is decided at instants; the time within it may be a rounding error below 0.
        tau = t - duration * np.floor(_not_before(t) / duration)
        if spec.method == "logarithmic" and ratio != 1.0:
            cycles = first * duration / np.log(ratio) * (ratio ** (tau / duration) - 1.0)
        else:
            cycles = first * tau + (last - first) * tau**2 / (2 * duration)
        oscillation: NDArray[np.float64] = spec.amplitude * np.sin(2 * np.pi * cycles)
        return oscillation + spec.offset

    return values


def _prbs(spec: Prbs) -> SignalFunction:
    register = int(np.random.default_rng(spec.seed).integers(1, 2**spec.order))
    levels = spec.offset + spec.amplitude * (2.0 * maximum_length_sequence(spec.order, register) - 1.0)
    period = len(levels)

    def values(t: Times) -> NDArray[np.float64]:
        index = np.floor(_not_before(t) / spec.hold).astype(np.int64) % period
        held: NDArray[np.float64] = levels[index]
        return held

    return values


def maximum_length_sequence(order: int, register: int) -> NDArray[np.float64]:
    """One period, 2^order − 1 bits (0.0 or 1.0), of a linear feedback shift register.

    Args:
        order: register length, 3 … 20.
        register: first content, 1 … 2^order − 1.

    References:
        S. W. Golomb, Shift Register Sequences, 1967.
    """
    bits = np.empty(2**order - 1)
    taps = [tap - 1 for tap in TAPS[order]]
    mask = 2**order - 1
    for k in range(len(bits)):
        bits[k] = register >> (order - 1)
        fed_back = 0
        for tap in taps:
            fed_back ^= register >> tap
        register = (register << 1) & mask | fed_back & 1
    return bits


def _table(spec: Table, path: Path) -> SignalFunction:
    times, column = _read_table(path, spec.column)
    first, last = times[0], times[-1]

    def values(t: Times) -> NDArray[np.float64]:
        after = _not_before(t)
        if spec.outside == "error":
            outside = (after < first) | (t > last + (after - t))
            if outside.any():
                raise DataError(
                    f"{path}: no value at t = {t[outside][0]:.9g} s, the rows go from {first:.9g} to "
                    f"{last:.9g} s; add rows, or say `outside: hold`"
                )
        if spec.interpolation == "hold":
            held: NDArray[np.float64] = column[np.maximum(np.searchsorted(times, after, side="right") - 1, 0)]
            return held
        return np.interp(t, times, column)

    return values


def _read_table(path: Path, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and values of one column of a CSV file.

    Raises:
        DataError: there is no such file or column, or the rows make no signal.
    """
    import pandas as pd

    if not path.is_file():
        beside = [p.name for p in path.parent.glob("*.csv")] if path.parent.is_dir() else []
        raise DataError(f"{path}: no such file; {nearest(path.name, beside, 'CSV files there')}")
    try:
        frame = pd.read_csv(path, skipinitialspace=True, index_col=False)
    except (OSError, ValueError) as error:  # pandas' parser and decoding errors are ValueErrors
        reason = str(error).strip().splitlines()[0]
        raise DataError(
            f"{path}: not a CSV table ({reason}); expected a line of column names, then numbers"
        ) from error
    for column in ("time", name):
        if column not in frame.columns:
            known = [str(c) for c in frame.columns]
            raise DataError(f"{path}: no column {column!r}; {nearest(column, known, 'columns')}")
    if frame.empty:
        raise DataError(f"{path}: no rows below the column names; expected at least one")
    times, values = (_numbers(path, column, frame[column]) for column in ("time", name))
    back = np.flatnonzero(np.diff(times) <= 0)
    if back.size:
        row = int(back[0]) + 2
        raise DataError(
            f"{path}: row {row} (counted below the column names): time {times[row - 1]:.9g} s does not come "
            f"after {times[row - 2]:.9g} s; times must increase"
        )
    return times, values


def _numbers(path: Path, column: str, entries: object) -> NDArray[np.float64]:
    """Entries of a column as finite numbers.

    Raises:
        DataError: with the first row that is none.
    """
    import pandas as pd

    numbers = pd.to_numeric(pd.Series(entries), errors="coerce").to_numpy(dtype=float)
    bad = np.flatnonzero(~np.isfinite(numbers))
    if bad.size:
        row = int(bad[0])
        found = pd.Series(entries).iloc[row]
        shown = "nothing or nan" if pd.isna(found) else repr(found) if isinstance(found, str) else found
        raise DataError(
            f"{path}: row {row + 1} (counted below the column names), column {column!r}: found {shown}, "
            "expected a finite number"
        )
    return numbers

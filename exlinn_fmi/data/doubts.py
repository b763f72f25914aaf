"""Whether measured data are fit to learn from: what is refused, and what the user should be told.

Refused is what could only lead to a model that looks trained and is not; the messages name file and row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import MINIMUM_ROWS
from exlinn_fmi.data.derivatives import derivative, noise_level
from exlinn_fmi.data.foreign import ForeignTable
from exlinn_fmi.errors import DataError
from exlinn_fmi.mechanics.coordinates import Coordinate, input_names, state_names

Signal = Float[NDArray[np.float64], " N"]

BURIED, POOR = 2.0, 10.0
"""A signal of less than so many standard deviations of its noise is refused, or doubtful."""
LONG = 10
"""Rows at the extreme that count as a plateau …"""
SHARE = 0.02
"""… and what share of a file must be in plateaus to be told of."""
SECTORS = 24
"""Sectors of the circle, each of which should be visited."""
USUAL_FACTORS = {
    "deg for rad": 180 / np.pi,
    "rad for deg": np.pi / 180,
    "rpm for rad/s": 60 / (2 * np.pi),
    "rad/s for rpm": 2 * np.pi / 60,
    "a factor of 1000": 1000.0,
    "a factor of 1/1000": 1e-3,
}
"""Mistakes in units, by the factor that tells them."""


@dataclass(frozen=True)
class Recording:
    """One file in the model's quantities.

    Args:
        table: the file as it was read.
        frame: ``time`` [s] from 0 and the quantities that the file has, by their names in the model.
        estimated: velocities that it does not have.
    """

    table: ForeignTable
    frame: pd.DataFrame
    estimated: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.table.path.name


def check_recordings(
    training: Sequence[Recording], tests: Sequence[Recording], coordinates: tuple[Coordinate, ...]
) -> list[str]:
    """Refuse recordings that nothing can be learned from; tell what is doubtful in the others.

    Args:
        training: files to train on.
        tests: files held out.
        coordinates: the generalised coordinates.

    Raises:
        DataError: too few rows, a quantity that does not change or only by noise, inputs that are 0
            throughout, or a test that is also trained on.
    """
    mistakes = list(_unusable(training, tests, coordinates))
    if mistakes:
        raise DataError("\n".join(mistakes))
    states, inputs = state_names(coordinates), input_names(coordinates)
    notes = list(_constant_inputs(training, inputs))
    for name in states:
        signals = [r.frame[name].to_numpy() for r in training if name in r.frame]
        if signals and (ratio := _signal_to_noise(signals)) < POOR:
            notes.append(f"{name!r} varies only {ratio:.2g} times as much as its noise: excite it more")
    for recording in training:
        present = [name for name in states if name in recording.frame]
        notes += [
            f"{recording.name}: {name!r} is {recording.frame[name].iloc[0]:.6g} in all rows of this file"
            for name in present
            if np.ptp(recording.frame[name]) == 0
        ]
        for name in (*present, *inputs):
            kind = "the input" if name in inputs else "the sensor, or the motion,"
            for found in plateaus(recording.frame[name].to_numpy()):
                notes.append(
                    f"{recording.table.at(found.row)}: {name!r} stays at its extreme, {found.level:.6g}, for "
                    f"{found.rows} rows from here, and for {found.share:.0%} of the file in all: {kind} may "
                    "be saturated, so that what acted is not what was recorded"
                )
    return notes


def _unusable(
    training: Sequence[Recording], tests: Sequence[Recording], coordinates: tuple[Coordinate, ...]
) -> Iterator[str]:
    """Why nothing can be learned."""
    rows = sum(len(r.frame) for r in training)
    if rows < MINIMUM_ROWS:
        yield f"{_files(training)}: {rows} rows in all, expected at least {MINIMUM_ROWS}; record for longer"
        return
    for test in tests:
        for twin in training:
            if test.frame.equals(twin.frame):
                yield f"{test.name}: held out, but its numbers are those of {twin.name}, which is trained on"
    for name in state_names(coordinates):
        signals = [r.frame[name].to_numpy() for r in training if name in r.frame]
        if signals and all(np.ptp(signal) == 0 for signal in signals):
            yield (
                f"{_files(training)}: {name!r} is {signals[0][0]:.6g} in all rows, so nothing can be learned "
                "of it; excite it, choose another column, or leave the coordinate out"
            )
        elif signals and (ratio := _signal_to_noise(signals)) < BURIED:
            yield (
                f"{_files(training)}: {name!r} varies only {ratio:.2g} times as much as its noise from row "
                "to row: it is not excited, or sampled too slowly; excite it more"
            )
    inputs = input_names(coordinates)
    if inputs and not any(r.frame[name].any() for r in training for name in inputs):
        named = " and ".join(map(repr, inputs))
        yield f"{_files(training)}: {named} is 0 in all rows, so the model's scale stays open; drive an input"


def _signal_to_noise(signals: Sequence[Signal]) -> float:
    """Standard deviation of a quantity over that of its noise."""
    noise = float(np.median([noise_level(signal) for signal in signals]))
    spread = float(np.sqrt(np.mean([signal.var() for signal in signals])))
    return spread / noise if noise > 0 else np.inf


def _constant_inputs(training: Sequence[Recording], inputs: Sequence[str]) -> Iterator[str]:
    """Inputs that are the same in all rows of all files."""
    for name in inputs:
        values = np.concatenate([r.frame[name].to_numpy() for r in training])
        if np.ptp(values) == 0:
            yield f"{_files(training)}: {name!r} is {values[0]:.6g} in all rows; vary it to learn more"


def _files(recordings: Sequence[Recording]) -> str:
    """Names of files, the first and the last where they are many."""
    names = [recording.name for recording in recordings]
    return ", ".join(names) if len(names) < 4 else f"{names[0]} … {names[-1]}"


# ── saturation ───────────────────────────────────────────────────────────────────────────────────────────


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
    if not len(real):
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


# ── what belongs together ────────────────────────────────────────────────────────────────────────────────


def doubts(
    parts: Sequence[pd.DataFrame], coordinates: tuple[Coordinate, ...], measured: Set[str]
) -> list[str]:
    """What is doubtful in the trajectories to train on.

    Args:
        parts: the trajectories, each on a regular grid.
        coordinates: the generalised coordinates.
        measured: quantities that were measured, not estimated.

    Raises:
        DataError: a measured velocity is not the derivative of its position at all.
    """
    notes: list[str] = []
    mistakes: list[str] = []
    for c in coordinates:
        if c.topology == "circle" and (share := _covered([part[c.name] for part in parts], c.unit)) < 1:
            notes.append(
                f"{c.name} covers {share:.0%} of the circle in training: elsewhere the model is a guess"
            )
        if c.topology != "cyclic" and {c.name, c.velocity} <= measured:
            text, grave = _mismatch(parts, c)
            (mistakes if grave else notes).extend([text] if text else [])
    if mistakes:
        raise DataError("\n".join(mistakes))
    return notes


def _covered(angles: Sequence[pd.Series[float]], unit: str) -> float:
    """Share of the circle that an angle visits."""
    from exlinn_fmi.mechanics.learned import TURN

    turn = TURN.get(unit, 2 * np.pi)
    sectors = np.floor(np.mod(np.concatenate(angles), turn) / turn * SECTORS)
    return len(np.unique(sectors)) / SECTORS


def _mismatch(parts: Sequence[pd.DataFrame], c: Coordinate) -> tuple[str, bool]:
    """What is to be said of a velocity that is not the derivative of its position, and whether it is grave.

    The true factor between the two lies between the two regressions, whichever of them is noisy.
    """
    slopes, speeds = [], []
    for part in parts:
        slopes.append(derivative(part["time"].to_numpy(), part[c.name].to_numpy()))
        speeds.append(part[c.velocity].to_numpy())
    slope, speed = np.concatenate(slopes), np.concatenate(speeds)
    product = float(slope @ speed)
    correlation = product / float(np.linalg.norm(slope) * np.linalg.norm(speed))
    if abs(correlation) < 0.3:
        text = f"{c.velocity!r} has nothing to do with the derivative of {c.name!r}: check columns and signs"
        return text, True
    low, high = product / float(speed @ speed), float(slope @ slope) / product
    if correlation > 0 and low < 1.1 and high > 1 / 1.1:
        return "", False
    factor = 1 / (np.sign(low) * float(np.sqrt(low * high)))
    text = (
        f"{c.velocity!r} is {factor:.4g} times the derivative of {c.name!r}{_cause(factor)}; give the "
        "`unit` or `scale` of the column in `data.columns` (or of the time in `data.time`)"
    )
    return text, not 0.5 < factor < 2


def _cause(factor: float) -> str:
    """The mistake in units that a factor tells."""
    known: Mapping[str, float] = USUAL_FACTORS
    near = [name for name, value in known.items() if abs(abs(factor) / value - 1) < 0.1]
    return f" ({'the other way round, ' if factor < 0 else ''}{near[0]}?)" if near else ""

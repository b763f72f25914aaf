"""Whether data are fit to learn from, wherever they come from: what is refused, what the user should be told.

Refused is what could only lead to a model that looks trained and is not; the messages name file and row, or
experiment and time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import MINIMUM_ROWS, Dataset, required_columns
from exlinn_fmi.data.derivatives import (
    EVEN,
    SHORTEST,
    best_window,
    derivative,
    noise_gain,
    noise_level,
)
from exlinn_fmi.data.faults import plateaus, spike, stuck
from exlinn_fmi.errors import DataError
from exlinn_fmi.mechanics.coordinates import Coordinate, full_turn, input_names, state_names

Signal = Float[NDArray[np.float64], " N"]

NO_USE = ", so nothing can be learned of it; excite it, choose another column, or leave the coordinate out"
OF_FILES = "give the `unit` or `scale` of the column in `data.columns` (or of the time in `data.time`)"
OF_PLANTS = "check that both are of the same coordinate, their signs and their units"
BURIED, POOR = 2.0, 10.0
"""A signal of less than so many standard deviations of its noise is refused, or doubtful."""
WILD = 100.0
"""A single row that sticks out by so many times the range of all others is refused."""
TURN_PER_ROW = 0.25
"""An angle that moves further than this share of a turn from row to row is not in the unit that it says."""
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
    """One file, or one experiment, in the model's quantities.

    Args:
        name: of the file or experiment.
        at: tells where a row of `frame` stands.
        frame: ``time`` [s] and the quantities that were recorded, by their names in the model.
        estimated: velocities that it does not have.
        notes: what the user should know of the reading.
    """

    name: str
    at: Callable[[int], str]
    frame: pd.DataFrame
    estimated: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def audit(dataset: Dataset, names: Sequence[str] = ()) -> list[str]:
    """Refuse data that no model can be trained on; tell what is doubtful in others.

    Args:
        dataset: trajectories; those that are held out only serve to tell whether they are also trained on.
        names: what to call the trajectories in messages; ``trajectory 0``, … if not given.

    Raises:
        DataError: too few rows, a coordinate that does not move or only by noise, inputs that are 0
            throughout, values that nothing real can have, a velocity that is not the derivative of its
            position, or a test that is also trained on.
    """
    called = names or [f"trajectory {number}" for number in dataset.trajectories]
    recorded = [name for name in required_columns(dataset.coordinates) if name not in dataset.estimated]
    recordings = {
        number: _as_recording(name, part[recorded].drop(columns="trajectory").reset_index(drop=True))
        for name, (number, part) in zip(called, dataset.frame.groupby("trajectory", sort=False), strict=True)
    }
    tests = [recordings.pop(number) for number in dataset.held_out]
    training = list(recordings.values())
    notes = check_recordings(training, tests, dataset.coordinates)
    for name in (c.acceleration for c in dataset.coordinates):
        if np.ptp(dataset.training.frame[name]) == 0:
            value = dataset.training.frame[name].iloc[0]
            raise DataError(f"{_files(training)}: {name!r} is {value:.6g} in all rows{NO_USE}")
    return notes + doubts([r.frame for r in training], dataset.coordinates, set(recorded), OF_PLANTS)


def _as_recording(name: str, frame: pd.DataFrame) -> Recording:
    time = frame["time"].to_numpy(dtype=float)
    return Recording(name, lambda row: f"{name} at t = {time[row]:.6g} s", frame)


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
            throughout, values out of all proportion, or a test that is also trained on.
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
        notes += _faults(recording, states, inputs)
    return notes


def _faults(recording: Recording, states: Sequence[str], inputs: Sequence[str]) -> Iterator[str]:
    """What single signals show of limits and failed sensors."""
    present = [name for name in states if name in recording.frame]
    for name in present:
        values = recording.frame[name].to_numpy(dtype=float)
        if len(values) > 1 and np.ptp(values) == 0:
            yield f"{recording.name}: {name!r} is {values[0]:.6g} in all its rows"
        if held := stuck(values):
            yield (
                f"{recording.at(held.row)}: {name!r} stays {held.level:.6g} for {held.rows} rows from here "
                "and then leaps: the sensor may be stuck; leave that part out"
            )
        if found := spike(values):
            more = f", the highest of {found.rows} spikes" if found.rows > 1 else ""
            yield (
                f"{recording.at(found.row)}: {name!r} is {found.value:.6g} in a single row{more}: no motion "
                "does that; repair or remove the row"
            )
    for name in (*present, *inputs):
        kind = "the input" if name in inputs else "the sensor, or the motion,"
        for plateau in plateaus(recording.frame[name].to_numpy(dtype=float)):
            yield (
                f"{recording.at(plateau.row)}: {name!r} stays at its extreme, {plateau.level:.6g}, for "
                f"{plateau.rows} rows from here, and for {plateau.share:.0%} of {recording.name} in all: "
                f"{kind} may be saturated, so that what acted is not what was recorded"
            )


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
    known = {name for r in training for name in r.frame}
    blind = {name for c in coordinates if c.acceleration not in known for name in (c.name, c.velocity)}
    for name in state_names(coordinates):
        found = [r for r in training if name in r.frame]
        signals = [r.frame[name].to_numpy(dtype=float) for r in found]
        if signals and _constant(signals):
            yield (f"{_files(training)}: {name!r} is {signals[0][0]:.6g} in all rows{NO_USE}")
        wild = [(r, s) for r, v in zip(found, signals, strict=True) if (s := spike(v)) and s.height > WILD]
        for recording, high in wild:
            yield (
                f"{recording.at(high.row)}: {name!r} is {high.value:.6g}, {high.height:.2g} times the range "
                "of all other rows: repair or remove the row"
            )
        # Where accelerations were recorded none is estimated, and rows need not be close to each other.
        if signals and not wild and name in blind and (ratio := _signal_to_noise(signals)) < BURIED:
            yield (
                f"{_files(training)}: {name!r} varies only {ratio:.2g} times as much as its noise from row "
                "to row: it is not excited, or sampled too slowly; excite it more"
            )
    inputs = input_names(coordinates)
    if not any(r.frame[name].any() for r in training for name in inputs):
        named = " and ".join(map(repr, inputs))
        what = f"{named} is 0 in all rows" if inputs else "no coordinate has an input"
        yield f"{_files(training)}: {what}, so the model's scale stays open; drive an input"


def _constant(signals: Sequence[NDArray[np.float64]]) -> bool:
    """Whether a quantity moves in no recording."""
    if max(map(len, signals)) == 1:
        return float(np.ptp(np.concatenate(signals))) == 0
    return all(float(np.ptp(signal)) == 0 for signal in signals)


def _signal_to_noise(signals: Sequence[NDArray[np.float64]]) -> float:
    """Standard deviation of a quantity over that of its noise, ∞ where no signal is long enough to tell."""
    long = [signal for signal in signals if len(signal) >= SHORTEST]
    noise = float(np.median([noise_level(signal) for signal in long])) if long else 0.0
    spread = float(np.sqrt(np.mean([signal.var() for signal in long]))) if long else 0.0
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


# ── what belongs together ────────────────────────────────────────────────────────────────────────────────


def doubts(
    parts: Sequence[pd.DataFrame],
    coordinates: tuple[Coordinate, ...],
    measured: Set[str],
    advice: str = OF_FILES,
) -> list[str]:
    """What is doubtful in the trajectories to train on.

    Args:
        parts: the trajectories, each on a regular grid.
        coordinates: the generalised coordinates.
        measured: quantities that were measured, not estimated.
        advice: what to do about a velocity in another unit.

    Raises:
        DataError: a measured velocity is not the derivative of its position at all.
    """
    notes: list[str] = []
    turning: list[str] = []
    mistakes: list[str] = []
    for c in coordinates:
        if c.topology == "circle" and (turns := _turns_per_row(parts, c)) > TURN_PER_ROW:
            turning.append(
                f"{c.name!r} moves up to {turns:.2g} turns from row to row: is it in {c.unit}? If so, record "
                "more rows per turn"
            )
        if c.topology == "circle" and (share := _covered([part[c.name] for part in parts], c.unit)) < 1:
            notes.append(
                f"{c.name} covers {share:.0%} of the circle in training: elsewhere the model is a guess"
            )
        if c.topology != "cyclic" and {c.name, c.velocity} <= measured:
            text, grave = _mismatch(parts, c, advice)
            (mistakes if grave else notes).extend([text] if text else [])
    if mistakes:
        raise DataError("\n".join([*mistakes, *turning]))
    return notes + turning


def _turns_per_row(parts: Sequence[pd.DataFrame], c: Coordinate) -> float:
    """Furthest that an angle moves from one row to the next."""
    moves = [np.abs(np.diff(part[c.name].to_numpy(dtype=float))).max(initial=0.0) for part in parts]
    return float(max(moves)) / full_turn(c.unit)


def _covered(angles: Sequence[pd.Series[float]], unit: str) -> float:
    """Share of the circle that an angle visits."""
    turn = full_turn(unit)
    sectors = np.floor(np.mod(np.concatenate(angles), turn) / turn * SECTORS)
    return len(np.unique(sectors)) / SECTORS


def _mismatch(parts: Sequence[pd.DataFrame], c: Coordinate, advice: str) -> tuple[str, bool]:
    """What is to be said of a velocity that is not the derivative of its position, and whether it is grave.

    The true factor between the two lies between the two regressions, whichever of them is noisy.
    """
    slopes, speeds, noise = [np.empty(0)], [np.empty(0)], 0.0
    for part in parts:
        time, position = part["time"].to_numpy(dtype=float), part[c.name].to_numpy(dtype=float)
        step = np.diff(time)
        if len(part) < SHORTEST or np.ptp(step) > EVEN * step.min():
            continue
        window = best_window(position)
        slopes.append(derivative(time, position, 1, window))
        speeds.append(part[c.velocity].to_numpy(dtype=float))
        noise += len(part) * (noise_level(position) * noise_gain(window) / step[0]) ** 2
    slope, speed = np.concatenate(slopes), np.concatenate(speeds)
    if not slope.any() or not speed.any():
        return "", False
    product = float(slope @ speed)
    correlation = product / float(np.linalg.norm(slope) * np.linalg.norm(speed))
    if abs(correlation) < 0.3:
        if noise > slope @ slope / 2:
            return "", False  # the position is too rough to tell
        text = f"{c.velocity!r} has nothing to do with the derivative of {c.name!r}: check columns and signs"
        return text, True
    low, high = product / float(speed @ speed), float(slope @ slope) / product
    if correlation > 0 and low < 1.1 and high > 1 / 1.1:
        return "", False
    factor = 1 / (np.sign(low) * float(np.sqrt(low * high)))
    text = f"{c.velocity!r} is {factor:.4g} times the derivative of {c.name!r}{_cause(factor)}; {advice}"
    return text, not 0.5 < factor < 2


def _cause(factor: float) -> str:
    """The mistake in units that a factor tells."""
    known: Mapping[str, float] = USUAL_FACTORS
    near = [name for name, value in known.items() if abs(abs(factor) / value - 1) < 0.1]
    return f" ({'the other way round, ' if factor < 0 else ''}{near[0]}?)" if near else ""

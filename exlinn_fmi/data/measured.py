"""Measured data: recordings from files to a data set of trajectories on a regular grid.

Each file is read, converted to the model's quantities and units, checked row by row, cut where the clock has
gaps, and evened out where its steps differ. Then what is missing of velocities and accelerations is estimated
(`dataset.estimate_missing`), and all is filtered and resampled where that is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset, estimate_missing, matched, required_columns
from exlinn_fmi.data.derivatives import EVEN, SHORTEST
from exlinn_fmi.data.doubts import Recording, check_recordings, doubts
from exlinn_fmi.data.foreign import ForeignTable, column_names, read_foreign
from exlinn_fmi.errors import DataError
from exlinn_fmi.mechanics.coordinates import Coordinate, full_turn, input_names
from exlinn_fmi.scenario.learning import Column, LowPass, Measured, Resample
from exlinn_fmi.scenario.units import conversion

GAP = 4.5
"""A step of more than so many usual ones cuts a recording in two; missing rows below are interpolated."""
GUARD = 0.8
"""Cut-off of the filter before decimation, as a share of the new Nyquist frequency."""
CLOSE = 0.25
"""Rows are close to each other that lie less than this share of the usual step apart."""
NO_TEST = (
    "no file is held out (`test` or `hold_out`): nothing tells how good the model is on data that it has not "
    "seen, and the figure shows it on what it was trained on; give it another recording"
)

Signal = Float[NDArray[np.float64], " N"]


def import_measured(data: Measured, coordinates: tuple[Coordinate, ...], folder: Path, seed: int) -> Dataset:
    """Read measured data.

    Args:
        data: files, columns, and what is done to them.
        coordinates: the generalised coordinates.
        folder: where relative paths start.
        seed: of the draw of files that are held out.

    Returns:
        Training files first, then those held out; each file, or part of it between gaps, is a trajectory.
        The notes of the data set say what was done unasked and what is doubtful.

    Raises:
        DataError: with file and row, for every file that cannot be used.
    """
    training, tests = held_out(data, seed)
    recordings = _record_all([folder / name for name in (*training, *tests)], data, coordinates)
    count, inputs = len(training), input_names(coordinates)
    notes = [note for recording in recordings for note in recording.notes] + _estimated(recordings)
    notes += check_recordings(recordings[:count], recordings[count:], coordinates)
    grid = as_grid(data)
    between = "hold" if grid is None else grid.inputs
    groups: list[list[pd.DataFrame]] = []
    for recording in recordings:
        parts, more = regular(recording, data, inputs)
        parts = [estimate_missing(part.assign(trajectory=0), coordinates, between) for part in parts]
        groups.append([low_pass(part, data.filter, recording.name) for part in parts])
        notes += more
    measured = set.intersection(*(set(recording.frame.columns) for recording in recordings))
    notes += doubts([part for group in groups[:count] for part in group], coordinates, measured)
    frames = [part if grid is None else resample(part, grid, inputs) for group in groups for part in group]
    numbered = [frame.assign(trajectory=number) for number, frame in enumerate(frames)]
    frame = pd.concat(numbered, ignore_index=True)
    kept = required_columns(coordinates)
    frame = frame[kept + [name for name in map(matched, inputs) if name in frame]]
    first = sum(map(len, groups[:count]))
    return Dataset(
        frame,
        coordinates,
        held_out=tuple(range(first, len(frames))),
        notes=tuple(notes if tests else [*notes, NO_TEST]),
        estimated=tuple(name for name in kept if name not in {"trajectory", *measured}),
    )


def held_out(data: Measured, seed: int) -> tuple[list[str], list[str]]:
    """Files to train on and files held out, the latter as stated or drawn."""
    if not data.hold_out:
        return list(data.files), list(data.test)
    drawn = set(np.random.default_rng(seed).permutation(len(data.files))[: data.hold_out].tolist())
    return (
        [name for k, name in enumerate(data.files) if k not in drawn],
        [name for k, name in enumerate(data.files) if k in drawn],
    )


def _record_all(
    paths: Sequence[Path], data: Measured, coordinates: tuple[Coordinate, ...]
) -> list[Recording]:
    """All files, or the mistakes in all of them."""
    recordings, mistakes = [], []
    for path in paths:
        try:
            recordings.append(record(path, data, coordinates))
        except DataError as error:
            mistakes.append(str(error))
    if mistakes:
        raise DataError("\n".join(mistakes))
    return recordings


def _estimated(recordings: Sequence[Recording]) -> list[str]:
    """Notes on velocities that were not measured."""
    files: dict[str, list[str]] = {}
    for recording in recordings:
        for name in recording.estimated:
            files.setdefault(name, []).append(recording.name)
    return [
        f"{name} is not in {'the files' if len(owners) == len(recordings) else ', '.join(owners)}: "
        "estimated from the position"
        for name, owners in files.items()
    ]


# ── from file to model ───────────────────────────────────────────────────────────────────────────────────


def quantities(
    data: Measured, coordinates: Sequence[Coordinate], known: Sequence[str]
) -> dict[str, tuple[Column, str]]:
    """Which column of a file is what in the model.

    Args:
        data: its `columns`.
        coordinates: the generalised coordinates.
        known: names of the columns of the file.

    Returns:
        Column and unit by name of the quantity. Velocities and accelerations that can be estimated are left
        out where `columns` does not name them and the file has no column of their name.
    """
    found = {}
    for c in coordinates:
        cyclic = c.topology == "cyclic"
        members = [] if cyclic else [(c.name, c.unit, True)]
        members += [(c.velocity, c.velocity_unit, cyclic), (c.acceleration, c.acceleration_unit, False)]
        members += [(c.input, c.input_unit, True)] if c.input is not None else []
        for name, unit, needed in members:
            if needed or name in data.columns or name in known:
                found[name] = as_column(data.columns.get(name, name)), unit
    return found


def as_column(given: str | Column) -> Column:
    """A column with its conversion, where only its name may be given."""
    return Column(column=given) if isinstance(given, str) else given


def record(path: Path, data: Measured, coordinates: tuple[Coordinate, ...]) -> Recording:
    """Read a file and convert it to the model's quantities.

    Raises:
        DataError: the file cannot be used; with the row.
    """
    clock = None if data.step is not None else as_column(data.time or "time")
    every = [as_column(column).column for column in data.columns.values()]
    known = column_names(path, [*every, *([clock.column] if clock else [])], data.delimiter, data.decimal)
    chosen = quantities(data, coordinates, known)
    names = [column.column for column, _ in chosen.values()]
    table = read_foreign(path, [*([clock.column] if clock else []), *names], data.delimiter, data.decimal)
    rows = len(next(iter(table.columns.values())))
    if rows < SHORTEST:
        raise DataError(f"{path.name}: {rows} rows, expected at least {SHORTEST}; record for longer")
    time = convert(table, clock, "s") if clock else np.arange(float(rows)) * (data.step or 0.0)
    _check_time(table, time, clock.column if clock else "")
    columns = {name: convert(table, column, unit) for name, (column, unit) in chosen.items()}
    for c in coordinates:
        if c.topology == "circle":
            columns[c.name] = unwrap(columns[c.name], c.unit)
    estimated = tuple(c.velocity for c in coordinates if c.velocity not in columns)
    frame = pd.DataFrame({"time": time - time[0], **columns})
    return Recording(path.name, table.at, frame, estimated, tuple(table.notes))


def convert(table: ForeignTable, column: Column, unit: str) -> Signal:
    """A column in the model's unit."""
    factor = 1.0 if column.unit is None else conversion(column.unit, unit)
    if factor is None:
        raise DataError(f"{column.column}: no conversion from {column.unit!r} to {unit!r}; give `scale`")
    values = column.scale * table.columns[column.column] + column.offset
    return np.asarray(factor * values)


def unwrap(angle: Signal, unit: str) -> Signal:
    """An angle without the jumps of sensors that begin anew after a full turn."""
    return np.unwrap(angle, period=full_turn(unit))


def _check_time(table: ForeignTable, time: Signal, column: str) -> None:
    """Refuse recordings in which time does not increase."""
    for row in np.flatnonzero(np.diff(time) <= 0)[:1] + 1:
        now, before = float(time[row]), float(time[row - 1])
        what = f"{table.at(int(row))}: column {column!r}: {now:.9g} s after {before:.9g} s; "
        if now < before:
            raise DataError(f"{what}time goes backwards: make a file of its own of what begins here")
        same = int(np.count_nonzero(np.diff(time) == 0))
        raise DataError(
            f"{what}time stands still here{f' and in {same - 1} other rows' if same > 1 else ''}: take out "
            "rows that are there twice, or, if it has too few digits, give `step` in the place of `time`"
        )


# ── from recording to trajectories ───────────────────────────────────────────────────────────────────────


def as_grid(data: Measured) -> Resample | None:
    """The grid that is asked for, where only its step may be given."""
    return Resample(step=data.resample) if isinstance(data.resample, float | int) else data.resample


def regular(
    recording: Recording, data: Measured, inputs: Sequence[str]
) -> tuple[list[pd.DataFrame], list[str]]:
    """Cut a recording at gaps, and even out its steps where they differ.

    Velocities and accelerations are to be estimated from what comes of it: after a filter, or on another grid
    than the recording's, noise would no longer look like noise.

    Args:
        recording: one file.
        data: what is to be done.
        inputs: names of the inputs.

    Returns:
        The parts, each on a regular grid, and what was done unasked.

    Raises:
        DataError: no part is long enough.
    """
    time = recording.frame["time"].to_numpy()
    steps = np.diff(time)
    usual = float(np.median(steps))
    cuts = np.flatnonzero(steps > GAP * usual) + 1
    parts = [recording.frame.iloc[a:b] for a, b in pairwise([0, *cuts.tolist(), len(time)])]
    long = [part for part in parts if len(part) >= SHORTEST]
    notes = list(_gap_notes(recording, steps, cuts, usual, len(parts) - len(long)))
    within = np.delete(steps, cuts - 1)
    if np.any(np.abs(within - usual) > EVEN * usual):
        grid = Resample(step=_readable(float(within.sum() / np.round(within / usual).sum())))
        long = [resample(part, grid, inputs) for part in long]
        notes += [] if data.resample else [_jitter_note(recording, within, grid.step)]
    if not long:
        raise DataError(
            f"{recording.name}: no part without gaps keeps {SHORTEST} rows or more; record for longer"
        )
    return long, notes


def _gap_notes(
    recording: Recording, steps: Signal, cuts: NDArray[np.intp], usual: float, short: int
) -> Iterator[str]:
    """What is to be said of gaps in the clock."""
    if not len(cuts):
        return
    largest = int(cuts[np.argmax(steps[cuts - 1])])
    several = f" (the largest of {len(cuts)} gaps)" if len(cuts) > 1 else ""
    dropped = f"; {short} part{'s' * (short > 1)} of less than {SHORTEST} rows left out" if short else ""
    yield (
        f"{recording.at(largest)}: no rows for {steps[largest - 1]:.4g} s before this one{several}, "
        f"the usual step is {usual:.4g} s: what comes after a gap is a trajectory of its own{dropped}"
    )


def _jitter_note(recording: Recording, steps: Signal, step: float) -> str:
    """What is to be said of steps that differ."""
    row = int(np.argmax(steps)) + 1
    return (
        f"{recording.name}: steps from {steps.min():.4g} to {steps.max():.4g} s (the largest at "
        f"{recording.at(row)}): evened out to {step:g} s; say so with `resample: {step:g}`, or if only "
        f"the time stamps jitter give `step: {step:g}` in the place of `time`"
    )


def _readable(step: float) -> float:
    """A step without the digits that measuring it has left."""
    forms = (float(f"{step:.{digits}g}") for digits in (2, 3, 4))
    return next(form for form in forms if abs(form - step) < EVEN * step)


def resample(frame: pd.DataFrame, grid: Resample, inputs: Sequence[str]) -> pd.DataFrame:
    """Bring a trajectory to a regular grid that begins at its first row.

    To a coarser grid it goes by way of a finer one, a multiple, on which frequencies that the coarser one
    cannot hold are filtered out.

    Args:
        frame: ``time`` [s] and quantities; increasing.
        grid: its step, and how values go between rows. A cubic one is not laid through rows so close to each
            other that it would magnify their noise.
        inputs: names of the inputs.
    """
    from scipy.interpolate import CubicSpline

    time = frame["time"].to_numpy()
    usual = float(np.median(np.diff(time)))
    multiple = max(1, round(grid.step / usual)) if grid.step > usual * (1 + EVEN) else 1
    step = grid.step / multiple
    fine = time[0] + step * np.arange(int((time[-1] - time[0]) / step * (1 + 1e-9)) + 1)
    cubic = grid.interpolation == "cubic" and float(np.diff(time).min()) > CLOSE * usual
    columns: dict[str, Signal] = {"time": fine}
    for name in frame.columns.drop("time"):
        values = frame[name].to_numpy()
        if name in inputs and grid.inputs == "hold":
            columns[name] = values[np.searchsorted(time, fine + 1e-6 * step, side="right") - 1]
        elif name not in inputs and cubic:
            columns[name] = np.asarray(CubicSpline(time, values)(fine))
        else:
            columns[name] = np.interp(fine, time, values)
    result = pd.DataFrame(columns)
    if multiple > 1:
        result = _butterworth(result, GUARD * 0.5 / grid.step, 8).iloc[::multiple]
    return result.reset_index(drop=True)


def low_pass(frame: pd.DataFrame, options: LowPass | None, file: str) -> pd.DataFrame:
    """Filter all quantities of a trajectory forwards and backwards; the ends, where it settles, are left out.

    Raises:
        DataError: the cut-off frequency is too high for the sampling, or too low for so few rows.
    """
    if options is None:
        return frame
    step = float(np.median(np.diff(frame["time"].to_numpy())))
    if options.cutoff >= 0.5 / step:
        raise DataError(
            f"{file}: the filter's cut-off, {options.cutoff:g} Hz, is not below half of the sampling "
            f"frequency, {0.5 / step:.4g} Hz; lower `filter.cutoff`, or leave the filter out"
        )
    settle = int(np.ceil(0.5 / (options.cutoff * step) - 1e-6))
    if len(frame) < 2 * settle + SHORTEST:
        raise DataError(
            f"{file}: a part of {len(frame)} rows is too short for a filter with cut-off {options.cutoff:g} "
            f"Hz, which takes {2 * settle} of them to settle; raise `filter.cutoff`, or leave the filter out"
        )
    filtered = _butterworth(frame, options.cutoff, options.order)
    return filtered.iloc[settle : len(filtered) - settle].reset_index(drop=True)


def _butterworth(frame: pd.DataFrame, cutoff: float, order: int) -> pd.DataFrame:
    """All columns but the time, filtered without phase."""
    from scipy.signal import butter, sosfiltfilt

    step = float(np.median(np.diff(frame["time"].to_numpy())))
    sections = butter(order, cutoff * step * 2, output="sos")
    pad = min(len(frame) - 1, int(np.ceil(3 / (cutoff * step))))
    values = frame.drop(columns="time")
    filtered = sosfiltfilt(sections, values.to_numpy(), axis=0, padlen=pad)
    return pd.concat([frame[["time"]], pd.DataFrame(filtered, values.index, values.columns)], axis="columns")

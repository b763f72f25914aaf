"""Checks of measured data before anything runs: files, columns, units and settings; not the rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from exlinn_fmi.errors import DataError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.scenario.explain import Finding
from exlinn_fmi.scenario.learning import Column, LearnFromData, Measured, Resample
from exlinn_fmi.scenario.survey import Survey
from exlinn_fmi.scenario.units import conversion
from exlinn_fmi.scenario.words import KeyPath, missing_file, suggestion

AT: KeyPath = ("learn", "data")
NO_TIME = "; say which column is the time: `time: NAME`"


def measured(survey: Survey) -> Iterator[Finding]:
    """A `learn.data` section that does not fit its files or its coordinates."""
    learn = survey.scenario.learn
    if not isinstance(learn, LearnFromData):
        return
    found = [*_files(learn.data, survey), *_settings(learn.data)]
    if survey.coordinates:
        found += _columns(learn.data, survey.coordinates)
        if not any(at[:2] == AT for at in survey.sound.cut) and all(
            at[2] in ("files", "test") for at, _ in found
        ):
            found += _headers(learn.data, survey, {at for at, _ in found})
    yield from found


def _files(data: Measured, survey: Survey) -> Iterator[Finding]:
    """Files that are not there or named twice."""
    seen: set[str] = set()
    for key in ("files", "test"):
        for k, name in enumerate(getattr(data, key)):
            at = (*AT, key, k)
            if not (survey.folder / name).is_file():
                yield at, missing_file(name, survey.folder)
            elif name in seen:
                trained = key == "test" and name in data.files
                what = "is trained on as well, so it tests nothing" if trained else "is there twice"
                yield at, f"{name!r} {what}; take one out"
            seen.add(name)


def _settings(data: Measured) -> Iterator[Finding]:
    """Settings that exclude each other."""
    if data.test and data.hold_out:
        yield (*AT, "hold_out"), "the files held out are stated by `test` or drawn by `hold_out`; keep one"
    elif data.hold_out >= len(data.files):
        most = len(data.files) - 1
        yield (
            (*AT, "hold_out"),
            f"expected ≤ {most}, so that a file is left to train on, found {data.hold_out}",
        )
    if data.time is not None and data.step is not None:
        yield (*AT, "step"), "the time is a column, `time`, or has a fixed `step`; keep one"
    if data.delimiter is not None and len(data.delimiter) != 1:
        yield (*AT, "delimiter"), f"expected one character, found {data.delimiter!r}"
    elif data.delimiter is not None and data.delimiter == data.decimal:
        yield (*AT, "decimal"), f"is the delimiter as well, {data.delimiter!r}"
    step = data.resample.step if isinstance(data.resample, Resample) else data.resample or data.step
    if data.filter is not None and step is not None and data.filter.cutoff >= 0.5 / step:
        limit = f"half of the sampling frequency, {0.5 / step:g} Hz"
        yield (*AT, "filter", "cutoff"), f"expected less than {limit}, found {data.filter.cutoff:g}"


def _columns(data: Measured, coordinates: Sequence[Coordinate]) -> Iterator[Finding]:
    """Columns of what the model does not have, and conversions that there are not."""
    from exlinn_fmi.data.measured import quantities

    units = {name: unit for name, (_, unit) in quantities(data, coordinates, _names(coordinates)).items()}
    for name, column in data.columns.items():
        if name not in units:
            message = f"the model has no quantity {name!r}{suggestion(name, list(units), 'its quantities')}"
            yield (*AT, "columns", name), message
        else:
            yield from _conversion((*AT, "columns", name), column, units[name])
    if data.time is not None:
        yield from _conversion((*AT, "time"), data.time, "s")


def _names(coordinates: Sequence[Coordinate]) -> list[str]:
    return [name for c in coordinates for name in (c.name, c.velocity, c.acceleration, c.input) if name]


def _conversion(at: KeyPath, column: str | Column, unit: str) -> Iterator[Finding]:
    if isinstance(column, str):
        return
    if column.scale == 0:
        yield (*at, "scale"), "expected a factor other than 0, found 0"
    if column.unit is not None and conversion(column.unit, unit) is None:
        message = f"no conversion from {column.unit!r} to {unit!r}; leave the unit out and give the `scale`"
        yield (*at, "unit"), message


def _headers(data: Measured, survey: Survey, faulty: set[KeyPath]) -> Iterator[Finding]:
    """Files that are no tables, and columns that they do not have; of each the first file without it."""
    from exlinn_fmi.data.foreign import column_names, no_column
    from exlinn_fmi.data.measured import as_column, quantities

    clock = None if data.step is not None else as_column(data.time or "time")
    stated = [as_column(c).column for c in data.columns.values()] + ([clock.column] if clock else [])
    lacking: dict[str, Finding] = {}
    for at in ((*AT, key, k) for key in ("files", "test") for k in range(len(getattr(data, key)))):
        if at in faulty:
            continue
        file = getattr(data, str(at[2]))[at[3]]
        try:
            known = column_names(survey.folder / file, stated, data.delimiter, data.decimal)
        except DataError as error:
            yield at, str(error)
            continue
        if clock is not None and clock.column not in known:
            place, hint = ((*AT, "time"), "") if data.time is not None else (at, NO_TIME)
            lacking.setdefault("", (place, f"{file}: {no_column(clock.column, known)}{hint}"))
        for name, (column, _) in quantities(data, survey.coordinates, known).items():
            if column.column not in known:
                place = (*AT, "columns", name) if name in data.columns else at
                lacking.setdefault(name, (place, f"{file}: {name}: {no_column(column.column, known)}"))
    yield from lacking.values()

"""Drafts of scenarios that learn from recordings: files, columns, units, and guesses of the coordinates."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import indent

from exlinn_fmi.scenario.draft_text import (
    as_comment,
    as_key,
    as_name,
    as_text,
    distinct,
    kind_lines,
    scenario_name,
)
from exlinn_fmi.scenario.guess import Guess, Quantity, guess_coordinates
from exlinn_fmi.scenario.units import si_unit

TIME = r"(?i)(t|time|zeit|timestamp|date|datetime)"
"""Names of a column that is the clock."""
UNKNOWN_COLUMNS = [
    "      q: TODO        # the column of a position, an angle or a charge",
    "      # q_dot: TODO  # of its velocity; estimated if left out",
    "      u: TODO        # of the input on it",
]
UNKNOWN_COORDINATE = [
    "    - name: q",
    "      unit: TODO       # rad, m, C",
    "      topology: line   # circle: an angle that may turn; cyclic: a charge, the current counts",
    "      input: u",
    "      input_unit: TODO   # N.m, N, V",
]


def data_draft(files: Sequence[str], columns: Mapping[str, str], written: str) -> str:
    """A scenario to go on with for recordings.

    Args:
        files: the files as the scenario is to name them.
        columns: units by name of the columns of the first, empty where they are not known.
        written: the file that the scenario is to be written to, for the commands in its comments.
    """
    clock = next((name for name in columns if re.fullmatch(TIME, _bare(name))), None)
    known = {name: unit if si_unit(unit) else "" for name, unit in columns.items()}
    quantities = [Quantity(name, unit) for name, unit in known.items() if name != clock]
    found = guess_coordinates(quantities, alone=True)
    held = "hold_out: 1   # of the files, kept for the test; or `test: [file.csv]`"
    alone = "# test: [another.csv]   # TODO: a recording to judge by, which training never sees"
    lines = [
        f"# Recordings to learn from. Columns: {as_comment(', '.join(columns))}",
        "#",
        f"#   exlinn collect {written}     only import them: conversions and warnings",
        f"#   exlinn run {written}         learn a model of them and report",
        f"#   exlinn validate {written}    what is wrong with this file, all at once",
        "#",
        "# TODO marks what was guessed from names and units, or is left to you.",
        f"name: {scenario_name(Path(files[0]))}",
        "",
        "learn:",
        "  data:",
        f"    files: [{', '.join(map(as_key, files))}]   # each the recording of one run",
        f"    {held if len(files) > 1 else alone}",
        *_clock(clock, known),
        "    columns:   # quantity of the model: column of the files, with its unit there",
    ]
    names = _column_names(found)
    for q in dict.fromkeys(q for g in found for q in g.members):
        unit = f"{{column: {as_key(q.name)}, unit: {as_key(q.unit)}}}" if q.unit else as_text(q.name)
        lines.append(f"      {names[q.name]}: {unit}")
    lines += [] if found else UNKNOWN_COLUMNS
    lines.append("  coordinates:   # TODO: check them")
    for g in found:
        lines += indent("\n".join(_data_coordinate(g, names)), "    ").splitlines()
    lines += [] if found else UNKNOWN_COORDINATE
    return "\n".join(lines) + "\n"


def _clock(name: str | None, columns: Mapping[str, str]) -> list[str]:
    if name is None:
        return ["    step: TODO   # [s] from row to row; or `time: COLUMN`"]
    unit = columns[name]
    if unit and unit != "s":
        return [f"    time: {{column: {as_key(name)}, unit: {as_key(unit)}}}"]
    return [] if name == "time" else [f"    time: {as_text(name)}"]


def _bare(column: str) -> str:
    """A column's name without its unit."""
    return re.sub(r"\s*[\[(][^)\]]*[\])]\s*$", "", column).strip()


def _column_names(found: Sequence[Guess]) -> dict[str, str]:
    """Names in the model by column."""
    names: dict[str, str] = {}
    for q in dict.fromkeys(q for g in found for q in g.members):
        names[q.name] = distinct(as_name(_bare(q.name), "q"), names.values())
    return names


def _data_coordinate(guess: Guess, names: Mapping[str, str]) -> Iterator[str]:
    name = names[guess.position.name] if guess.position else "Q"
    yield f"- name: {name}"
    yield f"  unit: {guess.unit}"
    yield from kind_lines(guess.kind, guess.topology, "only the current counts")
    if guess.velocity and names[guess.velocity.name] != f"{name}_dot":
        yield f"  velocity: {names[guess.velocity.name]}"
    yield from ([f"  velocity_unit: {guess.velocity_unit}"] if guess.kind == "electrical" else [])
    if guess.acceleration:
        yield f"  acceleration: {names[guess.acceleration.name]}"
    if guess.input:
        yield f"  input: {names[guess.input.name]}"
        yield f"  input_unit: {guess.input_unit}"
    else:
        yield "  # input: TODO, if one acts here"

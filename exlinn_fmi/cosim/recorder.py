"""What is recorded of a co-simulation, and the table that it goes into."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Component, Indices, Values
from exlinn_fmi.cosim.columns import Columns, Kind
from exlinn_fmi.cosim.order import Port
from exlinn_fmi.cosim.store import RowFile
from exlinn_fmi.errors import InputError, nearest

if TYPE_CHECKING:
    import pandas as pd

TIME = "time"
"""Name of the first column."""


def select(components: Mapping[str, Component], patterns: Iterable[str]) -> list[Port]:
    """The variables that patterns name, in the order of the patterns, then of the scenario.

    A pattern without ``*`` and ``?`` is the name of one variable of any causality. ``*`` alone stands for all
    inputs and outputs. Other patterns stand for all inputs, outputs and local variables whose
    ``component.variable`` fits, so ``plant.*`` adds the locals of one component; parameters, which stay as
    they are, are recorded only where named in full.

    Args:
        components: by name.
        patterns: names with wildcards.

    Raises:
        InputError: a pattern that nothing fits.
    """
    paths: dict[str, Port] = {}
    for number, (name, component) in enumerate(components.items()):
        for index, variable in enumerate(component.variables):
            paths[f"{name}.{variable.name}"] = (number, index)
    parts = list(components.values())
    chosen: dict[Port, None] = {}
    problems = []
    for pattern in patterns:
        found = [paths[pattern]] if pattern in paths else []
        if not found and ("*" in pattern or "?" in pattern):
            causalities = ("input", "output") if pattern == "*" else ("input", "output", "local")
            fits = re.compile(_expression(pattern)).fullmatch
            found = [
                port
                for path, port in paths.items()
                if parts[port[0]].variables[port[1]].causality in causalities and fits(path)
            ]
        if not found and pattern != "*":
            problems.append(f"record: nothing fits {pattern!r}; {nearest(pattern, paths, 'variables')}")
        chosen.update(dict.fromkeys(found))
    if problems:
        raise InputError("\n".join(problems))
    return list(chosen)


def _expression(pattern: str) -> str:
    """A regular expression for a pattern; brackets are part of FMI names (``A[1,2]``), not wildcards."""
    return "".join({"*": ".*", "?": "."}.get(c, re.escape(c)) for c in pattern)


class Recorder:
    """A row for every so many communication points: all in memory, or a block there and the others in a file.

    Args:
        names: names of the columns, the first is the time.
        units: units by name.
        ticks: number of the last communication point.
        every: a row is recorded at each tick that is a multiple of it.
        file: where rows go; without it they stay in memory.
        kinds: what each column holds; numbers if not given.

    Attributes:
        columns: what they stand for.
        table: (rows, columns), filled from the top by whoever steps.
        rows: how many rows are recorded in all.
        base: number of the row that the table begins with.

    Raises:
        InputError: so many rows do not fit into memory.
    """

    def __init__(
        self,
        names: Sequence[str],
        units: Mapping[str, str],
        ticks: int,
        every: int = 1,
        file: RowFile | None = None,
        kinds: Sequence[Kind] = (),
    ) -> None:
        self.columns, self.units, self.every, self.file = Columns(names, kinds), dict(units), every, file
        self.rows = self.base = 0
        rows = ticks // every + 1
        try:
            here = rows if file is None else min(rows, file.block)
            self.table: NDArray[np.float64] = np.empty((here, len(self.columns)))
        except (MemoryError, ValueError) as error:
            size = f"{rows} rows of {len(self.columns)} columns ({8e-9 * rows * len(self.columns):.3g} GB)"
            raise InputError(
                f"{size} do not fit into memory; record fewer variables, take a longer step, stop earlier or "
                "stream them to disk"
            ) from error

    def record(self, tick: int, signals: Values, columns: Indices) -> None:
        """Record the row of a tick, if it has one; there is `room` for it."""
        if not tick % self.every:
            row = tick // self.every
            self.table[row - self.base] = signals[columns]
            self.rows = row + 1

    def amend(self, tick: int, values: Values) -> bool:
        """Write the last columns of a tick's row that is recorded already; whether it has one."""
        row = tick // self.every - self.base
        if tick % self.every or row < 0:
            return False
        self.table[row, -len(values) :] = values
        return True

    def room(self, tick: int) -> int:
        """How many ticks after this one have room in the table for their rows; makes room as needed."""
        room = (self.base + len(self.table)) * self.every - 1 - tick
        if room < 1 and self.file is not None:
            self.flush()
            return self.room(tick)
        return room

    def flush(self) -> None:
        """Have all rows in the file, if there is one, and begin a new block.

        Raises:
            StorageError: they cannot be written; they are lost then.
        """
        if self.file is not None:
            rows, self.base = self.table[: self.rows - self.base], self.rows
            self.file.append(rows)

    def go_on(self, rows: int) -> None:
        """Begin after the first so many rows of the file."""
        assert self.file is not None
        self.file.cut(rows)
        self.rows = self.base = rows

    def frame(self) -> pd.DataFrame:
        """The rows as a frame; of more than fit well into memory, every n-th."""
        if self.file is not None:
            return self.columns.frame(self.file.thinned())
        # The copy of a run that ended early does not hold the memory of the rows that it lacks.
        return self.columns.frame(self.table[: self.rows], copy=self.rows < len(self.table))

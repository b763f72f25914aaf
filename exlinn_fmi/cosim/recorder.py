"""What is recorded of a co-simulation, and the table that it goes into."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Component, Indices, Values
from exlinn_fmi.cosim.order import Port
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
    """A table with a row for every so many communication points, allocated before the run begins.

    Args:
        names: names of the columns, the first is the time.
        units: units by name.
        ticks: number of the last communication point.
        every: a row is recorded at each tick that is a multiple of it.

    Attributes:
        table: (rows, columns), filled from the top by whoever steps.
        rows: how many are filled.
        base: number of the row that the table begins with.

    Raises:
        InputError: so many rows do not fit into memory.
    """

    def __init__(self, names: Sequence[str], units: Mapping[str, str], ticks: int, every: int = 1) -> None:
        self.names, self.units, self.every = list(names), dict(units), every
        self.rows = self.base = 0
        rows = ticks // every + 1
        try:
            self.table: NDArray[np.float64] = np.empty((rows, len(names)))
        except (MemoryError, ValueError) as error:
            size = f"{rows} rows of {len(names)} columns ({8e-9 * rows * len(names):.3g} GB)"
            raise InputError(
                f"{size} do not fit into memory; record fewer variables, take a longer step or stop earlier"
            ) from error

    def record(self, tick: int, signals: Values, columns: Indices) -> None:
        """Record the row of a tick, if it has one."""
        if not tick % self.every:
            row = tick // self.every
            self.table[row - self.base] = signals[columns]
            self.rows = row + 1

    def frame(self) -> pd.DataFrame:
        """The filled rows as a frame."""
        import pandas as pd

        # The copy of a run that ended early does not hold the memory of the rows that it lacks.
        return pd.DataFrame(self.table[: self.rows], columns=self.names, copy=self.rows < len(self.table))

"""What the numbers of recorded rows stand for: texts by number, whole numbers in two parts, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import TEXT_TYPES
from exlinn_fmi.components.texts import text
from exlinn_fmi.components.wide import joined
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.order import Port

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["number", "text", "int64", "uint64", "rest"]


def kinds_of(graph: Graph, recorded: Sequence[Port]) -> list[Kind]:
    """What the columns of recorded variables hold, and those of rests, which come after all of them."""
    kinds: list[Kind] = []
    for port in recorded:
        variable = graph.variable(port)
        whole = variable.wide if graph.rest(port) is not None else None
        kinds.append("text" if variable.type in TEXT_TYPES else whole or "number")
    kinds += ["rest"] * sum(kind in ("int64", "uint64") for kind in kinds)
    return kinds


class Columns:
    """Makes frames of rows.

    Args:
        names: of the columns, one by one.
        kinds: what each holds; numbers if not given. Columns of rests have no names.
    """

    def __init__(self, names: Sequence[str], kinds: Sequence[Kind] = ()) -> None:
        self.names, self.kinds = list(names), list(kinds) or ["number"] * len(names)

    def __len__(self) -> int:
        return len(self.kinds)

    def frame(self, rows: NDArray[np.float64], copy: bool = False) -> pd.DataFrame:
        """Rows (n, columns) as a frame: texts as such, binaries as bytes."""
        import pandas as pd

        if not any(kind != "number" for kind in self.kinds):
            return pd.DataFrame(rows, columns=self.names, copy=copy)
        rests = iter(rows.T[[kind == "rest" for kind in self.kinds]])
        made: list[NDArray[Any]] = []
        for kind, column in zip(self.kinds, rows.T, strict=True):
            if kind in ("int64", "uint64"):
                made.append(joined(column, next(rests), kind))
            elif kind != "rest":
                made.append(_texts(column) if kind == "text" else column.copy())
        return pd.DataFrame(dict(zip(self.names, made, strict=True)))


def _texts(column: NDArray[np.float64]) -> NDArray[Any]:
    """The texts that numbers stand for."""
    numbers, places = np.unique(column, return_inverse=True)
    known = np.empty(len(numbers), dtype=object)
    known[:] = [text(number) for number in numbers.tolist()]
    return known[places]

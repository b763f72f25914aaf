"""What the numbers of recorded rows stand for: texts by number, whole numbers in two parts, numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import TEXT_TYPES, Variable
from exlinn_fmi.components.texts import text

if TYPE_CHECKING:
    import pandas as pd

Kind = Literal["number", "text"]


def kind_of(variable: Variable) -> Kind:
    """What a column of a variable's values holds."""
    return "text" if variable.type in TEXT_TYPES else "number"


class Columns:
    """Makes frames of rows.

    Args:
        names: of the columns.
        kinds: what each holds; numbers if not given.
    """

    def __init__(self, names: Sequence[str], kinds: Sequence[Kind] = ()) -> None:
        self.names, self.kinds = list(names), list(kinds) or ["number"] * len(names)

    def frame(self, rows: NDArray[np.float64], copy: bool = False) -> pd.DataFrame:
        """Rows (n, columns) as a frame: texts as such, binaries as bytes."""
        import pandas as pd

        if not any(kind != "number" for kind in self.kinds):
            return pd.DataFrame(rows, columns=self.names, copy=copy)
        columns = {
            name: _texts(column) if kind == "text" else column.copy()
            for name, kind, column in zip(self.names, self.kinds, rows.T, strict=True)
        }
        return pd.DataFrame(columns)


def _texts(column: NDArray[np.float64]) -> NDArray[Any]:
    """The texts that numbers stand for."""
    numbers, places = np.unique(column, return_inverse=True)
    known = np.empty(len(numbers), dtype=object)
    known[:] = [text(number) for number in numbers.tolist()]
    return known[places]

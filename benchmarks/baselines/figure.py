"""A number that is promised, and how it is printed beside what it must be."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from baselines.show import text


class Figure(NamedTuple):
    """How a number is measured, what it must be and what would be better.

    Args:
        measure: gives the number.
        must: what it must not exceed, or fall below where it is to be large.
        stretch: what would be better.
        at_least: whether it is to be large.
        slow: whether it takes long.
        most: what it must not exceed even where it is to be large.
        whole: whether a quick run measures it as well as a long one; else nothing follows from it.
    """

    measure: Callable[[Any], float]
    must: float
    stretch: float = math.nan
    at_least: bool = False
    slow: bool = False
    most: float = math.inf
    whole: bool = True

    def met(self, value: float) -> str:
        """In a word."""
        sign = -1 if self.at_least else 1
        if value > self.most:
            return "MISSED"
        return next(
            (
                word
                for word, limit in (("better", self.stretch), ("met", self.must))
                if sign * value <= sign * limit
            ),
            "MISSED",
        )

    @property
    def bounds(self) -> str:
        """What it must be, in short."""
        if math.isfinite(self.most):
            return f"{text(self.must)} … {text(self.most)}"
        return ("≥ " if self.at_least else "≤ ") + text(self.must)


def print_figures(
    found: Mapping[str, float], figures: Mapping[str, Figure], console: Console, quick: bool = False
) -> None:
    """Each number beside what it must be, and whether it is, unless a quick run cannot tell."""
    table = Table("figure", "measured", "must", "stretch", "")
    for name, value in found.items():
        wanted = figures[name]
        stretch = "" if math.isnan(wanted.stretch) else text(wanted.stretch)
        word = "not by a quick run" if quick and not wanted.whole else wanted.met(value)
        table.add_row(name, f"{value:.3g}", wanted.bounds, stretch, word)
    console.print(table)

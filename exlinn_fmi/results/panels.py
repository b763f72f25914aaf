"""Panels of lines with names and units, whoever draws them: `figures` on paper, `interactive` on screen."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.results.typography import axis_label

Role = Literal["main", "model", "reference", "bound", "error", "other"]

COLOURS: dict[Role, str] = {
    "main": "#0072B2",
    "model": "#D55E00",
    "reference": "#D55E00",
    "bound": "#777777",
    "error": "#009E73",
}
"""Okabe and Ito's palette, which people with any colour vision can tell apart."""
SHADE = "#fbe3c8"
"""Colour of the time during which events are active."""
OTHERS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")


@dataclass(frozen=True)
class Line:
    """One line of a panel.

    Args:
        label: what it is, for the legend; empty where the panel's label says it.
        x: abscissa, shape (N,).
        y: ordinate, shape (N,); NaN makes a gap.
        role: what it stands for, which decides how it looks; each of `other` has a colour of its own.
        held: whether the value is held until the next one (an input, a sampled signal).
        points: whether each value stands alone.
    """

    label: str
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    role: Role = "main"
    held: bool = False
    points: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Args:
        name: name of the quantity.
        unit: its unit, ``""`` where it has no dimension.
        lines: what is drawn, first to last.
        strip: a difference to be shown in a strip of its own below, in `strip_unit`.
        strip_limits: range of the strip, None to fit the difference.
        note: a few words beside the label, e.g. bounds that are out of sight.
        limits: range of the ordinate, None to fit the lines.
        log: whether the ordinate is logarithmic.
    """

    name: str
    unit: str
    lines: tuple[Line, ...]
    strip: Line | None = None
    strip_unit: str = ""
    strip_limits: tuple[float, float] | None = None
    note: str = ""
    limits: tuple[float, float] | None = None
    log: bool = False

    @property
    def label(self) -> str:
        """Name and unit."""
        return axis_label(self.name, self.unit)

    @property
    def colours(self) -> list[str]:
        """Colour of each line."""
        own = cycle(OTHERS)
        return [COLOURS.get(line.role) or next(own) for line in self.lines]

    @property
    def strip_label(self) -> str:
        """Name and unit of the strip."""
        return axis_label("error", self.strip_unit)


@dataclass(frozen=True)
class Chart:
    """A figure: panels over one common abscissa.

    Args:
        name: file name without suffix.
        title: one line.
        panels: in reading order.
        x_label: label of the abscissa.
        note: what the reader should know besides.
        spans: name, begin and end of what is shaded in all panels.
    """

    name: str
    title: str
    panels: tuple[Panel, ...]
    x_label: str = "time [s]"
    note: str = ""
    spans: tuple[tuple[str, float, float], ...] = ()

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest abscissa of all lines."""
        return extremes(np.concatenate([line.x for panel in self.panels for line in panel.lines]))


def decimate(y: NDArray[np.float64], most: int) -> NDArray[np.intp]:
    """Indices of at most about `most` points that keep every peak and every gap of a line.

    Args:
        y: ordinates, shape (N,).
        most: number of points wanted, at least 8.

    Returns:
        Rising indices, all of them where N ≤ `most`.
    """
    n = len(y)
    if n <= most:
        return np.arange(n)
    width = -(-n // (most // 4))
    rows = -(-n // width)
    block = np.pad(y, (0, rows * width - n), mode="edge").reshape(rows, width)
    gap = np.isnan(block)
    kept = (
        np.where(gap, np.inf, block).argmin(axis=1),
        np.where(gap, -np.inf, block).argmax(axis=1),
        gap.argmax(axis=1),  # the first point of a block where it has no gap
    )
    corner = width * np.arange(rows)
    indices = np.concatenate([np.minimum(corner + k, n - 1) for k in kept] + [np.array([n - 1])])
    return np.unique(indices)


def extremes(values: NDArray[np.float64]) -> tuple[float, float]:
    """Lowest and highest of the values that are numbers, (0, 0) if none is."""
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)

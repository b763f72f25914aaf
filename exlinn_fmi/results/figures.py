"""Figures of a run as PNG and SVG, drawn with matplotlib: the same bytes from the same run folder."""

from __future__ import annotations

import io
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from exlinn_fmi.data.files import write_bytes
from exlinn_fmi.results.charts import charts
from exlinn_fmi.results.panels import COLOURS, SHADE, Chart, Line, Panel, Role, decimate
from exlinn_fmi.results.tables import read_run
from exlinn_fmi.results.typography import shortened

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

FEW_POINTS = 500
"""Up to so many points are drawn large."""
DASHES: dict[Role, Any] = {"model": (0, (4, 2)), "reference": (0, (4, 2)), "bound": (0, (1, 1.5))}
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.titlesize": 8,
    "axes.titlepad": 4,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.xmargin": 0.01,
    "axes.formatter.limits": (-4, 5),
    "axes.formatter.useoffset": False,
    "axes.formatter.use_mathtext": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.2,
    "legend.labelspacing": 0.2,
    "svg.hashsalt": "exlinn-fmi",
    "svg.fonttype": "path",
    "path.simplify": True,
}
POINTS_A_LINE, POINTS_A_FIGURE = 5000, 24_000
"""More than these add size to an SVG and nothing to see."""
RESOLUTION = 160  # dots per inch

# All lengths in inches. Panels are placed by hand: all axes of a column begin at the same place.
WIDTH, LEFT, RIGHT, BETWEEN = 7.4, 0.55, 0.15, 0.6
TITLE, COMMON, BOTTOM, NOTE = 0.22, 0.16, 0.42, 0.11
HEADER, LEGEND_LINE, MAIN, STRIP_HEADER, STRIP = 0.3, 0.13, 1.2, 0.17, 0.32
LONG_NAME = 26  # characters


def write_figures(folder: Path) -> list[Path]:
    """Draw all figures that a run folder has data for into ``figures/``, each as PNG and SVG.

    Args:
        folder: the run folder; its files are all that is read.

    Returns:
        The files written.

    Raises:
        DataError: it is no run folder, or one of its files cannot be read.
        StorageError: a figure could not be written.
    """
    run = read_run(folder)
    written = []
    for chart in charts(run):
        for suffix, content in draw(chart, run.scenario.name).items():
            file = folder / "figures" / f"{chart.name}.{suffix}"
            write_bytes(file, content)
            written.append(file)
    return written


def draw(chart: Chart, name: str) -> dict[str, bytes]:
    """A chart as pictures: content by suffix, ``png`` and ``svg``.

    Args:
        chart: what to draw.
        name: name of the scenario, for the title.
    """
    with mpl.rc_context(STYLE):
        figure = _figure(chart, f"{name}: {chart.title[0].lower()}{chart.title[1:]}")
        png, svg = io.BytesIO(), io.BytesIO()
        figure.savefig(png, format="png", dpi=RESOLUTION, metadata={"Software": "exlinn-fmi"})
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": "exlinn-fmi"})
    return {"png": png.getvalue(), "svg": svg.getvalue()}


def _figure(chart: Chart, title: str) -> Figure:
    """A grid of panels, two in a row, over one abscissa."""
    columns = min(2, len(chart.panels))
    rows = [chart.panels[k : k + columns] for k in range(0, len(chart.panels), columns)]
    note = fill(chart.note, 140)
    bottom = BOTTOM + (NOTE * (note.count("\n") + 2) if note else 0)
    heights = [_row_height(row) for row in rows]
    common = any(line.label and line.role != "other" for p in chart.panels for line in p.lines)
    top = TITLE + (COMMON if common else 0)
    height = top + sum(heights) + bottom
    width = (WIDTH - LEFT - RIGHT - (columns - 1) * BETWEEN) / columns

    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    lines = sum(len(p.lines) + (p.strip is not None) for p in chart.panels)
    most = max(200, min(POINTS_A_LINE, POINTS_A_FIGURE // lines))
    shared: Axes | None = None

    def place(left: float, low: float, high: float) -> Axes:
        """Axes from `low` to `high` above the figure's lower edge."""
        nonlocal shared
        box = (left / WIDTH, low / height, width / WIDTH, (high - low) / height)
        axes = figure.add_axes(box, sharex=shared)
        shared = shared or axes
        for _, begin, end in chart.spans:
            axes.axvspan(begin, end, color=SHADE, linewidth=0)
        return axes

    upper = height - top
    for r, row in enumerate(rows):
        lower, ceiling = upper - heights[r], upper - max(_header(panel) for panel in row)
        for c, panel in enumerate(row):
            left = LEFT + c * (width + BETWEEN)
            axes = place(left, lower + (STRIP + STRIP_HEADER if panel.strip else 0), ceiling)
            _fill(axes, panel, most)
            if panel.strip is not None:
                axes.tick_params(labelbottom=False)
                axes = place(left, lower, lower + STRIP)
                _fill_strip(axes, panel, panel.strip, most)
            lowest = r * columns + c + columns >= len(chart.panels)
            axes.tick_params(labelbottom=lowest)
            axes.set_xlabel(chart.x_label if lowest else "")
        upper = lower

    _head(figure, title, height)
    if note:
        figure.text(LEFT / WIDTH, NOTE / height, _plain(note), fontsize=6, color="#555555", va="bottom")
    return figure


def _row_height(row: tuple[Panel, ...]) -> float:
    """Height of a row of panels with what stands above them."""
    strip = STRIP + STRIP_HEADER if any(panel.strip for panel in row) else 0
    return max(_header(panel) for panel in row) + MAIN + strip


def _header(panel: Panel) -> float:
    """Height of what stands above a panel: its label, and its legend if it has one of its own."""
    names = _own_names(panel)
    return HEADER + LEGEND_LINE * max(0, -(-len(names) // _legend_columns(names)) - 1)


def _own_names(panel: Panel) -> list[str]:
    """What a panel's own legend names."""
    return [shortened(line.label) for line in panel.lines if line.role == "other"]


def _legend_columns(names: list[str]) -> int:
    """Number of names beside one another in a legend."""
    return 2 if all(len(name) <= LONG_NAME for name in names) else 1


def _head(figure: Figure, title: str, height: float) -> None:
    """Title of a figure, and a legend for what all its panels have in common."""
    figure.text(
        LEFT / WIDTH,
        1 - 0.06 / height,
        _plain(shortened(title, 90)),
        fontsize=9,
        fontweight="bold",
        va="top",
    )
    common: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            if axes.get_legend() is None:
                common.setdefault(label, handle)
    if common:
        figure.legend(
            [common[name] for name in sorted(common, key=_rank)],
            sorted(common, key=_rank),
            loc="upper left",
            bbox_to_anchor=(LEFT / WIDTH, 1 - 0.22 / height),
            ncols=len(common),
            borderaxespad=0,
            borderpad=0,
        )


def _rank(label: str) -> int:
    """Place of a label in the common legend: bounds, which many panels begin with, come last."""
    return int(label == "bound")


def _fill(axes: Axes, panel: Panel, most: int) -> None:
    """Draw a panel's lines, label and, where its lines are its own, its legend."""
    for line, colour in zip(panel.lines, panel.colours, strict=True):
        _plot(axes, line, colour, most)
    if panel.log and any(np.isfinite(line.y).any() for line in panel.lines):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(numticks=6))
        axes.minorticks_off()
    else:
        axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    if panel.limits is not None:
        axes.set_ylim(*panel.limits)
    axes.set_title(_plain(f"{panel.label}   {panel.note}".strip()), loc="left")
    if names := _own_names(panel):
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=_legend_columns(names),
            borderaxespad=0,
            borderpad=0.3,
        )


def _fill_strip(axes: Axes, panel: Panel, line: Line, most: int) -> None:
    """Draw a panel's difference in its strip."""
    _plot(axes, line, COLOURS["error"], most)
    if panel.strip_limits is not None:
        axes.set_ylim(*panel.strip_limits)
    axes.set_title(_plain(panel.strip_label), loc="left", fontsize=6.5, pad=1.5)
    axes.tick_params(axis="y", labelsize=6.5)
    axes.yaxis.set_major_locator(MaxNLocator(2, symmetric=True))


def _plot(axes: Axes, line: Line, colour: str, most: int) -> None:
    """Draw one line, reduced to what can be seen."""
    kept = decimate(line.y, most)
    axes.plot(
        line.x[kept],
        line.y[kept],
        color=colour,
        linestyle="none" if line.points else DASHES.get(line.role, "-"),
        marker="." if line.points else None,
        markersize=2 if len(kept) > FEW_POINTS else 4,
        markeredgewidth=0,
        linewidth=1.3 if line.role in ("model", "reference") else 0.9,
        drawstyle="steps-post" if line.held else "default",
        label=_plain(shortened(line.label)) or "_nolegend_",
    )


def _plain(text: str) -> str:
    """Text that matplotlib must not read as a formula or hide from the legend."""
    return text.replace("$", r"\$").lstrip("_")

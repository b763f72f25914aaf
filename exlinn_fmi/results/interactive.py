"""Charts for the report in plotly's JSON; zoom in time is linked over all panels of a chart."""

from __future__ import annotations

import base64
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.results.panels import COLOURS, SHADE, Chart, Line, Panel, Role, decimate
from exlinn_fmi.results.typography import shortened

POINTS_A_LINE, POINTS_A_CHART = 5000, 60_000
DASHES: dict[Role, str] = {"model": "dash", "reference": "dash", "bound": "dot"}

# Heights in pixels; plotly wants shares of the whole.
TOP, BOTTOM, HEADER, MAIN, STRIP_HEADER, STRIP = 30, 55, 36, 170, 20, 48
LABEL_LINE = 16
LABEL_WIDTH = 58  # characters
GAP = 0.09
"""Share of the width between two columns."""


def plotly_figure(chart: Chart) -> dict[str, Any]:
    """A chart as plotly's ``data`` and ``layout``; every text of the user's is escaped.

    Args:
        chart: what to draw.
    """
    columns = min(2, len(chart.panels))
    rows = [chart.panels[k : k + columns] for k in range(0, len(chart.panels), columns)]
    headers = [HEADER + LABEL_LINE * max(_label(panel).count("<br>") for panel in row) for row in rows]
    heights = [h + MAIN + _strip(row) for h, row in zip(headers, rows, strict=True)]
    height = sum(heights)
    width = (1 - GAP * (columns - 1)) / columns
    lines = sum(len(p.lines) + (p.strip is not None) for p in chart.panels)
    drawing = _Drawing(max(500, min(POINTS_A_LINE, POINTS_A_CHART // lines)), chart)

    upper = float(height)
    for r, row in enumerate(rows):
        lower, top = upper - heights[r], upper - headers[r]
        for c, panel in enumerate(row):
            x = (c * (width + GAP), c * (width + GAP) + width)
            lowest = r * columns + c + columns >= len(chart.panels)
            foot = lower + (STRIP + STRIP_HEADER if panel.strip else 0)
            drawing.add(panel, x, (foot / height, top / height), lowest and panel.strip is None)
            if panel.strip is not None:
                drawing.add_strip(panel, panel.strip, x, (lower / height, (lower + STRIP) / height), lowest)
        upper = lower
    drawing.layout |= {
        "height": height + TOP + BOTTOM,
        "margin": {"l": 60, "r": 15, "t": TOP, "b": BOTTOM},
        "hovermode": "x unified",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#9aa7b4", "activecolor": "#5c6b7a"},
        "dragmode": "zoom",
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"size": 12},
    }
    return {"data": drawing.data, "layout": drawing.layout}


class _Drawing:
    """Traces, axes and labels as they are put together, panel by panel."""

    def __init__(self, most: int, chart: Chart) -> None:
        self.most, self.x_label, self.span, self.spans = most, chart.x_label, chart.span, chart.spans
        self.data: list[dict[str, Any]] = []
        legend: dict[str, Any] = {
            "x": 0,
            "y": 1,
            "yanchor": "bottom",
            "orientation": "h",
            "bgcolor": "rgba(0,0,0,0)",
        }
        self.layout: dict[str, Any] = {"annotations": [], "legend": legend}
        if chart.spans:
            self.layout["shapes"] = []
        self.axes = 0
        self.named: set[str] = set()

    def add(self, panel: Panel, x: tuple[float, float], y: tuple[float, float], lowest: bool) -> None:
        """Add a panel in a domain of the figure given in shares of its width and height."""
        vertical: dict[str, Any] = _decades(panel) if panel.log else {"nticks": 6}
        if panel.limits is not None:
            vertical["range"] = list(panel.limits)
        self._axes(x, y, lowest, vertical)
        self._annotate(_label(panel), x[0], y[1])
        for line, colour in zip(panel.lines, panel.colours, strict=True):
            self._trace(line, colour)

    def add_strip(
        self, panel: Panel, strip: Line, x: tuple[float, float], y: tuple[float, float], lowest: bool
    ) -> None:
        """Add the strip of a panel in its domain."""
        vertical: dict[str, Any] = {"nticks": 5, "tickfont": {"size": 10}}
        if panel.strip_limits is not None:
            vertical["range"] = list(panel.strip_limits)
        self._axes(x, y, lowest, vertical)
        self._annotate(escape(panel.strip_label), x[0], y[1], size=10)
        self._trace(strip, COLOURS["error"])

    def _axes(
        self, x: tuple[float, float], y: tuple[float, float], lowest: bool, vertical: dict[str, Any]
    ) -> None:
        """Add a pair of axes; all abscissas move together."""
        self.axes += 1
        n = self.axes if self.axes > 1 else ""
        common = {"zeroline": False, "showline": True, "ticks": "outside", "exponentformat": "power"}
        horizontal: dict[str, Any] = {"domain": list(x), "anchor": f"y{n}", "showticklabels": lowest}
        horizontal["range"] = list(self.span)
        if n:
            horizontal["matches"] = "x"
        if lowest:
            horizontal["title"] = {"text": escape(self.x_label), "standoff": 8}
        for name, begin, end in self.spans:
            place = {"xref": f"x{n}", "x0": begin, "x1": end, "yref": f"y{n} domain", "y0": 0, "y1": 1}
            look = {"type": "rect", "layer": "below", "fillcolor": SHADE, "line": {"width": 0}}
            self.layout["shapes"].append(place | look | {"name": escape(name)})
        self.layout[f"xaxis{n}"] = common | horizontal
        self.layout[f"yaxis{n}"] = common | {"domain": list(y), "anchor": f"x{n}"} | vertical

    def _annotate(self, text: str, x: float, y: float, size: int = 12) -> None:
        """Add text above axes, at their left."""
        self.layout["annotations"].append(
            {
                "text": text,
                "align": "left",
                "x": x,
                "y": y,
                "xref": "paper",
                "yref": "paper",
                "xanchor": "left",
                "yanchor": "bottom",
                "showarrow": False,
                "font": {"size": size},
            }
        )

    def _trace(self, line: Line, colour: str) -> None:
        """Add a line to the axes added last; what is in common is named once and shown or hidden together."""
        kept = decimate(line.y, self.most)
        n = self.axes if self.axes > 1 else ""
        trace: dict[str, Any] = {
            "type": "scatter",
            "mode": "markers" if line.points else "lines",
            "x": packed(line.x[kept], "f8"),
            "y": packed(line.y[kept], "f8" if kept.size < 1000 else "f4"),
            "xaxis": f"x{n}",
            "yaxis": f"y{n}",
            "name": escape(line.label or "value"),
            "showlegend": _in_legend(line) and line.label not in self.named,
            "line": {
                "color": colour,
                "width": 2 if line.role in ("model", "reference") else 1.3,
                "dash": DASHES.get(line.role, "solid"),
                "shape": "hv" if line.held else "linear",
            },
            "marker": {"size": 3, "color": colour},
            "hoverinfo": "skip" if line.role == "bound" else "all",
        }
        if _in_legend(line):
            trace |= {"legendgroup": line.role, "legendrank": 2000 if line.role == "bound" else 1000}
            self.named.add(line.label)
        self.data.append(trace)


def packed(values: NDArray[np.float64], kind: str) -> dict[str, str]:
    """An array as plotly's typed array, which keeps the report small and has a place for NaN.

    Args:
        values: shape (N,).
        kind: ``f4`` or ``f8``.
    """
    with np.errstate(over="ignore"):
        little_endian = values.astype(f"<{kind}")
    return {"dtype": kind, "bdata": base64.b64encode(little_endian.tobytes()).decode("ascii")}


def _decades(panel: Panel) -> dict[str, Any]:
    """A logarithmic axis with about six labels."""
    values = np.concatenate([line.y for line in panel.lines])
    known = values[values > 0]
    decades = float(np.log10(known.max() / known.min())) if known.size else 1.0
    return {"type": "log", "dtick": max(1, round(decades / 6))}


def _strip(row: tuple[Panel, ...]) -> int:
    """Height that strips need in a row."""
    return STRIP + STRIP_HEADER if any(panel.strip for panel in row) else 0


def _in_legend(line: Line) -> bool:
    """Whether a line is of those that panels have in common; others are named in the panel's label."""
    return bool(line.label) and line.role != "other"


def _label(panel: Panel) -> str:
    """What stands above a panel: quantity, note, and in their colours the lines that are its own."""
    rows, used = [f"<b>{escape(panel.label)}</b>"], len(panel.label)
    if panel.note:
        rows[-1] += f"&nbsp;&nbsp; {escape(panel.note)}"
    for line, colour in zip(panel.lines, panel.colours, strict=True):
        if line.role != "other":
            continue
        name = shortened(line.label)
        used += len(name) + 3
        if used > LABEL_WIDTH:
            rows.append("")
            used = len(name)
        rows[-1] += f' &nbsp; <span style="color:{colour}">{escape(name)}</span>'
    return "<br>".join(row.strip() for row in rows)

"""Charts for the report in plotly's JSON; zoom in time is linked over all panels of a chart."""

from __future__ import annotations

import base64
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.results.charts import COLOURS, OTHERS, Chart, Line, Panel, Role, decimate

POINTS_A_LINE, POINTS_A_CHART = 5000, 60_000
DASHES: dict[Role, str] = {"model": "dash", "reference": "dash", "bound": "dot"}

# Heights in pixels; plotly wants shares of the whole.
TOP, BOTTOM, HEADER, MAIN, STRIP_HEADER, STRIP = 10, 55, 42, 170, 20, 48
LEGEND_LINE = 17
GAP = 0.09
"""Share of the width between two columns."""


def plotly_figure(chart: Chart) -> dict[str, Any]:
    """A chart as plotly's ``data`` and ``layout``; every text of the user's is escaped.

    Args:
        chart: what to draw.
    """
    columns = min(2, len(chart.panels))
    rows = [chart.panels[k : k + columns] for k in range(0, len(chart.panels), columns)]
    headers = [HEADER + LEGEND_LINE * max(0, max(map(_own_lines, row)) - 2) for row in rows]
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
                drawing.add_strip(panel, x, (lower / height, (lower + STRIP) / height), lowest)
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
        self.most, self.x_label, self.span = most, chart.x_label, chart.span
        self.data: list[dict[str, Any]] = []
        self.layout: dict[str, Any] = {"annotations": []}
        self.axes = 0
        self.legends = 0

    def add(self, panel: Panel, x: tuple[float, float], y: tuple[float, float], lowest: bool) -> None:
        """Add a panel in a domain of the figure given in shares of its width and height."""
        vertical: dict[str, Any] = {"type": "log", "dtick": 1} if panel.log else {"nticks": 6}
        if panel.limits is not None:
            vertical["range"] = list(panel.limits)
        self._axes(x, y, lowest, vertical)
        self._label(f"<b>{escape(panel.label)}</b>   {escape(panel.note)}", x[0], y[1])
        legend = self._legend(x[1], y[1])
        own = 0
        for line in panel.lines:
            colour = COLOURS.get(line.role) or OTHERS[own % len(OTHERS)]
            own += line.role == "other"
            self._trace(line, colour, legend)

    def add_strip(self, panel: Panel, x: tuple[float, float], y: tuple[float, float], lowest: bool) -> None:
        """Add a panel's strip in its domain."""
        if panel.strip is None:
            return
        self._axes(x, y, lowest, {"nticks": 5, "tickfont": {"size": 10}})
        self._label(escape(panel.strip_label), x[0], y[1], size=10)
        self._trace(panel.strip, COLOURS["error"], None)

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
        self.layout[f"xaxis{n}"] = common | horizontal
        self.layout[f"yaxis{n}"] = common | {"domain": list(y), "anchor": f"x{n}"} | vertical

    def _label(self, text: str, x: float, y: float, size: int = 12) -> None:
        """Add a label above axes, at their left."""
        self.layout["annotations"].append(
            {
                "text": text.strip(),
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

    def _legend(self, x: float, y: float) -> str:
        """Add a legend above axes, at their right."""
        self.legends += 1
        name = f"legend{self.legends if self.legends > 1 else ''}"
        self.layout[name] = {
            "x": x,
            "y": y,
            "xanchor": "right",
            "yanchor": "bottom",
            "orientation": "h",
            "font": {"size": 11},
            "bgcolor": "rgba(0,0,0,0)",
        }
        return name

    def _trace(self, line: Line, colour: str, legend: str | None) -> None:
        """Add a line to the axes added last."""
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
            "showlegend": bool(line.label) and legend is not None,
            "line": {
                "color": colour,
                "width": 2 if line.role in ("model", "reference") else 1.3,
                "dash": DASHES.get(line.role, "solid"),
                "shape": "hv" if line.held else "linear",
            },
            "marker": {"size": 3, "color": colour},
            "hoverinfo": "skip" if line.role == "bound" else "all",
        }
        if legend is not None:
            trace["legend"] = legend
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


def _strip(row: tuple[Panel, ...]) -> int:
    """Height that strips need in a row."""
    return STRIP + STRIP_HEADER if any(panel.strip for panel in row) else 0


def _own_lines(panel: Panel) -> int:
    """Number of lines that only a panel's own legend names."""
    return sum(line.role == "other" for line in panel.lines)

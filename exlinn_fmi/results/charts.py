"""What the figures show, made from a run's tables and its scenario. Nothing here knows a plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.results.metrics import Loop, control_loops
from exlinn_fmi.results.panels import Chart, Line, Panel, Role, extremes
from exlinn_fmi.results.robustness import study_charts
from exlinn_fmi.results.tables import LEARNED, RunFiles, Table
from exlinn_fmi.results.typography import axis_label, readable, typeset, words

if TYPE_CHECKING:
    import pandas as pd

    from exlinn_fmi.scenario.spec import Bounds

MOST_PANELS = 12
MOST_LINES = 6
HUGE = 1e100
"""Beyond this a value is no measurement but a model that has diverged; drawn as a gap."""
STILL = 1e-3
"""A line that moves by less than this share of its size is shown as one that hardly moves."""
COINCIDE = 0.1
"""Two lines that are mostly closer than this share of their range get a strip that shows their difference."""
EVENTS = "events."
"""What the columns begin with that tell which events were active."""
MOST_EVENTS = 8
"""Events that a note names."""

TRANSIENT = 5.0
"""An error that grows to this multiple of what it mostly stays within is cut off in its strip."""


def charts(run: RunFiles) -> list[Chart]:
    """All charts that a run has data for."""
    made: list[Chart | None] = []
    if run.evaluation is not None:
        made.append(learning_chart(run.evaluation))
    if run.curves is not None:
        made += curve_charts(run.curves)
    if run.training is not None:
        made.append(training_chart(run.training))
    if run.trajectories is not None:
        loops = control_loops(run.scenario)
        drawn = [control_chart(run.trajectories, loop, several=len(loops) > 1) for loop in loops]
        if not loops:
            drawn = [trajectory_chart(run.trajectories, run.scenario.connection_list())]
        made += [_with_events(chart, run.trajectories) for chart in drawn if chart is not None]
    if run.study is not None and run.scenario.study is not None:
        made += study_charts(run.study, list(run.scenario.study.vary))
    return [replace(c, panels=tuple(map(_legible, c.panels))) for c in made if c is not None]


# ── the charts ───────────────────────────────────────────────────────────────────────────────────────────


def learning_chart(evaluation: Table) -> Chart | None:
    """Measured against learned on a test that training never saw: the paper's Fig. 3."""
    frame = evaluation.frame
    names = [c for c in map(str, frame.columns) if c + LEARNED in frame.columns]
    time = _values(frame, "time")
    panels = []
    for name in names:
        measured, learned = _values(frame, name), _values(frame, name + LEARNED)
        panels.append(
            _comparison(
                name,
                evaluation.unit(name),
                Line("measured", time, measured),
                Line("learned", time, learned, "model"),
            )
        )
    if not panels:
        return None
    return Chart("fig3_learning", "Learned model against measurement on the unseen test", tuple(panels))


def curve_charts(curves: pd.DataFrame) -> list[Chart]:
    """Functions that the model holds, with 95 % bands: a chart for each position and velocity."""
    made = []
    for variable, part in curves.groupby("variable", sort=False):
        panels = []
        for name, curve in part.groupby("curve", sort=False):
            x = _values(curve, "at")
            lines = [Line("learned", x, _values(curve, "value"), "model")]
            lines += [
                Line(label, x, _values(curve, side), "bound")
                for label, side in (("95 %", "low"), ("", "high"))
                if curve[side].notna().any()
            ]
            panels.append(Panel(str(name), _text(curve["unit"].iloc[0]), tuple(lines)))
        label = axis_label(str(variable), _text(part["variable_unit"].iloc[0]))
        title = f"What the model holds over {variable}"
        made.append(Chart(f"curves_{variable}", title, tuple(panels), x_label=label))
    return made


def _text(cell: object) -> str:
    """A cell of a CSV file that may be empty."""
    return cell if isinstance(cell, str) else ""


def training_chart(history: pd.DataFrame) -> Chart | None:
    """Training and validation loss over the iterations, or whatever the first column counts."""
    x = str(history.columns[0])
    losses = [str(c) for c in history.columns[1:] if "loss" in str(c)]
    roles: dict[str, Role] = {c: "model" if "valid" in c else "main" for c in losses}
    lines = tuple(
        Line(
            "validation" if roles[c] == "model" else "training",
            _values(history, x),
            _positive(_values(history, c)),
            roles[c],
        )
        for c in losses
    )
    if not any(np.isfinite(line.y).any() for line in lines):
        return None
    return Chart("training", "Training", (Panel("loss", "", lines, log=True),), x_label=words(x))


def control_chart(trajectories: Table, loop: Loop, several: bool) -> Chart | None:
    """Cost, inputs, tracked output and states against their references, solve time: the paper's Fig. 4."""
    frame = trajectories.frame
    rows = loop.samples(_values(frame, "time"))
    measured = loop.states.values()
    outputs = [
        _tracked_panel(trajectories, loop, output, loop.own(reference))
        for reference, output in loop.outputs.items()
        if output not in measured
    ]
    states = [
        _tracked_panel(trajectories, loop, path, loop.reference_of(name), loop.settings.states.get(name))
        for name, path in loop.states.items()
    ]
    panels = [
        _cost_panel(trajectories, loop, rows),
        *(_input_panel(trajectories, loop, name, path) for name, path in loop.inputs.items()),
        *outputs,
        *states,
        *_estimated_panels(trajectories, loop, rows),
        _solve_time_panel(trajectories, loop, rows),
    ]
    shown = tuple(panel for panel in panels if panel is not None)
    if not shown:
        return None
    return Chart(
        f"fig4_control_{loop.controller}" if several else "fig4_control",
        "Tracking, inputs and solver" + (f" of {loop.controller}" if several else ""),
        shown,
    )


def trajectory_chart(trajectories: Table, connections: Sequence[tuple[str, str]] = ()) -> Chart | None:
    """Every recorded variable, one panel for each unit; what finds no room is named.

    Args:
        trajectories: what was recorded.
        connections: (from, to) pairs; an input is not drawn beside the output that it equals.
    """
    frame = trajectories.frame
    same = {target for source, target in connections if source in frame.columns}
    groups: dict[str, list[str]] = {}
    for column in map(str, frame.columns):
        if (
            column != "time"
            and not column.startswith(EVENTS)
            and column not in same
            and frame[column].dtype.kind in "bif"
        ):
            groups.setdefault(trajectories.unit(column), []).append(column)
    blocks = [
        (unit, columns[k : k + MOST_LINES])
        for unit, columns in groups.items()
        for k in range(0, len(columns), MOST_LINES)
    ]
    if not blocks:
        return None
    time = _values(frame, "time")
    panels = tuple(
        Panel("", unit, tuple(Line(c, time, _values(frame, c), "other") for c in columns))
        for unit, columns in blocks[:MOST_PANELS]
    )
    left_out = [column for _, columns in blocks[MOST_PANELS:] for column in columns]
    note = f"Not shown, but in trajectories.csv: {', '.join(left_out)}." if left_out else ""
    return Chart("trajectories", "Recorded trajectories", panels, note=note)


# ── panels ───────────────────────────────────────────────────────────────────────────────────────────────


def _comparison(
    name: str,
    unit: str,
    first: Line,
    second: Line,
    bounds: Bounds | None = None,
    settled: NDArray[np.bool_] | None = None,
) -> Panel:
    """Two lines that should be one, on common abscissas, and their difference where no eye can see it.

    Args:
        name: of the quantity.
        unit: of the quantity.
        first: what is judged or, for a model, what it is judged by.
        second: the other.
        bounds: of the quantity.
        settled: where the difference counts, shape (N,); it is most of the time if not given.
    """
    lines, note = _with_bounds((first, second), bounds, unit)
    span = _range(first.y)
    error = second.y - first.y if second.role == "model" else first.y - second.y
    size = np.abs(error)
    if np.isfinite(size).all() and np.percentile(size, 75) <= COINCIDE * span and size.max() <= span:
        counts = settled is not None and settled.any()
        mostly, worst = float(size[settled].max() if counts else np.percentile(size, 90)), float(size.max())
        cut = worst > TRANSIENT * mostly > 0
        factor, error_unit = readable(mostly if cut else worst, unit)
        strip = Line("", first.x, error * factor, "error")
        limits = (-1.5 * mostly * factor, 1.5 * mostly * factor) if cut else None
        return Panel(name, unit, lines, strip, error_unit, limits, note)
    limits = None
    if span > 0 and not _range(second.y) <= 20 * span:  # a diverged model must not flatten the measurement
        low, high = float(np.nanmin(first.y)), float(np.nanmax(first.y))
        limits = (low - span / 2, high + span / 2)
        beyond = ~((second.y >= limits[0]) & (second.y <= limits[1]))
        if beyond.any():
            note = _join(note, f"{second.label} out of sight from {first.x[beyond.argmax()]:.4g} s")
    return Panel(name, unit, lines, note=note, limits=limits)


def _tracked_panel(
    table: Table, loop: Loop, path: str, reference: str, bounds: Bounds | None = None
) -> Panel | None:
    """A plant variable against its reference, with its bounds; compared where the reference is fresh."""
    frame = table.frame
    if path not in frame.columns:
        return None
    name, unit, time = _short(path), table.unit(path), _values(frame, "time")
    line, rows = Line("", time, _values(frame, path)), loop.samples(time)
    if reference not in frame.columns or not rows.any():
        lines, note = _with_bounds((line,), bounds, unit)
        return Panel(name, unit, lines, note=note)
    at = time[rows]
    sampled = _comparison(
        name,
        unit,
        Line("measured", at, line.y[rows]),
        Line("reference", at, _values(frame, reference)[rows], "reference"),
        bounds,
        at >= loop.settled,
    )
    # What happens between the samples is drawn too, the error is only known at them.
    return replace(sampled, lines=(Line("measured", time, line.y), *sampled.lines[1:]))


def _estimated_panels(table: Table, loop: Loop, rows: NDArray[np.bool_]) -> list[Panel]:
    """What the controller estimates: states that it does not measure, and disturbances if there are any."""
    frame, panels = table.frame, list[Panel]()
    if not rows.any():
        return panels
    time = _values(frame, "time")[rows]
    for column in map(str, frame.columns):
        owner, _, name = column.partition(".")
        kind, _, of = name.partition("_")
        wanted = kind == "disturbance" or (kind == "estimate" and of not in loop.states)
        if owner != loop.controller or not wanted:
            continue
        values = _values(frame, column)[rows]
        lines: tuple[Line, ...] = (Line("estimated", time, values, held=True),)
        if kind == "estimate" and loop.reference_of(of) in frame.columns:
            reference = _values(frame, loop.reference_of(of))[rows]
            lines += (Line("reference", time, reference, "reference"),)
        if kind == "estimate" or np.nanmax(np.abs(values), initial=0.0) > 0.0:
            title = f"{of} (estimated)" if kind == "estimate" else f"disturbance of {of}"
            panels.append(Panel(title, table.unit(column), lines))
    return panels


def _input_panel(table: Table, loop: Loop, name: str, path: str) -> Panel | None:
    """A plant input as the controller holds it, with its bounds."""
    column = next((c for c in (path, loop.own(name)) if c in table.frame.columns), None)
    if column is None:
        return None
    line = Line("", _values(table.frame, "time"), _values(table.frame, column), held=True)
    lines, note = _with_bounds((line,), loop.settings.inputs.get(name), table.unit(column))
    return Panel(_short(path), table.unit(column), lines, note=note)


def _cost_panel(table: Table, loop: Loop, rows: NDArray[np.bool_]) -> Panel | None:
    """The controller's cost J at its samples; logarithmic where it spans decades."""
    column = loop.own("cost")
    if column not in table.frame.columns or not rows.any():
        return None
    cost = _values(table.frame, column)[rows]
    logarithmic = bool(np.all(cost > 0)) and float(np.max(cost)) > 1e3 * float(np.min(cost))
    line = Line("", _values(table.frame, "time")[rows], cost, held=True)
    return Panel("cost J", "", (line,), log=logarithmic)


def _solve_time_panel(table: Table, loop: Loop, rows: NDArray[np.bool_]) -> Panel | None:
    """Time that each solve took, and what of it was after the measurement, beside the sampling time."""
    column, after = loop.own("solve_time"), loop.own("feedback_time")
    if column not in table.frame.columns or not rows.any():
        return None
    time, solve = _values(table.frame, "time")[rows], 1e3 * _values(table.frame, column)[rows]
    lines: tuple[Line, ...] = (Line("", time, solve, points=True),)
    if after in table.frame.columns:
        feedback = 1e3 * _values(table.frame, after)[rows]
        lines = (
            Line("in all", time, solve, points=True),
            Line("after the measurement", time, feedback, "model", points=True),
        )
    period, longest = 1e3 * loop.period, extremes(solve)[1]
    near = longest > period / 2
    if near:
        lines += (Line("bound", time[[0, -1]], np.full(2, period), "bound"),)
    return Panel(
        "solve time",
        "ms",
        lines,
        note=f"sampling time {period:g} ms",
        limits=(0, 1.1 * max(longest, period if near else 0)) if longest > 0 else None,
    )


def _with_bounds(lines: tuple[Line, ...], bounds: Bounds | None, unit: str) -> tuple[tuple[Line, ...], str]:
    """Lines with those bounds that are near enough not to flatten them, and all bounds in words."""
    given = [b for b in (bounds.min, bounds.max) if b is not None] if bounds is not None else []
    x = lines[0].x
    if bounds is None or not given or not x.size:
        return lines, ""
    low, high = extremes(lines[0].y)
    reach = 0.5 * max(high - low, 1e-9 * max(abs(low), abs(high)))
    near = [b for b in given if low - reach <= b <= high + reach]
    drawn = tuple(Line("bound", x[[0, -1]], np.full(2, b), "bound") for b in near)
    if len(given) == 2:
        words = f"bounds {given[0]:g} … {given[1]:g} {typeset(unit)}"
    else:
        words = f"bound {'≥' if bounds.max is None else '≤'} {given[0]:g} {typeset(unit)}"
    return lines + drawn, words.replace("-", "−").strip()


def _legible(panel: Panel) -> Panel:
    """A panel in a multiple of its unit where numbers would be long, not zoomed into rounding errors."""
    if panel.log:
        return panel
    low, high = panel.limits or extremes(np.concatenate([line.y for line in panel.lines]))
    size = max(abs(low), abs(high))
    if high - low < STILL * size:
        panel = replace(panel, limits=(low - STILL * size, high + STILL * size))
    factor, unit = readable(size, panel.unit)
    if 1e-2 <= size < 1e4 or factor == 1:
        return panel
    return replace(
        panel,
        unit=unit,
        lines=tuple(replace(line, y=line.y * factor) for line in panel.lines),
        limits=panel.limits and (panel.limits[0] * factor, panel.limits[1] * factor),
    )


# ── words and numbers ────────────────────────────────────────────────────────────────────────────────────


def _with_events(chart: Chart, trajectories: Table) -> Chart:
    """A chart with the time shaded during which events were active, and a note of which these are."""
    time, spans = _values(trajectories.frame, "time"), []
    for column in map(str, trajectories.frame.columns):
        if column.startswith(EVENTS):
            active = _values(trajectories.frame, column) > 0.5
            edges = np.flatnonzero(np.diff(np.concatenate([[False], active, [False]])))
            for first, end in edges.reshape(-1, 2).tolist():
                spans.append(
                    (column.removeprefix(EVENTS), float(time[first]), float(time[min(end, len(time) - 1)]))
                )
    told = "; ".join(f"{name} {begin:.4g}–{end:.4g} s" for name, begin, end in spans[:MOST_EVENTS])
    more = f"; {len(spans) - MOST_EVENTS} more" if len(spans) > MOST_EVENTS else ""
    note = _join(chart.note, f"Shaded: {told}{more}." if spans else "")
    return replace(chart, spans=tuple(spans), note=note)


def _values(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    """A column as numbers, with NaN for what is not finite or huge beyond meaning."""
    values = frame[column].to_numpy(dtype=float)
    return np.where(np.abs(values) < HUGE, values, np.nan)


def _positive(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values that a logarithmic axis can show."""
    return np.where(values > 0, values, np.nan)


def _range(values: NDArray[np.float64]) -> float:
    """Highest less lowest value, NaN where not all are numbers."""
    return float(np.ptp(values)) if np.isfinite(values).all() and values.size else np.nan


def _short(path: str) -> str:
    """A variable's name without its component."""
    return path.split(".", 1)[1]


def _join(*notes: str) -> str:
    """Notes on one line."""
    return "; ".join(note for note in notes if note)

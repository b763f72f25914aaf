"""Charts of a robustness study: how its runs are distributed, and what the error hangs on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.results.panels import Chart, Line, Panel
from exlinn_fmi.results.typography import words

if TYPE_CHECKING:
    import pandas as pd

MOST_CAUSES = 12
"""Most values that were drawn whose influence is shown."""


def study_charts(study: pd.DataFrame, varied: Sequence[str]) -> list[Chart | None]:
    """How the runs of a robustness study are distributed, and what the error hangs on.

    Args:
        study: one row for each run.
        varied: key paths of what was drawn.
    """
    shown = ("control.rmse_", "control.max_error_", "control.violations", "control.decrease")
    judged = [
        str(c)
        for c in study.columns
        if str(c).startswith(shown) and np.isfinite(_numbers(study, str(c))).any()
    ]
    if "control.violations" in judged and not np.nansum(_numbers(study, "control.violations")):
        judged.remove("control.violations")
    panels = []
    for column in judged:
        values = np.sort(_numbers(study, column)[np.isfinite(_numbers(study, column))])
        share = 100.0 * (np.arange(len(values)) + 0.5) / len(values)
        name, unit = _metric(column)
        panels.append(Panel(name, unit, (Line("", share, values, points=True),)))
    errors = [c for c in judged if c.startswith("control.rmse_")]
    return [
        Chart(
            "study_runs", "Runs of the study, from the best to the worst", tuple(panels), x_label="runs [%]"
        )
        if panels
        else None,
        _dependence_chart(study, errors[0], varied) if errors else None,
    ]


def _dependence_chart(study: pd.DataFrame, error: str, varied: Sequence[str]) -> Chart | None:
    """The error of each run over every value that was drawn for it, most telling first."""
    name, unit = _metric(error)
    y = _numbers(study, error)
    ranked: list[tuple[float, Panel]] = []
    for path in varied:
        if path not in study.columns:
            continue
        try:
            x = study[path].to_numpy(dtype=float)
        except ValueError:  # words: in the order of their names
            x = np.unique(study[path].astype(str), return_inverse=True)[1].astype(float)
        known = np.isfinite(x) & np.isfinite(y)
        if known.sum() < 2 or np.ptp(x[known]) == 0.0:
            continue
        place = 100.0 * (x - x[known].min()) / np.ptp(x[known])
        rank = np.corrcoef(np.argsort(np.argsort(x[known])), np.argsort(np.argsort(y[known])))[0, 1]
        ends = f"{path.split('.', 1)[1]}: {_end(study[path], x, 0)} … {_end(study[path], x, -1)}"
        panel = Panel(name, unit, (Line("", place[known], y[known], points=True),), note=ends)
        ranked.append((-abs(float(rank)), panel))
    panels = [panel for _, panel in sorted(ranked, key=lambda pair: pair[0])[:MOST_CAUSES]]
    if not panels:
        return None
    title = "What the error hangs on, most telling first"
    return Chart("study_causes", title, tuple(panels), x_label="place in its range [%]")


def _end(values: pd.Series[Any], x: NDArray[np.float64], place: int) -> str:
    """Least (0) or greatest (−1) of what was drawn, as text."""
    value = values.iloc[int(np.argsort(x)[place])]
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _metric(column: str) -> tuple[str, str]:
    """A metric's name and unit: ``control.rmse_x_m`` is the rmse of x in m."""
    name = column.removeprefix("control.")
    if name.startswith(("rmse_", "max_error_")):
        quantity, _, unit = name.rpartition("_")
        return words(quantity), unit
    return words(name), ""


def _numbers(frame: pd.DataFrame, column: str) -> NDArray[np.float64]:
    """A column as numbers."""
    return frame[column].to_numpy(dtype=float)

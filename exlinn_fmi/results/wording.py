"""Metrics in plain words and readable numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from html import escape

from exlinn_fmi.results.charts import SUPERSCRIPTS, readable, typeset, words
from exlinn_fmi.results.metrics import control_loops, quantity
from exlinn_fmi.results.tables import RunFiles

GROUPS = {
    "learn": "Learning",
    "identify": "Identification",
    "control": "Closed loop",
    "simulate": "Simulation",
}
"""Groups of metrics in the order of the report, by the first part of their keys."""

WORDING = (
    (r"learn\.force_mse_test", "Generalised force on the unseen test, mean square error", ""),
    (r"learn\.force_mse_(train|validation|test)(?:_(.+))?", "Force, mean square error: {0} {1}", ""),
    (
        r"learn\.acceleration_n?r?mse_test(?:_(.+))?",
        "Acceleration by the forward model on the unseen test {0}",
        "",
    ),
    (r"learn\.rollout_nrmse_(\d+)s(?:_(.+))?", "Free run over {0} s, error relative to the signal {1}", ""),
    (r"learn\.(?:train_)?seconds", "Time of training", "s"),
    (r"identify\.max_rel_error", "Largest relative error of an identified parameter", ""),
    (r"identify\.(?:rel_error_)?(.+)", "Identified {0}", ""),
    (r"control\.violations", "Recorded values outside their bounds", ""),
    (r"control\.solve_ms_median", "Time of a solve, median", "ms"),
    (r"control\.solve_ms_p99", "Time of a solve, 99th percentile", "ms"),
    (r"control\.solve_ms_max", "Time of a solve, longest", "ms"),
    (r"control\.fallbacks", "Steps that fell back to the previous plan", ""),
    (r"control\.iterations_mean", "Solver iterations a step, mean", ""),
    (r"control\.cost_mean", "Cost J, mean", ""),
    (r"simulate\.steps", "Communication steps", ""),
    (r"simulate\.seconds", "Time of the co-simulation", "s"),
    (r"simulate\.real_time_factor", "Faster than real time by a factor of", ""),
)
"""Pattern of a metric's key, what it means, unit; groups of the pattern go into the text."""

HEADLINES = (
    r"learn\.force_mse_test",
    r"learn\.rollout_nrmse_10s",
    r"identify\.max_rel_error",
    r"control\.(\w+\.)?rmse_.*",
    r"control\.(\w+\.)?violations",
    r"control\.(\w+\.)?solve_ms_median",
)
"""Keys of the numbers that a report begins with."""


def describe(run: RunFiles, key: str) -> tuple[str, str]:
    """What a metric means, and its unit.

    Args:
        run: the run, whose scenario tells of which variables the metrics of control are.
        key: e.g. ``control.rmse_x_m``.
    """
    loops = control_loops(run.scenario)
    suffix = ""
    if len(loops) > 1:
        for loop in loops:
            if key.startswith(f"control.{loop.controller}."):
                key = key.replace(f"{loop.controller}.", "", 1)
                suffix, loops = f" ({loop.controller})", [loop]
                break
    for loop in loops:
        unit = run.trajectories.unit(loop.output) if run.trajectories and loop.output else ""
        name = quantity(loop.output, unit) if loop.output else ""
        if name and key in (f"control.rmse_{name}", f"control.max_error_{name}"):
            kind = "root mean square" if ".rmse_" in key else "largest"
            return f"Tracking error of {loop.output}, {kind}{suffix}", unit
        for name, path in loop.inputs.items():
            if key in ("control.input_rms", f"control.input_rms_{name}"):
                unit = run.trajectories.unit(path) if run.trajectories else ""
                return f"Input {path}, root mean square{suffix}", unit
    for pattern, text, unit in WORDING:
        if match := re.fullmatch(pattern, key):
            filled = text.format(*(words(group or "") for group in match.groups())).strip()
            return filled + suffix, unit
    return words(key.partition(".")[2] or key).capitalize() + suffix, ""


def headlines(keys: Iterable[str]) -> list[str]:
    """The keys that a report begins with, of those that there are."""
    known = list(keys)
    return [key for pattern in HEADLINES for key in known if re.fullmatch(pattern, key)]


def value(run: RunFiles, key: str) -> str:
    """A metric's value with its unit, as HTML that shows all digits when pointed at."""
    metric, unit = run.metrics[key], describe(run, key)[1]
    if metric is None:
        return "not finite"
    factor, multiple = readable(abs(metric), unit) if unit else (1.0, "")
    shown = f"{number(metric * factor, 3)} {typeset(multiple)}".strip()
    return f'<span title="{escape(f"{metric!r} {unit}".strip())}">{escape(shown)}</span>'


def number(x: float, digits: int) -> str:
    """A number with so many significant digits, powers of ten as print has them; – where there is none."""
    if math.isnan(x):
        return "–"
    if not math.isfinite(x) or (x == int(x) and abs(x) < 1e6):
        return f"{x:g}".replace("-", "−")
    if 1e-3 <= abs(x) < 1e5:
        return f"{x:.{digits}g}".replace("-", "−") if "e" not in f"{x:.{digits}g}" else f"{x:.0f}"
    mantissa, _, exponent = f"{x:.{digits - 1}e}".partition("e")
    return f"{mantissa} × 10{str(int(exponent)).translate(SUPERSCRIPTS)}".replace("-", "−")

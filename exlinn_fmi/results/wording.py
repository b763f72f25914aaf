"""Metrics in plain words."""

from __future__ import annotations

import re
from collections.abc import Iterable
from html import escape

from exlinn_fmi.results.metrics import control_loops, quantity
from exlinn_fmi.results.tables import RunFiles
from exlinn_fmi.results.typography import number, readable, typeset, words

GROUPS = {
    "learn": "Learning",
    "identify": "Identification",
    "control": "Closed loop",
    "simulate": "Simulation",
    "study": "Robustness",
}
"""Groups of metrics in the order of the report, by the first part of their keys."""

WORDING = (
    (r"learn\.force_mse_test", "Generalised force on the unseen test, mean square error", ""),
    (r"learn\.force_mse_test_(.+)", "… in the equation of {0}", ""),
    (r"learn\.force_mse_train", "Generalised force on the training data, mean square error", ""),
    (r"learn\.acceleration_mse_test", "Acceleration on the unseen test, mean square error", ""),
    (r"learn\.rollout_nrmse_(\d+)s", "Free run over {0} s, largest error relative to the signal", ""),
    (r"learn\.rollout_nrmse_\d+s_(.+)", "… of {0}", ""),
    (r"learn\.rollout_diverged", "Free runs diverged (1) or stayed finite (0)", ""),
    (r"learn\.mass_matrix_min_eigenvalue", "Smallest eigenvalue of the mass matrix", ""),
    (r"learn\.seconds", "Time of training", "s"),
    (r"learn\.noise_(.+)", "Noise of {0}, relative to the signal", ""),
    (r"learn\.objective", "What was made small, and why", ""),
    (r"learn\.terms", "Terms found", ""),
    (r"learn\.guarantee", "Whether it stays bounded under bounded inputs", ""),
    (r"identify\.objective", "How the parameters were found, and why", ""),
    (r"identify\.max_rel_error", "Largest relative error of an identified parameter", ""),
    (r"identify\.misfit", "What the identified parameters leave unexplained", ""),
    (r"identify\.(.+)_rel_error", "Relative error of {0}", ""),
    (r"identify\.(.+)_std", "Standard deviation of {0}", ""),
    (r"identify\.(.+)", "Identified {0}", ""),
    (r"control\.violations", "Recorded values outside their bounds", ""),
    (r"control\.worst_violation", "Furthest of them beyond its bound, over the bounds' range", ""),
    (r"control\.solve_ms_median", "Time of a solve, median", "ms"),
    (r"control\.solve_ms_p99", "Time of a solve, 99th percentile", "ms"),
    (r"control\.solve_ms_max", "Time of a solve, longest", "ms"),
    (r"control\.feedback_ms_median", "Time between measurement and input, median", "ms"),
    (r"control\.feedback_ms_p99", "Time between measurement and input, 99th percentile", "ms"),
    (r"control\.deadline_misses", "Solves that took longer than the sampling time", ""),
    (r"control\.missing_measurements", "Measurements that were missing, and were predicted", ""),
    (r"control\.lost_samples", "Samples with the safe input, as measurements were missing for too long", ""),
    (r"control\.decrease", "Share of samples at which the cost fell as a Lyapunov function must", ""),
    (r"control\.terminal_inside", "Samples whose plan ended in the terminal set", ""),
    (r"control\.fallbacks", "Steps that fell back to the previous plan", ""),
    (r"control\.iterations_mean", "Solver iterations a step, mean", ""),
    (r"control\.cost_mean", "Cost J, mean", ""),
    (r"control\.solver_backend", "What computed the solver's steps", ""),
    (r"study\.runs", "Runs", ""),
    (r"study\.success_rate", "Share of successes", ""),
    (r"study\.success_rate_low", "… at least (95 %)", ""),
    (r"study\.success_rate_high", "… at most (95 %)", ""),
    (r"study\.failed", "Runs that ended with an error", ""),
    (r"study\.runs_with_(.+)", "Runs with {0}", ""),
    (r"study\.decrease_p50", "Share of samples at which the cost fell as it must, median of the runs", ""),
    (r"study\.decrease_min", "… in the worst run", ""),
    (r"study\.(rmse|max_error)_(.+)_p(\d+)", "{0} of {1}, {2} % of the runs stay below", ""),
    (r"study\.(rmse|max_error)_(.+)_max", "{0} of {1}, worst run", ""),
    (r"simulate\.steps", "Communication steps", ""),
    (r"simulate\.seconds", "Time of the co-simulation", "s"),
    (r"simulate\.missed_deadlines", "Communication points that came late", ""),
    (r"simulate\.worst_delay", "… by at most", "s"),
    (r"simulate\.late_steps\.(.+)", "Steps of {0} that took longer than they may", ""),
    (r"simulate\.longest_step\.(.+)", "… the longest", "s"),
    (r"simulate\.real_time_factor", "Faster than real time by a factor of", ""),
)
"""Pattern of a metric's key, what it means, unit; groups of the pattern go into the text."""

NO_VALUE = "–"
"""Where there was nothing to judge by."""

HEADLINES = (
    r"learn\.force_mse_test",
    r"learn\.rollout_nrmse_10s",
    r"identify\.max_rel_error",
    r"control\.(\w+\.)?rmse_.*",
    r"control\.(\w+\.)?violations",
    r"study\.success_rate",
    r"study\.rmse_.*_p95",
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
        for output in loop.outputs.values():
            unit = run.trajectories.unit(output) if run.trajectories else ""
            name = quantity(output, unit)
            if key in (f"control.rmse_{name}", f"control.max_error_{name}"):
                kind = "root mean square" if ".rmse_" in key else "largest"
                return f"Tracking error of {output}, {kind}{suffix}", unit
        for name, path in loop.inputs.items():
            if key in ("control.input_rms", f"control.input_rms_{name}"):
                unit = run.trajectories.unit(path) if run.trajectories else ""
                return f"Input {path}, root mean square{suffix}", unit
    for pattern, text, unit in WORDING:
        if match := re.fullmatch(pattern, key):
            filled = text.format(*match.groups())
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
        diverged = key.startswith("learn.rollout") and run.metrics.get("learn.rollout_diverged")
        return "diverged" if diverged else NO_VALUE
    if isinstance(metric, str):
        return f'<span class="words">{escape(metric)}</span>'
    factor, multiple = readable(abs(metric), unit) if unit else (1.0, "")
    shown = f"{number(metric * factor, 3)} {typeset(multiple)}".strip()
    return f'<span title="{escape(f"{metric!r} {unit}".strip())}">{escape(shown)}</span>'

"""How well a closed loop was controlled: tracking errors, violations, solver effort, from recorded rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.scenario.control import Nmpc
from exlinn_fmi.scenario.schema import NmpcComponent, Scenario, SensorComponent
from exlinn_fmi.scenario.signals import MEASURED
from exlinn_fmi.scenario.spec import Bounds

if TYPE_CHECKING:
    import pandas as pd

DIAGNOSTICS = (
    "reference",
    "cost",
    "stage_cost",
    "cost_disturbance",
    "solve_status",
    "missing",
    "iterations",
    "kkt",
    "solve_time",
    "feedback_time",
    "fallbacks",
    "slack",
    "terminal_cost",
    "terminal_level",
)
FAMILIES = ("reference_", "estimate_", "disturbance_")
"""Outputs of a controller that are not inputs of the plant: their names, and how others begin."""
DECREASE_TOLERANCE = 1e-3
"""Share of the cost that its decrease may miss: a real-time iteration is not converged."""
NO_COST = 1e-6
"""Share of a run's largest cost that counts as none: there the reference's own rounding shows."""
BOUND_TOLERANCE = 1e-6
"""Share of the range between two bounds by which a value may be outside: the solver's tolerance."""


@dataclass(frozen=True)
class Loop:
    """One controller and the plant variables around it, as the connections tell.

    Args:
        controller: name of the controller component.
        start: time of its first sample [s].
        period: its sampling time [s].
        settled: from when on errors count [s].
        settings: its part of the scenario.
        inputs: plant input by name of the controller's output that drives it.
        states: plant variable by name of the model state that it is measured for.
        outputs: plant variable that should follow a reference, by the name of the controller's output that
            tells the reference, as far as that is known.
    """

    controller: str
    start: float
    period: float
    settled: float
    settings: Nmpc
    inputs: Mapping[str, str]
    states: Mapping[str, str]
    outputs: Mapping[str, str]

    def own(self, output: str) -> str:
        """Path of one of the controller's outputs."""
        return f"{self.controller}.{output}"

    def reference_of(self, state: str) -> str:
        """Path of the reference of a model state."""
        return self.own(f"reference_{state}")

    def bounded(self) -> list[tuple[str, str, Bounds]]:
        """(plant variable, the controller's own column of it or "", bounds) for every bounded variable."""
        inputs = [
            (self.inputs.get(name, self.own(name)), self.own(name), bounds)
            for name, bounds in self.settings.inputs.items()
        ]
        states = [
            (self.states[name], "", bounds)
            for name, bounds in self.settings.states.items()
            if name in self.states
        ]
        return inputs + states

    def samples(self, time: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which rows are at the controller's own sampling times.

        Args:
            time: time of each row [s], shape (N,).

        Returns:
            Shape (N,). Between these rows the controller's outputs, its reference too, are held.
        """
        ticks = (time - self.start) / self.period
        near: NDArray[np.bool_] = np.abs(ticks - np.rint(ticks)) < 1e-6
        return near


def control_loops(scenario: Scenario) -> list[Loop]:
    """The controllers of a scenario that is simulated."""
    if scenario.simulate is None:
        return []
    connections = scenario.connection_list()
    loops = []
    for name, component in scenario.components.items():
        if not isinstance(component, NmpcComponent):
            continue
        inputs: dict[str, str] = {}
        for source, target in connections:
            owner, variable = source.split(".", 1)
            if owner == name and variable not in DIAGNOSTICS and not variable.startswith(FAMILIES):
                inputs.setdefault(variable, _beyond(scenario, target))
        states = {
            target.split(".", 1)[1]: _before(scenario, source)
            for source, target in connections
            if target.split(".", 1)[0] == name
        }
        loops.append(
            Loop(
                controller=name,
                start=scenario.simulate.start,
                period=component.step or scenario.simulate.step,
                settled=scenario.simulate.start + scenario.metrics.settle,
                settings=component.nmpc,
                inputs=inputs,
                states=states,
                outputs=_tracked(scenario, component.nmpc, inputs, states),
            )
        )
    return loops


def _before(scenario: Scenario, path: str) -> str:
    """The variable that a sensor measures, for one of its outputs; any other path as it is."""
    component, variable = path.split(".", 1)
    if isinstance(scenario.components.get(component), SensorComponent):
        inputs = {target: source for source, target in scenario.connection_list()}
        return inputs.get(f"{component}.{variable.removesuffix(MEASURED)}", path)
    return path


def _beyond(scenario: Scenario, path: str) -> str:
    """The variable that a signal reaches through a sensor (a late actuator); any other path as it is."""
    component, variable = path.split(".", 1)
    if isinstance(scenario.components.get(component), SensorComponent):
        return dict(scenario.connection_list()).get(f"{component}.{variable}{MEASURED}", path)
    return path


def control_metrics(frame: pd.DataFrame, scenario: Scenario, units: Mapping[str, str]) -> dict[str, float]:
    """Metrics of every controller in a scenario, from what the co-simulation recorded.

    Errors, effort and cost are taken at the controller's own samples, where its outputs are fresh; violations
    are counted in all rows. A metric whose columns were not recorded is left out.

    Args:
        frame: trajectories, columns ``time`` [s] and ``component.variable``.
        scenario: the scenario as run.
        units: unit by column.

    Returns:
        ``control.<metric>``, or ``control.<controller>.<metric>`` where there is more than one controller.
    """
    loops = control_loops(scenario)
    metrics: dict[str, float] = {}
    for loop in loops:
        prefix = "control." if len(loops) == 1 else f"control.{loop.controller}."
        own = {
            **_tracking(frame, loop, units),
            **_violations(frame, loop),
            **_decrease(frame, loop),
            **_effort(frame, loop),
        }
        metrics |= {prefix + key: value for key, value in own.items()}
    return metrics


def quantity(path: str, unit: str) -> str:
    """A variable as part of a metric's key, with its unit: ``plant.x`` in m is ``x_m``."""
    words = f"{path.split('.', 1)[1]} {'' if unit == '1' else unit}"
    return "_".join("".join(c if c.isalnum() else " " for c in words.replace("_", " ")).split())


def _ends(bounds: Bounds) -> tuple[float, float, float]:
    """Lower and upper bound, ∞ where there is none, and their range; the size of one alone."""
    low = -np.inf if bounds.min is None else bounds.min
    high = np.inf if bounds.max is None else bounds.max
    finite = [b for b in (low, high) if np.isfinite(b)]
    return low, high, high - low if len(finite) == 2 else max(map(abs, finite), default=0.0)


def outside(values: NDArray[np.float64], bounds: Bounds) -> NDArray[np.bool_]:
    """Which values are outside their bounds by more than the solver's tolerance; NaN is outside.

    Args:
        values: shape (N,).
        bounds: lower and upper bound, of the same unit.
    """
    low, high, span = _ends(bounds)
    slack = BOUND_TOLERANCE * span
    beyond: NDArray[np.bool_] = ~((values >= low - slack) & (values <= high + slack))
    return beyond


def _tracked(
    scenario: Scenario, settings: Nmpc, inputs: Mapping[str, str], states: Mapping[str, str]
) -> dict[str, str]:
    """The plant variables that follow the controller's references."""
    neighbours = {path.split(".", 1)[0] for path in (*inputs.values(), *states.values())}
    named = [path for path in scenario.metrics.outputs if path.split(".", 1)[0] in neighbours]
    if named:
        return dict(zip(settings.references, named, strict=False))
    return {
        name: states[reference.coordinate]
        for name, reference in settings.references.items()
        if reference.through is None and reference.coordinate in states
    }


def _tracking(frame: pd.DataFrame, loop: Loop, units: Mapping[str, str]) -> dict[str, float]:
    """Root mean square and largest distance of each output from its reference, after settling."""
    time = frame["time"].to_numpy(dtype=float)
    rows = loop.samples(time) & (time >= loop.settled - 1e-6 * loop.period)
    metrics: dict[str, float] = {}
    for reference, output in loop.outputs.items():
        if not rows.any() or not {output, loop.own(reference)} <= set(frame.columns):
            continue
        error = (frame[output] - frame[loop.own(reference)]).to_numpy(dtype=float)[rows]
        name = quantity(output, units.get(output) or "")
        metrics[f"rmse_{name}"] = float(np.sqrt(np.mean(error**2)))
        metrics[f"max_error_{name}"] = float(np.max(np.abs(error)))
    return metrics


def _violations(frame: pd.DataFrame, loop: Loop) -> dict[str, float]:
    """Number of values outside the controller's bounds, and the furthest of them over the bounds' range.

    Left out where one of them was not recorded.
    """
    count, worst = 0, 0.0
    for path, own, bounds in loop.bounded():
        column = next((c for c in (path, own) if c in frame.columns), None)
        if column is None:
            return {}
        values = frame[column].to_numpy(dtype=float)
        wrong = values[outside(values, bounds)]
        count += len(wrong)
        worst = max(worst, _furthest(wrong, bounds))
    if not len(frame):
        return {}
    return {"violations": float(count)} | ({"worst_violation": worst} if count else {})


def _furthest(values: NDArray[np.float64], bounds: Bounds) -> float:
    """How far the furthest value is beyond its bounds, over their range."""
    low, high, span = _ends(bounds)
    return float(np.maximum(low - values, values - high).max(initial=0.0)) / (span or 1.0)


def _decrease(frame: pd.DataFrame, loop: Loop) -> dict[str, float]:
    """Share of the samples at which the cost, as a Lyapunov function, fell as it should.

    J may not exceed what is left of it after a sample, J less its first term, by more than the distance of
    the state from its prediction explains (D. Mayne et al., Constrained model predictive control: stability
    and optimality, Automatica 36, 2000).
    """
    columns = [loop.own(name) for name in ("cost", "stage_cost", "cost_disturbance")]
    if not set(columns) <= set(frame.columns):
        return {}
    rows = loop.samples(frame["time"].to_numpy(dtype=float))
    cost, stage, change = frame[columns].to_numpy(dtype=float)[rows].T
    if len(cost) < 2:
        return {}
    allowed = (cost - stage)[:-1] + change[1:]
    fell = cost[1:] <= allowed + DECREASE_TOLERANCE * cost[:-1] + NO_COST * cost.max()
    return {"decrease": float(np.mean(fell))}


def _effort(frame: pd.DataFrame, loop: Loop) -> dict[str, float]:
    """Solve time, fallbacks, iterations, cost and input power, each where it was recorded."""
    rows = loop.samples(frame["time"].to_numpy(dtype=float))

    def recorded(output: str) -> NDArray[np.float64]:
        if loop.own(output) not in frame.columns:
            return np.empty(0)
        values: NDArray[np.float64] = frame[loop.own(output)].to_numpy(dtype=float)[rows]
        return values[np.isfinite(values)]

    metrics: dict[str, float] = {}
    if (solve := 1e3 * recorded("solve_time")).size:
        metrics["solve_ms_median"] = float(np.median(solve))
        metrics["solve_ms_p99"] = float(np.percentile(solve, 99))
        metrics["solve_ms_max"] = float(np.max(solve))
        metrics["deadline_misses"] = float(np.count_nonzero(solve > 1e3 * loop.period))
    if (feedback := 1e3 * recorded("feedback_time")).size:
        metrics["feedback_ms_median"] = float(np.median(feedback))
        metrics["feedback_ms_p99"] = float(np.percentile(feedback, 99))
    if (fallbacks := recorded("fallbacks")).size:
        metrics["fallbacks"] = float(fallbacks[-1])
    if (missing := recorded("missing")).size and missing.any():
        metrics["missing_measurements"] = float(missing.sum())
    if (end := recorded("terminal_cost")).size and (level := recorded("terminal_level")).size == end.size:
        metrics["terminal_inside"] = float(np.mean(end <= level))
    if (lost := recorded("solve_status") == 3).any():
        metrics["lost_samples"] = float(np.count_nonzero(lost))
    for output in ("iterations", "cost"):
        if (values := recorded(output)).size:
            metrics[f"{output}_mean"] = float(np.mean(values))
    for name in loop.inputs:
        if (values := recorded(name)).size:
            key = "input_rms" if len(loop.inputs) == 1 else f"input_rms_{name}"
            metrics[key] = float(np.sqrt(np.mean(values**2)))
    return metrics

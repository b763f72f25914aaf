"""The co-simulation master: steps components in lockstep and records what they do.

At each communication point t = start + k · step:

1. values pass through the connections in the graph's order, so that all inputs and outputs belong together;
2. the row labelled t is recorded;
3. every component due is stepped over its own step, with inputs held (Jacobi), or refreshed from those that
   were stepped before (Gauss–Seidel); sampled components (sources, controllers) always hold.

A component with a longer step of its own takes part at its own ticks only. With Gauss–Seidel the recorded
inputs are those at the communication point.

References: FMI 2.0 §4.2.1; Kübler and Schiehlen, "Two methods of simulator coupling", 2000.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from exlinn_fmi.components.base import Component
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.loops import SOLVERS, LoopOptions
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.profile import Timed
from exlinn_fmi.cosim.recorder import TIME, Recorder, select
from exlinn_fmi.cosim.stepping import Stepper, make_stepper
from exlinn_fmi.errors import InputError, Interrupted, RunError, nearest

if TYPE_CHECKING:
    import pandas as pd

ALGORITHMS = ("jacobi", "gauss-seidel")
Progress = Callable[[float, float], None]

REPORT_EVERY = 0.1
"""Least wall time between two reports of progress [s]."""


@dataclass(frozen=True)
class Trajectories:
    """What came of a run.

    Args:
        frame: columns ``time`` [s] and ``component.variable``, a row per communication point.
        units: unit by column, where one is known.
        error: why the run ended early, None where it did not; the rows until then are in `frame`.
        statistics: ``stepping`` (``plain`` or ``compiled``), ``steps`` (number done), ``seconds`` (wall
            time), ``real_time_factor`` (simulated over wall time), ``warnings`` (by component: ``count`` and
            text of the ``first``) and, where asked for, ``component_seconds`` (by component); ``loop_passes``
            and ``loop_residual`` (their number, the worst accepted) where algebraic loops are solved.
    """

    frame: pd.DataFrame
    units: dict[str, str]
    error: RunError | None
    statistics: dict[str, Any]


class Master:
    """Steps the components of a graph from start to stop.

    Args:
        graph: components and connections.
        start: start time [s].
        stop: stop time [s]; a whole number of steps after start.
        step: communication step [s].
        own_steps: longer steps of single components [s], multiples of `step`, by component.
        algorithm: ``jacobi`` or ``gauss-seidel``.
        record: names and patterns of variables to record, see `recorder.select`.
        profile: whether to measure the time that each component takes (costs up to 0.2 µs per call).
        compiled: whether to step in compiled code what offers its C functions; by default, where it pays.
        record_every: a row is recorded at every so many communication points.
        loops: how algebraic loops are solved; without it each is broken by a delay of one step.

    Raises:
        InputError: times do not fit together, or `record` names what is not there.
    """

    def __init__(
        self,
        graph: Graph,
        start: float,
        stop: float,
        step: float,
        own_steps: Mapping[str, float] | None = None,
        algorithm: str = "jacobi",
        record: Sequence[str] = ("*",),
        profile: bool = False,
        compiled: bool | None = None,
        record_every: int = 1,
        loops: LoopOptions | None = None,
    ) -> None:
        self.graph, self.start, self.stop, self.step = graph, start, stop, step
        self.ticks = count_ticks(start, stop, step)
        own_steps = own_steps or {}
        _check_names(graph, "own step", own_steps)
        self.every = [count_every(name, own_steps.get(name, step), step) for name in graph.names]
        if algorithm not in ALGORITHMS:
            hint = nearest(algorithm, ALGORITHMS, "algorithms")
            raise InputError(f"algorithm: there is no {algorithm!r}; {hint}")
        self._seidel = algorithm == "gauss-seidel"
        self.recorded = select(graph.components, record)
        if loops is not None and loops.solver not in SOLVERS:
            raise InputError(
                f"loops: there is no solver {loops.solver!r}; {nearest(loops.solver, SOLVERS, 'solvers')}"
            )
        if record_every < 1:
            raise InputError(f"record_every: expected a whole number of at least 1, found {record_every}")
        self._profile, self._compiled, self._every = profile, compiled, record_every
        self._loops = loops
        self._stepper: Stepper | None = None

    def run(
        self,
        starts: Mapping[str, Mapping[str, float]] | None = None,
        progress: Progress | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> Trajectories:
        """Run from start to stop and close all components, whatever happens.

        Runs are alike to the last bit; a second one needs components that can be entered after `close`.

        Args:
            starts: start values by component and variable.
            progress: told (fraction done, t [s]) about ten times a second.
            should_stop: asked after every row; True ends the run with the rows so far.

        Returns:
            The trajectories; a failure in the course of the run is their `error`.

        Raises:
            InputError: a start value that a component does not take, or a table too large for the memory.
        """
        starts = starts or {}
        components: list[Component] = list(self.graph.components.values())
        if self._profile:
            components = [Timed(component) for component in components]
        began = time.perf_counter()
        try:
            _check_names(self.graph, "start values", starts)
            recorder = self._recorder()
            plan = Plan(
                self.graph,
                components,
                self.recorded,
                self.every,
                self.ticks,
                self.step,
                self._seidel,
                self._loops,
            )
            error = self._attempt(plan, recorder, starts, progress, should_stop)
        finally:
            faults = _close(components)
        for number, text in faults:
            plan.warn(number, text)
        statistics = self._statistics(plan, recorder, time.perf_counter() - began)
        if self._profile:
            timed = [c.seconds for c in components if isinstance(c, Timed)]
            inside = np.zeros(len(timed)) if self._stepper is None else self._stepper.seconds
            statistics["component_seconds"] = {
                name: seconds + float(more)
                for name, seconds, more in zip(self.graph.names, timed, inside, strict=True)
            }
        return Trajectories(recorder.frame(), recorder.units, error, statistics)

    def _recorder(self) -> Recorder:
        """An empty table for time and recorded variables."""
        names = [TIME, *map(self.graph.path, self.recorded)]
        stated = [self.graph.variable(port).unit for port in self.recorded]
        units = {name: unit for name, unit in zip(names, ["s", *stated], strict=True) if unit is not None}
        return Recorder(names, units, self.ticks, self._every)

    def _attempt(
        self,
        plan: Plan,
        recorder: Recorder,
        starts: Mapping[str, Mapping[str, float]],
        progress: Progress | None,
        should_stop: Callable[[], bool] | None,
    ) -> RunError | None:
        """Step until the end or until something happens, which is returned."""
        try:
            # What is not finite becomes an error with name and time: no warnings of numpy beside it.
            with np.errstate(over="ignore", invalid="ignore"):
                plan.initialize(self.start, self.stop, starts)
                self._step_all(plan, recorder, progress, should_stop)
        except RunError as error:
            return error
        except KeyboardInterrupt:
            if should_stop is not None and should_stop():
                raise  # asked for the second time: at once
            return Interrupted("stopped by the user; the rows so far are kept")
        return None

    def _step_all(
        self,
        plan: Plan,
        recorder: Recorder,
        progress: Progress | None,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        """Step from tick to tick, a row each.

        Raises:
            RunError: a component failed, or the user asked to stop.
        """
        ticks, k, report_at = self.ticks, 0, 0.0
        plan.propagate(0, self.start)
        recorder.record(0, plan.signals, plan.columns)
        stepper = make_stepper(plan, recorder, self.start, self.step, self._profile, self._compiled)
        self._stepper = stepper
        while True:
            t = self.start + k * self.step
            if progress is not None and (time.perf_counter() >= report_at or k == ticks):
                progress(k / ticks, t)
                report_at = time.perf_counter() + REPORT_EVERY
            if k == ticks:
                return
            if should_stop is not None and should_stop():
                raise Interrupted(f"stopped by the user at t = {t:.9g} s; the rows so far are kept")
            until = min(k + stepper.chunk, ticks)
            stepper.run(k, until)
            k = until

    def _statistics(self, plan: Plan, recorder: Recorder, seconds: float) -> dict[str, Any]:
        steps = max(recorder.rows - 1, 0) * self._every
        loops = plan.loops
        solved = {} if loops is None else {"loop_passes": loops.passes, "loop_residual": loops.worst}
        return solved | {
            "stepping": "plain" if self._stepper is None else type(self._stepper).__name__.lower(),
            "steps": steps,
            "seconds": seconds,
            "real_time_factor": steps * self.step / seconds,
            "warnings": {name: asdict(warned) for name, warned in plan.warnings.items()},
        }


# ── times ────────────────────────────────────────────────────────────────────────────────────────────────


def count_ticks(start: float, stop: float, step: float) -> int:
    """Number of steps from start to stop.

    Args:
        start: [s].
        stop: [s].
        step: [s].

    Raises:
        InputError: it is no whole number of at least 1; the nearest stop times are offered.
    """
    if not (math.isfinite(start) and math.isfinite(stop) and math.isfinite(step) and step > 0):
        raise InputError(
            f"start {start} s, stop {stop} s, step {step} s: expected finite times and a step above 0"
        )
    if stop <= start:
        raise InputError(f"stop {stop:.12g} s does not lie after start {start:.12g} s; give a later stop")
    ratio = (stop - start) / step
    ticks = round(ratio)
    if ticks >= 1 and _whole(ratio, max(abs(start), abs(stop)) / step):
        return ticks
    below, above = (f"{start + n * step:.12g} s" for n in (math.floor(ratio), math.floor(ratio) + 1))
    offer = f"{below} or {above}" if ratio > 1 else above
    raise InputError(
        f"stop {stop:.12g} s is no whole number of steps of {step:.12g} s after start {start:.12g} s; "
        f"nearest: {offer}"
    )


def count_every(name: str, own_step: float, step: float) -> int:
    """A component's own step in steps of the master.

    Args:
        name: of the component, for the message.
        own_step: [s].
        step: [s].

    Raises:
        InputError: it is no whole number of at least 1; the nearest own steps are offered.
    """
    if not (math.isfinite(own_step) and own_step > 0):
        raise InputError(f"component {name!r}: its step is {own_step} s, expected a finite time above 0")
    ratio = own_step / step
    if ratio > 0.5 and _whole(ratio, ratio):
        return round(ratio)
    below, above = (f"{n * step:.12g} s" for n in (math.floor(ratio), math.floor(ratio) + 1))
    offer = f"{below} or {above}" if ratio > 1 else f"{step:.12g} s"
    raise InputError(
        f"component {name!r}: its step {own_step:.12g} s is no multiple of the communication step "
        f"{step:.12g} s; nearest: {offer}"
    )


def _whole(ratio: float, largest: float) -> bool:
    """Whether a ratio of times is whole, but for the rounding of times as large as `largest` steps."""
    return abs(ratio - round(ratio)) <= max(1e-9, 4 * sys.float_info.epsilon * largest)


# ── checks and closing ───────────────────────────────────────────────────────────────────────────────────


def _check_names(graph: Graph, what: str, named: Iterable[str]) -> None:
    """Refuse names of components that are not there.

    Raises:
        InputError: with the names that are nearest.
    """
    for name in named:
        if name not in graph.components:
            raise InputError(f"{what}: no component {name!r}; {nearest(name, graph.names, 'components')}")


def _close(components: Sequence[Component]) -> list[tuple[int, str]]:
    """Close all components, whatever each says to it; gives number and text of those that failed."""
    faults = []
    for number, component in enumerate(components):
        try:
            component.close()
        except Exception as error:
            faults.append((number, f"closing failed: {type(error).__name__}: {error}"))
    return faults

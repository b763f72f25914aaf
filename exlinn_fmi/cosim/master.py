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

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from exlinn_fmi.components.base import Component, Number, Values
from exlinn_fmi.cosim.adaptive import Adaptive, AdaptiveOptions
from exlinn_fmi.cosim.columns import Columns, Kind, kinds_of
from exlinn_fmi.cosim.extrapolation import ExtrapolationOptions
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.loops import SOLVERS, LoopOptions
from exlinn_fmi.cosim.pace import Pace, timing_columns
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.profile import Timed
from exlinn_fmi.cosim.recorder import TIME, Recorder, select
from exlinn_fmi.cosim.stepping import Stepper, make_stepper
from exlinn_fmi.cosim.store import RowFile, Store
from exlinn_fmi.cosim.times import count_every, count_ticks
from exlinn_fmi.cosim.watch import Progress, Watch
from exlinn_fmi.errors import InputError, Interrupted, RunError, nearest

if TYPE_CHECKING:
    import pandas as pd

ALGORITHMS = ("jacobi", "gauss-seidel")


@dataclass(frozen=True)
class Trajectories:
    """What came of a run.

    Args:
        frame: columns ``time`` [s] and ``component.variable``, a row per communication point; of a run in a
            store that is too long for the memory, every n-th.
        units: unit by column, where one is known.
        error: why the run ended early, None where it did not; the rows until then are in `frame`.
        statistics: ``stepping`` (``plain``, ``compiled`` or ``adaptive``), ``steps`` (number done),
            ``seconds`` (wall time), ``real_time_factor`` (simulated over wall time), ``warnings`` (by
            component: ``count`` and text of the ``first``) and, where asked for, ``component_seconds`` (by
            component); ``loop_passes`` and ``loop_residual`` (their number, the worst accepted) where
            algebraic loops are solved; ``missed_deadlines``, ``worst_delay`` and ``first_delay_at`` [s] of a
            run that is paced, ``late_steps`` and ``longest_step`` [s] of its components, by name;
            ``communication_steps``, ``rejected_steps``, ``inexact_steps`` (kept in spite
            of their error) and ``shortest_step`` [s] where steps are adaptive.
        columns: what the numbers of a row stand for.
        rows: all rows, where the run has a store.
    """

    frame: pd.DataFrame
    units: dict[str, str]
    error: RunError | None
    statistics: dict[str, Any]
    columns: Columns
    rows: RowFile | None = None

    def frames(self) -> Iterator[pd.DataFrame]:
        """All rows, some at a time where they are in a store; at least one frame."""
        if self.rows is None or not self.rows.rows:
            yield self.frame
        else:
            yield from map(self.columns.frame, self.rows.blocks())


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
        extrapolation: how inputs go on over a step; without it they are held.
        adaptive: how exact communication steps must be; `step` is the longest then.

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
        extrapolation: ExtrapolationOptions | None = None,
        adaptive: AdaptiveOptions | None = None,
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
        self._loops, self._extrapolation, self._adaptive = loops, extrapolation, adaptive
        if adaptive is not None:
            select(graph.components, adaptive.tolerances)
        self._timed = profile
        self._stepper: Stepper | None = None

    def run(
        self,
        starts: Mapping[str, Mapping[str, Number]] | None = None,
        progress: Progress | None = None,
        should_stop: Callable[[], bool] | None = None,
        store: Store | None = None,
        pace: float | None = None,
    ) -> Trajectories:
        """Run from start to stop and close all components, whatever happens.

        Runs are alike to the last bit; a second one needs components that can be entered after `close`.

        Args:
            starts: start values by component and variable.
            progress: told (fraction done, t [s]) about ten times a second.
            should_stop: asked after every row, or some of them where many are done in a moment; True ends the
                run with the rows so far.
            store: where rows and checkpoints are kept; without it rows stay in memory.
            pace: simulated time per wall time that the run is held to; without it, as fast as it goes.

        Returns:
            The trajectories; a failure in the course of the run is their `error`.

        Raises:
            InputError: a start value that a component does not take, a table too large for the memory, or no
                checkpoint to go on from.
        """
        starts = starts or {}
        components: list[Component] = list(self.graph.components.values())
        self._timed = self._profile or pace is not None
        if self._timed:
            components = [Timed(component) for component in components]
        watch = Watch(progress, should_stop, store)
        try:
            _check_names(self.graph, "start values", starts)
            recorder = self._recorder(store, [] if pace is None else timing_columns(self.graph.names))
            plan = Plan(
                self.graph,
                components,
                self.recorded,
                self.every,
                self.ticks,
                self.step,
                self._seidel,
                self._loops,
                self._extrapolation,
            )
            if pace is not None:
                own = {name: e * self.step for name, e in zip(self.graph.names, self.every, strict=True)}
                watch.pace = Pace(pace, own, lambda: self._seconds(components), recorder)
                # Its columns are written after their row.
                plan.columns = np.append(plan.columns, np.zeros(1 + len(own), dtype=plan.columns.dtype))
            error = self._attempt(plan, recorder, starts, watch) or _flush(recorder)
        finally:
            faults = _close(components)
        for number, text in faults:
            plan.warn(number, text)
        statistics = self._statistics(plan, recorder, watch)
        if self._profile:
            seconds = self._seconds(components).tolist()
            statistics["component_seconds"] = dict(zip(self.graph.names, seconds, strict=True))
        return Trajectories(
            recorder.frame(), recorder.units, error, statistics, recorder.columns, recorder.file
        )

    def _seconds(self, components: Sequence[Component]) -> Values:
        """For how long each component has been at work [s]."""
        timed = np.array([c.seconds for c in components if isinstance(c, Timed)])
        return timed if self._stepper is None else timed + self._stepper.seconds

    def _recorder(self, store: Store | None, timing: list[str]) -> Recorder:
        """An empty table for time, recorded variables, and what is told of the pace."""
        names = [TIME, *map(self.graph.path, self.recorded), *timing]
        stated = ["s", *(self.graph.variable(port).unit for port in self.recorded), *("s" for _ in timing)]
        units = {name: unit for name, unit in zip(names, stated, strict=True) if unit is not None}
        kinds: list[Kind] = ["number", *kinds_of(self.graph, self.recorded)]
        kinds += ["number"] * len(timing)
        file = None if store is None else store.row_file(self.ticks // self._every + 1, len(kinds))
        return Recorder(names, units, self.ticks, self._every, file, kinds)

    def _attempt(
        self, plan: Plan, recorder: Recorder, starts: Mapping[str, Mapping[str, Number]], watch: Watch
    ) -> RunError | None:
        """Step until the end or until something happens, which is returned."""
        try:
            # What is not finite becomes an error with name and time: no warnings of numpy beside it.
            with np.errstate(over="ignore", invalid="ignore"):
                plan.initialize(self.start, self.stop, starts)
                self._step_all(plan, recorder, watch)
        except RunError as error:
            return error
        except KeyboardInterrupt:
            if watch.stopping:
                raise  # asked for the second time: at once
            return Interrupted("stopped by the user; the rows so far are kept")
        return None

    def _step_all(self, plan: Plan, recorder: Recorder, watch: Watch) -> None:
        """Step from tick to tick, a row each.

        Raises:
            RunError: a component failed, or the user asked to stop.
        """
        ticks, saved = self.ticks, watch.saved()
        if saved is None:
            k = 0
            plan.propagate(0, self.start)
            recorder.record(0, plan.signals, plan.columns)
        else:
            k = saved["tick"]
            plan.restore(saved["plan"])
            recorder.go_on(saved["rows"])
        stepper = self._stepper = self._make_stepper(plan, recorder)
        if saved is not None:
            stepper.restore(saved["stepper"])

        def state() -> tuple[dict[str, Any], Recorder]:
            return {"tick": k, "plan": plan.save(), "stepper": stepper.save()}, recorder

        while watch.goes_on(k, ticks, self.start + k * self.step, state):
            chunk = stepper.chunk if watch.pace is None else 1
            until = min(k + chunk, k + recorder.room(k), ticks)
            stepper.run(k, until)
            k = until

    def _make_stepper(self, plan: Plan, recorder: Recorder) -> Stepper:
        if self._adaptive is not None:
            return Adaptive(plan, recorder, self.start, self.step, self._adaptive)
        return make_stepper(plan, recorder, self.start, self.step, self._timed, self._compiled)

    def _statistics(self, plan: Plan, recorder: Recorder, watch: Watch) -> dict[str, Any]:
        steps, seconds, loops = max(recorder.rows - 1, 0) * self._every, watch.seconds, plan.loops
        return {
            "stepping": "plain" if self._stepper is None else type(self._stepper).__name__.lower(),
            "steps": steps,
            "seconds": seconds,
            "real_time_factor": steps * self.step / seconds,
            "warnings": {name: asdict(warned) for name, warned in plan.warnings.items()},
            **({} if self._stepper is None else self._stepper.report()),
            **({} if loops is None else {"loop_passes": loops.passes, "loop_residual": loops.worst}),
            **watch.report(),
        }


# ── checks and closing ───────────────────────────────────────────────────────────────────────────────────


def _check_names(graph: Graph, what: str, named: Iterable[str]) -> None:
    """Refuse names of components that are not there.

    Raises:
        InputError: with the names that are nearest.
    """
    for name in named:
        if name not in graph.components:
            raise InputError(f"{what}: no component {name!r}; {nearest(name, graph.names, 'components')}")


def _flush(recorder: Recorder) -> RunError | None:
    """Write what rows are left; an error is returned."""
    try:
        recorder.flush()
    except RunError as error:
        return error
    return None


def _close(components: Sequence[Component]) -> list[tuple[int, str]]:
    """Close all components, whatever each says to it; gives number and text of those that failed."""
    faults = []
    for number, component in enumerate(components):
        try:
            component.close()
        except Exception as error:
            faults.append((number, f"closing failed: {type(error).__name__}: {error}"))
    return faults

"""Compiled stepping: the work of a plan done by a compiled loop over the components' own C functions.

Components that offer their C functions are set, read and stepped there, straight between the signal vector
and the FMU; signals that depend on time alone come from a table made for many ticks at once; for all others
the loop comes back to Python. Values, rows and errors are those of the plain stepping to the last bit.
"""

from __future__ import annotations

import time

import numpy as np

from exlinn_fmi.components.base import Status, Values
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.program import Program, Source
from exlinn_fmi.cosim.recorder import Recorder
from exlinn_fmi.cosim.stepping import Stepper, clock_address

SHORTEST, LONGEST = 64, 2**15
"""Ticks that are done in one go: at first, and at most."""

IN_ONE_GO = 0.05
"""Wall time that the loop is left alone for [s], so that progress is told and Ctrl-C is minded."""


class Compiled(Stepper):
    """Steps a plan from tick to tick in compiled code.

    Args:
        plan: initialised, with its first row done.
        recorder: takes the rows.
        start: start time [s].
        step: step of the master [s].
        profile: whether to measure the time of each component.

    Attributes:
        chunk: ticks that should be done in one go.
        seconds: time spent in C functions [s] by component number, where `profile`.
    """

    def __init__(self, plan: Plan, recorder: Recorder, start: float, step: float, profile: bool) -> None:
        from exlinn_fmi.cosim import kernel

        self._kernel, self._plan, self._recorder = kernel, plan, recorder
        self._start, self._step, self.chunk = start, step, SHORTEST
        self._program = Program(plan, recorder.every, start, step)
        self._calls = [act.call or _nothing for act in self._program.acts]
        self._columns = np.asarray(plan.columns, dtype=np.uint64)
        self._span = np.array([start, step])
        self.seconds: Values = np.zeros(len(plan.components))
        self._state = np.zeros(kernel.STATES, dtype=np.int64)
        self._state[kernel.FINAL] = plan.ticks
        self._state[kernel.CLOCK] = clock_address() if profile else 0
        arrays = {
            kernel.PROGRAM: self._program.table,
            kernel.MOVES: self._program.moves,
            kernel.COLUMNS: self._columns,
            kernel.SIGNALS: plan.signals,
            kernel.OWN_STEPS: self._program.own_steps,
            kernel.TIMES: self._span,
            kernel.SECONDS: self.seconds,
            kernel.STATE: self._state,
        }
        self._arguments = np.zeros(kernel.ARGUMENTS, dtype=np.int64)
        self._arguments[list(arrays)] = [array.ctypes.data for array in arrays.values()]
        self._arguments[kernel.ACROSS] = len(self._columns)
        self._loop, self._where = kernel.load(), self._arguments.ctypes.data

    def run(self, first: int, until: int) -> None:
        """Step from tick `first` to tick `until` and record the rows in between and that of `until`.

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """
        k, state, began = self._kernel, self._state, time.perf_counter()
        self._tables = [self._tabulate(source, first, until) for source in self._program.sources]
        state[k.AT_TICK], state[k.AT], state[k.BASE] = first, 0, self._recorder.base
        self._aim()
        loop, where, calls, reasons = self._loop, self._where, self._calls, k.REASONS
        tick = memoryview(state.data)[k.AT_TICK :]
        try:
            for end in self._program.turns.pieces(first, until):
                state[k.UNTIL] = end
                while reason := loop(where):
                    if reason % reasons == k.CALL:
                        calls[reason // reasons](tick[0])
                    else:
                        self._see_to(reason % reasons, reason // reasons)
        finally:
            recorded = tick[0] - (state[k.AT] > self._program.tick)
            self._recorder.rows = int(recorded) // self._recorder.every + 1
        for source in self._program.sources:
            self._follow(source, first, until)
        took = time.perf_counter() - began
        self.chunk = int(np.clip(self.chunk * IN_ONE_GO / took, SHORTEST, min(2 * self.chunk, LONGEST)))

    def _aim(self, acts: int | None = None) -> None:
        """Point the loop at its arrays, and at the first so many acts of the program only."""
        k, program, recorder = self._kernel, self._program, self._recorder
        self._arguments[k.ACTS] = len(program.acts) if acts is None else acts
        self._arguments[k.ROWS] = recorder.table.ctypes.data

    def _see_to(self, reason: int, line: int) -> None:
        """Do what the loop cannot, for an act of the program.

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """
        plan, act = self._plan, self._program.acts[line]
        t = self._start + int(self._state[self._kernel.AT_TICK]) * self._step
        if reason == self._kernel.STATUS:
            self._heed(line, t)
        if act.exchange is not None and reason == self._kernel.REFUSED:
            assert act.vector is not None
            tick = int(self._state[self._kernel.AT_TICK])
            self._program.turns.tell_time(act.exchange.component, tick)
            plan.exchange(act.exchange, act.vector, t)  # which ends in an error
        elif act.exchange is not None and act.exchange.outputs is not None:
            plan.check_finite(act.exchange, t)

    def _heed(self, line: int, t: float) -> None:
        """Count a warning of a C function, or stop on anything worse.

        A set or get of several calls ends as the worst of them, as `Component.set` and `get` do.

        Raises:
            RunError: it was worse.
        """
        k, state, acts = self._kernel, self._state, self._program.acts
        last, tick, until, worst = line + acts[line].more, state[k.AT_TICK], int(state[k.UNTIL]), Status.OK
        state[k.UNTIL] = tick
        self._aim(last + 1)
        reason, at = k.STATUS, line
        while reason == k.STATUS:
            native = acts[at].native
            assert native is not None
            worst = max(worst, native.heed(acts[at].name, int(state[k.RESULT])))
            if worst >= Status.ERROR:
                break  # nothing more may be asked of it
            at, reason = divmod(self._loop(self._where), k.REASONS)
        if reason == k.REFUSED:
            self._see_to(reason, at)
        state[k.UNTIL], state[k.AT_TICK], state[k.AT] = until, tick, last + 1
        self._aim()
        if worst != Status.OK:
            self._plan.judge(int(self._program.table[line, k.WHO]), worst, acts[line].what, t)

    # ── functions of time ────────────────────────────────────────────────────────────────────────────────

    def _due(self, source: Source, first: int, until: int) -> range:
        """Ticks after `first` until `until` at which a source is read."""
        every = source.advance.every
        return range((first // every + 1) * every, until + 1, every)

    def _tabulate(self, source: Source, first: int, until: int) -> Values:
        """Values of a source at the ticks from `first` to `until`, for the loop to read."""
        x, component = source.exchange, self._plan.components[source.exchange.component]
        # As a component counts: from where a step began, over the step.
        began = np.array(self._due(source, first, until), dtype=float) - source.advance.every
        times = self._start + began * self._step + source.advance.h
        assert x.outputs is not None
        try:
            values = component.outputs_over(x.outputs, times)
        except Exception as error:
            raise self._plan.wrapped(x.component, error, self._start + first * self._step) from error
        assert values is not None
        table = np.ascontiguousarray(values, dtype=np.float64)
        self._program.table[source.line, self._kernel.REFERENCES] = table.ctypes.data
        return table

    def _follow(self, source: Source, first: int, until: int) -> None:
        """Let a source know what time it is: one step stands for all of a chunk."""
        due, h = self._due(source, first, until), source.advance.h
        if due:
            self._plan.components[source.exchange.component].step(
                self._start + (due[-1] - source.advance.every) * self._step, h
            )


def _nothing(tick: int) -> None:
    """For acts that need no call of Python."""

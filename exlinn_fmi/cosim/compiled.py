"""Compiled stepping: the work of a plan done by a compiled loop over the components' own C functions.

Components that offer their C functions are set, read and stepped there, straight between the signal vector
and the FMU; signals that depend on time alone come from a table made for many ticks at once; for all others
the loop comes back to Python. Values, rows and errors are those of the plain stepping to the last bit.
"""

from __future__ import annotations

import ctypes
import time

import numpy as np

from exlinn_fmi.components.base import Status, Values
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.program import Program, Source
from exlinn_fmi.cosim.recorder import Recorder
from exlinn_fmi.cosim.stepping import Stepper

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
        self._program = Program(plan, recorder.every, start)
        self._columns = np.asarray(plan.columns, dtype=np.int64)
        self._span = np.array([start, step])
        self.seconds: Values = np.zeros(len(plan.components))
        self._state = np.zeros(kernel.STATES, dtype=np.int64)
        self._state[kernel.FINAL] = plan.ticks
        self._state[kernel.CLOCK] = clock_address() if profile else 0

    def run(self, first: int, until: int) -> None:
        """Step from tick `first` to tick `until` and record the rows in between and that of `until`.

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """
        k, state, began = self._kernel, self._state, time.perf_counter()
        tables = [self._tabulate(source, first, until) for source in self._program.sources]
        state[k.AT_TICK], state[k.AT], state[k.UNTIL], state[k.BASE] = first, 0, until, self._recorder.base
        try:
            while reason := self._loop():
                self._see_to(reason)
                state[k.AT] += 1
        finally:
            recorded = state[k.AT_TICK] - (state[k.AT] > self._program.tick)
            self._recorder.rows = int(recorded) // self._recorder.every + 1
        for source, table in zip(self._program.sources, tables, strict=True):
            self._follow(source, first, until)
            del table
        took = time.perf_counter() - began
        self.chunk = int(np.clip(self.chunk * IN_ONE_GO / took, SHORTEST, min(2 * self.chunk, LONGEST)))

    def _loop(self, acts: int | None = None) -> int:
        """Let the loop go on, with the first so many acts of the program only; gives why it ended."""
        program = self._program
        reason: int = self._kernel.run(
            program.table[:acts],
            program.moves,
            self._columns,
            self._plan.signals,
            self._recorder.table,
            program.own_steps,
            self._span,
            self.seconds,
            self._state,
        )
        return reason

    def _see_to(self, reason: int) -> None:
        """Do what the loop cannot, at the line where it stands.

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """
        k, plan, state = self._kernel, self._plan, self._state
        line, tick = int(state[k.AT]), int(state[k.AT_TICK])
        act, t = self._program.acts[line], self._start + tick * self._step
        if reason == k.CALL:
            assert act.call is not None
            act.call(tick, t)
        elif reason == k.STATUS:
            self._heed(line, t)
        elif reason == k.INFINITE:
            assert act.exchange is not None
            plan.check_finite(act.exchange, t)
        else:  # a value that its type cannot hold: the component says so itself
            assert act.exchange is not None
            assert act.vector is not None
            plan.exchange(act.exchange, act.vector, t)

    def _heed(self, line: int, t: float) -> None:
        """Count a warning of a C function, or stop on anything worse.

        A set or get of several calls ends as the worst of them, as `Component.set` and `get` do.

        Raises:
            RunError: it was worse.
        """
        k, state, act = self._kernel, self._state, self._program.acts[line]
        last, tick, until, worst = line + act.more, state[k.AT_TICK], int(state[k.UNTIL]), Status.OK
        state[k.UNTIL] = tick
        reason = k.STATUS
        while reason == k.STATUS and worst < Status.DISCARD:
            native = self._program.acts[state[k.AT]].native
            assert native is not None
            worst = max(worst, native.heed(self._program.acts[state[k.AT]].name, int(state[k.RESULT])))
            state[k.AT] += 1
            reason = self._loop(last + 1)
        if reason == k.REFUSED:
            self._see_to(reason)  # which ends in an error
        state[k.UNTIL], state[k.AT_TICK], state[k.AT] = until, tick, last
        if worst != Status.OK:
            self._plan.judge(int(self._program.table[line, k.WHO]), worst, act.what, t)
        if act.exchange is not None and act.exchange.outputs is not None:
            self._plan.check_finite(act.exchange, t)

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


def clock_address() -> int:
    """Where the system's clock_gettime lies, 0 where there is none."""
    try:
        return ctypes.cast(ctypes.CDLL(None).clock_gettime, ctypes.c_void_p).value or 0
    except (AttributeError, OSError, TypeError):
        return 0

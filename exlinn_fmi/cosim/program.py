"""A plan as a program for the compiled loop: a table of C calls and moves of values, addresses and all.

See `kernel.py` for what the columns mean, and `compiled.py` for who runs it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Component, Values
from exlinn_fmi.components.native import Native, NativeAccess, State
from exlinn_fmi.cosim import kernel as k
from exlinn_fmi.cosim.exchange import Advance, Exchange
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.turns import Turns

Columns = dict[int, int]
Move = tuple[int, int, int]

NEVER = 2**62
"""Span of a line that is left out: it leads beyond the end from any tick."""


@dataclass(frozen=True)
class Act:
    """What a line of the program is part of, for when the loop comes back with it.

    Args:
        what: it does, in words.
        name: of its C function.
        native: the C functions that it is one of.
        exchange: it is part of.
        vector: that the exchange reads.
        call: what to do from Python in its place, given the tick.
        more: calls that follow it and belong to the same set or get.
    """

    what: str = ""
    name: str = ""
    native: Native | None = None
    exchange: Exchange | None = None
    vector: Values | None = None
    call: Callable[[int], None] | None = None
    more: int = 0


@dataclass(frozen=True)
class Source:
    """A component that depends on time alone: the line that reads its table, and what it does in a plan."""

    line: int
    exchange: Exchange
    advance: Advance


class Program:
    """The acts of a tick, from the steps that begin at it to the row of the next one.

    Args:
        plan: initialised.
        every: a row is recorded at every so many ticks.
        start: start time [s].
        step: step of the master [s].

    Attributes:
        table: (acts, `kernel.WIDTH`), see `kernel.py`.
        moves: (moves, 3): kind, address read, address written.
        own_steps: (acts, 2) step, and time that it is behind [s].
        acts: what the lines are part of.
        tick: the line with which the next tick begins.
        sources: components whose values are tabulated.
        turns: what changes in the course of a run.
    """

    def __init__(self, plan: Plan, every: int, start: float, step: float) -> None:
        self._plan, self._start, self._step = plan, start, step
        self._natives = [self._native(component) for component in plan.components]
        self.turns = Turns(plan, self._natives, start, step)
        self._lines: list[Columns] = []
        self._moves: list[Move] = []
        self._own: list[float] = []
        self._kept: list[Any] = []
        self.acts: list[Act] = []
        self.sources: list[Source] = []
        tabulated = {x.component for _, x in plan.visits if self._is_source(x)}
        steps = {a.component: a for a in plan.advances}
        for a in plan.advances:
            if a.component not in tabulated:
                self._add_step(a)
        self.tick = self._add(k.TICK)
        for own, x in plan.visits:
            if x.component in tabulated:
                reading = {k.EVERY: own, k.COUNT: len(x.taken), k.VALUES: _address(x.taken)}
                line = self._add(k.TABLE, reading, Act(exchange=x))
                self.sources.append(Source(line, x, steps[x.component]))
            else:
                self._add_exchange(x, plan.signals, {k.EVERY: own})
        base = plan.signals.ctypes.data
        held = zip(plan.hold_from, plan.hold_to, strict=True)
        first = self._add_moves((k.F8, base + 8 * int(a), base + 8 * int(b)) for a, b in held)
        if plan.loops is not None:
            self._add(k.PYTHON, act=Act(call=lambda tick: plan.pass_on(tick, self._time(tick))))
        elif plan.hold_to.size:
            self._add(k.MOVE, {k.FIRST: first, k.LAST: len(self._moves)})
        self._add(k.ROW, {k.EVERY: every})
        self.table = np.zeros((len(self._lines), k.WIDTH), dtype=np.int64)
        self.table[:, k.EVERY], self.table[:, k.WHO] = 1, -1
        for row, columns in zip(self.table, self._lines, strict=True):
            row[list(columns)] = list(columns.values())
        self.moves = np.array(self._moves or [(0, 0, 0)], dtype=np.int64)
        self.own_steps = np.stack([self._own, np.zeros(len(self._own))], axis=1)

    def _native(self, component: Component) -> Native | None:
        """The C functions of a component, unless the plan calls it otherwise and it has to know when."""
        native = component.native()
        outside = self._plan.loops is not None or self._plan.extrapolation is not None
        return None if native is not None and native.turns and outside else native

    def _time(self, tick: int) -> float:
        return self._start + tick * self._step

    def _is_source(self, x: Exchange) -> bool:
        """Whether an exchange reads what depends on time alone."""
        if x.inputs is not None or x.outputs is None:
            return False
        return self._plan.components[x.component].outputs_over(x.outputs, np.array([self._start])) is not None

    def _add(self, code: int, columns: Columns | None = None, act: Act | None = None, h: float = 0.0) -> int:
        """Add a line; gives its number."""
        self._lines.append({k.CODE: code, **(columns or {})})
        self.acts.append(act or Act())
        self._own.append(h)
        return len(self._lines) - 1

    def _add_moves(self, moves: Any) -> int:
        """Add moves; gives the number of the first."""
        first = len(self._moves)
        self._moves += moves
        return first

    def _add_changes(self, x: Exchange, verb: Literal["Get", "Set"], ahead: int) -> None:
        """Moves that do to values in a piece of the vector what their component does to them."""
        native, number = self._natives[x.component], x.component
        indices, piece = (x.inputs, x.given) if verb == "Set" else (x.outputs, x.taken)
        assert native is not None
        assert indices is not None
        kinds = {"set": k.F8, "add": k.ADD, "scale": k.SCALE, "hold": k.HOLD}
        for change in native.changes(verb, indices):
            self._kept.append(change.number)
            cell, value = _address(change.number), _address(piece[change.position :])
            states: dict[State, Move] = {
                "on": (kinds[change.kind], cell, value),
                "keep": (k.F8, value, cell),
                "off": (k.F8, value, value),
            }
            place = self._add_moves([states["on"]])
            if change.state is not None:
                self.turns.add(number, ahead, partial(self._arrange_move, place, states, change.state))

    def _add_arrival(self, number: int, what: str, due: Columns, ahead: int) -> None:
        """What a component sets by itself at a new communication point; done only where something changes."""
        native = self._natives[number]
        if native is None or not native.arrives:
            return

        here = 0 if k.TICK in (columns[k.CODE] for columns in self._lines) else ahead

        def arrive(tick: int) -> None:
            if status := self.turns.tell_time(number, tick + here):
                self._plan.judge(number, status, what, self._time(tick + here))

        line = self._add(k.PYTHON, due, Act(call=arrive))
        self.turns.add(number, ahead, lambda t, turning: self._skip(line, not turning))

    def _arrange_move(
        self, place: int, states: Mapping[State, Move], state: Callable[[float], State], t: float, _: bool
    ) -> None:
        self.moves[place] = states[state(t)]

    def _arrange_set(self, line: int, native: Native, t: float, _: bool) -> None:
        self._skip(line, native.frozen(t))

    def _arrange_step(self, line: int, native: Native, t: float, _: bool) -> None:
        self._skip(line, native.frozen(t))
        self.own_steps[line, 1] = native.lag

    def _skip(self, line: int, yes: bool) -> None:
        """Leave a line out, or not."""
        columns = {k.EVERY: 2, k.SPAN: NEVER} if yes else self._lines[line]
        self.table[line, k.EVERY], self.table[line, k.SPAN] = columns.get(k.EVERY, 1), columns.get(k.SPAN, 0)

    def _add_step(self, a: Advance) -> None:
        """A step, with its exchanges before and after in Gauss–Seidel."""
        native, due = self._natives[a.component], {k.EVERY: a.every, k.SPAN: a.every}
        if native is None:
            self._add(k.PYTHON, due, Act(call=lambda tick: self._plan.step(a, self._time(tick), a.h)))
            return
        if a.before is not None:
            self._add_exchange(a.before, self._plan.ahead, due, ahead=0)
        extrapolation = self._plan.extrapolation
        if extrapolation is not None and extrapolation.concerns(a.component):
            prepare = extrapolation.prepare
            act = Act(call=lambda tick: prepare(a.component, self._time(tick), a.h))
            self._add(k.PYTHON, due, act)
        step = native.step
        columns = {
            **due,
            k.WHO: a.component,
            k.FUNCTION: step.function,
            k.HANDLE: step.handle,
            k.FLAG: step.flag,
        }
        columns |= dict(zip((k.EVENT, k.END, k.EARLY, k.REACHED), step.pointers, strict=False))
        self._add_arrival(a.component, "the step", due, ahead=0)
        line = self._add(k.STEP, columns, Act("the step", "DoStep", native), a.h)
        self.turns.add(a.component, 0, partial(self._arrange_step, line, native))
        if a.after is not None:
            self._add_exchange(a.after, self._plan.ahead, due, ahead=a.every)

    def _add_exchange(self, x: Exchange, vector: Values, due: Columns, ahead: int = 1) -> None:
        """An exchange: the calls that set, then those that get; for the tick so many `ahead`."""
        native, who = self._natives[x.component], {**due, k.WHO: x.component}
        first = len(self._moves)
        if x.inputs is not None:
            sources = vector.ctypes.data + 8 * x.sources
            given = zip(sources.tolist(), _addresses(x.given), strict=True)
            self._add_moves((k.F8, a, b) for a, b in given)
            if native is not None:
                self._add_changes(x, "Set", ahead)
                if native.turns:  # what it is given is recorded even if it is not set
                    self._add(k.MOVE, {**due, k.FIRST: first, k.LAST: len(self._moves)})
                    first = len(self._moves)
        check = {k.CHECK: _address(x.taken), k.CHECKED: len(x.taken)}
        if native is None:
            act = Act(call=lambda tick: self._plan.trade(x, self._time(tick)))
            self._add(k.PYTHON, {**due, k.FIRST: first, k.LAST: len(self._moves)}, act)
            if x.outputs is not None:
                self._add(k.FINITE, {**due, **check}, Act(exchange=x))
            return
        self._add_arrival(
            x.component, "reading outputs" if x.inputs is None else "setting inputs", due, ahead
        )
        if x.inputs is not None:
            calls = native.access("Set", x.inputs)
            for n, call in enumerate(calls, 1):
                values, kind = self._buffer(call, x.given)
                if kind is not None:
                    to = _addresses(values, call.elements)
                    cells = zip(_addresses(x.given, call.positions), to, strict=True)
                    rests = {to[n]: _address(x.given[place:]) for n, place in call.rests}
                    self._add_moves((k.I8, a, b) for b, a in rests.items())
                    self._add_moves((kind + k.REST * (b in rests), a, b) for a, b in cells)
                columns = {**who, **_arguments(call, values), k.FIRST: first, k.LAST: len(self._moves)}
                act = Act("setting inputs", call.name, native, x, vector, more=len(calls) - n)
                line = self._add(k.SET, columns, act)
                self.turns.add(x.component, ahead, partial(self._arrange_set, line, native))
                first = len(self._moves)
        if x.outputs is not None:
            calls = native.access("Get", x.outputs)
            for n, call in enumerate(calls, 1):
                values, kind = self._buffer(call, x.taken)
                first = len(self._moves)
                if kind is not None:
                    out = _addresses(values, call.elements)
                    cells = zip(out, _addresses(x.taken, call.positions), strict=True)
                    self._add_moves((kind + k.FROM, a, b) for a, b in cells)
                    rest = kind + k.REST + k.FROM
                    self._add_moves((rest, out[n], _address(x.taken[place:])) for n, place in call.rests)
                if n == len(calls):
                    self._add_changes(x, "Get", ahead)
                columns = {**who, **_arguments(call, values), k.FIRST: first, k.LAST: len(self._moves)}
                if n == len(calls):
                    columns |= check
                act = Act("reading outputs", call.name, native, x, vector, more=len(calls) - n)
                self._add(k.GET, columns, act)

    def _buffer(self, call: NativeAccess, piece: Values) -> tuple[NDArray[Any], int | None]:
        """Values of a call: the piece of the vector itself, or else a buffer and the kind of its elements."""
        self._kept.append(call.references)
        whole = call.array is None and np.array_equal(call.positions, np.arange(len(piece)))
        if whole and call.dtype == np.float64:
            return piece, None
        buffer = np.zeros(len(call.positions), dtype=call.dtype) if call.array is None else call.array
        self._kept.append(buffer)
        if call.boolean:
            return buffer, k.B1 if buffer.itemsize == 1 else k.B4
        return buffer, k.TYPES.index(f"{buffer.dtype.kind}{buffer.itemsize}")


def _arguments(call: NativeAccess, values: NDArray[Any]) -> Columns:
    return {
        k.FUNCTION: call.function,
        k.HANDLE: call.handle,
        k.REFERENCES: call.references.ctypes.data,
        k.COUNT: len(call.references),
        k.VALUES: _address(values),
        k.COUNTED: len(values) if call.counted else 0,
    }


def _address(values: NDArray[Any]) -> int:
    return int(values.ctypes.data)


def _addresses(values: NDArray[Any], positions: Sequence[int] | NDArray[np.intp] | None = None) -> list[int]:
    """Where the elements of a contiguous array lie."""
    numbers = np.arange(len(values)) if positions is None else np.asarray(positions)
    found: list[int] = (values.ctypes.data + values.itemsize * numbers).tolist()
    return found

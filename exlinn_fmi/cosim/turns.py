"""Parts of a compiled program that change in the course of a run, and when: what events do to components.

Between two turns the program is the same from tick to tick, so the compiled loop runs on without a look.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from exlinn_fmi.components.native import Native
from exlinn_fmi.cosim.exchange import Advance
from exlinn_fmi.cosim.plan import Plan

Arrange = Callable[[float, bool], None]
"""Makes a part as it is at a time [s]; told also whether something may be otherwise from there on."""


@dataclass(frozen=True)
class _Part:
    """A part of the program that a component changes, so many ticks ahead of that at which a tick begins."""

    advance: Advance
    ahead: int
    arrange: Arrange


class Turns:
    """When to arrange which parts of a program anew.

    Args:
        plan: initialised.
        natives: the C functions of its components.
        start: start time [s].
        step: step of the master [s].
    """

    def __init__(self, plan: Plan, natives: Sequence[Native | None], start: float, step: float) -> None:
        self._start, self._step, self._last = start, step, plan.ticks
        self._parts: list[_Part] = []
        self._changing = {
            a.component: (native, a)
            for a in plan.advances
            if (native := natives[a.component]) is not None and native.turns
        }
        # Some steps to each side, before and after an exchange: to arrange what has not changed does no harm.
        self._ticks = {
            (math.floor((t - start) / a.h) + steps) * a.every + ticks
            for native, a in self._changing.values()
            for t in native.turns
            for steps in range(-2, 3)
            for ticks in (-1, 0)
        }

    def add(self, component: int, ahead: int, arrange: Arrange) -> None:
        """Have a part arranged where its component changes, which most never do."""
        if component in self._changing:
            self._parts.append(_Part(self._changing[component][1], ahead, arrange))

    def pieces(self, first: int, until: int) -> Iterator[int]:
        """Arrange the program for the ticks from `first` on, tell until where that holds; so on to `until`.

        The components are told what was done when the next is asked for.
        """
        turning = {k for k in self._ticks if first < k < until} | {first} if self._parts else set()
        cuts = {*turning, *(k + 1 for k in turning if k + 1 < until), until} - {first}
        begin = first
        for end in sorted(cuts):
            for part in self._parts:
                part.arrange(self.seen(begin + part.ahead, part.advance), begin in turning)
            yield end
            for native, a in self._changing.values():
                last = min(end - 1, self._last - a.every) // a.every
                count = last - (begin - 1) // a.every
                if count > 0:
                    native.passed(self._start + last * a.every * self._step, a.h, count)
            begin = end

    def seen(self, tick: int, a: Advance) -> float:
        """The time [s] that it is at a tick for a component, who counts from where its last step began."""
        due = tick - tick % a.every
        return self._start + (due - a.every) * self._step + a.h if due else self._start

    def tell_time(self, component: int, tick: int) -> int:
        """Let a component know at which tick it is, and set what it does then; gives a `Status`."""
        if component not in self._changing:
            return 0
        native, a = self._changing[component]
        return native.arrive(self.seen(tick, a))

"""Event Mode, which Model Exchange and FMI 3 Co-Simulation share: iterations, time events and clocks.

References: FMI 2.0 §3.2.3, FMI 3.0 §2.2.8 (time-based clocks) and §2.3.5 (Event Mode).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from ctypes import c_bool, c_double, c_int, c_size_t, c_uint32, c_void_p
from dataclasses import dataclass

from exlinn_fmi.components.base import Values
from exlinn_fmi.components.fmu_description import Clock
from exlinn_fmi.components.fmu_native import Instance, pointer_to

MOST_ITERATIONS = 1000
"""Iterations of one event before it is taken never to end."""

CLOSE = 1e-12
"""Times that differ by less, relative to themselves or 1 s, are the same."""


class Stopped(Exception):  # noqa: N818 - a reason, on its way to becoming a message
    """The FMU cannot or will not go on; the text says why.

    Args:
        message: why.
        code: fmi…Discard where the FMU asks to end the simulation, else fmi…Error.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.message, self.code = message, code


def close(a: float, b: float) -> bool:
    """Whether two times are the same but for rounding; either may be infinite."""
    return abs(a - b) <= CLOSE * max(1.0, min(abs(a), abs(b)))


@dataclass(frozen=True)
class Changes:
    """What an event brought.

    Args:
        nominals: whether nominal values of states are others now.
        states: whether states have jumped.
    """

    nominals: bool
    states: bool


class EventMode:
    """An instance's events.

    Args:
        instance: the FMU.
        leave: name of the function that leaves Event Mode.

    Attributes:
        inside: whether the instance is in Event Mode.
        next_event: [s] time of the next time event or tick, infinite where there is none.
    """

    def __init__(self, instance: Instance, leave: str) -> None:
        self._instance, self._leave = instance, leave
        self._clocks = [
            _Ticking(clock)
            for clock in instance.description.clocks
            if clock.causality == "input" and clock.kind != "triggered"
        ]
        self.inside = True
        self._announced = math.inf

    @property
    def next_event(self) -> float:
        """See the class."""
        return min([self._announced, *(clock.next_tick for clock in self._clocks)])

    def begin(self, t: float) -> Changes:
        """The first event, on leaving Initialization Mode."""
        self.inside = True
        for clock in self._clocks:
            clock.begin(self._instance, t)
        return self.handle(t)

    def enter(self) -> None:
        """Enter Event Mode, if not there already.

        Raises:
            Refused: the FMU reports an error.
        """
        if not self.inside:
            self._instance.demand("EnterEventMode")
            self.inside = True

    def handle(self, t: float) -> Changes:
        """Let clocks tick that are due, iterate until all is settled, and leave Event Mode.

        Raises:
            Refused: the FMU reports an error.
            Stopped: the FMU asks to end, or the iteration does not.
        """
        self.enter()
        due = [clock for clock in self._clocks if clock.next_tick <= t or close(clock.next_tick, t)]
        for clock in due:
            clock.tick(self._instance)
        nominals = states = False
        for _ in range(MOST_ITERATIONS):
            update = self._instance.update_discrete_states()
            nominals |= update.nominals_changed
            states |= update.states_changed
            if update.terminate:
                raise Stopped(f"the FMU asks to end the simulation, at t = {t:.9g} s", 2)
            if not update.again:
                break
        else:
            raise Stopped(f"the event at t = {t:.9g} s has not settled in {MOST_ITERATIONS} iterations", 3)
        self._announced = update.next_event
        for clock in self._clocks:
            clock.schedule(self._instance, t, clock in due)
        self._instance.demand(self._leave)
        self.inside = False
        return Changes(nominals, states)

    def snapshot(self) -> list[float]:
        """What `restore` wants."""
        return [self._announced, *(x for clock in self._clocks for x in (clock.next_tick, clock.interval))]

    def restore(self, saved: Sequence[float] | Values) -> None:
        """Back to a snapshot; the instance is not in Event Mode."""
        self._announced = float(saved[0])
        for k, clock in enumerate(self._clocks):
            clock.next_tick, clock.interval = map(float, saved[1 + 2 * k : 3 + 2 * k])
        self.inside = False


class _Ticking:
    """A time-based input clock: it ticks because we make it."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.next_tick, self.interval = clock, math.inf, clock.interval or math.inf
        self._references = (c_uint32 * 1)(clock.reference)

    def begin(self, instance: Instance, t: float) -> None:
        """Plan the first tick."""
        self.next_tick = math.inf
        if self.clock.kind == "countdown":
            self._ask(instance, t)
            return
        if self.clock.interval is None:
            self._ask(instance, None)
        if math.isfinite(self.interval):
            self.next_tick = t + self.clock.shift

    def tick(self, instance: Instance) -> None:
        """Activate the clock for the event at hand."""
        instance.demand("SetClock", c_void_p(self._at), c_size_t(1), pointer_to((c_bool * 1)(True)))

    def schedule(self, instance: Instance, t: float, ticked: bool) -> None:
        """Plan the next tick, after an event."""
        if self.clock.kind == "countdown":
            if ticked:
                self.next_tick = math.inf
            self._ask(instance, t)
        elif ticked:
            if self.clock.kind in ("changing", "tunable"):
                self._ask(instance, None)
            self.next_tick += self.interval

    @property
    def _at(self) -> int:
        return pointer_to(self._references).value or 0

    def _ask(self, instance: Instance, t: float | None) -> None:
        """Ask the FMU for the interval; with a time, it is that to the next tick."""
        interval, qualifier = c_double(), c_int()
        pointers = pointer_to(interval), pointer_to(qualifier)
        instance.demand("GetIntervalDecimal", c_void_p(self._at), c_size_t(1), *pointers)
        if qualifier.value == 2:  # fmi3IntervalChanged
            self.interval = interval.value
            if t is not None:
                self.next_tick = t + interval.value

"""What events do to values, and when: see `events` for the components that they happen to.

Random effects depend on seed, event and time alone: a run that is repeated, undone in part or resumed sees
the same.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from hashlib import blake2b
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Values
from exlinn_fmi.components.native import State
from exlinn_fmi.scenario.events import Event, event_names


class Schedule:
    """When each event is active; shared by all components of a run.

    Args:
        events: the events.
        seed: seed of what is random.
        step: communication step [s].
    """

    def __init__(self, events: Sequence[Event], seed: int, step: float) -> None:
        self.events, self.names = tuple(events), event_names(list(events))
        self._seed, self._step = seed, step
        self.begins: list[float] = []
        self.restart()

    def restart(self) -> None:
        """Back to the start of a run: nothing was crossed."""
        self.begins = [math.inf if event.at is None else event.at for event in self.events]

    def end(self, k: int) -> float:
        """When event k ends [s]."""
        event = self.events[k]
        if event.duration is not None:
            return self.begins[k] + event.duration
        return math.inf if event.until is None else event.until

    @overload
    def active(self, k: int, t: float) -> bool: ...
    @overload
    def active(self, k: int, t: Values) -> NDArray[np.bool_]: ...
    def active(self, k: int, t: float | Values) -> bool | NDArray[np.bool_]:
        """Whether event k is active at the communication point, or each of those, t [s]."""
        slack = 1e-6 * self._step
        return (self.begins[k] - slack <= t) & (t < self.end(k) - slack)

    def watch(self, k: int, value: float, then: float) -> None:
        """Let event k begin at `then` [s] if the value that it waits for is there, for the first time."""
        when = self.events[k].when
        assert when is not None
        beyond = value > when.above if when.above is not None else value < (when.below or 0.0)
        if beyond and math.isinf(self.begins[k]):
            self.begins[k] = then

    def uniforms(self, k: int, t: float) -> tuple[float, float]:
        """Two numbers in (0, 1), independent for each event and communication point."""
        key = struct.pack("<QQq", self._seed, k, round(1024 * t / self._step))
        one, other = struct.unpack("<QQ", blake2b(key, digest_size=16).digest())
        return (one + 0.5) / 2**64, (other + 0.5) / 2**64


class Effect:
    """What one event does to one variable; called at every communication point, also while it is not active.

    Args:
        schedule: when events are active.
        k: number of the event.
        smooth: whether values between two samples make sense.
        rest: whether what it is done to is the rest of a value, see `Variable.wide`: what is set has none.

    Attributes:
        kind: see `Event.effect`.
        cell: (1,) the value of ``set`` and ``disconnect``, the number of ``add`` and ``scale``, or what
            ``hold`` and ``drop`` keep, not a number where that is nothing.
    """

    def __init__(self, schedule: Schedule, k: int, smooth: bool, rest: bool = False) -> None:
        self._schedule, self._k, self._smooth, self._rest = schedule, k, smooth, rest
        event = schedule.events[k]
        self.kind = event.effect
        self._number = 0.0 if rest and self.kind == "set" else float(getattr(event, event.effect) or 0.0)
        self.cell: Values = np.full(1, math.nan if self.kind in ("hold", "drop") else self._number)
        self._history: list[tuple[float, float]] = []

    def afresh(self) -> Effect:
        """The same, at the beginning."""
        return Effect(self._schedule, self._k, self._smooth, self._rest)

    def state(self, t: float) -> State:
        """What it does at t [s], see `native.Change`."""
        if self._schedule.active(self._k, t):
            return "on"
        return "keep" if self.kind == "hold" else "off"

    def __call__(self, t: float, value: float) -> float:
        """The value that comes of one at t [s]; may be called again for the same time."""
        kind, number, active = self.kind, self._number, self._schedule.active(self._k, t)
        if kind in ("hold", "drop"):
            lost = active and (kind == "hold" or self._schedule.uniforms(self._k, t)[0] < number)
            if not lost or math.isnan(self.cell[0]):
                self.cell[0] = value
            return float(self.cell[0])
        if kind == "delay":
            return self._delay(t, value, active)
        if not active:
            return value
        if kind == "noise":
            u, w = self._schedule.uniforms(self._k, t)
            return value + number * math.sqrt(-2 * math.log(u)) * math.cos(2 * math.pi * w)
        return {"add": value + number, "scale": value * number}.get(kind, float(self.cell[0]))

    def memory(self) -> list[Any]:
        """What it remembers, plain enough for JSON."""
        kept = float(self.cell[0])
        return [None if math.isnan(kept) else kept, self._history]

    def recall(self, memory: list[Any]) -> None:
        """Remember that instead."""
        kept, history = memory
        self.cell[0] = math.nan if kept is None else kept
        self._history = [(t, value) for t, value in history]

    def _delay(self, t: float, value: float, active: bool) -> float:
        """The value some time ago, between samples on a straight line; the first if there was none."""
        past = self._history
        while past and past[-1][0] >= t:  # the same point again, or a step that was undone
            past.pop()
        past.append((t, value))
        then = t - self._number
        while len(past) > 2 and past[1][0] <= then:
            del past[0]
        if not active:
            return value
        (t0, first), (t1, second) = past[0], past[min(1, len(past) - 1)]
        slack = 1e-9 * self._number
        if then >= t1 - slack:
            return second
        if then <= t0 + slack or not self._smooth:
            return first
        return first + (second - first) * (then - t0) / (t1 - t0)

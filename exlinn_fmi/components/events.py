"""Events and faults: wrappers that change what goes into and comes out of components in the course of a run.

A `Touched` component passes every call on, and on the way does to inputs, outputs and parameters what the
events say that are active at the present communication point. Changed inputs are written back into the values
given, so that the master records what the component really had. Random effects depend on seed, event and time
alone: a run that is repeated, undone in part or resumed sees the same.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Status, Values, Variable
from exlinn_fmi.components.wrapper import Wrapper
from exlinn_fmi.scenario.events import Event, event_names

MONITOR = "events"
"""Name of the component that tells which events are active."""


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

    def active(self, k: int, t: float) -> bool:
        """Whether event k is active at the communication point t [s]."""
        event, slack = self.events[k], 1e-6 * self._step
        end = math.inf if event.until is None else event.until
        if event.duration is not None:
            end = self.begins[k] + event.duration
        return self.begins[k] - slack <= t < end - slack

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
    """

    def __init__(self, schedule: Schedule, k: int, smooth: bool) -> None:
        self._schedule, self._k, self._smooth = schedule, k, smooth
        event = schedule.events[k]
        self._kind = event.effect
        self._number = float(getattr(event, event.effect) or 0.0)
        self.start = 0.0
        self._time = -math.inf
        self._before: float | None = None
        self._latest: float | None = None
        self._kept: float | None = None
        self._history: list[tuple[float, float]] = []

    def __call__(self, t: float, value: float) -> float:
        """The value that comes of one at t [s]; may be called again for the same time."""
        kind, number = self._kind, self._number
        active = self._schedule.active(self._k, t)
        if kind == "hold":
            return self._hold(t, value, active)
        if kind == "drop":
            if not active or self._kept is None or self._schedule.uniforms(self._k, t)[0] >= number:
                self._kept = value
            return self._kept
        if kind == "delay":
            return self._delay(t, value, active)
        if not active:
            return value
        if kind == "noise":
            u, w = self._schedule.uniforms(self._k, t)
            return value + number * math.sqrt(-2 * math.log(u)) * math.cos(2 * math.pi * w)
        return {"set": number, "add": value + number, "scale": value * number, "disconnect": self.start}[kind]

    def memory(self) -> list[Any]:
        """What it remembers, plain enough for JSON."""
        return [self.start, self._time, self._before, self._latest, self._kept, self._history]

    def recall(self, memory: list[Any]) -> None:
        """Remember that instead."""
        self.start, self._time, self._before, self._latest, self._kept, history = memory
        self._history = [(t, value) for t, value in history]

    def _hold(self, t: float, value: float, active: bool) -> float:
        """The value at the communication point before the event began; at the start of the run, the first."""
        if t > self._time:
            self._time, self._before = t, self._latest
        self._latest = value
        if not active:
            self._kept = None
            return value
        if self._kept is None:
            self._kept = value if self._before is None else self._before
        return self._kept

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


class Touched(Wrapper):
    """A component to which events happen, or one of whose variables an event waits for.

    Args:
        inner: the component that does the work.
        schedule: when events are active.
    """

    def __init__(self, inner: Component, schedule: Schedule) -> None:
        super().__init__(inner)
        self._schedule = schedule
        places = {variable.name: k for k, variable in enumerate(inner.variables)}
        self._effects: dict[int, list[Effect]] = {}
        self._freezing: list[int] = []
        self._watched: list[tuple[int, int]] = []
        for k, event in enumerate(schedule.events):
            if event.when is not None and event.when.variable.partition(".")[0] == self.name:
                self._watched.append((k, places[event.when.variable.partition(".")[2]]))
            if event.component == self.name and not event.variable:
                self._freezing.append(k)
            elif event.component == self.name:
                place = places[event.variable]
                effect = Effect(schedule, k, inner.variables[place].type == "Real")
                self._effects.setdefault(place, []).append(effect)
        self._own = [k for k in self._effects if inner.variables[k].causality in ("input", "parameter")]
        self._given = dict.fromkeys(self._own, 0.0)  # values as they come, before anything happens to them
        self._connected: set[int] = set()
        self._touching: dict[bytes, list[tuple[int, int]]] = {}
        self._time = self._lag = 0.0
        self._arrived = -math.inf

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, float]
    ) -> Status:
        """As the inner component; what it starts with is noted."""
        status = self.inner.enter_initialization(start_time, stop_time, starts)
        self._schedule.restart()
        self._time, self._lag, self._arrived = start_time, 0.0, -math.inf
        for place, effects in self._effects.items():
            self._effects[place] = [Effect(self._schedule, e._k, e._smooth) for e in effects]
        if self._own and status < Status.DISCARD:
            values = np.zeros(len(self._own))
            status = max(status, self.inner.get(np.array(self._own, dtype=np.intp), values))
            self._given = dict(zip(self._own, values.tolist(), strict=True))
            for place in self._own:
                for effect in self._effects[place]:
                    effect.start = self._given[place]
        return status

    def set(self, indices: Indices, values: Values) -> Status:
        """Set what comes of the values, which are changed in place; nothing while the component is frozen."""
        if self._frozen():
            return Status.OK
        status = self._arrive()
        for position, place in self._touched(indices):
            self._connected.add(place)
            self._given[place] = float(values[position])
            values[position] = self._applied(place, values[position])
        return max(status, self.inner.set(indices, values))

    def get(self, indices: Indices, values: Values) -> Status:
        """Read, and change what the events are about."""
        status = Status.OK if self._frozen() else self._arrive()
        status = max(status, self.inner.get(indices, values))
        for position, place in self._touched(indices):
            if place not in self._given:
                values[position] = self._applied(place, values[position])
        return status

    def step(self, t: float, h: float) -> Status:
        """Look for what events wait for, and step unless the component is frozen."""
        status = Status.OK
        if self._watched:
            values = np.zeros(len(self._watched))
            status = self.get(np.array([place for _, place in self._watched], dtype=np.intp), values)
            for (k, _), value in zip(self._watched, values.tolist(), strict=True):
                self._schedule.watch(k, value, t + h)
        if self._frozen():
            self._lag += h
        else:
            status = max(status, self._arrive(), self.inner.step(t - self._lag, h))
        self._time = t + h
        return status

    def save_state(self) -> object:
        """The inner component's state and what the effects remember."""
        memory = {
            "effects": [[effect.memory() for effect in effects] for effects in self._effects.values()],
            "given": list(self._given.values()),
            "times": [self._time, self._lag, self._arrived],
            "connected": sorted(self._connected),
            "begins": list(self._schedule.begins),
        }
        return self.inner.save_state(), json.dumps(memory)

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned."""
        assert isinstance(state, tuple)
        inner, text = state
        self.inner.restore_state(inner)
        memory = json.loads(text)
        for effects, kept in zip(self._effects.values(), memory["effects"], strict=True):
            for effect, one in zip(effects, kept, strict=True):
                effect.recall(one)
        self._given = dict(zip(self._given, memory["given"], strict=True))
        self._time, self._lag, self._arrived = memory["times"]
        self._connected = set(memory["connected"])
        self._schedule.begins[:] = memory["begins"]

    def serialize_state(self, state: object) -> bytes:
        """The inner component's state and what the effects remember, as bytes."""
        assert isinstance(state, tuple)
        inner, text = state
        return json.dumps([self.inner.serialize_state(inner).hex(), text]).encode()

    def deserialize_state(self, data: bytes) -> object:
        """A state from bytes."""
        inner, text = json.loads(data)
        return self.inner.deserialize_state(bytes.fromhex(inner)), text

    def _frozen(self) -> bool:
        return any(self._schedule.active(k, self._time) for k in self._freezing)

    def _arrive(self) -> Status:
        """Give parameters, and inputs that nothing is connected to, what they have at a new point in time."""
        places = [] if self._time == self._arrived else [k for k in self._own if k not in self._connected]
        self._arrived = self._time
        if not places:
            return Status.OK
        values = np.array([self._applied(place, self._given[place]) for place in places])
        return self.inner.set(np.array(places, dtype=np.intp), values)

    def _applied(self, place: int, value: float) -> float:
        for effect in self._effects[place]:
            value = effect(self._time, float(value))
        return value

    def _touched(self, indices: Indices) -> list[tuple[int, int]]:
        """Position and place of those variables that something happens to."""
        key = indices.tobytes()
        found = self._touching.get(key)
        if found is None:
            found = [(at, int(k)) for at, k in enumerate(indices) if int(k) in self._effects]
            self._touching[key] = found
        return found


class Monitor(Component):
    """Outputs that tell which events are active, one for each."""

    def __init__(self, schedule: Schedule) -> None:
        self.name, self._schedule, self._time = MONITOR, schedule, 0.0
        self.variables = tuple(
            Variable(name, "output", "discrete", type="Boolean", description=f"{event.effect} on {event.on}")
            for name, event in zip(schedule.names, schedule.events, strict=True)
        )

    @property
    def sampled(self) -> bool:
        """It holds between communication points."""
        return True

    @property
    def can_save_state(self) -> bool:
        """All that it keeps is the time."""
        return True

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, float]
    ) -> Status:
        """Begin."""
        self._time = start_time
        return Status.OK

    def exit_initialization(self) -> Status:
        """Nothing."""
        return Status.OK

    def set(self, indices: Indices, values: Values) -> Status:
        """There is nothing to set."""
        return Status.OK

    def get(self, indices: Indices, values: Values) -> Status:
        """1 where an event is active, else 0."""
        values[:] = [self._schedule.active(int(k), self._time) for k in indices]
        return Status.OK

    def step(self, t: float, h: float) -> Status:
        """Time passes."""
        self._time = t + h
        return Status.OK

    def save_state(self) -> object:
        """The time."""
        return self._time

    def restore_state(self, state: object) -> None:
        """Go back to a time."""
        assert isinstance(state, float)
        self._time = state

    @property
    def can_serialize_state(self) -> bool:
        """It is but a number."""
        return True

    def serialize_state(self, state: object) -> bytes:
        """The time."""
        return repr(state).encode()

    def deserialize_state(self, data: bytes) -> object:
        """The time."""
        return float(data)

    def close(self) -> None:
        """Nothing."""


def with_events(
    components: Mapping[str, Component], events: Sequence[Event], seed: int, step: float
) -> dict[str, Component]:
    """The components of a run with what events do to them, and the component that tells of it.

    Args:
        components: by name.
        events: what happens; nothing is changed where that is nothing.
        seed: seed of what is random.
        step: communication step [s].
    """
    if not events:
        return dict(components)
    schedule = Schedule(events, seed, step)
    touched = {event.component for event in events}
    touched |= {event.when.variable.partition(".")[0] for event in events if event.when is not None}
    wrapped = {name: Touched(c, schedule) if name in touched else c for name, c in components.items()}
    return {**wrapped, MONITOR: Monitor(schedule)}

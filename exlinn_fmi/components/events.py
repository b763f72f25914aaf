"""Events and faults: wrappers that change what goes into and comes out of components in the course of a run.

A `Touched` component passes every call on, and on the way does to inputs, outputs and parameters what the
events say that are active at the present communication point. Changed inputs are written back into the values
given, so that the master records what the component really had.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values, Variable
from exlinn_fmi.components.effects import Effect, Schedule
from exlinn_fmi.components.native import Native
from exlinn_fmi.components.wrapper import Wrapper
from exlinn_fmi.scenario.events import Event

MONITOR = "events"
"""Name of the component that tells which events are active."""


class Touched(Wrapper):
    """A component to which events happen, or one of whose variables an event waits for.

    Args:
        inner: the component that does the work.
        schedule: when events are active.
    """

    def __init__(self, inner: Component, schedule: Schedule) -> None:
        super().__init__(inner)
        self.schedule, self.lag = schedule, 0.0
        places = {variable.name: k for k, variable in enumerate(inner.variables)}
        self._effects: dict[int, list[Effect]] = {}
        self._freezing: list[int] = []
        self._mine = [
            k
            for k, event in enumerate(schedule.events)
            if self.name in (event.component, event.when and event.when.variable.partition(".")[0])
        ]
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
                if inner.variables[place].wide is not None:
                    rest = self._effects.setdefault(place + len(inner.variables), [])
                    rest.append(Effect(schedule, k, smooth=False, rest=True))
        kinds = {k: inner.variables[k % len(inner.variables)].causality for k in self._effects}
        self._own = [k for k, kind in kinds.items() if kind in ("input", "parameter")]
        self._given = dict.fromkeys(self._own, 0.0)  # values as they come, before anything happens to them
        self._connected: set[int] = set()
        self._touching: dict[bytes, list[tuple[int, int]]] = {}
        self._time, self._arrived = 0.0, -math.inf
        self._put: tuple[list[int], bytes] | None = None  # what was set last that is not connected

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """As the inner component; what it starts with is noted."""
        status = self.inner.enter_initialization(start_time, stop_time, starts)
        self.schedule.restart()
        self._time, self.lag, self._arrived, self._put = start_time, 0.0, -math.inf, None
        for place, effects in self._effects.items():
            self._effects[place] = [effect.afresh() for effect in effects]
        if self._own and status < Status.DISCARD:
            values = np.zeros(len(self._own))
            status = max(status, self.inner.get(np.array(self._own, dtype=np.intp), values))
            self._given = dict(zip(self._own, values.tolist(), strict=True))
            for place in self._own:
                for effect in self._effects[place]:
                    if effect.kind == "disconnect":
                        effect.cell[0] = self._given[place]
        return status

    def set(self, indices: Indices, values: Values) -> Status:
        """Set what comes of the values, which are changed in place; nothing while the component is frozen."""
        touched = self._touched(indices)
        self._connected.update(place for _, place in touched)
        if self.frozen(self._time):
            return Status.OK
        status = self._arrive()
        for position, place in touched:
            self._given[place] = float(values[position])
            values[position] = self._applied(place, values[position])
        return max(status, self.inner.set(indices, values))

    def get(self, indices: Indices, values: Values) -> Status:
        """Read, and change what the events are about."""
        status = Status.OK if self.frozen(self._time) else self._arrive()
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
                self.schedule.watch(k, value, t + h)
        if self.frozen(self._time):
            self.lag += h
        else:
            status = max(status, self._arrive(), self.inner.step(t - self.lag, h))
        self._time = t + h
        return status

    def save_state(self) -> object:
        """The inner component's state and what the effects remember."""
        memory = {
            "effects": [[effect.memory() for effect in effects] for effects in self._effects.values()],
            "given": list(self._given.values()),
            "times": [self._time, self.lag, self._arrived],
            "connected": sorted(self._connected),
            "begins": list(self.schedule.begins),
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
        self._time, self.lag, self._arrived = memory["times"]
        self._put = None
        self._connected = set(memory["connected"])
        self.schedule.begins[:] = memory["begins"]

    def serialize_state(self, state: object) -> bytes:
        """The inner component's state and what the effects remember, as bytes."""
        assert isinstance(state, tuple)
        inner, text = state
        return json.dumps([self.inner.serialize_state(inner).hex(), text]).encode()

    def deserialize_state(self, data: bytes) -> object:
        """A state from bytes."""
        inner, text = json.loads(data)
        return self.inner.deserialize_state(bytes.fromhex(inner)), text

    # ── for compiled stepping, see `event_native` ──────────────────────────────────────────────────────────

    def native(self) -> Native | None:
        """The inner component's functions, where all that happens to it can be done beside them."""
        from exlinn_fmi.components.event_native import KINDS, TouchedNative

        inner = self.inner.native()
        kinds = {effect.kind for effects in self._effects.values() for effect in effects}
        waiting = any(self.schedule.events[k].when is not None for k in self._mine)
        return None if inner is None or waiting or not kinds <= KINDS.keys() else TouchedNative(inner, self)

    def effects_on(self, indices: Indices, verb: str) -> list[tuple[int, list[Effect]]]:
        """Position and effects of those variables to which something happens when they are set or got."""
        return [
            (position, self._effects[place])
            for position, place in self._touched(indices)
            if verb == "Set" or place not in self._given
        ]

    @property
    def arrives(self) -> bool:
        """Whether something happens to parameters, or to inputs that nothing is connected to."""
        return not self._connected.issuperset(self._own)

    def arrive_at(self, t: float) -> Status:
        """Be at a new communication point t [s], with parameters and inputs as they are there."""
        self._time = t
        return Status.OK if self.frozen(t) else self._arrive()

    def passed(self, t: float, h: float, steps: int) -> None:
        """Take note of so many steps of h [s], the last of them from t [s]."""
        if self.frozen(t):
            for _ in range(steps):
                self.lag += h
        self._time = t + h

    def frozen(self, t: float) -> bool:
        """Whether it stands still at t [s]."""
        return any(self.schedule.active(k, t) for k in self._freezing)

    def _arrive(self) -> Status:
        """Give parameters, and inputs that nothing is connected to, what they have at a new point in time."""
        places = [] if self._time == self._arrived else [k for k in self._own if k not in self._connected]
        self._arrived = self._time
        values = np.array([self._applied(place, self._given[place]) for place in places])
        if not places or self._put == (put := (places, values.tobytes())):
            return Status.OK
        self._put = put
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
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
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

    def outputs_over(self, indices: Indices, times: Values) -> Values | None:
        """See `Component`: all is known beforehand where no event waits for a variable."""
        if any(event.when is not None for event in self._schedule.events):
            return None
        return np.stack([self._schedule.active(int(k), times) for k in indices], axis=1).astype(float)

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

"""How an FMU gets from one communication point to the next: by its own step, with or without Event Mode.

Model Exchange, where the step is ours, is in `fmu_exchange`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from exlinn_fmi.components.base import Values
from exlinn_fmi.components.fmu_events import EventMode, Stopped, close
from exlinn_fmi.components.fmu_native import DISCARD, WARNING, Instance
from exlinn_fmi.components.fmu_versions import Instance3


class Stepper(ABC):
    """What carries an instance over a communication step, from the end of its initialisation on.

    Attributes:
        has_events: whether discrete inputs and tunable parameters are set in Event Mode alone.
        remark: what the user should know of the step just made, "" where there is nothing.
    """

    has_events = False
    remark = ""

    @abstractmethod
    def begin(self, t: float) -> None:
        """Get ready, at the start time [s].

        Raises:
            Refused: the FMU reports an error.
            Stopped: it asks to end.
        """

    @abstractmethod
    def step(self, t: float, h: float) -> int:
        """Advance from t to t + h [s]; what fmi…DoStep returns.

        Raises:
            Refused: a function other than fmi…DoStep reports an error.
            Stopped: the FMU asks to end, or cannot be integrated.
        """

    @abstractmethod
    def enter_event_mode(self) -> None:
        """Discrete variables are about to be set."""

    @abstractmethod
    def inputs_changed(self) -> None:
        """Inputs have been set."""

    @abstractmethod
    def settle(self) -> None:
        """Make outputs up to date with what was set."""

    @abstractmethod
    def snapshot(self) -> Values:
        """What `restore` wants, beside the FMU's own state."""

    @abstractmethod
    def restore(self, saved: Values) -> None:
        """Go back to a snapshot; the FMU's own state is back already."""


class OwnStep(Stepper):
    """Co-Simulation without Event Mode."""

    def __init__(self, instance: Instance) -> None:
        self._instance = instance

    def begin(self, t: float) -> None:
        """Nothing to do."""

    def step(self, t: float, h: float) -> int:
        """fmi…DoStep."""
        return self._instance.do_step(t, h)

    def enter_event_mode(self) -> None:
        """There is none."""

    def inputs_changed(self) -> None:
        """Nothing to do."""

    def settle(self) -> None:
        """Nothing to do."""

    def snapshot(self) -> Values:
        """Nothing: all is in the FMU."""
        return np.zeros(0)

    def restore(self, saved: Values) -> None:
        """Nothing to do."""


class EventedStep(Stepper):
    """FMI 3 Co-Simulation with Event Mode: steps may return early, at an event."""

    has_events = True

    def __init__(self, instance: Instance3) -> None:
        self._instance = instance
        self._events = EventMode(instance, "EnterStepMode")
        self._t = 0.0

    def begin(self, t: float) -> None:
        """The first event."""
        self._t = t
        self._events.begin(t)

    def enter_event_mode(self) -> None:
        """fmi3EnterEventMode."""
        self._events.enter()

    def inputs_changed(self) -> None:
        """Nothing to do."""

    def settle(self) -> None:
        """Iterate and go on stepping, where discrete variables have been set."""
        if self._events.inside:
            self._events.handle(self._t)

    def step(self, t: float, h: float) -> int:
        """fmi3DoStep from event to event."""
        self.settle()
        end, stuck, worst = t + h, 0, 0
        self._t = t
        while not close(self._t, end):
            target = min(end, self._events.next_event)
            if target > self._t:
                code, reached, event = self._instance.step_to_event(self._t, target - self._t)
                if code not in (0, WARNING):
                    return code
                worst = max(worst, code)
                stuck = 0 if reached > self._t else stuck + 1
                if stuck > 10:
                    raise Stopped(f"fmi3DoStep does not get beyond t = {self._t:.9g} s", DISCARD)
                self._t = end if close(reached, end) else reached
            else:
                event = True
            if event or self._events.next_event <= self._t or close(self._events.next_event, self._t):
                self._events.handle(self._t)
        self._t = end
        return worst

    def snapshot(self) -> Values:
        """Time and time events."""
        return np.array([self._t, *self._events.snapshot()])

    def restore(self, saved: Values) -> None:
        """Back to a snapshot."""
        self._t = float(saved[0])
        self._events.restore(saved[1:])

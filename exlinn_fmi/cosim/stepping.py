"""Who does the work of a plan from tick to tick: plain Python here, compiled code where it saves time."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Values
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.recorder import Recorder

PLAIN_SECONDS_PER_CALL = 1e-6
"""What a call of a component costs at least when it is made from Python [s]."""

WORTH_IT = 0.5
"""Seconds that compiled stepping must save at least: to load the compiled loop takes about as long."""


class Stepper(ABC):
    """Steps a plan whose row of the present tick is done.

    Attributes:
        chunk: ticks that should be done in one go.
        seconds: time spent in components [s] by their number, as far as it is measured here.
    """

    chunk: int
    seconds: Values

    @abstractmethod
    def run(self, first: int, until: int) -> None:
        """Step from tick `first` to tick `until` and record the rows after `first`, that of `until` included.

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """

    def save(self) -> dict[str, Any]:
        """What it remembers from one communication point to the next, in plain values."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:  # noqa: B027 - nothing to remember by default
        """Go on from what `save` gave."""

    def report(self) -> dict[str, Any]:
        """What is told of it when the run is over."""
        return {}


class Plain(Stepper):
    """Steps a plan in Python; see `Stepper`.

    Args:
        plan: initialised, with its first row done.
        recorder: takes the rows.
        start: start time [s].
        step: step of the master [s].
    """

    chunk = 1

    def __init__(self, plan: Plan, recorder: Recorder, start: float, step: float) -> None:
        self._plan, self._recorder, self._start, self._step = plan, recorder, start, step
        self.seconds: Values = np.zeros(len(plan.components))

    def run(self, first: int, until: int) -> None:
        """Step from tick to tick."""
        plan = self._plan
        for k in range(first, until):
            plan.advance(k, self._start + k * self._step)
            plan.propagate(k + 1, self._start + (k + 1) * self._step)
            self._recorder.record(k + 1, plan.signals, plan.columns)


def make_stepper(
    plan: Plan, recorder: Recorder, start: float, step: float, profile: bool, compiled: bool | None
) -> Stepper:
    """Compiled stepping where that is asked for, or saves more time than it takes to load; else plain.

    Args:
        plan: initialised, with its first row done.
        recorder: takes the rows.
        start: start time [s].
        step: step of the master [s].
        profile: whether to measure the time of each component.
        compiled: whether to step in compiled code; None leaves it to the number of calls.
    """
    native = [component.native() is not None for component in plan.components]
    exchanges = [
        (own, (x.inputs is not None) + (x.outputs is not None))
        for own, x in plan.visits
        if native[x.component]
    ]
    calls = sum(n / own for own, n in exchanges) + sum(
        1 / a.every for a in plan.advances if native[a.component]
    )
    if profile and not clock_address():
        compiled = False  # what a component takes could not be told
    saved = calls * plan.ticks * PLAIN_SECONDS_PER_CALL
    if calls and (saved > WORTH_IT if compiled is None else compiled):
        from exlinn_fmi.cosim.compiled import Compiled

        return Compiled(plan, recorder, start, step, profile)
    return Plain(plan, recorder, start, step)


def clock_address() -> int:
    """Where the system's clock_gettime lies, 0 where there is none."""
    try:
        return ctypes.cast(ctypes.CDLL(None).clock_gettime, ctypes.c_void_p).value or 0
    except (AttributeError, OSError, TypeError):
        return 0

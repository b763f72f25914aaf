"""Real-time pacing: simulated time that keeps step with the clock, and a count of what comes late."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Values
from exlinn_fmi.cosim.recorder import Recorder

NAP = 0.05
"""Longest time that is slept in one go [s], so that a wish to stop is heard."""


TIMING = "timing"
"""What the columns begin with that tell of it."""


def timing_columns(names: Iterable[str]) -> list[str]:
    """Columns [s]: by how much a row was late, and for how long each component was at work for it.

    Args:
        names: the components' names.
    """
    return [f"{TIMING}.{name}" for name in ("delay", *names)]


class Pace:
    """Holds a run to a multiple of real time.

    The row of a communication point is due when the clock reaches its time; what comes later is late. A
    component is late that takes longer for a step and the outputs after it than the step itself may last.

    Args:
        factor: simulated time per wall time, 1 for real time.
        steps: own step of each component [s] by name.
        clock: for how long each component has been at work so far [s].
        recorder: takes what is told of each row, in its last columns.

    Attributes:
        missed: points that were late.
        worst: greatest delay [s].
        first: simulated time of the first that was late [s], None where none was.
    """

    def __init__(
        self, factor: float, steps: Mapping[str, float], clock: Callable[[], Values], recorder: Recorder
    ) -> None:
        self.factor, self._clock, self._recorder = factor, clock, recorder
        self._names, self._may = list(steps), np.array(list(steps.values())) / factor
        self._late, self._longest = np.zeros(len(steps), dtype=int), np.zeros(len(steps))
        self._before, self._told = np.zeros(len(steps)), np.zeros(1 + len(steps))
        self.missed, self.worst = 0, 0.0
        self.first: float | None = None
        self._origin: tuple[float, float] | None = None

    def wait(self, tick: int, t: float, should_stop: Callable[[], bool] | None) -> None:
        """Wait until the clock has come to t [s], which is the time of the tick just done."""
        now, taken = time.perf_counter(), self._clock()
        if self._origin is None:
            self._origin, self._before = (now, t), taken  # what led here is no step
        due = self._origin[0] + (t - self._origin[1]) / self.factor
        self._tell(tick, max(0.0, now - due), taken - self._before)
        self._before = taken
        if now > due:
            self.missed += 1
            self.worst = max(self.worst, now - due)
            self.first = t if self.first is None else self.first
        while (left := due - time.perf_counter()) > 0 and not (should_stop and left > NAP and should_stop()):
            time.sleep(min(left, NAP))

    def _tell(self, tick: int, delay: float, took: Values) -> None:
        """Count who was late; a row tells the worst since the one before."""
        self._late += took > self._may
        self._longest = np.maximum(self._longest, took)
        self._told = np.maximum(self._told, [delay, *took])
        if self._recorder.amend(tick, self._told):
            self._told = np.zeros_like(self._told)

    def report(self) -> dict[str, Any]:
        """What is told of it when the run is over."""
        return {
            "missed_deadlines": self.missed,
            "worst_delay": self.worst,
            "first_delay_at": self.first,
            "late_steps": dict(zip(self._names, self._late.tolist(), strict=True)),
            "longest_step": dict(zip(self._names, self._longest.tolist(), strict=True)),
        }

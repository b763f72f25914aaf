"""Real-time pacing: simulated time that keeps step with the clock, and a count of missed deadlines."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

NAP = 0.05
"""Longest time that is slept in one go [s], so that a wish to stop is heard."""


class Pace:
    """Holds a run to a multiple of real time.

    The row of a communication point is due when the clock reaches its time; what comes later is late.

    Args:
        factor: simulated time per wall time, 1 for real time.

    Attributes:
        missed: points that were late.
        worst: greatest delay [s].
        first: simulated time of the first that was late [s], None where none was.
    """

    def __init__(self, factor: float) -> None:
        self.factor = factor
        self.missed, self.worst = 0, 0.0
        self.first: float | None = None
        self._origin: tuple[float, float] | None = None

    def wait(self, t: float, should_stop: Callable[[], bool] | None) -> None:
        """Wait until the clock has come to t [s], which is the time of the row just recorded."""
        now = time.perf_counter()
        if self._origin is None:
            self._origin = now, t
        due = self._origin[0] + (t - self._origin[1]) / self.factor
        if now > due:
            self.missed += 1
            self.worst = max(self.worst, now - due)
            self.first = t if self.first is None else self.first
        while (left := due - time.perf_counter()) > 0 and not (should_stop and left > NAP and should_stop()):
            time.sleep(min(left, NAP))

    def report(self) -> dict[str, Any]:
        """What is told of it when the run is over."""
        return {"missed_deadlines": self.missed, "worst_delay": self.worst, "first_delay_at": self.first}

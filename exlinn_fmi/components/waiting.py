"""Waiting for a pipe between two processes: to look for a moment before sleeping saves being woken.

A process that sleeps on an idle processor takes longer to wake than most FMUs to step. So whoever waits looks
again and again for a moment first. Where that is in vain, because the other side works for long or needs this
very processor, it is not tried again for some waits.

Reference: Karlin et al., "Empirical studies of competitive spinning for a shared-memory
multiprocessor", 1991.
"""

from __future__ import annotations

import os
import select
import time

from exlinn_fmi.components.base import Values

LOOKING = 100e-6
"""Time that is spent looking before sleeping [s]: a few times what it takes to be woken."""

LONGEST_PAUSE = 255
"""Most waits that are slept through after looking was in vain."""


class Waiter:
    """Waits for a pipe; not on Windows, whose pipes cannot be waited for.

    Args:
        descriptor: to read from.
        others: (1,) number of processes that wait and work for each other beside the first of them, kept up
            to date by that one; where there are not as many processors, looking would keep one from its work.
    """

    def __init__(self, descriptor: int, others: Values) -> None:
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        self._others, self._processors = others, _processors()
        self._pause = self._left = 0

    def wait(self, timeout: float) -> bool:
        """Wait until there is something to read, or that many seconds; whether there is."""
        return self.look() or bool(self._poll.poll(1e3 * timeout))

    def look(self) -> bool:
        """Whether there is something to read within a moment; False at once where that is unlikely."""
        if self._left:
            self._left -= 1
            return False
        if self._processors <= self._others[0]:
            return False
        poll, clock = self._poll.poll, time.perf_counter
        end = clock() + LOOKING
        while not poll(0):
            if clock() > end:
                self._left = self._pause = min(2 * self._pause + 1, LONGEST_PAUSE)
                return False
        self._pause = 0
        return True


def _processors() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

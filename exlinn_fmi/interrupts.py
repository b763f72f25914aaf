"""Ctrl-C: the first one asks the work to end in good order, the second ends it at once."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType, TracebackType


class StopRequest:
    """While entered, counts Ctrl-C; called, tells whether the user asked to stop.

    The first Ctrl-C sets the request, which training and co-simulation poll: what they have so far is kept.
    The second raises KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: signal.Handlers | object = signal.SIG_DFL

    def __call__(self) -> bool:
        """Whether a stop was asked for."""
        return self.requested

    def take(self) -> bool:
        """Whether a stop was asked for; the request counts as answered then."""
        requested, self.requested = self.requested, False
        return requested

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print(
            "\nStopping after the present step; what there is will be kept. Ctrl-C again ends at once.",
            file=sys.stderr,
        )

    def __enter__(self) -> StopRequest:
        # Signals can be handled in the main thread only; elsewhere the caller has its own ways.
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self._previous)  # type: ignore[arg-type]

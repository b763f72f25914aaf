"""What is minded between communication points: progress, the user's wish to stop, pace, and checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from exlinn_fmi.cosim.pace import Pace
from exlinn_fmi.cosim.recorder import Recorder
from exlinn_fmi.cosim.store import Store
from exlinn_fmi.errors import InputError, Interrupted

Progress = Callable[[float, float], None]

REPORT_EVERY = 0.1
"""Least wall time between two reports of progress [s]."""

Saved = Callable[[], tuple[dict[str, Any], Recorder]]
"""Gives the whole state at the present tick, and the rows that belong to it."""


class Watch:
    """Minds what is not stepping.

    Args:
        progress: told (fraction done, t [s]).
        should_stop: whether the user wants to stop.
        store: where checkpoints are kept.

    Attributes:
        pace: what holds the run to real time, None where nothing does.
    """

    def __init__(
        self,
        progress: Progress | None,
        should_stop: Callable[[], bool] | None,
        store: Store | None,
    ) -> None:
        self.pace: Pace | None = None
        self._progress, self._should_stop, self._store = progress, should_stop, store
        self._began, self._before = time.perf_counter(), 0.0
        self._report_at = 0.0
        self._save_at: float | None = None if store is None or store.every is None else 0.0

    @property
    def stopping(self) -> bool:
        """Whether the user has asked to stop."""
        return self._should_stop is not None and self._should_stop()

    @property
    def seconds(self) -> float:
        """Wall time of the run so far, that before a checkpoint included [s]."""
        return self._before + time.perf_counter() - self._began

    def saved(self) -> dict[str, Any] | None:
        """The checkpoint to go on from, None where the run begins at its start.

        Raises:
            InputError: there is none.
        """
        if self._store is None or not self._store.resume:
            return None
        state = self._store.load()
        self._before = state["seconds"]
        return state

    def goes_on(self, k: int, ticks: int, t: float, state: Saved) -> bool:
        """Mind everything at a communication point whose row is done; False at the last one.

        Args:
            k: number of the tick.
            ticks: number of the last one.
            t: time [s].
            state: what a checkpoint holds.

        Raises:
            Interrupted: the user asked to stop.
            InputError: a checkpoint is wanted, and a component cannot write its state.
        """
        if self._progress is not None and (time.perf_counter() >= self._report_at or k == ticks):
            self._progress(k / ticks, t)
            self._report_at = time.perf_counter() + REPORT_EVERY
        if self.pace is not None:
            self.pace.wait(k, t, self._should_stop)
        if k == ticks:
            return False
        if self.stopping:
            text = f"stopped by the user at t = {t:.9g} s; the rows so far are kept"
            if self._save_at is not None:
                self._save(state)
                text += ", and --resume goes on from there"
            raise Interrupted(text)
        if self._save_at is not None and time.perf_counter() >= self._save_at:
            self._save(state)
        return True

    def _save(self, state: Saved) -> None:
        """Write a checkpoint."""
        assert self._store is not None
        assert self._store.every is not None
        try:
            content, recorder = state()
        except NotImplementedError as error:
            raise InputError(
                f"checkpoint: not all components can be saved to disk ({error}); run without `checkpoint`"
            ) from None
        recorder.flush()
        assert recorder.file is not None
        self._store.save(content | {"seconds": self.seconds}, recorder.file)
        self._save_at = time.perf_counter() + self._store.every

    def report(self) -> dict[str, Any]:
        """What is told of it when the run is over."""
        return {} if self.pace is None else self.pace.report()

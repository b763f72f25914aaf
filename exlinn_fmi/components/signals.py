"""Signal sources: components with one output that is a function of time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from exlinn_fmi.components.base import Indices, Values, Variable
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.scenario.signals import Signal


class SignalSource(PythonComponent):
    """A signal, sampled at communication points and held in between, as output ``y``.

    Args:
        name: name in the scenario.
        spec: the signal.
        folder: folder of the scenario, which file names start from.

    Raises:
        DataError: the signal's table cannot be used.
    """

    def __init__(self, name: str, spec: Signal, folder: Path) -> None:
        super().__init__(
            name, (Variable("y", "output", unit=spec.unit, description=f"{spec.signal} signal"),)
        )
        self._signal = signal_function(spec, folder)
        self._now = np.zeros(1)

    @property
    def sampled(self) -> bool:
        """The signal holds between communication points."""
        return True

    def initialize(self, start_time: float, stop_time: float) -> None:
        """Refuse a table that does not reach over the run, before anything is run.

        Raises:
            DataError: it does not, and says that it must.
        """
        self._signal(np.array([start_time, stop_time]))

    def outputs(self, t: float) -> None:
        """The signal at t [s]."""
        self._now[0] = t
        self.values[:] = self._signal(self._now)

    def outputs_over(self, indices: Indices, times: Values) -> Values:
        """The signal at all times at once."""
        return np.repeat(self._signal(times)[:, np.newaxis], len(indices), axis=1)

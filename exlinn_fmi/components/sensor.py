"""What lies between a plant and its controller: noise, offset, resolution and delay, signal by signal."""

from __future__ import annotations

from collections import deque

import numpy as np

from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.scenario.derived import sensor_variables
from exlinn_fmi.scenario.signals import Channel


class Sensor(PythonComponent):
    """Samples signals at its communication points and holds them: input ``x``, output ``x_measured``.

    Args:
        name: name in the scenario.
        channels: what becomes of each signal, by its name.
        seed: of the noise.
    """

    def __init__(self, name: str, channels: dict[str, Channel], seed: int) -> None:
        super().__init__(name, sensor_variables(channels))
        self._channels, self._seed = list(channels.values()), seed
        self.initialize(0.0, 0.0)

    @property
    def sampled(self) -> bool:
        """Outputs hold between communication points."""
        return True

    def initialize(self, start_time: float, stop_time: float) -> None:
        """The same noise in each run."""
        self._random = np.random.default_rng(self._seed)
        self._noise = self._random.normal(size=len(self._channels))
        self._past: list[deque[float]] = [deque(maxlen=max(1, c.delay)) for c in self._channels]

    def outputs(self, t: float) -> None:
        """What is measured at t [s]; before a late signal has come, its first value."""
        count = len(self._channels)
        for k, channel in enumerate(self._channels):
            past = self._past[k]
            value = self.values[k] if not channel.delay or not past else past[0]
            value += channel.offset + channel.noise * self._noise[k]
            if channel.resolution:
                value = channel.resolution * np.rint(value / channel.resolution)
            self.values[count + k] = value

    def advance(self, t: float, h: float) -> None:
        """Remember for those that are late; new noise."""
        for k, past in enumerate(self._past):
            if not past:  # as if it had always been so
                past.extend([self.values[k]] * self._channels[k].delay)
            past.append(self.values[k])
        self._noise = self._random.normal(size=len(self._channels))

    def get_state(self) -> object:
        """Noise and what is on its way."""
        return self._random.bit_generator.state, self._noise, [past.copy() for past in self._past]

    def set_state(self, state: object) -> None:
        """Put back what `get_state` returned."""
        assert isinstance(state, tuple)
        self._random.bit_generator.state, self._noise, past = state
        self._past = [one.copy() for one in past]

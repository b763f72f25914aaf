"""Small components with known discrete solutions, and some that misbehave, written to the contract alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Status, Values, Variable
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master, Trajectories


class Small(Component):
    """Base of the components below: values in an array, every call noted down.

    Attributes:
        calls: (method, tick time or None) in the order of the calls.
        closed: how often `close` was called.
    """

    is_sampled = False

    def __init__(self, name: str, *variables: Variable) -> None:
        self.name, self.variables = name, variables
        self.values = np.zeros(len(variables))
        self.calls: list[str] = []
        self.closed = 0
        self.time = 0.0

    @property
    def sampled(self) -> bool:
        return self.is_sampled

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.index(name)])

    def __setitem__(self, name: str, value: float) -> None:
        self.values[self.index(name)] = value

    def react(self) -> None:
        """Outputs from inputs and state."""

    def move(self, t: float, h: float) -> None:
        """State from t to t + h."""

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, float]
    ) -> Status:
        self.calls.append("enter")
        self.message = ""
        self.time = start_time
        for k, variable in enumerate(self.variables):
            self.values[k] = starts.get(variable.name, variable.start or 0.0)
        return Status.OK

    def exit_initialization(self) -> Status:
        self.calls.append("exit")
        return Status.OK

    def set(self, indices: Indices, values: Values) -> Status:
        self.calls.append("set")
        self.values[indices] = values
        return Status.OK

    def get(self, indices: Indices, values: Values) -> Status:
        self.calls.append("get")
        self.react()
        values[:] = self.values[indices]
        return Status.OK

    def step(self, t: float, h: float) -> Status:
        self.calls.append(f"step {t:.9g} {h:.9g}")
        self.move(t, h)
        self.time = t + h
        return Status.OK

    def close(self) -> None:
        self.closed += 1


class Integrator(Small):
    """ẏ = gain · u by one explicit Euler step per communication step; no direct feed-through."""

    def __init__(self, name: str, start: float = 0.0, gain: float = 1.0) -> None:
        super().__init__(
            name,
            Variable("u", "input", unit="m/s", start=0.0),
            Variable("y", "output", unit="m", start=start),
            Variable("gain", "parameter", "fixed", start=gain),
            Variable("twice", "local"),
        )

    def move(self, t: float, h: float) -> None:
        self["y"] = self["y"] + h * (self["gain"] * self["u"])

    def react(self) -> None:
        self["twice"] = 2 * self["y"]


class Lag(Small):
    """T ẏ + y = u, exact for inputs that are held; `rate` is ẏ and has direct feed-through."""

    def __init__(self, name: str, time_constant: float = 0.5, states: bool = True) -> None:
        super().__init__(
            name,
            Variable("u", "input", start=0.0),
            Variable("y", "output", start=0.0, depends_on=() if states else None),
            Variable("rate", "output", depends_on=("u",) if states else None),
        )
        self.time_constant = time_constant

    def move(self, t: float, h: float) -> None:
        share = np.exp(-h / self.time_constant)
        self["y"] = share * self["y"] + (1 - share) * self["u"]

    def react(self) -> None:
        self["rate"] = (self["u"] - self["y"]) / self.time_constant


class Gain(Small):
    """y = gain · u + offset without delay."""

    def __init__(
        self, name: str, gain: float = 1.0, offset: float = 0.0, sampled: bool = False, start: float = 0.0
    ) -> None:
        super().__init__(
            name, Variable("u", "input", start=start), Variable("y", "output", depends_on=("u",))
        )
        self.gain, self.offset, self.is_sampled = gain, offset, sampled

    def react(self) -> None:
        self["y"] = self.gain * self["u"] + self.offset


class Source(Small):
    """y = function(t), sampled."""

    is_sampled = True

    def __init__(self, name: str, function: Callable[[float], float]) -> None:
        super().__init__(name, Variable("y", "output"))
        self.function = function

    def react(self) -> None:
        self["y"] = self.function(self.time)


class Faulty(Integrator):
    """An integrator that does `fault` in the method of that name, from time `at` on."""

    def __init__(self, name: str, method: str, fault: Callable[[Faulty], Status], at: float = 0.0) -> None:
        super().__init__(name, start=1.0)
        self.method, self.fault, self.at = method, fault, at

    def _now(self, method: str) -> bool:
        return method == self.method and self.time >= self.at

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, float]
    ) -> Status:
        status = super().enter_initialization(start_time, stop_time, starts)
        return self.fault(self) if self._now("enter") else status

    def exit_initialization(self) -> Status:
        status = super().exit_initialization()
        return self.fault(self) if self._now("exit") else status

    def set(self, indices: Indices, values: Values) -> Status:
        status = super().set(indices, values)
        return self.fault(self) if self._now("set") else status

    def get(self, indices: Indices, values: Values) -> Status:
        status = super().get(indices, values)
        return self.fault(self) if self._now("get") else status

    def step(self, t: float, h: float) -> Status:
        if self._now("step"):
            return self.fault(self)
        return super().step(t, h)

    def close(self) -> None:
        super().close()
        if self.method == "close":
            self.fault(self)


def graph(components: Sequence[Component], *connections: str) -> Graph:
    """A graph with connections written as ``"a.y > b.u"``."""
    pairs = [tuple(map(str.strip, c.split(">"))) for c in connections]
    return Graph({c.name: c for c in components}, [(a, b) for a, b in pairs])


def run(
    components: Sequence[Component],
    *connections: str,
    stop: float = 1.0,
    step: float = 0.1,
    **options: object,
) -> Trajectories:
    """Connect and run from 0 to `stop`."""
    starts = options.pop("starts", None)
    return Master(graph(components, *connections), 0.0, stop, step, **options).run(starts)

"""Where the time of a co-simulation goes: a component that measures another."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values
from exlinn_fmi.components.native import Native


class Timed(Component):
    """A component that passes every call on and adds up the time taken by set, get and step.

    Args:
        inner: the component that does the work.

    Attributes:
        seconds: wall time so far [s].
    """

    def __init__(self, inner: Component) -> None:
        self.name, self.variables, self._inner = inner.name, inner.variables, inner
        self.seconds = 0.0

    @property
    def message(self) -> str:  # type: ignore[override]  # the contract has a plain attribute
        """What the inner component last said."""
        return self._inner.message

    @property
    def sampled(self) -> bool:
        """As the inner component."""
        return self._inner.sampled

    @property
    def can_save_state(self) -> bool:
        """As the inner component."""
        return self._inner.can_save_state

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """Not measured: it happens once."""
        return self._inner.enter_initialization(start_time, stop_time, starts)

    def exit_initialization(self) -> Status:
        """Not measured: it happens once."""
        return self._inner.exit_initialization()

    def set(self, indices: Indices, values: Values) -> Status:
        """Measured."""
        began = perf_counter()
        status = self._inner.set(indices, values)
        self.seconds += perf_counter() - began
        return status

    def get(self, indices: Indices, values: Values) -> Status:
        """Measured."""
        began = perf_counter()
        status = self._inner.get(indices, values)
        self.seconds += perf_counter() - began
        return status

    def step(self, t: float, h: float) -> Status:
        """Measured."""
        began = perf_counter()
        status = self._inner.step(t, h)
        self.seconds += perf_counter() - began
        return status

    @property
    def can_serialize_state(self) -> bool:
        """As the inner component."""
        return self._inner.can_serialize_state

    def serialize_state(self, state: object) -> bytes:
        """As the inner component."""
        return self._inner.serialize_state(state)

    def deserialize_state(self, data: bytes) -> object:
        """As the inner component."""
        return self._inner.deserialize_state(data)

    @property
    def gives_directional_derivatives(self) -> bool:
        """As the inner component."""
        return self._inner.gives_directional_derivatives

    def directional_derivative(self, unknowns: Indices, knowns: Indices, seed: Values) -> Values:
        """Measured."""
        began = perf_counter()
        derivative = self._inner.directional_derivative(unknowns, knowns, seed)
        self.seconds += perf_counter() - began
        return derivative

    @property
    def takes_input_derivatives(self) -> bool:
        """As the inner component."""
        return self._inner.takes_input_derivatives

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        """Measured."""
        began = perf_counter()
        status = self._inner.set_input_derivatives(indices, derivatives)
        self.seconds += perf_counter() - began
        return status

    def native(self) -> Native | None:
        """As the inner component; whoever calls its functions measures them."""
        return self._inner.native()

    def outputs_over(self, indices: Indices, times: Values) -> Values | None:
        """Measured."""
        began = perf_counter()
        values = self._inner.outputs_over(indices, times)
        self.seconds += perf_counter() - began
        return values

    def save_state(self) -> object:
        """As the inner component."""
        return self._inner.save_state()

    def restore_state(self, state: object) -> None:
        """As the inner component."""
        self._inner.restore_state(state)

    def close(self) -> None:
        """Close the inner component."""
        self._inner.close()

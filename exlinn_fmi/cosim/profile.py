"""Where the time of a co-simulation goes: a component that measures another."""

from __future__ import annotations

from time import perf_counter

from exlinn_fmi.components.base import Component, Indices, Status, Values
from exlinn_fmi.components.native import Native
from exlinn_fmi.components.wrapper import Wrapper


class Timed(Wrapper):
    """A component that passes every call on and adds up the time taken by set, get and step.

    Args:
        inner: the component that does the work.

    Attributes:
        seconds: wall time so far [s].
    """

    def __init__(self, inner: Component) -> None:
        super().__init__(inner)
        self.seconds = 0.0

    def set(self, indices: Indices, values: Values) -> Status:
        """Measured."""
        began = perf_counter()
        status = self.inner.set(indices, values)
        self.seconds += perf_counter() - began
        return status

    def get(self, indices: Indices, values: Values) -> Status:
        """Measured."""
        began = perf_counter()
        status = self.inner.get(indices, values)
        self.seconds += perf_counter() - began
        return status

    def step(self, t: float, h: float) -> Status:
        """Measured."""
        began = perf_counter()
        status = self.inner.step(t, h)
        self.seconds += perf_counter() - began
        return status

    @property
    def gives_directional_derivatives(self) -> bool:
        """As the inner component."""
        return self.inner.gives_directional_derivatives

    def directional_derivative(self, unknowns: Indices, knowns: Indices, seed: Values) -> Values:
        """Measured."""
        began = perf_counter()
        derivative = self.inner.directional_derivative(unknowns, knowns, seed)
        self.seconds += perf_counter() - began
        return derivative

    @property
    def takes_input_derivatives(self) -> bool:
        """As the inner component."""
        return self.inner.takes_input_derivatives

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        """Measured."""
        began = perf_counter()
        status = self.inner.set_input_derivatives(indices, derivatives)
        self.seconds += perf_counter() - began
        return status

    def native(self) -> Native | None:
        """As the inner component; whoever calls its functions measures them."""
        return self.inner.native()

    def outputs_over(self, indices: Indices, times: Values) -> Values | None:
        """Measured."""
        began = perf_counter()
        values = self.inner.outputs_over(indices, times)
        self.seconds += perf_counter() - began
        return values

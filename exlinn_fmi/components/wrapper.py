"""A component around another that passes every call on; who changes something overrides that alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values
from exlinn_fmi.components.native import Change, Native, NativeAccess


class Wrapper(Component):
    """A component that is as the one within.

    Args:
        inner: the component that does the work.
    """

    def __init__(self, inner: Component) -> None:
        self.name, self.variables, self.warnings = inner.name, inner.variables, inner.warnings
        self.inner = inner

    @property
    def message(self) -> str:  # type: ignore[override]  # the contract has a plain attribute
        """What the inner component last said."""
        return self.inner.message

    @property
    def sampled(self) -> bool:
        """As the inner component."""
        return self.inner.sampled

    @property
    def can_save_state(self) -> bool:
        """As the inner component."""
        return self.inner.can_save_state

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """As the inner component."""
        return self.inner.enter_initialization(start_time, stop_time, starts)

    def exit_initialization(self) -> Status:
        """As the inner component."""
        return self.inner.exit_initialization()

    def set(self, indices: Indices, values: Values) -> Status:
        """As the inner component."""
        return self.inner.set(indices, values)

    def get(self, indices: Indices, values: Values) -> Status:
        """As the inner component."""
        return self.inner.get(indices, values)

    def step(self, t: float, h: float) -> Status:
        """As the inner component."""
        return self.inner.step(t, h)

    def save_state(self) -> object:
        """As the inner component."""
        return self.inner.save_state()

    def restore_state(self, state: object) -> None:
        """As the inner component."""
        self.inner.restore_state(state)

    @property
    def can_serialize_state(self) -> bool:
        """As the inner component."""
        return self.inner.can_serialize_state

    def serialize_state(self, state: object) -> bytes:
        """As the inner component."""
        return self.inner.serialize_state(state)

    def deserialize_state(self, data: bytes) -> object:
        """As the inner component."""
        return self.inner.deserialize_state(data)

    def close(self) -> None:
        """Close the inner component."""
        self.inner.close()


class WrapperNative(Native):
    """The C functions of a component within a wrapper.

    Args:
        inner: its own.
    """

    def __init__(self, inner: Native) -> None:
        self.inner, self.step, self.turns = inner, inner.step, inner.turns

    def access(self, verb: Literal["Get", "Set"], indices: Indices) -> Sequence[NativeAccess]:
        """As the inner component."""
        return self.inner.access(verb, indices)

    def heed(self, function: str, code: int) -> Status:
        """As the inner component."""
        return self.inner.heed(function, code)

    def changes(self, verb: Literal["Get", "Set"], indices: Indices) -> Sequence[Change]:
        """As the inner component."""
        return self.inner.changes(verb, indices)

    def frozen(self, t: float) -> bool:
        """As the inner component."""
        return self.inner.frozen(t)

    @property
    def lag(self) -> float:
        """As the inner component."""
        return self.inner.lag

    @property
    def arrives(self) -> bool:
        """As the inner component."""
        return self.inner.arrives

    def arrive(self, t: float) -> int:
        """As the inner component."""
        return self.inner.arrive(t)

    def passed(self, t: float, h: float, steps: int) -> None:
        """As the inner component."""
        self.inner.passed(t, h, steps)

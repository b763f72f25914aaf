"""The C functions of a component as addresses, for a master that calls them from compiled code.

Addresses, handles and pointers are plain numbers: whoever steps needs no library of FMI to use them, only the
argument lists given here, which are those of FMI 2.0 and 3.0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from exlinn_fmi.components.base import Indices, Status


@dataclass(frozen=True)
class NativeAccess:
    """A C function that gets or sets variables of one type: ``int f(handle, references, count, values)``.

    Args:
        name: of the function, for messages.
        function: its address.
        handle: its first argument.
        references: value references, to be kept while it is called.
        dtype: element type of the values.
        boolean: whether the values are truth values, 0 and 1 only.
        counted: whether the number of values follows after ``values`` (FMI 3).
        positions: which of the variables that were asked for it gets or sets, in this order.
        array: the whole array that the one reference stands for, where these are elements of one.
        elements: where in `array` they are.
        rests: of values with a rest: number in `positions`, and which of the variables asked for the rest is.
    """

    name: str
    function: int
    handle: int
    references: NDArray[np.uint32]
    dtype: np.dtype[Any]
    boolean: bool
    counted: bool
    positions: Indices
    array: NDArray[Any] | None = None
    elements: Indices | None = None
    rests: Sequence[tuple[int, int]] = ()


@dataclass(frozen=True)
class NativeStep:
    """A C function that steps: ``int f(handle, t, h, flag)``, or FMI 3's with four pointers after the flag.

    Args:
        function: its address.
        handle: its first argument.
        flag: whether no state before t will be restored.
        pointers: none, or where it writes whether an event is to be handled, whether the simulation is to
            end, whether it returned early (one byte each), and the time reached.
    """

    function: int
    handle: int
    flag: bool
    pointers: tuple[int, ...] = ()


State = Literal["on", "off", "keep"]


@dataclass(frozen=True)
class Change:
    """What a component does to a value on its way, in the vector that the master has.

    Args:
        position: of the value among those set or got.
        kind: ``set`` to the number, ``add`` it, ``scale`` by it, or ``hold``: the number is the value
            that was kept last, not a number where that is none: the first is kept then.
        number: (1,) see `kind`.
        state: what is done at a communication point [s]: ``on``, ``off``, or ``keep`` the value in `number`;
            None where it is always on.
    """

    position: int
    kind: Literal["set", "add", "scale", "hold"]
    number: NDArray[np.float64]
    state: Callable[[float], State] | None = None


class Native(ABC):
    """What a component offers for compiled stepping.

    Attributes:
        step: its step.
        turns: times [s] about which `Change.state`, `frozen` or what `arrive` sets may become another.
    """

    step: NativeStep
    turns: Sequence[float] = ()

    @abstractmethod
    def access(self, verb: Literal["Get", "Set"], indices: Indices) -> Sequence[NativeAccess]:
        """The calls that get or set the variables at `indices`, in order."""

    @abstractmethod
    def heed(self, function: str, code: int) -> Status:
        """A code other than 0 that a function returned, as a status, with the component's message set.

        Args:
            function: `NativeAccess.name`, or ``DoStep``; this one also if its end or early flag was set.
            code: what it returned.
        """

    def changes(self, verb: Literal["Get", "Set"], indices: Indices) -> Sequence[Change]:
        """What becomes of values of the variables at `indices`, before `Set` or after `Get`, in order."""
        return ()

    def frozen(self, t: float) -> bool:
        """Whether the component is neither set nor stepped at t [s]."""
        return False

    @property
    def lag(self) -> float:
        """Time that it is behind [s]: a step at t is one at t − lag for its C function."""
        return 0.0

    @property
    def arrives(self) -> bool:
        """Whether `arrive` ever sets anything."""
        return False

    def arrive(self, t: float) -> int:
        """Set what no exchange does, first thing at t [s]; needed at `turns` only. Gives a `Status`."""
        return 0

    def passed(self, t: float, h: float, steps: int) -> None:  # noqa: B027 - most need not know
        """Take note of so many steps of h [s] that were due, the last of them from t [s]."""

"""The work that a plan is made of: setting and getting variables of one component, and stepping it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from exlinn_fmi.components.base import Indices, Status, Values

Call = Callable[[Indices, Values], Status]


@dataclass(slots=True, frozen=True)
class Exchange:
    """Set some variables of a component, then get some.

    Args:
        component: its number.
        set: its method.
        inputs: variables to set; None where there are none.
        sources: where their values are in the vector that they come from.
        given: where they are put, in the order of `inputs`.
        get: the component's method.
        outputs: variables to get; None where there are none.
        taken: where they are put.
    """

    component: int
    set: Call
    inputs: Indices | None
    sources: Indices
    given: Values
    get: Call
    outputs: Indices | None
    taken: Values


@dataclass(slots=True, frozen=True)
class Advance:
    """Step a component; with Gauss–Seidel, refresh its inputs before and read its outputs after.

    Args:
        component: its number.
        every: its own step in ticks.
        h: its own step [s].
        step: its method.
        before: takes new values of components already stepped.
        after: gives new values to components that are still to be stepped.
    """

    component: int
    every: int
    h: float
    step: Callable[[float, float], Status]
    before: Exchange | None
    after: Exchange | None


@dataclass(slots=True)
class Warned:
    """WARNING statuses of a component: how many, and what the first one said."""

    count: int
    first: str

"""Events in compiled stepping: what `Touched` does in Python, for those events that begin at a known time.

Between the times at which events begin and end nothing changes in what is done, so the compiled loop needs to
be told at those times only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Literal

from exlinn_fmi.components.base import Indices
from exlinn_fmi.components.effects import Effect
from exlinn_fmi.components.events import Touched
from exlinn_fmi.components.native import Change, Native, State
from exlinn_fmi.components.wrapper import WrapperNative

KINDS: dict[str, Literal["set", "add", "scale", "hold"]] = {
    "set": "set", "disconnect": "set", "add": "add", "scale": "scale", "hold": "hold",
}  # fmt: skip
"""Changes that effects are; others need Python at each communication point."""


class TouchedNative(WrapperNative):
    """The C functions behind a `Touched` component.

    Args:
        inner: those of the component within.
        touched: the component.
    """

    def __init__(self, inner: Native, touched: Touched) -> None:
        super().__init__(inner)
        self._touched, schedule = touched, touched.schedule
        ends = [schedule.end(k) for k in range(len(schedule.events))]
        self.turns = sorted({*inner.turns, *filter(math.isfinite, [*schedule.begins, *ends])})

    def changes(self, verb: Literal["Get", "Set"], indices: Indices) -> Sequence[Change]:
        """See `Native`."""
        own = [
            Change(position, KINDS[effect.kind], effect.cell, partial(self._state, verb, effect))
            for position, effects in self._touched.effects_on(indices, verb)
            for effect in effects
        ]
        inner = self.inner.changes(verb, indices)
        return [*own, *inner] if verb == "Set" else [*inner, *own]

    def _state(self, verb: str, effect: Effect, t: float) -> State:
        """What an effect does; nothing to what is not set because the component is frozen."""
        return "off" if verb == "Set" and self._touched.frozen(t) else effect.state(t)

    def frozen(self, t: float) -> bool:
        """See `Native`."""
        return self._touched.frozen(t) or self.inner.frozen(t)

    @property
    def lag(self) -> float:
        """See `Native`."""
        return self._touched.lag + self.inner.lag

    @property
    def arrives(self) -> bool:
        """See `Native`."""
        return self._touched.arrives or self.inner.arrives

    def arrive(self, t: float) -> int:
        """See `Native`."""
        return max(self._touched.arrive_at(t), self.inner.arrive(t))

    def passed(self, t: float, h: float, steps: int) -> None:
        """See `Native`."""
        self._touched.passed(t, h, steps)
        self.inner.passed(t, h, steps)

"""Connections that change values: from one unit to another, and by a factor and an offset of the user's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Status, Values
from exlinn_fmi.components.native import Change, Native
from exlinn_fmi.components.wrapper import Wrapper, WrapperNative
from exlinn_fmi.scenario.schema import Link
from exlinn_fmi.scenario.units import linear


class Converted(Wrapper):
    """A component whose inputs are given in other units or scales; what it is given is recorded.

    Args:
        inner: the component that does the work.
        conversions: factor and offset by index of the variable; the values are changed in place.
    """

    def __init__(self, inner: Component, conversions: Mapping[int, tuple[float, float]]) -> None:
        super().__init__(inner)
        self._conversions = dict(conversions)
        self._known: dict[bytes, tuple[Values, Values] | None] = {}

    def set(self, indices: Indices, values: Values) -> Status:
        """Set the values in the component's own units."""
        if (known := self.conversion(indices)) is not None:
            values *= known[0]
            values += known[1]
        return self.inner.set(indices, values)

    def conversion(self, indices: Indices) -> tuple[Values, Values] | None:
        """Factors and offsets (k,) of the variables at `indices` (k,), None where nothing is to be done."""
        key = indices.tobytes()
        if key not in self._known:
            found = [self._conversions.get(int(k), (1.0, 0.0)) for k in indices]
            factors, offsets = (np.array(column) for column in zip(*found, strict=True))
            touched = any(int(k) in self._conversions for k in indices)
            self._known[key] = (factors, offsets) if touched else None
        return self._known[key]

    def native(self) -> Native | None:
        """The inner component's functions, with the conversions as changes before them."""
        inner = self.inner.native()
        return None if inner is None else _ConvertedNative(inner, self)

    @property
    def takes_input_derivatives(self) -> bool:
        """As the inner component."""
        return self.inner.takes_input_derivatives

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        """Derivatives in the component's own units."""
        factors = [self._conversions.get(int(k), (1.0, 0.0))[0] for k in indices]
        return self.inner.set_input_derivatives(indices, derivatives * np.array(factors))


class _ConvertedNative(WrapperNative):
    """The C functions behind a `Converted` component."""

    def __init__(self, inner: Native, converted: Converted) -> None:
        super().__init__(inner)
        self._converted = converted

    def changes(self, verb: Literal["Get", "Set"], indices: Indices) -> Sequence[Change]:
        """See `Native`: the same operations in the same order as `Converted.set`."""
        known = self._converted.conversion(indices) if verb == "Set" else None
        own: list[Change] = []
        if known is not None:
            factors, offsets = known
            own = [Change(k, "scale", factors[k : k + 1]) for k in range(len(indices))]
            own += [Change(k, "add", offsets[k : k + 1]) for k in range(len(indices))]
        return [*own, *self.inner.changes(verb, indices)]


def with_links(
    components: Mapping[str, Component], links: Iterable[tuple[str, Link]]
) -> dict[str, Component]:
    """The components of a run, with the conversions that its connections need.

    Args:
        components: by name.
        links: source ``component.variable`` and connection; its units fit, which the checks have seen to.
    """
    found: dict[str, dict[int, tuple[float, float]]] = {}
    for source, link in links:
        (tail, output), (head, variable) = source.split(".", 1), link.to.split(".", 1)
        index = components[head].index(variable)
        start = components[tail].variables[components[tail].index(output)]
        factor, offset = linear(start, components[head].variables[index]) or (1.0, 0.0)
        if not link.convert:
            factor, offset = 1.0, 0.0
        both = (link.factor * factor, link.factor * offset + link.offset)
        if both != (1.0, 0.0):
            found.setdefault(head, {})[index] = both
    return {name: Converted(c, found[name]) if name in found else c for name, c in components.items()}

"""Values of FMU variables in and out: one C call per type, with buffers that are ready.

Numbers are converted to and from float64, those of 64 bits in two parts (`wide`). An element of an array
travels with its whole array, which is kept from call to call: FMI 3 sets and gets arrays as a whole. Texts
and binaries are told by number (`texts`).
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Indices, Values
from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.fmu_native import Instance, reference_buffer, value_buffer
from exlinn_fmi.components.texts import handle, text
from exlinn_fmi.components.wide import fits, joined, rest_of

TEXTS = ("String", "Binary")
"""Accessors of what is told by number."""

Arrays = dict[tuple[str, int], "np.ndarray[Any, Any]"]
"""Arrays by accessor and value reference, as last set."""


class Group(ABC):
    """One C call: its function, its arguments and the buffers that they point to.

    Attributes:
        accessor: name of the function less the prefix and the verb.
        positions: which of the values asked for it holds.
        function: the C function.
        arguments: what it is called with.
    """

    accessor: str
    positions: Any
    function: Callable[..., int]
    arguments: tuple[Any, ...]

    @abstractmethod
    def fill(self, values: Values) -> int | None:
        """Put values into the buffer; gives the position of the first that its type cannot hold."""

    @abstractmethod
    def take(self, values: Values) -> None:
        """Put the buffer into the values."""


class Numbers(Group):
    """Numbers of one type: scalars, or elements of one array."""

    def __init__(
        self,
        instance: Instance,
        verb: str,
        accessor: str,
        references: list[int],
        positions: Any,
        array: Any,
        rests: Any,
    ) -> None:
        self.accessor, self.positions = accessor, positions
        self._rests, self._kind = rests, accessor.lower()
        self._references = reference_buffer(references)
        elements, whole = array if array is not None else (slice(None), None)
        self.buffer = (
            value_buffer(instance.description, accessor, len(references)) if whole is None else whole
        )
        self._elements = elements
        self.function, self.arguments = instance.accessor(verb, accessor, self._references, self.buffer)
        self._double = self.buffer.dtype == np.float64
        self._boolean = accessor == "Boolean"

    def fill(self, values: Values) -> int | None:
        """See `Group`."""
        given = values[self.positions]
        if self._double:
            self.buffer[self._elements] = given
            return None
        if self._rests is not None:
            at, places = self._rests
            rest = np.zeros(len(given))
            rest[at] = values[places]
            wrong = np.flatnonzero(~fits(given, rest, self._kind))
            if not wrong.size:
                self.buffer[self._elements] = joined(given, rest, self._kind)
            return self._place(values, wrong[0]) if wrong.size else None
        with np.errstate(invalid="ignore", over="ignore"):
            self.buffer[self._elements] = given.astype(bool) if self._boolean else given
        if self.buffer.dtype == np.float32:
            return None
        refused = np.flatnonzero(self.buffer[self._elements] != given)
        return self._place(values, refused[0]) if refused.size else None

    def take(self, values: Values) -> None:
        """See `Group`."""
        got = self.buffer[self._elements]
        values[self.positions] = got
        if self._rests is not None:
            at, places = self._rests
            values[places] = rest_of(got[at])

    def _place(self, values: Values, k: int) -> int:
        return int(np.arange(len(values))[self.positions][k])


class Texts(Group):
    """Texts or binaries, scalars and arrays alike."""

    def __init__(
        self, instance: Instance, verb: str, accessor: str, references: list[int], positions: Any, array: Any
    ) -> None:
        self.accessor, self.positions = accessor, positions
        self._references = reference_buffer(references)
        self._elements = np.arange(len(references)) if array is None else array[0]
        count = len(references) if array is None else len(array[1])
        self._whole = np.zeros(count) if array is None else array[1]
        self._pointers, self._sizes = np.zeros(count, np.uintp), np.zeros(count, np.uintp)
        self._kept: list[Any] = []
        self._binary = accessor == "Binary"
        sizes = self._sizes if self._binary else None
        self.function, self.arguments = instance.accessor(
            verb, accessor, self._references, self._pointers, sizes
        )

    def fill(self, values: Values) -> int | None:
        """See `Group`."""
        self._whole[self._elements] = values[self.positions]
        try:
            data = [self._encoded(text(number)) for number in self._whole]
        except ValueError:
            return 0
        self._kept = [ctypes.create_string_buffer(value, len(value) + 1) for value in data]
        self._pointers[:] = [ctypes.addressof(kept) for kept in self._kept]
        self._sizes[:] = [len(value) for value in data]
        return None

    def take(self, values: Values) -> None:
        """See `Group`."""
        for k, place in enumerate(self._elements):
            pointer, size = int(self._pointers[place]), int(self._sizes[place])
            if self._binary:
                value: str | bytes = ctypes.string_at(pointer, size) if pointer and size else b""
            else:
                value = ctypes.string_at(pointer).decode("utf-8", "replace") if pointer else ""
            self._whole[place] = handle(value)
            values[self._where(values, k)] = self._whole[place]

    def _encoded(self, value: str | bytes) -> bytes:
        """As C wants it; a binary that is given as text is in hexadecimal digits."""
        if isinstance(value, bytes):
            return value
        return bytes.fromhex(value) if self._binary else value.encode()

    def _where(self, values: Values, k: int) -> int:
        return int(np.arange(len(values))[self.positions][k])


def by_call(description: FmuDescription, indices: Indices) -> dict[tuple[str, int | None], list[int]]:
    """Positions in `indices` by C call: scalars by accessor, each array by itself; rests are left out."""
    positions: dict[tuple[str, int | None], list[int]] = {}
    for position, k in enumerate(indices):
        if k < len(description.variables):
            alone = description.references[k] if is_array(description, k) else None
            positions.setdefault((description.accessors[k], alone), []).append(position)
    return positions


def rests_of(description: FmuDescription, indices: Indices, positions: Indices) -> list[tuple[int, int]]:
    """Of values at `positions` in `indices` whose rest is there: number in `positions`, place of the rest."""
    count = len(description.variables)
    places = {int(k) - count: place for place, k in enumerate(indices) if k >= count}
    values = [int(k) for k in indices[positions]] if places else []
    return [(number, places[k]) for number, k in enumerate(values) if k in places]


def is_array(description: FmuDescription, k: int) -> bool:
    """Whether a variable is an element of an array of more than one; an array of one is set like a scalar."""
    return description.sizes[k] > 1


def groups(
    description: FmuDescription,
    instance: Instance,
    arrays: Arrays,
    verb: str,
    indices: Indices,
    chosen: Indices,
) -> list[Group]:
    """The C calls that get or set those of the variables at `indices` whose positions are `chosen`."""
    made: list[Group] = []
    if not chosen.size:
        return made
    for (accessor, reference), places in by_call(description, indices[chosen]).items():
        where = chosen[places]
        positions: Any = slice(None) if len(where) == len(indices) else where
        array = None
        if reference is None:
            references = [description.references[k] for k in indices[where]]
        else:
            elements = np.array([description.elements[k] for k in indices[where]], dtype=np.intp)
            whole = arrays[accessor, reference]
            references, array = [reference], (elements, whole.copy() if verb == "Get" else whole)
        common = instance, verb, accessor, references, positions, array
        if accessor in TEXTS:
            made.append(Texts(*common))
            continue
        pairs = rests_of(description, indices, where)
        rests = tuple(np.array(part) for part in zip(*pairs, strict=True)) if pairs else None
        made.append(Numbers(*common, rests))
    return made


def start_arrays(description: FmuDescription) -> Arrays:
    """All arrays with their start values, zero where there is none."""
    arrays: Arrays = {}
    for k, variable in enumerate(description.variables):
        key = description.accessors[k], description.references[k]
        if description.sizes[k] <= 1:
            continue
        if key not in arrays:
            texts = key[0] in TEXTS
            size = description.sizes[k]
            arrays[key] = np.zeros(size) if texts else value_buffer(description, key[0], size)
        if variable.start is not None:
            arrays[key][description.elements[k]] = variable.start
    return arrays

"""The C functions of a Co-Simulation FMU as compiled stepping wants them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from exlinn_fmi.components.base import Indices, Status
from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.fmu_native import Instance, address, reference_buffer, value_buffer
from exlinn_fmi.components.fmu_values import Arrays, by_call, rests_of
from exlinn_fmi.components.native import Native, NativeAccess


class FmuNative(Native):
    """An FMU's C functions and what to make of their codes.

    Args:
        description: the FMU.
        instance: its instance, initialised.
        arrays: its arrays as last set.
        judge: makes a status of a function's name and code.
    """

    def __init__(
        self,
        description: FmuDescription,
        instance: Instance,
        arrays: Arrays,
        judge: Callable[[str, int], Status],
    ) -> None:
        self._description, self._instance, self._arrays = description, instance, arrays
        self._judge = judge
        self.step = instance.native_step()

    def access(self, verb: Literal["Get", "Set"], indices: Indices) -> list[NativeAccess]:
        """See `Native`: a call per type, and one per array."""
        return [
            self._access(verb, accessor, array, indices, np.array(positions, dtype=np.intp))
            for (accessor, array), positions in by_call(self._description, indices).items()
        ]

    def _access(
        self,
        verb: Literal["Get", "Set"],
        accessor: str,
        array: int | None,
        indices: Indices,
        positions: Indices,
    ) -> NativeAccess:
        """One call; where `array` is a value reference, that of an array."""
        d, chosen = self._description, indices[positions]
        references = reference_buffer([array] if array is not None else [d.references[k] for k in chosen])
        buffer = value_buffer(d, accessor, 0)
        function, arguments = self._instance.accessor(verb, accessor, references, buffer)
        whole = elements = None
        if array is not None:
            whole = self._arrays[accessor, array]
            whole = whole if verb == "Set" else whole.copy()
            elements = np.array([d.elements[k] for k in chosen], dtype=np.intp)
        return NativeAccess(
            name=f"{verb}{accessor}",
            function=address(function),
            handle=arguments[0],
            references=references,
            dtype=buffer.dtype,
            boolean=accessor == "Boolean",
            counted=len(arguments) > 4,
            positions=positions,
            array=whole,
            elements=elements,
            rests=rests_of(d, indices, positions),
        )

    def heed(self, function: str, code: int) -> Status:
        """See `Native`."""
        return self._judge(function, self._instance.outcome(code) if function == "DoStep" else code)

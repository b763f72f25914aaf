"""Functional Mock-up Units as components: FMI 2.0 and 3.0 Co-Simulation, loaded through FMPy.

All scalar Real, Integer, Boolean and Enumeration variables (FMI 3: floats, integers of every width, Boolean,
Enumeration) travel as float64. Arrays, strings, binaries and clocks are left out of `variables`; an FMU that
has some runs all the same, with their start values.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Status, Values, Variable
from exlinn_fmi.components.cache import Lease
from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.fmu_file import check_runnable, read_description, unpack
from exlinn_fmi.components.fmu_native import (
    Instance,
    address,
    make_instance,
    reference_buffer,
    value_buffer,
)
from exlinn_fmi.components.native import Native, NativeAccess
from exlinn_fmi.components.starts import check_starts, takes_start
from exlinn_fmi.errors import ComponentError

_STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")


def read_variables(path: Path, runnable: bool = False) -> tuple[Variable, ...]:
    """The variables of an FMU, from its model description alone: nothing is unpacked or loaded.

    Args:
        path: the .fmu file.
        runnable: also demand a binary for this platform.

    Raises:
        FmuError: the file is missing or damaged, or no FMI 2.0 or 3.0 FMU for Co-Simulation.
    """
    description = read_description(Path(path))
    if runnable:
        check_runnable(description)
    return description.variables


class FmuComponent(Component):
    """An FMU for Co-Simulation, unpacked into the cache.

    Args:
        name: name in the scenario, and of the FMU's instance.
        path: the .fmu file.

    Raises:
        FmuError: the file cannot be used; the message says why and what to do.
        StorageError: there is no room to unpack it.
    """

    def __init__(self, name: str, path: Path) -> None:
        self.name = name
        self._description = read_description(Path(path))
        self.variables = self._description.variables
        lease = unpack(self._description)
        try:
            self._instance = make_instance(self._description, lease.folder, name)
        except BaseException:
            lease.release()
            raise
        self._release = weakref.finalize(self, _release, self._instance, lease)
        self._phase = "instantiated"
        self._plans: dict[tuple[str, bytes], _Plan] = {}
        self._h = 0.0

    @property
    def can_save_state(self) -> bool:
        """Whether the FMU says so."""
        return self._description.saves_state

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, float]
    ) -> Status:
        """Set start values and enter Initialization Mode, on a fresh instance after a run.

        Raises:
            InputError: a name in `starts` is unknown or cannot be set, or a value is not taken.
            FmuError: the FMU refuses to be instantiated again.
        """
        given = check_starts(self.name, self.variables, starts)
        if self._phase != "instantiated":
            self._instance.restart()
        self._plans.clear()
        self._phase, self._h, self.message = "instantiated", 0.0, ""
        status = self._check("set up", self._instance.set_up(start_time, stop_time))
        if given and status < Status.DISCARD:
            indices = np.array(list(given), dtype=np.intp)
            status = max(status, self.set(indices, np.array(list(given.values()))))
        self._phase = "initializing"
        self._plans.clear()
        if status >= Status.DISCARD:
            return status
        return max(status, self._check("EnterInitializationMode", self._instance.enter_initialization()))

    def exit_initialization(self) -> Status:
        """Leave Initialization Mode."""
        self._phase = "stepping"
        self._plans.clear()
        return self._check("ExitInitializationMode", self._instance.exit_initialization())

    def set(self, indices: Indices, values: Values) -> Status:
        """Set variables, converted to their types."""
        key = ("Set", indices.tobytes())
        plan = self._plans.get(key)
        if plan is None:
            for k in indices:
                if not self._settable(self.variables[k]):
                    self.message = f"{self.variables[k].name} cannot be set while {self._phase}"
                    return Status.ERROR
            plan = self._plans[key] = _Plan(self._description, self._instance, "Set", indices)
        worst = Status.OK
        for group in plan.groups:
            refused = group.fill(values)
            if refused is not None:
                variable = self.variables[indices[refused]]
                self.message = f"{variable.name} is of type {variable.type}: cannot be {values[refused]:g}"
                return Status.ERROR
            code = group.function(*group.arguments)
            if code:
                worst = max(worst, self._check(f"Set{group.accessor}", code))
        return worst

    def get(self, indices: Indices, values: Values) -> Status:
        """Read variables."""
        key = ("Get", indices.tobytes())
        plan = self._plans.get(key)
        if plan is None:
            plan = self._plans[key] = _Plan(self._description, self._instance, "Get", indices)
        worst = Status.OK
        for group in plan.groups:
            code = group.function(*group.arguments)
            if code:
                worst = max(worst, self._check(f"Get{group.accessor}", code))
            values[group.positions] = group.buffer
        return worst

    def step(self, t: float, h: float) -> Status:
        """DoStep."""
        if self._description.equal_steps and abs(h - (self._h or h)) > 1e-9 * h:
            self.message = f"takes equal communication steps only: had {self._h:g} s, now {h:g} s"
            return Status.ERROR
        self._h = h
        code = self._instance.do_step(t, h)
        return Status.OK if code == 0 else self._check("DoStep", code)

    def native(self) -> Native:
        """The FMU's own functions."""
        return _FmuNative(self)

    def calls(self, verb: Literal["Get", "Set"], indices: Indices) -> list[NativeAccess]:
        """The C calls that get or set these variables, one per type."""
        found = []
        for accessor, positions in _by_accessor(self._description, indices).items():
            references = reference_buffer([self._description.references[indices[p]] for p in positions])
            buffer = value_buffer(self._description, accessor, 0)
            function, arguments = self._instance.accessor(verb, accessor, references, buffer)
            found.append(
                NativeAccess(
                    name=f"{verb}{accessor}",
                    function=address(function),
                    handle=arguments[0],
                    references=references,
                    dtype=buffer.dtype,
                    boolean=accessor == "Boolean",
                    counted=len(arguments) > 4,
                    positions=np.array(positions, dtype=np.intp),
                )
            )
        return found

    def save_state(self) -> object:
        """The FMU's own copy of its state, freed when the object returned is dropped.

        Raises:
            ComponentError: the FMU reports an error.
        """
        try:
            return _SavedState(self._instance)
        except RuntimeError as error:
            raise ComponentError(self.name, f"saving the state failed: {error}") from error

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned in this run.

        Raises:
            ComponentError: the FMU reports an error.
        """
        assert isinstance(state, _SavedState)
        if state.generation != self._instance.generation:
            raise ComponentError(self.name, "restoring the state failed: it is of an earlier run")
        try:
            self._instance.set_state(state.pointer)
        except RuntimeError as error:
            raise ComponentError(self.name, f"restoring the state failed: {error}") from error

    def close(self) -> None:
        """Terminate and free the instance, unload the binary, give the folder back."""
        self._plans.clear()
        self._release()

    def _settable(self, variable: Variable) -> bool:
        """As the FMI state machines have it for the phase."""
        if self._phase != "stepping":
            return takes_start(variable)
        tunable = variable.causality == "parameter" and variable.variability == "tunable"
        return tunable or variable.causality == "input"

    def _check(self, function: str, code: int) -> Status:
        """A code of the FMU as a status, with a message where it is not OK."""
        if code == 0:
            return Status.OK
        self._instance.code(code)
        prefix = self._instance.prefix
        word = f"{prefix}{_STATUS[code]}" if 0 <= code < len(_STATUS) else f"the unknown status {code}"
        said = self._instance.remark or self._instance.said()
        self._instance.remark = ""
        self.message = f"{prefix}{function} returned {word}{f': {said}' if said else ''}"
        # Pending (5) is for asynchronous steps, which we never ask for.
        return Status(code) if 0 <= code <= Status.FATAL else Status.ERROR


class _Plan:
    """The C calls that get or set one set of variables: one group per accessor, all buffers ready."""

    def __init__(self, description: FmuDescription, instance: Instance, verb: str, indices: Indices) -> None:
        self.groups = [
            _Group(description, instance, verb, accessor, indices, where)
            for accessor, where in _by_accessor(description, indices).items()
        ]


def _by_accessor(description: FmuDescription, indices: Indices) -> dict[str, list[int]]:
    """Positions in `indices` by accessor."""
    positions: dict[str, list[int]] = {}
    for position, k in enumerate(indices):
        positions.setdefault(description.accessors[k], []).append(position)
    return positions


class _Group:
    """One C call: its function, its arguments and the buffer that they point to."""

    def __init__(
        self,
        description: FmuDescription,
        instance: Instance,
        verb: str,
        accessor: str,
        indices: Indices,
        positions: list[int],
    ) -> None:
        alone = len(positions) == len(indices)
        self.accessor = accessor
        self.positions: Any = slice(None) if alone else np.array(positions, dtype=np.intp)
        self.buffer = value_buffer(description, accessor, len(positions))
        self._references = reference_buffer([description.references[indices[p]] for p in positions])
        self.function: Callable[..., int]
        self.function, self.arguments = instance.accessor(verb, accessor, self._references, self.buffer)
        self._double = self.buffer.dtype == np.float64
        self._boolean = accessor == "Boolean"

    def fill(self, values: Values) -> int | None:
        """Put values into the buffer; gives the position of the first that its type cannot hold."""
        given = values[self.positions]
        if self._double:
            self.buffer[:] = given
            return None
        with np.errstate(invalid="ignore", over="ignore"):
            self.buffer[:] = given.astype(bool) if self._boolean else given
        if self.buffer.dtype == np.float32:
            return None
        refused = np.flatnonzero(self.buffer != given)
        return int(np.arange(len(values))[self.positions][refused[0]]) if refused.size else None


class _FmuNative(Native):
    """An FMU's C functions and what to make of their codes."""

    def __init__(self, component: FmuComponent) -> None:
        self._component = component
        self.step = component._instance.native_step()

    def access(self, verb: Literal["Get", "Set"], indices: Indices) -> list[NativeAccess]:
        return self._component.calls(verb, indices)

    def heed(self, function: str, code: int) -> Status:
        if function == "DoStep":
            code = self._component._instance.outcome(code)
        return self._component._check(function, code)


class _SavedState:
    """A state saved by an FMU, freed with this object."""

    def __init__(self, instance: Instance) -> None:
        self.pointer, self.generation = instance.get_state(), instance.generation
        weakref.finalize(self, _free_state, instance, self.generation, self.pointer).atexit = False


def _free_state(instance: Instance, generation: int, state: int) -> None:
    """Free a state, unless a fresh instance, which does not know it, has taken the place of its owner."""
    if instance.generation == generation:
        instance.free_state(state)


def _release(instance: Instance, lease: Lease) -> None:
    """Close an instance and give its folder back, in this order: Windows keeps loaded files."""
    instance.close()
    lease.release()

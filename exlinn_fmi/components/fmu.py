"""Functional Mock-up Units as components: FMI 1.0, 2.0 and 3.0 Co-Simulation, 2.0 and 3.0 Model Exchange.

FMPy loads them. Variables of all types travel as float64, texts and binaries by number (`texts`); arrays are
taken apart into their elements. What float64 lacks of whole numbers of 64 bits is at indices of its own.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values, Variable
from exlinn_fmi.components.cache import Lease
from exlinn_fmi.components.fmu_calls import FmuNative
from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.fmu_events import Stopped
from exlinn_fmi.components.fmu_file import check_runnable, read_description, unpack
from exlinn_fmi.components.fmu_interfaces import Kind
from exlinn_fmi.components.fmu_native import (
    Instance,
    Refused,
    reference_buffer,
)
from exlinn_fmi.components.fmu_steppers import EventedStep, OwnStep, Stepper
from exlinn_fmi.components.fmu_values import TEXTS, Group, groups, start_arrays
from exlinn_fmi.components.fmu_versions import Instance3, make_instance
from exlinn_fmi.components.native import Native
from exlinn_fmi.components.starts import check_starts, takes_start
from exlinn_fmi.errors import ComponentError, InputError

_STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")


@dataclass(frozen=True)
class FmuSettings:
    """How an FMU is to be used.

    Args:
        interface: Co-Simulation if the FMU can, else Model Exchange, if not given.
        solver: for Model Exchange, one of `fmu_exchange.SOLVERS`.
        tolerance: relative tolerance of the integration; the FMU's own, else 1e-6, if not given.
        structure: values of structural parameters by name; other names are passed over.
    """

    interface: Kind | None = None
    solver: str = "auto"
    tolerance: float | None = None
    structure: Mapping[str, Number] = field(default_factory=dict)

    def describe(self, path: Path) -> FmuDescription:
        """The description of an FMU that is used like this.

        Raises:
            FmuError: it cannot be.
        """
        return read_description(Path(path), self.interface, self.structure)


def read_variables(
    path: Path, runnable: bool = False, settings: FmuSettings | None = None
) -> tuple[Variable, ...]:
    """The variables of an FMU, from its model description alone: nothing is unpacked or loaded.

    Args:
        path: the .fmu file.
        runnable: also demand a binary for this platform.
        settings: how it is to be used.

    Raises:
        FmuError: the file is missing or damaged, or no FMU that can be used like that.
    """
    description = (settings or FmuSettings()).describe(path)
    if runnable:
        check_runnable(description)
    return description.variables


class FmuComponent(Component):
    """An FMU, unpacked into the cache.

    Args:
        name: name in the scenario, and of the FMU's instance.
        path: the .fmu file.
        settings: how it is to be used.

    Raises:
        FmuError: the file cannot be used; the message says why and what to do.
        StorageError: there is no room to unpack it.
    """

    def __init__(self, name: str, path: Path, settings: FmuSettings | None = None) -> None:
        self.name = name
        self.settings = settings or FmuSettings()
        self.description = self.settings.describe(path)
        self.variables = self.description.variables
        lease = unpack(self.description)
        try:
            self._instance = make_instance(self.description, lease.folder, name)
        except BaseException:
            lease.release()
            raise
        self._release = weakref.finalize(self, _release, self._instance, lease)
        self._phase = "instantiated"
        self._plans: dict[tuple[str, bytes], _Plan] = {}
        self._h = 0.0
        self._failed = Status.OK  # or the error after which only a saved state or a fresh instance helps
        self._stepper: Stepper = OwnStep(self._instance)
        self._arrays = start_arrays(self.description)
        self._held: Values = np.full(2 * len(self.variables), np.nan)  # rests included

    # ── initialisation ───────────────────────────────────────────────────────────────────────────────────

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """Set start values and enter Initialization Mode, on a fresh instance after a run.

        Raises:
            InputError: a name in `starts` is unknown or cannot be set, or a value is not taken.
            FmuError: the FMU refuses to be instantiated again.
        """
        given = self._without_structure(check_starts(self.name, self.variables, starts))
        if self._phase != "instantiated":
            self._instance.restart()
        self._phase, self._h, self.message, self._failed = "instantiated", 0.0, "", Status.OK
        self._start, self._plans = start_time, {}
        self._arrays = start_arrays(self.description)
        self._stepper = self._make_stepper()
        status = self._check("SetupExperiment", self._instance.set_up(start_time, stop_time, self.tolerance))
        if given and status < Status.DISCARD:
            indices = np.array(list(given), dtype=np.intp)
            status = max(status, self.set(indices, np.array(list(given.values()))))
        self._phase = "initializing"
        self._plans.clear()
        if status >= Status.DISCARD:
            return status
        return max(status, self._check("EnterInitializationMode", self._instance.enter_initialization()))

    def _without_structure(self, given: dict[int, float]) -> dict[int, float]:
        """Start values less those of structural parameters, which are set before everything else.

        Raises:
            InputError: one is not as it was when the variables were listed.
        """
        sizing = {k for k, v in enumerate(self.variables) if v.name in self.description.structural}
        for k in sizing & given.keys():
            if given[k] != self.variables[k].start:
                raise InputError(
                    f"{self.name}.{self.variables[k].name}: sizes arrays and is "
                    f"{self.variables[k].start:g} since the FMU was opened; give it in the settings"
                )
        return {k: value for k, value in given.items() if k not in sizing}

    @property
    def tolerance(self) -> float | None:
        """Relative tolerance that is asked for."""
        if self.settings.tolerance is not None or self.description.interface.kind == "co_simulation":
            return self.settings.tolerance
        from exlinn_fmi.components.fmu_exchange import TOLERANCE

        return self.description.experiment.tolerance or TOLERANCE

    def _make_stepper(self) -> Stepper:
        interface = self.description.interface
        if interface.kind == "model_exchange":
            from exlinn_fmi.components.fmu_exchange import ModelExchange

            return ModelExchange(self._instance, self.settings.solver, self.tolerance or 0.0)
        if interface.event_mode and isinstance(self._instance, Instance3):
            return EventedStep(self._instance)
        return OwnStep(self._instance)

    def exit_initialization(self) -> Status:
        """Leave Initialization Mode, and handle the first event where there are events."""
        self._phase = "stepping"
        self._plans.clear()
        self._held[:] = np.nan
        status = self._check("ExitInitializationMode", self._instance.exit_initialization())
        if status >= Status.DISCARD:
            return status
        return max(status, self._guarded(lambda: self._stepper.begin(self._start)))

    # ── values ───────────────────────────────────────────────────────────────────────────────────────────

    def set(self, indices: Indices, values: Values) -> Status:
        """Set variables, converted to their types."""
        if self._failed:
            return self._failed
        key = ("Set", indices.tobytes())
        plan = self._plans.get(key)
        if plan is None:
            for k in indices:
                if not self._settable(self._variable(k)):
                    self.message = f"{self._variable(k).name} cannot be set while {self._phase}"
                    return Status.ERROR
            plan = self._plans[key] = self._plan("Set", indices)
        worst, doing = Status.OK, plan.groups
        if self._stepper.has_events and self._phase == "stepping":
            self._stepper.inputs_changed()
            if plan.discrete.size and not np.array_equal(
                self._held[indices[plan.discrete]], values[plan.discrete]
            ):
                self._held[indices] = values
                worst = self._guarded(self._stepper.enter_event_mode)
                doing = plan.groups + plan.eventful
        for group in doing:
            refused = group.fill(values)
            if refused is not None:
                variable = self._variable(indices[refused])
                self.message = f"{variable.name} is of type {variable.type}: cannot be {values[refused]:g}"
                return Status.ERROR
            if worst >= Status.ERROR:
                break  # nothing more may be asked of it
            code = group.function(*group.arguments)
            if code:
                worst = max(worst, self._check(f"Set{group.accessor}", code))
        return worst

    def get(self, indices: Indices, values: Values) -> Status:
        """Read variables."""
        if self._failed:
            return self._failed
        key = ("Get", indices.tobytes())
        plan = self._plans.get(key)
        if plan is None:
            plan = self._plans[key] = self._plan("Get", indices)
        worst = Status.OK
        if self._stepper.has_events and self._phase == "stepping":
            worst = self._guarded(self._stepper.settle)
        for group in plan.groups:
            if worst >= Status.ERROR:
                break
            code = group.function(*group.arguments)
            if code:
                worst = max(worst, self._check(f"Get{group.accessor}", code))
                if code not in (Status.OK, Status.WARNING) and group.accessor in TEXTS:
                    continue  # what its pointers point to is anybody's guess
            group.take(values)
        return worst

    def _variable(self, index: int) -> Variable:
        """The variable that an index stands for, be it of its value or of its rest."""
        return self.variables[index % len(self.variables)]

    def _plan(self, verb: str, indices: Indices) -> _Plan:
        """The C calls for these variables."""
        stepping = self._phase == "stepping" and self._stepper.has_events and verb == "Set"
        waits = np.array([stepping and self._waits(self._variable(k)) for k in indices], dtype=bool)
        eventful, at_once = np.flatnonzero(waits), np.flatnonzero(~waits)
        everything = self.description, self._instance, self._arrays, verb, indices
        return _Plan(groups(*everything, at_once), groups(*everything, eventful), eventful)

    def _waits(self, variable: Variable) -> bool:
        """Whether a variable may be set in Event Mode alone, once stepping."""
        return not (variable.causality == "input" and variable.variability == "continuous")

    def _settable(self, variable: Variable) -> bool:
        """As the FMI state machines have it for the phase."""
        if self._phase != "stepping":
            return takes_start(variable)
        tunable = variable.causality == "parameter" and variable.variability == "tunable"
        return tunable or variable.causality == "input"

    @property
    def stepper(self) -> Stepper:
        """What carries it over a step."""
        return self._stepper

    # ── stepping ─────────────────────────────────────────────────────────────────────────────────────────

    def step(self, t: float, h: float) -> Status:
        """DoStep, or integration where it is Model Exchange."""
        if self.description.interface.equal_steps and abs(h - (self._h or h)) > 1e-9 * h:
            self.message = f"takes equal communication steps only: had {self._h:g} s, now {h:g} s"
            return Status.ERROR
        if self._failed:
            return self._failed
        self._h = h
        try:
            code = self._stepper.step(t, h)
        except (Refused, Stopped) as problem:
            return self.take_trouble(problem)
        status = self.take_warnings()
        if self._stepper.remark:
            self.message = "; ".join([self._stepper.remark, *[self.message] * bool(status)])
            self._stepper.remark, status = "", Status.WARNING
        return status if code == 0 else max(status, self._check("DoStep", code))

    @property
    def takes_input_derivatives(self) -> bool:
        """Whether `set_input_derivatives` works."""
        interface = self.description.interface
        return interface.kind == "model_exchange" or interface.input_derivatives

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        """Let continuous inputs change over the next step, from the values set last.

        Args:
            indices: (k,) of the inputs, all continuous and of type Real or Float64.
            derivatives: [unit/s] (k,) first derivatives.
        """
        references = self._references(indices)
        if self.description.interface.kind == "co_simulation":
            values = np.ascontiguousarray(derivatives, dtype=float)
            return self._guarded(lambda: self._instance.set_input_derivatives(references, 1, values))
        from exlinn_fmi.components.fmu_exchange import ModelExchange

        assert isinstance(self._stepper, ModelExchange)
        present = np.zeros(len(indices))
        status = self.get(indices, present)
        self._stepper.set_derivatives(references, present, np.array(derivatives, dtype=float))
        return status

    @property
    def gives_directional_derivatives(self) -> bool:
        """Whether `directional_derivative` works."""
        return self.description.interface.directional_derivatives

    def directional_derivative(self, unknowns: Indices, knowns: Indices, seed: Values) -> Values:
        """∂(unknowns)/∂(knowns) · seed at the present point, all of type Real or Float64.

        Args:
            unknowns: (n,) indices of outputs or state derivatives.
            knowns: (k,) indices of inputs or states.
            seed: (k,) direction.

        Returns:
            (n,) the change of the unknowns.

        Raises:
            ComponentError: the FMU reports an error.
        """
        of, to = self._references(unknowns), self._references(knowns)
        result = np.zeros(len(unknowns))
        try:
            self._instance.directional_derivative(of, to, np.ascontiguousarray(seed, dtype=float), result)
        except Refused as problem:
            self.take_trouble(problem)
            raise ComponentError(self.name, self.message) from problem
        return result

    def _references(self, indices: Indices) -> Any:
        """Value references of variables, as C wants them."""
        return reference_buffer([self.description.references[k] for k in indices])

    def native(self) -> Native | None:
        """The FMU's own functions, where a step is one of them and no texts or binaries may travel."""
        texts = any(v.type in TEXTS and v.causality in ("input", "output") for v in self.variables)
        if texts or not isinstance(self._stepper, OwnStep):
            return None
        return FmuNative(self.description, self._instance, self._arrays, self._check)

    # ── state ────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def can_save_state(self) -> bool:
        """Whether the FMU says so."""
        return self.description.interface.saves_state

    @property
    def can_serialize_state(self) -> bool:
        """Whether the FMU says so."""
        return self.description.interface.serializes_state

    def save_state(self) -> object:
        """The FMU's own copy of its state, freed when the object returned is dropped.

        Raises:
            ComponentError: the FMU reports an error.
        """
        if self._phase == "stepping" and self._guarded(self._stepper.settle) >= Status.DISCARD:
            raise ComponentError(self.name, f"saving the state failed: {self.message}")
        try:
            return _SavedState(self._instance, self._stepper.snapshot(), self._held.copy())
        except Refused as problem:
            self.take_trouble(problem)
            raise ComponentError(self.name, f"saving the state failed: {self.message}") from problem

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned in this run.

        Raises:
            ComponentError: the FMU reports an error.
        """
        assert isinstance(state, _SavedState)
        if state.generation != self._instance.generation:
            raise ComponentError(self.name, "restoring the state failed: it is of an earlier run")
        if self._failed == Status.FATAL:
            raise ComponentError(self.name, f"restoring the state failed: {self.message}")
        try:
            self._instance.set_state(state.pointer)
        except Refused as problem:
            self.take_trouble(problem)
            raise ComponentError(self.name, f"restoring the state failed: {self.message}") from problem
        self._failed = Status.OK
        self._stepper.restore(state.snapshot)
        self._held[:] = state.held

    def serialize_state(self, state: object) -> bytes:
        """A state that `save_state` returned, as bytes.

        Raises:
            ComponentError: the FMU reports an error.
        """
        assert isinstance(state, _SavedState)
        try:
            own = np.concatenate([state.snapshot, state.held]).tobytes()
            return len(own).to_bytes(8, "little") + own + self._instance.serialize(state.pointer)
        except Refused as problem:
            self.take_trouble(problem)
            raise ComponentError(self.name, f"serialising the state failed: {self.message}") from problem

    def deserialize_state(self, data: bytes) -> object:
        """A state for `restore_state`, of bytes that `serialize_state` gave in any run of this FMU.

        Raises:
            ComponentError: the FMU reports an error.
        """
        begin = 8 + int.from_bytes(data[:8], "little")
        own = np.frombuffer(data[8:begin])
        try:
            pointer = self._instance.deserialize(data[begin:])
        except Refused as problem:
            self.take_trouble(problem)
            raise ComponentError(self.name, f"deserialising the state failed: {self.message}") from problem
        mine = len(own) - len(self._held)
        return _SavedState(self._instance, own[:mine].copy(), own[mine:].copy(), pointer)

    def close(self) -> None:
        """Terminate and free the instance, unload the binary, give the folder back."""
        self._plans.clear()
        self._release()

    # ── trouble ──────────────────────────────────────────────────────────────────────────────────────────

    def _guarded(self, action: Callable[[], object]) -> Status:
        """Do something that the FMU may refuse; OK or what came of it."""
        try:
            action()
        except (Refused, Stopped) as problem:
            return self.take_trouble(problem)
        return self.take_warnings()

    def take_warnings(self) -> Status:
        """What functions returned a warning since last asked, as a status with a message."""
        if not self._instance.warned:
            return Status.OK
        *others, last = self._instance.warned
        self._instance.warned.clear()
        status = self._check(last, Status.WARNING)
        self.message = "".join(f"{self._instance.prefix}{name}, " for name in others) + self.message
        return status

    def take_trouble(self, problem: Refused | Stopped) -> Status:
        """What went wrong as a status, with a message."""
        if isinstance(problem, Refused):
            return self._check(problem.function, problem.code)
        self.message = problem.message
        return Status(problem.code)

    def _check(self, function: str, code: int) -> Status:
        """A code of the FMU as a status, with a message where it is not OK."""
        if code == 0:
            return Status.OK
        self._instance.code(code)
        prefix = f"fmi{self.description.version if self.description.version > 1 else ''}"
        word = f"{prefix}{_STATUS[code]}" if 0 <= code < len(_STATUS) else f"the unknown status {code}"
        said = self._instance.remark or self._instance.said()
        self._instance.remark = ""
        self.message = f"{prefix}{function} returned {word}{f': {said}' if said else ''}"
        # Pending (5) is for asynchronous steps, which we never ask for.
        status = Status(code) if 0 <= code <= Status.FATAL else Status.ERROR
        if status >= Status.ERROR:
            self._failed = status
        return status


@dataclass
class _Plan:
    """The C calls that get or set one set of variables.

    Args:
        groups: calls to make at once.
        eventful: calls to set what may be set in Event Mode alone.
        discrete: positions of the values of `eventful`.
    """

    groups: list[Group]
    eventful: list[Group]
    discrete: Indices


class _SavedState:
    """A state saved by an FMU, freed with this object."""

    def __init__(
        self, instance: Instance, snapshot: Values, held: Values, pointer: int | None = None
    ) -> None:
        self.pointer = instance.get_state() if pointer is None else pointer
        self.generation, self.snapshot, self.held = instance.generation, snapshot, held
        weakref.finalize(self, _free_state, instance, self.generation, self.pointer).atexit = False


def _free_state(instance: Instance, generation: int, state: int) -> None:
    """Free a state, unless a fresh instance, which does not know it, has taken the place of its owner."""
    if instance.generation == generation:
        instance.free_state(state)


def _release(instance: Instance, lease: Lease) -> None:
    """Close an instance and give its folder back, in this order: Windows keeps loaded files."""
    instance.close()
    lease.release()

"""What the FMI versions do differently: FMI 1.0 Co-Simulation, FMI 2.0 and 3.0 of both kinds."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Mapping
from contextlib import suppress
from ctypes import byref, c_bool, c_char, c_double, c_int, c_size_t, c_void_p
from pathlib import Path
from typing import Any

import fmpy
from fmpy import fmi1, fmi2, fmi3

from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.fmu_interfaces import Kind
from exlinn_fmi.components.fmu_native import (
    DISCARD,
    Instance,
    Refused,
    Update,
    keep_message,
    pointer_to,
    reference_buffer,
    value_buffer,
)
from exlinn_fmi.errors import FmuError


def make_instance(description: FmuDescription, folder: Path, name: str) -> Instance:
    """An instance of an unpacked FMU.

    Raises:
        FmuError: the binary cannot be loaded, or refuses to be instantiated.
    """
    kinds: dict[int, type[Instance1 | Instance2 | Instance3]] = {1: Instance1, 2: Instance2, 3: Instance3}
    return kinds[description.version](description, folder, name)


@fmi2.fmi2CallbackLoggerTYPE  # type: ignore[untyped-decorator]
def _log2(handle: int | None, _: bytes, status: int, category: bytes | None, message: bytes | None) -> None:
    keep_message(handle, status, category, message)


@fmi3.fmi3LogMessageCallback  # type: ignore[untyped-decorator]
def _log3(handle: int | None, status: int, category: bytes | None, message: bytes | None) -> None:
    keep_message(handle, status, category, message)


class Instance1(Instance):
    """FMI 1.0 Co-Simulation."""

    loaders: Mapping[Kind, Any] = {"co_simulation": fmi1.FMU1Slave}
    terminate, release, reset = "TerminateSlave", "FreeSlaveInstance", "ResetSlave"

    @property
    def prefix(self) -> str:  # type: ignore[override]
        """The functions bear the model's name."""
        return f"{self.description.identifier}_fmi"

    def _instantiate(self) -> int | None:
        handle = self._handle

        @fmi1.fmi1CallbackLoggerTYPE  # type: ignore[untyped-decorator]
        def log(_: int, __: bytes, status: int, category: bytes | None, message: bytes | None) -> None:
            keep_message(handle, status, category, message)

        calls = fmi1.fmi1CallbackFunctions()
        calls.logger = log
        calls.allocateMemory = ctypes.cast(fmpy.calloc, fmi1.fmi1CallbackAllocateMemoryTYPE)
        calls.freeMemory = ctypes.cast(fmpy.free, fmi1.fmi1CallbackFreeMemoryTYPE)
        self._callbacks = calls, log
        with suppress(ImportError, OSError):
            from fmpy.logging import addLoggerProxy

            addLoggerProxy(byref(calls))
        pointer: int | None = self._fmu.fmi1InstantiateSlave(
            self.name.encode(),
            self.description.token.encode(),
            self.folder.as_uri().encode(),
            b"application/x-fmu-sharedlibrary",
            0.0,
            b"\0",
            b"\0",
            calls,
            b"\1",
        )
        return pointer

    def set_up(self, start_time: float, stop_time: float, tolerance: float | None) -> int:
        """FMI 1 says it on initialising."""
        self._span = start_time, stop_time
        return 0

    def enter_initialization(self) -> int:
        """fmiInitializeSlave: there is no mode, only the moment."""
        function = self.function("InitializeSlave", c_void_p, c_double, c_char, c_double)
        return self.code(function(self.pointer, self._span[0], b"\1", self._span[1]))

    def _leave_initialization(self) -> int:
        return 0

    def _bind_step(self) -> None:
        self._do_step = self.function("DoStep", c_void_p, c_double, c_double, c_char)

    def do_step(self, t: float, h: float) -> int:
        """FmiDoStep."""
        code: int = self._do_step(self.pointer, t, h, b"\1")
        return code

    def outcome(self, code: int) -> int:
        """As it is."""
        return code

    def update_discrete_states(self) -> Update:
        """There are no events in FMI 1.0 Co-Simulation."""
        raise NotImplementedError


class Instance2(Instance):
    """FMI 2.0."""

    prefix = "fmi2"
    loaders: Mapping[Kind, Any] = {"co_simulation": fmi2.FMU2Slave, "model_exchange": fmi2.FMU2Model}
    state_noun, deserializer = "FMUstate", "DeSerializeFMUstate"
    model_functions = (
        "SetTime",
        "SetContinuousStates",
        "GetDerivatives",
        "GetEventIndicators",
        "CompletedIntegratorStep",
        "SetReal",
        "GetReal",
    )

    def _instantiate(self) -> int | None:
        calls = fmi2.fmi2CallbackFunctions()
        calls.logger = _log2
        # The C library's own functions, not wrapped in Python: an FMU may allocate in every step.
        calls.allocateMemory = ctypes.cast(fmpy.calloc, fmi2.fmi2CallbackAllocateMemoryTYPE)
        calls.freeMemory = ctypes.cast(fmpy.free, fmi2.fmi2CallbackFreeMemoryTYPE)
        calls.componentEnvironment = self._handle
        with suppress(ImportError, OSError):  # it formats messages; FMPy has none for some platforms
            from fmpy.logging import addLoggerProxy

            addLoggerProxy(byref(calls))
        self._callbacks = calls
        resources = (self.folder / "resources").as_uri()
        pointer: int | None = self._fmu.fmi2Instantiate(
            self.name.encode(),
            fmi2.fmi2CoSimulation
            if self.description.interface.kind == "co_simulation"
            else fmi2.fmi2ModelExchange,
            self.description.token.encode(),
            resources.encode(),
            byref(calls),
            False,
            True,
        )
        return pointer

    def set_up(self, start_time: float, stop_time: float, tolerance: float | None) -> int:
        """fmi2SetupExperiment."""
        function = self.function("SetupExperiment", c_void_p, c_int, c_double, c_double, c_int, c_double)
        told = tolerance is not None
        return self.code(function(self.pointer, told, tolerance or 0.0, start_time, 1, stop_time))

    def enter_initialization(self) -> int:
        """fmi2EnterInitializationMode."""
        return self.call("EnterInitializationMode")

    def _bind_step(self) -> None:
        self._do_step = self.function("DoStep", c_void_p, c_double, c_double, c_int)

    def do_step(self, t: float, h: float) -> int:
        """fmi2DoStep."""
        return self.outcome(self._do_step(self.pointer, t, h, not self.roll_back))

    def outcome(self, code: int) -> int:
        """What fmi2DoStep returned, with a remark where it says more."""
        if code == DISCARD:
            ended = c_int()
            status = self.function("GetBooleanStatus", c_void_p, c_int, c_void_p)
            self.code(status(self.pointer, fmi2.fmi2Terminated, byref(ended)))
            self.remark = "the FMU asks to end the simulation" if ended.value else ""
        return code

    def update_discrete_states(self) -> Update:
        """fmi2NewDiscreteStates."""
        info = fmi2.fmi2EventInfo()
        self.demand("NewDiscreteStates", pointer_to(info))
        return Update(
            again=bool(info.newDiscreteStatesNeeded),
            terminate=bool(info.terminateSimulation),
            nominals_changed=bool(info.nominalsOfContinuousStatesChanged),
            states_changed=bool(info.valuesOfContinuousStatesChanged),
            next_event=info.nextEventTime if info.nextEventTimeDefined else math.inf,
        )


class Instance3(Instance):
    """FMI 3.0."""

    prefix = "fmi3"
    loaders: Mapping[Kind, Any] = {"co_simulation": fmi3.FMU3Slave, "model_exchange": fmi3.FMU3Model}
    state_noun, deserializer = "FMUState", "DeserializeFMUState"
    model_functions = (
        "SetTime",
        "SetContinuousStates",
        "GetContinuousStateDerivatives",
        "GetEventIndicators",
        "CompletedIntegratorStep",
        "SetFloat64",
        "GetFloat64",
    )

    def _instantiate(self) -> int | None:
        interface = self.description.interface
        name, token = self.name.encode(), self.description.token.encode()
        resources = f"{self.folder / 'resources'}{os.sep}".encode()
        common = (
            name,
            token,
            resources,
            False,
            True,
        )  # not visible; logging, or FMUs keep silent on errors too
        if interface.kind == "model_exchange":
            pointer: int | None = self._fmu.fmi3InstantiateModelExchange(*common, self._handle, _log3)
        else:
            pointer = self._fmu.fmi3InstantiateCoSimulation(
                *common,
                interface.event_mode,
                interface.event_mode,  # returning early is allowed where events can be handled
                None,
                0,
                self._handle,
                _log3,
                fmi3.fmi3IntermediateUpdateCallback(),
            )
        self.pointer = pointer
        if pointer and self.description.structure:
            self._configure()
        return pointer

    def _configure(self) -> None:
        """Give structural parameters their values.

        Raises:
            FmuError: the FMU does not take them.
        """
        try:
            self.demand("EnterConfigurationMode")
            for (accessor, reference), value in self.description.structure.items():
                references, values = (
                    reference_buffer([reference]),
                    value_buffer(self.description, accessor, 1),
                )
                values[0] = value
                function, arguments = self.accessor("Set", accessor, references, values)
                self.heed(f"Set{accessor}", function(*arguments))
            self.demand("ExitConfigurationMode")
        except Refused as refused:
            raise FmuError(
                f"{self.description.path}: the FMU does not take the structural parameters: "
                f"fmi3{refused.function} returned status {refused.code}{self.said(': ')}"
            ) from refused

    def set_up(self, start_time: float, stop_time: float, tolerance: float | None) -> int:
        """FMI 3 says it on entering Initialization Mode."""
        self._span = start_time, stop_time, tolerance
        return 0

    def enter_initialization(self) -> int:
        """fmi3EnterInitializationMode."""
        start_time, stop_time, tolerance = self._span
        function = self.function(
            "EnterInitializationMode", c_void_p, c_bool, c_double, c_double, c_bool, c_double
        )
        told = tolerance is not None
        return self.code(function(self.pointer, told, tolerance or 0.0, start_time, True, stop_time))

    def _bind_step(self) -> None:
        flag = c_void_p
        self._do_step = self.function(
            "DoStep", c_void_p, c_double, c_double, c_bool, flag, flag, flag, c_void_p
        )
        self._event, self._end, self._early, self._reached = c_bool(), c_bool(), c_bool(), c_double()
        outcome = (self._event, self._end, self._early, self._reached)
        self._outcome = tuple(ctypes.addressof(value) for value in outcome)

    def do_step(self, t: float, h: float) -> int:
        """fmi3DoStep; ending or returning early is a discarded step to us."""
        return self.outcome(self._do_step(self.pointer, t, h, not self.roll_back, *self._outcome))

    def outcome(self, code: int) -> int:
        """What fmi3DoStep returned, or that it discarded the step where it wants to end or returned early."""
        if self._end.value or self._early.value:
            wish = "asks to end the simulation" if self._end.value else "returned early, which it may not"
            self.remark = f"the FMU {wish}, at t = {self._reached.value:.9g} s"
            return max(code, DISCARD)
        return code

    def update_discrete_states(self) -> Update:
        """fmi3UpdateDiscreteStates."""
        flags, when = [c_bool() for _ in range(5)], c_double()
        self.demand("UpdateDiscreteStates", *map(pointer_to, flags), pointer_to(when))
        again, terminate, nominals, states, defined = (flag.value for flag in flags)
        return Update(again, terminate, nominals, states, when.value if defined else math.inf)

    def step_to_event(self, t: float, h: float) -> tuple[int, float, bool]:
        """fmi3DoStep, which may return early: code, time reached [s], and whether there is an event.

        Where it did not return early the step is done, although an FMU whose own steps are longer may tell
        the time of the last of them.
        """
        code: int = self._do_step(self.pointer, t, h, not self.roll_back, *self._outcome)
        if self._end.value:
            self.remark = f"the FMU asks to end the simulation, at t = {self._reached.value:.9g} s"
            code = max(code, DISCARD)
        return code, self._reached.value if self._early.value else t + h, self._event.value

    def state_counts(self) -> tuple[int, int]:
        """As the FMU counts them: structural parameters may have changed them."""
        return self._count("ContinuousStates"), self._count("EventIndicators")

    def _count(self, what: str) -> int:
        number = c_size_t()
        self.demand(f"GetNumberOf{what}", pointer_to(number))
        return number.value

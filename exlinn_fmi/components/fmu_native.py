"""One instance of an FMU's binary: the C functions of FMI 2.0 and 3.0 Co-Simulation under the same few names.

FMPy loads the binary and has the types; the calls of the hot path go straight to the C functions, with
addresses of buffers that live as long as the plan they belong to. Codes returned are those of fmi2Status and
fmi3Status, which agree; `remark` says what a code does not.
"""

from __future__ import annotations

import ctypes
import itertools
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ctypes import byref, c_bool, c_double, c_int, c_size_t, c_uint32, c_void_p
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy import fmi2, fmi3

from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.native import NativeStep
from exlinn_fmi.errors import FmuError

DISCARD, ERROR, FATAL = 2, 3, 4

DTYPES: dict[str, Any] = {
    "Real": np.float64,
    "Float32": np.float32,
    "Float64": np.float64,
    "Integer": np.int32,
    **{
        f"{sign}Int{bits}": f"{kind}{bits // 8}"
        for sign, kind in (("", "i"), ("U", "u"))
        for bits in (8, 16, 32, 64)
    },
}
"""Element type of value buffers, by accessor; Boolean is c_int in FMI 2 and C99 bool in FMI 3."""

# ── log messages ─────────────────────────────────────────────────────────────────────────────────────────

_logs: dict[int, deque[str]] = {}
_handles = itertools.count(1)


def _keep(handle: int | None, status: int, category: bytes | None, message: bytes | None) -> None:
    """Keep what an FMU says of trouble; its chatter is dropped."""
    log = _logs.get(handle or 0)
    if log is not None and (status != 0 or b"error" in (category or b"").lower()):
        text = (message or b"").decode("utf-8", "replace").strip()
        if text and text not in log:
            log.append(text)


@fmi2.fmi2CallbackLoggerTYPE  # type: ignore[untyped-decorator]
def _log2(handle: int | None, _: bytes, status: int, category: bytes | None, message: bytes | None) -> None:
    _keep(handle, status, category, message)


@fmi3.fmi3LogMessageCallback  # type: ignore[untyped-decorator]
def _log3(handle: int | None, status: int, category: bytes | None, message: bytes | None) -> None:
    _keep(handle, status, category, message)


# ── instances ────────────────────────────────────────────────────────────────────────────────────────────


class Instance(ABC):
    """An instance of an FMU and its life, whatever the FMI version.

    Args:
        description: the FMU.
        folder: where it is unpacked.
        name: name of the instance.

    Raises:
        FmuError: the binary cannot be loaded, or refuses to be instantiated.
    """

    prefix: str
    loader: Any

    def __init__(self, description: FmuDescription, folder: Path, name: str) -> None:
        self.description, self.name, self.folder = description, name, folder
        self.remark = ""
        self.roll_back = False
        self.usable = True
        self.stepping = False
        self.generation = 0
        self.pointer: int | None = None
        self._fmu = self._load()
        self._do_step: Any = None
        self._outcome: tuple[int, ...] = ()
        self._handle = next(_handles)
        self._log = _logs.setdefault(self._handle, deque(maxlen=5))
        try:
            self.instantiate()
        except FmuError:
            self.close()
            raise

    def _load(self) -> Any:
        description = self.description
        try:
            with _working_folder_kept():
                return self.loader(
                    guid=description.token,
                    modelIdentifier=description.identifier,
                    unzipDirectory=str(self.folder),
                    instanceName=self.name,
                )
        except AttributeError as error:
            raise FmuError(
                f"{description.path}: the binary lacks a function of FMI {description.version}: {error}"
            ) from error
        except Exception as error:  # FMPy raises bare Exceptions here, around the loader's OSError
            reason = str(error.__context__ or error).replace(f"{self.folder}{os.sep}", "")
            raise FmuError(
                f"{description.path}: the binary for {description.platform} cannot be loaded: {reason}; "
                "it may be damaged, made for another machine, or need libraries that are not installed"
                f"{self._tool_hint()}"
            ) from error

    def instantiate(self) -> None:
        """Make a fresh instance, in place of the one there was.

        Raises:
            FmuError: the FMU refuses.
        """
        self.free()
        self.generation += 1
        self.pointer = self._instantiate()
        self.usable, self.stepping, self.roll_back = True, False, False
        if not self.pointer:
            raise FmuError(
                f"{self.description.path}: the FMU refuses to be instantiated"
                f"{self.said(': ')}{self._tool_hint()}"
            )
        # Logging is on, or FMUs keep silent on errors too; but only in the standard categories for trouble.
        wanted = [c for c in self.description.log_categories if c.startswith("logStatus")]
        if wanted:
            names = (ctypes.c_char_p * len(wanted))(*(c.encode() for c in wanted))
            # What it returns does not matter: an FMU that cannot choose runs all the same.
            self.function("SetDebugLogging", c_void_p, c_bool, c_size_t, c_void_p)(
                self.pointer, True, len(wanted), names
            )

    def restart(self) -> None:
        """Back to the state after instantiation, by a fresh instance where the FMU allows more than one."""
        if self.description.once and self.usable and self.call("Reset") < DISCARD:
            self.stepping, self.roll_back = False, False
        else:
            self.instantiate()

    def free(self) -> None:
        """Terminate and free the instance, as far as its state allows."""
        if self.pointer and self.usable:
            if self.stepping:
                self.call("Terminate")
            self.function("FreeInstance", c_void_p, result=None)(self.pointer)
        self.pointer, self.stepping = None, False

    def close(self) -> None:
        """Free the instance and unload the binary; only once."""
        self.free()
        _logs.pop(self._handle, None)
        # After fmi2Fatal nothing of the FMU may be called, its unloading code neither.
        if self.usable:
            self._fmu.freeLibrary()
        self._fmu = self._do_step = None  # a call from now on is a TypeError, not a jump into the void

    def said(self, before: str = "") -> str:
        """What the FMU has logged of trouble since last asked, after `before` if there is anything."""
        text = "; ".join(self._log)
        self._log.clear()
        return before + text if text else ""

    def _tool_hint(self) -> str:
        tool = self.description.tool
        return f"; it says that it needs {tool} on this machine" if tool else ""

    # ── calls ────────────────────────────────────────────────────────────────────────────────────────────

    def function(self, name: str, *arguments: Any, result: Any = c_int) -> Callable[..., Any]:
        """A C function of the FMU by its name less the prefix, with these argument types."""
        found: Any = self._fmu.dll[self.prefix + name]
        found.argtypes, found.restype = arguments, result
        return found  # type: ignore[no-any-return]

    def call(self, name: str) -> int:
        """Call a function that takes the instance alone."""
        return self.code(self.function(name, c_void_p)(self.pointer))

    def code(self, code: int) -> int:
        """A status code, heeded: fmi2Fatal kills the instance, after fmi2Error it can only be freed."""
        if code >= ERROR:
            self.stepping = False
            self.usable = code != FATAL
        return code

    @abstractmethod
    def _instantiate(self) -> int | None: ...

    @abstractmethod
    def set_up(self, start_time: float, stop_time: float) -> int:
        """Say what time will be simulated, before start values are set."""

    @abstractmethod
    def enter_initialization(self) -> int:
        """Enter Initialization Mode, after start values are set."""

    def exit_initialization(self) -> int:
        """Leave Initialization Mode; steps may follow."""
        code = self.call("ExitInitializationMode")
        self.stepping = code < ERROR
        self._bind_step()
        return code

    @abstractmethod
    def accessor(
        self, verb: str, name: str, references: Any, values: Any
    ) -> tuple[Callable[..., int], tuple[Any, ...]]:
        """A get or set function and its arguments for these buffers, which the caller keeps."""

    @abstractmethod
    def _bind_step(self) -> None: ...

    @abstractmethod
    def do_step(self, t: float, h: float) -> int:
        """Advance from t to t + h [s]."""

    @abstractmethod
    def outcome(self, code: int) -> int:
        """What the C function behind `do_step` returned, and the flags it set, as one code."""

    def native_step(self) -> NativeStep:
        """The C function behind `do_step`."""
        return NativeStep(address(self._do_step), self.pointer or 0, not self.roll_back, self._outcome)

    # ── state ────────────────────────────────────────────────────────────────────────────────────────────

    state_noun: str

    def get_state(self) -> int:
        """A saved state, to be freed by `free_state`; from now on steps know that they may be undone.

        Raises:
            RuntimeError: the FMU reports an error.
        """
        state = c_void_p()
        function = self.function(f"Get{self.state_noun}", c_void_p, c_void_p)
        if self.code(function(self.pointer, byref(state))) >= DISCARD:
            raise RuntimeError(self.said())
        self.roll_back = True
        return state.value or 0

    def set_state(self, state: int) -> None:
        """Go back to a saved state.

        Raises:
            RuntimeError: the FMU reports an error.
        """
        function = self.function(f"Set{self.state_noun}", c_void_p, c_void_p)
        if self.code(function(self.pointer, state)) >= DISCARD:
            raise RuntimeError(self.said())

    def free_state(self, state: int) -> None:
        """Free a saved state."""
        if self.pointer and self.usable:
            held = c_void_p(state)
            self.function(f"Free{self.state_noun}", c_void_p, c_void_p)(self.pointer, byref(held))


class Instance2(Instance):
    """FMI 2.0."""

    prefix = "fmi2"
    loader = fmi2.FMU2Slave
    state_noun = "FMUstate"

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
            fmi2.fmi2CoSimulation,
            self.description.token.encode(),
            resources.encode(),
            byref(calls),
            False,
            True,
        )
        return pointer

    def set_up(self, start_time: float, stop_time: float) -> int:
        """fmi2SetupExperiment."""
        function = self.function("SetupExperiment", c_void_p, c_int, c_double, c_double, c_int, c_double)
        return self.code(function(self.pointer, 0, 0.0, start_time, 1, stop_time))

    def enter_initialization(self) -> int:
        """fmi2EnterInitializationMode."""
        return self.call("EnterInitializationMode")

    def accessor(
        self, verb: str, name: str, references: Any, values: Any
    ) -> tuple[Callable[..., int], tuple[Any, ...]]:
        """fmi2Get… or fmi2Set…."""
        function = self.function(f"{verb}{name}", c_void_p, c_void_p, c_size_t, c_void_p)
        return function, (self.pointer, references.ctypes.data, len(references), values.ctypes.data)

    def _bind_step(self) -> None:
        self._do_step = self.function("DoStep", c_void_p, c_double, c_double, c_int)

    def do_step(self, t: float, h: float) -> int:
        """fmi2DoStep."""
        return self.outcome(self._do_step(self.pointer, t, h, not self.roll_back))

    def outcome(self, code: int) -> int:
        """What fmi2DoStep returned, with a remark where it says more."""
        if code == DISCARD:
            ended = c_int()
            self.function("GetBooleanStatus", c_void_p, c_int, c_void_p)(
                self.pointer, fmi2.fmi2Terminated, byref(ended)
            )
            self.remark = "the FMU asks to end the simulation" if ended.value else ""
        return code


class Instance3(Instance):
    """FMI 3.0."""

    prefix = "fmi3"
    loader = fmi3.FMU3Slave
    state_noun = "FMUState"

    def _instantiate(self) -> int | None:
        resources = f"{self.folder / 'resources'}{os.sep}"
        pointer: int | None = self._fmu.fmi3InstantiateCoSimulation(
            self.name.encode(),
            self.description.token.encode(),
            resources.encode(),
            False,  # visible
            True,  # loggingOn, or FMUs keep silent on errors too
            False,  # eventModeUsed
            False,  # earlyReturnAllowed
            None,
            0,
            self._handle,
            _log3,
            fmi3.fmi3IntermediateUpdateCallback(),
        )
        return pointer

    def set_up(self, start_time: float, stop_time: float) -> int:
        """FMI 3 says it on entering Initialization Mode."""
        self._span = start_time, stop_time
        return 0

    def enter_initialization(self) -> int:
        """fmi3EnterInitializationMode."""
        start_time, stop_time = self._span
        function = self.function(
            "EnterInitializationMode", c_void_p, c_bool, c_double, c_double, c_bool, c_double
        )
        return self.code(function(self.pointer, False, 0.0, start_time, True, stop_time))

    def accessor(
        self, verb: str, name: str, references: Any, values: Any
    ) -> tuple[Callable[..., int], tuple[Any, ...]]:
        """fmi3Get… or fmi3Set…."""
        function = self.function(f"{verb}{name}", c_void_p, c_void_p, c_size_t, c_void_p, c_size_t)
        count = len(references)
        return function, (self.pointer, references.ctypes.data, count, values.ctypes.data, count)

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


def make_instance(description: FmuDescription, folder: Path, name: str) -> Instance:
    """An instance of an unpacked FMU.

    Raises:
        FmuError: the binary cannot be loaded, or refuses to be instantiated.
    """
    return (Instance2 if description.version == 2 else Instance3)(description, folder, name)


def address(function: Any) -> int:
    """Where a C function lies."""
    return ctypes.cast(function, c_void_p).value or 0


def value_buffer(description: FmuDescription, accessor: str, size: int) -> np.ndarray[Any, Any]:
    """An array for values of one accessor, laid out as the C functions want it."""
    boolean = np.int32 if description.version == 2 else np.bool_
    return np.zeros(size, dtype=DTYPES.get(accessor, boolean))


def reference_buffer(references: list[int]) -> np.ndarray[Any, Any]:
    """Value references as the C functions want them."""
    return np.array(references, dtype=c_uint32)


@contextmanager
def _working_folder_kept() -> Iterator[None]:
    """FMPy changes into the binary's folder, and stays there when loading fails."""
    before = Path.cwd()
    try:
        yield
    finally:
        os.chdir(before)

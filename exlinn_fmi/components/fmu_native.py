"""One instance of an FMU's binary: the C functions of all FMI versions under the same few names.

FMPy loads the binary and has the types; the calls of the hot path go straight to the C functions, with
addresses of buffers that live as long as the plan they belong to. Codes returned are those of fmiStatus, the
same in all versions; `remark` says what a code does not. What differs is in `fmu_versions`.
"""

from __future__ import annotations

import ctypes
import itertools
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from ctypes import byref, c_bool, c_int, c_size_t, c_void_p
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from exlinn_fmi.components.fmu_description import FmuDescription
from exlinn_fmi.components.fmu_interfaces import Kind
from exlinn_fmi.components.native import NativeStep
from exlinn_fmi.errors import FmuError

WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4

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
"""Element type of value buffers, by accessor; Boolean is char in FMI 1, int in FMI 2 and bool in FMI 3."""

# ── log messages ─────────────────────────────────────────────────────────────────────────────────────────

_logs: dict[int, deque[str]] = {}
_handles = itertools.count(1)


def keep_message(handle: int | None, status: int, category: bytes | None, message: bytes | None) -> None:
    """Keep what an FMU says of trouble; its chatter is dropped."""
    log = _logs.get(handle or 0)
    if log is not None and (status != 0 or b"error" in (category or b"").lower()):
        text = (message or b"").decode("utf-8", "replace").strip()
        if text and text not in log:
            log.append(text)


class Refused(Exception):  # noqa: N818 - a status, on its way to becoming a message
    """A function of the FMU returned fmi…Discard or worse where nothing can go on.

    Args:
        function: its name less the prefix.
        code: what it returned.
    """

    def __init__(self, function: str, code: int) -> None:
        super().__init__(function, code)
        self.function, self.code = function, code


@dataclass(frozen=True)
class Update:
    """What an iteration of Event Mode brought.

    Args:
        again: whether there must be another.
        terminate: whether the FMU asks to end the simulation.
        nominals_changed: whether nominal values of states are others now.
        states_changed: whether states have jumped.
        next_event: [s] time of the next time event, infinite where there is none.
    """

    again: bool
    terminate: bool
    nominals_changed: bool
    states_changed: bool
    next_event: float


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
    loaders: Mapping[Kind, Any]
    terminate, release, reset = "Terminate", "FreeInstance", "Reset"

    def __init__(self, description: FmuDescription, folder: Path, name: str) -> None:
        self.description, self.name, self.folder = description, name, folder
        self.remark = ""
        self.warned: dict[str, None] = {}  # functions that returned a warning nobody was told of yet
        self.roll_back = False
        self.usable = True
        self.stepping = False
        self.generation = 0
        self._model_addresses: list[int] = []
        self.pointer: int | None = None
        self._functions: dict[tuple[Any, ...], Any] = {}
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
                return self.loaders[description.interface.kind](
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
            choose = self.function("SetDebugLogging", c_void_p, c_bool, c_size_t, c_void_p)
            # An FMU that cannot choose runs all the same.
            if self.code(choose(self.pointer, True, len(wanted), names)) == FATAL:
                raise FmuError(
                    f"{self.description.path}: {self.prefix}SetDebugLogging returned {self.prefix}Fatal"
                    f"{self.said(': ')}"
                )

    def restart(self) -> None:
        """Back to the state after instantiation, by a fresh instance where the FMU allows more than one."""
        if self.description.interface.once and self.usable and self.call(self.reset) < DISCARD:
            self.stepping, self.roll_back = False, False
        else:
            self.instantiate()

    def free(self) -> None:
        """Terminate and free the instance, as far as its state allows."""
        if self.pointer and self.usable:
            if self.stepping:
                self.call(self.terminate)
            if self.usable:
                self.function(self.release, c_void_p, result=None)(self.pointer)
        self.pointer, self.stepping = None, False

    def close(self) -> None:
        """Free the instance and unload the binary; only once."""
        self.free()
        _logs.pop(self._handle, None)
        # After fmi2Fatal nothing of the FMU may be called, its unloading code neither.
        if self.usable:
            self._fmu.freeLibrary()
        self._functions.clear()
        self._fmu = self._do_step = None  # a call from now on is a TypeError, not a jump into the void

    def said(self, before: str = "") -> str:
        """What the FMU has logged of trouble since last asked, after `before` if there is anything."""
        text = "; ".join(self._log)
        self._log.clear()
        return before + text if text else ""

    def _tool_hint(self) -> str:
        needs, tool = self.description.interface.needs_tool, self.description.tool
        return f"; it says that it needs {tool} on this machine" if needs else ""

    # ── calls ────────────────────────────────────────────────────────────────────────────────────────────

    def function(self, name: str, *arguments: Any, result: Any = c_int) -> Callable[..., Any]:
        """A C function of the FMU by its name less the prefix, with these argument types."""
        key = name, arguments
        found = self._functions.get(key)
        if found is None:
            found = self._functions[key] = self._fmu.dll[self.prefix + name]
            found.argtypes, found.restype = arguments, result
        return found  # type: ignore[no-any-return]

    def call(self, name: str) -> int:
        """Call a function that takes the instance alone."""
        return self.code(self.function(name, c_void_p)(self.pointer))

    def code(self, code: int) -> int:
        """A status code, heeded: fmi2Fatal kills the instance, after fmi2Error it can only be freed."""
        if code >= ERROR or code < 0:
            self.stepping = False
            self.usable &= code != FATAL
        return code

    def demand(self, name: str, *arguments: Any) -> None:
        """Call a function with the instance and these C values.

        Raises:
            Refused: it returned fmi…Discard or worse.
        """
        kinds = [type(argument) for argument in arguments]
        self.heed(name, self.function(name, c_void_p, *kinds)(self.pointer, *arguments))

    def heed(self, name: str, code: int) -> None:
        """Note a warning that a function returned.

        Raises:
            Refused: it returned anything else than that or fmi…OK.
        """
        if code == WARNING:
            self.warned[name] = None
        elif self.code(code) != 0:
            raise Refused(name, code)

    @abstractmethod
    def _instantiate(self) -> int | None: ...

    @abstractmethod
    def set_up(self, start_time: float, stop_time: float, tolerance: float | None) -> int:
        """Say what time will be simulated and how precisely, before start values are set."""

    @abstractmethod
    def enter_initialization(self) -> int:
        """Enter Initialization Mode, after start values are set."""

    def exit_initialization(self) -> int:
        """Leave Initialization Mode; steps may follow."""
        code = self._leave_initialization()
        self.stepping = code < ERROR
        if self.description.interface.kind == "co_simulation":
            self._bind_step()
        return code

    def accessor(
        self, verb: str, name: str, references: Any, values: Any, sizes: Any = None
    ) -> tuple[Callable[..., int], tuple[Any, ...]]:
        """A get or set function and its arguments for these buffers, which the caller keeps.

        Binaries have a buffer of their sizes as well.
        """
        counted, v, z = self.description.version == 3, c_void_p, c_size_t
        sized = [] if sizes is None else [sizes.ctypes.data]
        function = self.function(f"{verb}{name}", v, v, z, *[v] * len(sized), v, *[z] * counted)
        first = self.pointer, references.ctypes.data, len(references)
        return function, (*first, *sized, values.ctypes.data, *[len(values)] * counted)

    def _leave_initialization(self) -> int:
        return self.call("ExitInitializationMode")

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

    # ── events, in Model Exchange and in FMI 3 Co-Simulation with Event Mode ──────────────────────────────

    @abstractmethod
    def update_discrete_states(self) -> Update:
        """One iteration of Event Mode.

        Raises:
            Refused: the FMU reports an error.
        """

    def state_counts(self) -> tuple[int, int]:
        """Numbers of continuous states and of event indicators."""
        return self.description.state_count, self.description.indicator_count

    model_functions: tuple[str, ...] = ()
    """Names of the functions that a solver calls, in the order of `fmu_solver.FUNCTIONS`."""

    def model_calls(self) -> list[int]:
        """`fmu_solver.Model.calls`: the instance, addresses of the functions that a solver calls, flags."""
        if not self._model_addresses:
            self._model_addresses = [address(self.function(name)) for name in self.model_functions]
        return [self.pointer or 0, *self._model_addresses, self.description.version, self.roll_back]

    # ── state ────────────────────────────────────────────────────────────────────────────────────────────

    state_noun = ""

    def get_state(self) -> int:
        """A saved state, to be freed by `free_state`; from now on steps know that they may be undone.

        Raises:
            Refused: the FMU reports an error.
        """
        state = c_void_p()
        self.demand(f"Get{self.state_noun}", pointer_to(state))
        self.roll_back = True
        return state.value or 0

    def set_state(self, state: int) -> None:
        """Go back to a saved state.

        Raises:
            Refused: the FMU reports an error.
        """
        self.demand(f"Set{self.state_noun}", c_void_p(state))
        self.stepping = True  # also after an error, which is behind it now

    def free_state(self, state: int) -> None:
        """Free a saved state."""
        if self.pointer and self.usable:
            held = c_void_p(state)
            self.code(self.function(f"Free{self.state_noun}", c_void_p, c_void_p)(self.pointer, byref(held)))

    def serialize(self, state: int) -> bytes:
        """A saved state as bytes.

        Raises:
            Refused: the FMU reports an error.
        """
        size = c_size_t()
        self.demand(f"Serialized{self.state_noun}Size", c_void_p(state), pointer_to(size))
        data = ctypes.create_string_buffer(size.value)
        self.demand(f"Serialize{self.state_noun}", c_void_p(state), pointer_to(data), size)
        return data.raw

    deserializer = ""

    def deserialize(self, data: bytes) -> int:
        """A saved state of bytes, to be freed by `free_state`.

        Raises:
            Refused: the FMU reports an error.
        """
        state = c_void_p()
        kept = ctypes.create_string_buffer(data, len(data))
        self.demand(self.deserializer, pointer_to(kept), c_size_t(len(data)), pointer_to(state))
        return state.value or 0

    # ── derivatives ──────────────────────────────────────────────────────────────────────────────────────

    def directional_derivative(self, unknowns: Any, knowns: Any, seed: Any, result: Any) -> None:
        """∂(unknowns)/∂(knowns) · seed into `result`; all are buffers, the first two of value references.

        Raises:
            Refused: the FMU reports an error.
        """
        v, z = c_void_p, c_size_t
        n, k = len(unknowns), len(knowns)
        sizes = (z(k), z(n)) if self.description.version == 3 else ()
        first = (v(unknowns.ctypes.data), z(n), v(knowns.ctypes.data), z(k), v(seed.ctypes.data))
        last = v(result.ctypes.data)
        if sizes:
            self.demand("GetDirectionalDerivative", *first, sizes[0], last, sizes[1])
        else:
            self.demand("GetDirectionalDerivative", *first, last)

    def set_input_derivatives(self, references: Any, order: int, values: Any) -> None:
        """Derivatives of inputs for the next step (FMI 1 and 2 Co-Simulation).

        Raises:
            Refused: the FMU reports an error.
        """
        count = len(references)
        orders = np.full(count, order, dtype=np.int32)
        v = c_void_p
        pointers = v(orders.ctypes.data), v(values.ctypes.data)
        self.demand("SetRealInputDerivatives", v(references.ctypes.data), c_size_t(count), *pointers)


def pointer_to(value: Any) -> c_void_p:
    """The address of a C value, which the caller keeps."""
    return c_void_p(ctypes.addressof(value))


def address(function: Any) -> int:
    """Where a C function lies."""
    return ctypes.cast(function, c_void_p).value or 0


def value_buffer(description: FmuDescription, accessor: str, size: int) -> np.ndarray[Any, Any]:
    """An array for values of one accessor, laid out as the C functions want it."""
    boolean = {1: np.int8, 2: np.int32, 3: np.bool_}[description.version]
    return np.zeros(size, dtype=DTYPES.get(accessor, boolean))


def reference_buffer(references: list[int]) -> np.ndarray[Any, Any]:
    """Value references as the C functions want them."""
    return np.array(references, dtype=np.uint32)


@contextmanager
def _working_folder_kept() -> Iterator[None]:
    """FMPy changes into the binary's folder, and stays there when loading fails."""
    before = Path.cwd()
    try:
        yield
    finally:
        os.chdir(before)

"""A component in a process of its own: whatever happens there, this process and the rows so far live on.

The process (`worker.py`) holds the real component. Calls go to it through a pipe, answers come back through
another; values lie in a block of memory that both map and that has no name, so that nothing is left over. A
crash, an exit or a call that takes too long is a `ComponentError` that names call, time and cause.
"""

from __future__ import annotations

import json
import math
import weakref
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from exlinn_fmi import errors
from exlinn_fmi.components.base import Component, Indices, Number, Status, Values, Variable
from exlinn_fmi.components.fmu import FmuComponent, FmuSettings, read_variables
from exlinn_fmi.components.process import PATIENCE, LostError, Process
from exlinn_fmi.components.texts import handle, text
from exlinn_fmi.components.wide import exact
from exlinn_fmi.components.worker import (
    CALL,
    EXCHANGE,
    FAILED,
    FINE,
    FIRST,
    OTHER,
    POST,
    REPLY,
    REQUEST,
    STEP,
    STEPPING,
    plain,
)
from exlinn_fmi.errors import ComponentError, ExlinnError

START = 60.0
"""Time that a process has to start [s]: on a busy machine this may be slow, whatever the component."""

_STAGES = ("instantiation", "setting inputs", "reading outputs", "the step")
_Slot = tuple[int, Values, list[int]]
"""Number of a set of variables, where their values are in the shared block, which of them are texts."""


class IsolatedComponent(Component):
    """A component in a process of its own.

    A step goes on while others are stepped. That it failed is told by the next call, as an error with the
    step's time; once a state was saved, by the step itself, since the caller may want to undo it.

    Args:
        name: name in the scenario.
        variables: the component's variables.
        target: what makes the component there, ``module:name``.
        arguments: what to call that with, plain enough for JSON.
        timeout: longest time that a call may take [s].
        memory: most memory that the process may take [bytes]; what the machine has if not given.

    Raises:
        InputError: the component cannot be made; the message says why.
        ComponentError: it crashed or hung while it was made.
    """

    def __init__(
        self,
        name: str,
        variables: Sequence[Variable],
        target: str,
        arguments: Mapping[str, Any],
        timeout: float = 60.0,
        memory: float | None = None,
    ) -> None:
        self.name, self.variables = name, tuple(variables)
        self._slots: dict[tuple[bool, bytes], _Slot] = {}
        self._free = FIRST
        self._texts = frozenset(k for k, v in enumerate(self.variables) if v.type in ("String", "Binary"))
        self._theirs: dict[float, float] = {0.0: 0.0}  # number there of a text, by its number here
        self._ours: dict[float, float] = {0.0: 0.0}  # the other way round
        self._pending = -1  # slot with inputs that are still to be set
        self._posted: float | None = None  # time of a step that may still be going on [s]
        self._carried = -1  # slot with the inputs that it took along
        self._time = math.nan  # present communication point [s]
        self._undoable = False
        self._dropped: list[int] = []
        self._process = Process(8 * (FIRST + 4096 + 8 * len(self.variables)), timeout, memory)
        self._end = weakref.finalize(self, self._process.end)
        self._process.timeout = max(timeout, START)
        self._call("load", target, what="start")
        self._process.timeout = timeout
        made = self._call("make", dict(arguments), what=_STAGES[0])
        self._sampled, self._saves = bool(made["sampled"]), bool(made["can_save_state"])
        self.warnings = tuple(made["warnings"])

    @property
    def sampled(self) -> bool:
        """As the component itself."""
        return self._sampled

    @property
    def can_save_state(self) -> bool:
        """As the component itself."""
        return self._saves

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """As the component itself."""
        self._pending, self._undoable, self._time = -1, False, start_time
        texts = {self.variables[k].name for k in self._texts}
        given = {n: self._sent(float(v)) if n in texts else exact(v) for n, v in starts.items()}
        return self._status("enter_initialization", start_time, stop_time, given, what="initialisation")

    def exit_initialization(self) -> Status:
        """As the component itself."""
        status = self._settle()
        if status >= Status.DISCARD:
            return status
        return max(status, self._status("exit_initialization", what="the end of initialisation"))

    def set(self, indices: Indices, values: Values) -> Status:
        """Lay values ready; they are set, and refused if they are, together with the call that comes next."""
        number, place, texts = self._slot(False, indices)
        status = Status.OK
        if self._pending not in (-1, number) or self._carried == number:
            status = self._settle()  # what lies there may not have been read yet
        sent = [self._sent(float(values[k])) for k in texts]
        place[:] = values
        if texts:
            place[texts] = sent
        self._pending = number
        return status

    def get(self, indices: Indices, values: Values) -> Status:
        """As the component itself."""
        number, place, texts = self._slot(True, indices)
        status = self._exchange(EXCHANGE, number)
        values[:] = place
        for k in texts:
            values[k] = self._received(float(place[k]))
        return status

    def step(self, t: float, h: float) -> Status:
        """Begin a step."""
        if self._undoable:
            status = self._exchange(STEP, -1, t, h)
            self._time = t + h
            return status
        if self._posted is not None and (status := self._settle()) >= Status.DISCARD:
            return status
        self._send(REQUEST.pack(POST, self._pending, -1, 0, t, h))
        self._posted, self._carried, self._pending, self._time = t, self._pending, -1, t + h
        return Status.OK

    def save_state(self) -> object:
        """A copy of the whole state, which stays in the other process."""
        self._undoable = True
        if self._dropped:
            dropped, self._dropped[:] = self._dropped[:], []
            self._call("forget", dropped, what="freeing a state")
        return self._state(self._call("save_state", what="saving its state"))

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned in this run."""
        assert isinstance(state, _SavedState)
        self._pending = -1
        self._call("restore_state", state.number, what="restoring its state")

    @property
    def can_serialize_state(self) -> bool:
        """As the component itself."""
        return bool(self._call("ask", "can_serialize_state", what="asking what it can do"))

    def serialize_state(self, state: object) -> bytes:
        """A state that `save_state` returned, as bytes."""
        assert isinstance(state, _SavedState)
        return b64decode(self._call("serialize_state", state.number, what="serializing its state"))

    def deserialize_state(self, data: bytes) -> object:
        """A state from bytes."""
        text = b64encode(data).decode()
        return self._state(self._call("deserialize_state", text, what="reading a state"))

    @property
    def gives_directional_derivatives(self) -> bool:
        """As the component itself."""
        return bool(self._call("ask", "gives_directional_derivatives", what="asking what it can do"))

    def directional_derivative(self, unknowns: Indices, knowns: Indices, seed: Values) -> Values:
        """As the component itself."""
        given = unknowns.tolist(), knowns.tolist(), seed.tolist()
        return np.array(self._call("derivative", *given, what="a directional derivative"), dtype=float)

    @property
    def takes_input_derivatives(self) -> bool:
        """As the component itself."""
        return bool(self._call("ask", "takes_input_derivatives", what="asking what it can do"))

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        """As the component itself."""
        given = indices.tolist(), derivatives.tolist()
        return self._status("input_derivatives", *given, what="setting derivatives of inputs")

    def close(self) -> None:
        """Close the component and end its process."""
        if self._end.alive and self._process.alive:
            try:
                try:
                    self._settle()
                finally:
                    if self._process.alive:
                        self._call("close", what="closing")
                        self._process.end(PATIENCE)
            finally:
                self._end()

    # ── requests ─────────────────────────────────────────────────────────────────────────────────────────

    def _state(self, number: int) -> _SavedState:
        """A state that the other process keeps under a number, until it is dropped here."""
        state = _SavedState(number)
        weakref.finalize(state, self._dropped.append, number).atexit = False
        return state

    def _slot(self, read: bool, indices: Indices) -> _Slot:
        """Where values of these variables lie."""
        key = (read, indices.tobytes())
        slot = self._slots.get(key)
        if slot is None:
            full = self._free + len(indices) > len(self._process.block)
            if full:
                self._flush()
                self._slots.clear()
                self._free = FIRST
            self._call("slot", self._free, indices.tolist(), full, what="laying out memory")
            place = self._process.block[self._free : self._free + len(indices)]
            texts = [at for at, k in enumerate(indices.tolist()) if k in self._texts]
            slot = self._slots[key] = (len(self._slots), place, texts)
            self._free += len(indices)
        return slot

    def _sent(self, number: float) -> float:
        """The number in the other process of a text that has a number in this one."""
        if number not in self._theirs:
            self._theirs[number] = self._call("keep", *plain(text(number)), what="passing on a text")
        return self._theirs[number]

    def _received(self, number: float) -> float:
        """The number in this process of a text that has a number in the other one."""
        if number not in self._ours:
            content, binary = self._call("tell", number, what="passing on a text")
            self._ours[number] = handle(bytes.fromhex(content) if binary else content)
        return self._ours[number]

    def _exchange(self, kind: int, taken: int, t: float = 0.0, h: float = 0.0) -> Status:
        """Set what is still to be set, then step or read outputs into a slot."""
        self._send(REQUEST.pack(kind, self._pending, taken, 0, t, h))
        self._pending = -1
        status, said = self._receive(_STAGES[2])
        if status:
            self.message = said
        return Status(status)

    def _settle(self) -> Status:
        """Wait for the end of the step that may be going on.

        Raises:
            ComponentError: it failed.
        """
        return self._exchange(EXCHANGE, -1) if self._pending >= 0 or self._posted is not None else Status.OK

    def _flush(self) -> None:
        """Set what is still to be set.

        Raises:
            ComponentError: that failed.
        """
        if self._pending >= 0 and self._settle() >= Status.DISCARD:
            raise ComponentError(self.name, self.message, time=self._time)

    def _status(self, method: str, *arguments: Any, what: str) -> Status:
        """Call a method that gives a status."""
        status, said = self._request(method, arguments, what)
        if status:
            self.message = said
        return Status(status)

    def _call(self, method: str, *arguments: Any, what: str) -> Any:
        """Call a method that gives a value."""
        return json.loads(self._request(method, arguments, what)[1])

    def _request(self, method: str, arguments: Sequence[Any], what: str) -> tuple[int, str]:
        if method != "slot":
            self._flush()
        data = json.dumps({"method": method, "arguments": arguments}).encode()
        self._send(REQUEST.pack(CALL, -1, -1, len(data), 0.0, 0.0) + data)
        return self._receive(what)

    def _send(self, data: bytes) -> None:
        try:
            self._process.send(data)
        except LostError as error:
            self._lost(error, "")

    def _receive(self, what: str) -> tuple[int, str]:
        """Status and text of the next reply.

        Raises:
            ExlinnError: what the component raised in its process.
            ComponentError: the step posted before failed, or the process ended or had to be.
        """
        try:
            reply = self._process.receive(REPLY.size)
            posted, self._posted, self._carried = self._posted, None, -1
            if reply == FINE:
                return Status.OK, ""
            status, length = REPLY.unpack(reply)
            said = self._process.receive(length).decode() if length else ""
        except LostError as error:
            self._lost(error, what)
        if status < 0:
            word = f"the step ended with status {Status(-status).name}"
            raise ComponentError(self.name, f"{word}: {said or 'no text'}", time=posted)
        if status == FAILED:
            raise self._raised(**json.loads(said))
        return status, said

    def _lost(self, error: LostError, what: str) -> NoReturn:
        """Tell how the process ended, and in which call."""
        stage = int(self._process.block[0])
        what, time = (_STAGES[stage] if stage < OTHER else what), self._time
        if stage == STEPPING and self._posted is not None:
            time = self._posted
        where = f" in {what}" if what else ""
        raise ComponentError(self.name, f"{error}{where}", time=None if math.isnan(time) else time) from None

    def _raised(self, name: str, said: str) -> ExlinnError:
        """An exception of the component as it would be in this process."""
        kind = getattr(errors, name, None)
        if kind is ComponentError or not (isinstance(kind, type) and issubclass(kind, ExlinnError)):
            prefix = "" if kind is ComponentError else f"{name}: "
            return ComponentError(self.name, prefix + said.removeprefix(f"{self.name}: "))
        return kind(said)


class _SavedState:
    """A state that the other process keeps under a number, until this object is dropped."""

    def __init__(self, number: int) -> None:
        self.number = number


def isolated_fmu(
    name: str, path: Path, timeout: float, memory: float | None, settings: FmuSettings | None = None
) -> IsolatedComponent:
    """An FMU in a process of its own.

    Args:
        name: name in the scenario.
        path: the .fmu file.
        timeout: longest time that a call may take [s].
        memory: most memory that it may take [bytes]; what the machine has if None.
        settings: how it is to be used.

    Raises:
        FmuError: the file cannot be used.
        ComponentError: it crashed or hung while it was loaded.
    """
    arguments = {"name": name, "path": str(path.absolute()), **asdict(settings or FmuSettings())}
    variables = read_variables(path, runnable=True, settings=settings)
    return IsolatedComponent(name, variables, f"{__name__}:fmu", arguments, timeout, memory)


def fmu(name: str, path: str, **settings: Any) -> FmuComponent:
    """An FMU; called in the process that is to run it."""
    return FmuComponent(name, Path(path), FmuSettings(**settings))

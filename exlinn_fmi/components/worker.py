"""The other end of an isolated component: a process that holds the real one and does what it is asked.

`process.py` starts it as ``python -m exlinn_fmi.components.worker``. Requests come on standard input, replies
go to standard output, values lie in a block of memory that both processes map. What the component prints goes
to standard error.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import select
import struct
import sys
import threading
from base64 import b64decode, b64encode
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Status, Values
from exlinn_fmi.components.texts import handle, text
from exlinn_fmi.components.waiting import Waiter

REQUEST = struct.Struct("<iiiidd")
"""Kind, slot to set, slot to get, bytes that follow, t [s], h [s]; a slot is -1 where there is none."""
REPLY = struct.Struct("<ii")
"""Status, negative if it is that of the step posted before; bytes that follow: the message, or a result."""

FINE = REPLY.pack(0, 0)
"""The reply where all went well and nothing follows."""

EXCHANGE, STEP, POST, CALL = range(4)
"""Kinds of request: set and get, set and step, the same without a reply, a method with arguments as JSON."""

FAILED = 256
"""Status of a call that raised; the exception follows."""

INSTANTIATION, SETTING, READING, STEPPING, OTHER = range(5)
"""Stages, of which the present one stands in the first 8 bytes of the block: it tells where a crash was."""
OTHERS, FIRST = 1, 2
"""Places in the block of the number of such processes, and from which slots lie."""


class Worker:
    """Serves one component.

    Args:
        block: the memory shared with the parent, as numbers.
        requests: descriptor to read from.
        replies: descriptor to write to.
        memory: most that the component may take [bytes], 0 for any.
    """

    def __init__(self, block: Values, requests: int, replies: int, memory: int = 0) -> None:
        self._block, self._requests, self._replies, self._memory = block, requests, replies, memory
        self._factory: Callable[..., Component]
        self._component: Component
        self._slots: list[tuple[Indices, Values]] = []
        self._states: dict[int, object] = {}
        self._count = 0

    def serve(self) -> None:
        """Answer until the parent closes the component or is gone."""
        size, unpack = REQUEST.size, REQUEST.unpack
        posted, said = Status.OK, ""
        waiter = None if sys.platform == "win32" else Waiter(self._requests, self._block[OTHERS : OTHERS + 1])
        while True:
            if waiter is not None:
                waiter.look()
            request = os.read(self._requests, size)
            if len(request) < size:
                return
            kind, given, taken, length, t, h = unpack(request)
            call = json.loads(self._read(length)) if kind == CALL else None
            if posted >= Status.DISCARD:
                self._reply(-posted, said)
                posted = Status.OK
            elif call is not None:
                self._call(**call)
                if call["method"] == "close":
                    return
            elif kind == POST:
                posted, said = self._exchange(kind, given, taken, t, h)
            else:
                status, words = self._exchange(kind, given, taken, t, h)
                if posted > status:
                    status, words = posted, said
                posted = Status.OK
                if status:
                    self._reply(status, words)
                else:
                    os.write(self._replies, FINE)

    def _exchange(self, kind: int, given: int, taken: int, t: float, h: float) -> tuple[Status, str]:
        """Set, then step or get, to the first that fails; the worst status and its message."""
        component, block = self._component, self._block
        worst = status = Status.OK
        said = ""
        try:
            if given >= 0:
                block[0] = SETTING
                worst = component.set(*self._slots[given])
                if worst:
                    said = component.message
                    if worst >= Status.DISCARD:
                        return worst, said
            if kind != EXCHANGE:
                block[0] = STEPPING
                status = component.step(t, h)
            elif taken >= 0:
                block[0] = READING
                status = component.get(*self._slots[taken])
        except Exception as error:
            return Status.ERROR, f"{type(error).__name__}: {error}"
        return (status, component.message) if status > worst else (worst, said)

    def _call(self, method: str, arguments: list[Any]) -> None:
        """Call a method of ours, or else of the component; an exception is handed on."""
        self._block[0] = INSTANTIATION if method == "make" else OTHER
        try:
            own = getattr(self, f"do_{method}", None)
            result = (own or getattr(self._component, method))(*arguments)
        except Exception as error:
            raised = json.dumps({"name": type(error).__name__, "said": str(error)})
            self._reply(FAILED, raised)
        else:
            if isinstance(result, Status):
                self._reply(result, self._component.message)
            else:
                self._reply(Status.OK, json.dumps(result))

    # ── what is not handed on to the component as it is ──────────────────────────────────────────────────

    def do_load(self, target: str) -> None:
        """Import what makes the component."""
        module, name = target.split(":")
        self._factory = getattr(import_module(module), name)
        _limit(self._memory)

    def do_make(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Make the component; what the parent needs to know of it."""
        self._component = component = self._factory(**arguments)
        watch_parent(
            self._requests
        )  # not before: the loading of a library may hold Python's lock for as long as it likes
        return {
            "sampled": component.sampled,
            "can_save_state": component.can_save_state,
            "warnings": list(component.warnings),
        }

    def do_slot(self, place: int, indices: list[int], afresh: bool) -> None:
        """A new set of variables and where their values are in the block; all others go if it is `afresh`."""
        if afresh:
            self._slots.clear()
        self._slots.append((np.array(indices, dtype=np.intp), self._block[place : place + len(indices)]))

    def do_keep(self, content: str, binary: bool) -> float:
        """Number here of a text."""
        return handle(bytes.fromhex(content) if binary else content)

    def do_tell(self, number: float) -> tuple[str, bool]:
        """The text that has a number here."""
        return plain(text(number))

    def do_save_state(self) -> int:
        """Save the state; its number."""
        self._count += 1
        self._states[self._count] = self._component.save_state()
        return self._count

    def do_restore_state(self, number: int) -> None:
        """Go back to a saved state."""
        self._component.restore_state(self._states[number])

    def do_serialize_state(self, number: int) -> str:
        """A saved state as bytes, in base64."""
        return b64encode(self._component.serialize_state(self._states[number])).decode()

    def do_deserialize_state(self, data: str) -> int:
        """A saved state made of bytes, in base64; its number."""
        self._count += 1
        self._states[self._count] = self._component.deserialize_state(b64decode(data))
        return self._count

    def do_forget(self, numbers: list[int]) -> None:
        """Drop saved states."""
        for number in numbers:
            del self._states[number]

    def do_ask(self, name: str) -> Any:
        """A property of the component."""
        return getattr(self._component, name)

    def do_derivative(self, unknowns: list[int], knowns: list[int], seed: list[float]) -> list[float]:
        """A directional derivative."""
        found: list[float] = self._component.directional_derivative(
            np.array(unknowns, dtype=np.intp), np.array(knowns, dtype=np.intp), np.array(seed, dtype=float)
        ).tolist()
        return found

    def do_input_derivatives(self, indices: list[int], derivatives: list[float]) -> Status:
        """Derivatives of inputs."""
        return self._component.set_input_derivatives(
            np.array(indices, dtype=np.intp), np.array(derivatives, dtype=float)
        )

    # ── pipes ────────────────────────────────────────────────────────────────────────────────────────────

    def _read(self, length: int) -> bytes:
        data = b""
        while len(data) < length:
            part = os.read(self._requests, length - len(data))
            if not part:
                raise EOFError  # the parent is gone in the middle of a request
            data += part
        return data

    def _reply(self, status: int, words: str = "") -> None:
        data = words.encode(errors="replace")
        data = REPLY.pack(status, len(data)) + data
        while data:
            data = data[os.write(self._replies, data) :]


def plain(content: str | bytes) -> tuple[str, bool]:
    """A text as JSON has it, a binary in hexadecimal digits; and whether it is one."""
    return (content.hex(), True) if isinstance(content, bytes) else (content, False)


def watch_parent(requests: int) -> None:  # pragma: no cover - in a process of its own
    """End this process as soon as the parent is gone, also in the middle of an endless loop."""
    if sys.platform == "win32":
        kernel = ctypes.windll.kernel32
        parent = kernel.OpenProcess(0x00100000, False, os.getppid())  # SYNCHRONIZE

        def wait() -> None:
            kernel.WaitForSingleObject(parent, 0xFFFFFFFF)
            os._exit(1)

    else:
        poll = select.poll()
        poll.register(requests, 0)  # nothing but that the other end is closed

        def wait() -> None:
            poll.poll()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    _die_with_starter(0)


def _die_with_starter(signal: int) -> None:  # pragma: no cover - in a process of its own
    """Linux: have the kernel send a signal when the thread that started this process ends; 0 for none."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal)  # PR_SET_PDEATHSIG


def _limit(memory: int) -> None:  # pragma: no cover - in a process of its own
    """Bound what this process may take beyond what it has [bytes]; let crashes write no core files."""
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if memory:
            with suppress(OSError):  # Linux alone tells
                memory += int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


def main(place: str, size: int, memory: int) -> None:  # pragma: no cover - in a process of its own
    """Serve a component over standard input and output, which from now on nobody else has.

    Args:
        place: descriptor or, on Windows, name of the block of memory.
        size: its size [bytes].
        memory: most memory that the component may take [bytes], 0 for any.
    """
    _die_with_starter(9)
    requests, replies = os.dup(0), os.dup(1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    windows: Any = place  # typeshed has one platform's signature at a time
    shared = mmap.mmap(-1, size, windows) if sys.platform == "win32" else mmap.mmap(int(place), size)
    with suppress(EOFError):
        Worker(np.frombuffer(shared), requests, replies, memory).serve()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))

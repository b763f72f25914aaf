"""The process of an isolated component, seen from this side: pipes, shared memory, a watch on every call."""

from __future__ import annotations

import mmap
import os
import signal
import subprocess
import sys
import tempfile
import threading
import uuid
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

import numpy as np

from exlinn_fmi.components import worker
from exlinn_fmi.components.base import Values
from exlinn_fmi.components.waiting import Waiter

POLLS = sys.platform != "win32"
"""Whether a pipe can be waited for; if not, a timer ends the process, which ends the wait as well."""

PATIENCE = 5.0
"""Time that a process has to end once it was told to [s]."""


class LostError(Exception):
    """The process has ended, or had to be ended; the text says how."""


class Process:
    """A process that runs `worker.py`, in a session of its own.

    Args:
        size: size of the shared block [bytes].
        timeout: longest wait for a reply [s].
        memory: most memory that it may take [bytes]; what the machine has if None.

    Attributes:
        block: the shared block as numbers.
        alive: whether it has not ended as far as is known.
        timeout: as given; may be changed.
    """

    def __init__(self, size: int, timeout: float, memory: float | None) -> None:
        self.timeout, self.alive = timeout, True
        self._memory = memory
        shared, place, descriptors = _shared(size)
        self.block: Values = np.frombuffer(shared)
        bound = int(memory if memory is not None else _physical_memory())
        # The same interpreter with the same modules to be found; -P: not those of the working folder.
        paths = os.pathsep.join(str(Path(path).absolute()) for path in sys.path)
        try:
            self._popen = subprocess.Popen(
                [sys.executable, "-P", "-m", worker.__name__, place, str(size), str(bound)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=descriptors,
                start_new_session=True,  # Ctrl-C is for us: we end it in good order
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
                env=os.environ | {"PYTHONPATH": paths},
            )
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        self._requests, self._replies = self._popen.stdin.fileno(), self._popen.stdout.fileno()
        self._how = ""
        others = self.block[worker.OTHERS : worker.OTHERS + 1]
        self._waiter = Waiter(self._replies, others) if POLLS else None
        _running.add(self)
        _tell_number()

    def send(self, data: bytes) -> None:
        """Write a request.

        Raises:
            LostError: the process is not there any more.
        """
        if not self.alive:
            raise LostError(self._how)
        try:
            while data:
                data = data[os.write(self._requests, data) :]
        except OSError:
            self._lose(expired=False)

    def receive(self, size: int) -> bytes:
        """Read that many bytes of a reply.

        Raises:
            LostError: there is no such reply.
        """
        try:
            data, expired = self._read(size)
            while data and len(data) < size:
                part, expired = self._read(size - len(data))
                data = data + part if part else b""
        except BaseException:  # Ctrl-C: the reply would be taken for that to the next request
            self.end()
            raise
        if len(data) < size:
            self._lose(expired)
        return data

    def _read(self, size: int) -> tuple[bytes, bool]:
        """What there is to read, nothing where the process has ended or the time is up; and whether it is."""
        if self._waiter is not None:
            return (os.read(self._replies, size), False) if self._waiter.wait(self.timeout) else (b"", True)
        expired = False

        def expire() -> None:
            nonlocal expired
            expired = True
            self._popen.kill()

        timer = threading.Timer(self.timeout, expire)
        timer.start()
        try:
            return os.read(self._replies, size), expired
        finally:
            timer.cancel()

    def _lose(self, expired: bool) -> NoReturn:
        """Say how the process ended, which it is made to if it has not."""
        self.end()
        code = self._popen.returncode
        limit = "" if self._memory is None else f" (of memory it may take {self._memory / 1e6:.0f} MB)"
        if expired:
            self._how = f"no answer within {self.timeout:g} s, so its process was ended,"
        elif code < 0:
            name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
            hint = ", perhaps for lack of memory" if name == "SIGKILL" else ""
            self._how = f"its process was ended by {name}, {signal.strsignal(-code)}{hint}{limit},"
        else:
            self._how = f"its process ended with exit code {code}{limit}"
        raise LostError(self._how)

    def end(self, patience: float = 0.0) -> None:
        """End the process and all that it started; harmless when called twice.

        Args:
            patience: time to let it end by itself [s].
        """
        if self.alive:
            self.alive = False
            _running.discard(self)
            _tell_number()
            if patience:
                with suppress(subprocess.TimeoutExpired):
                    self._popen.wait(patience)
            if self._popen.returncode is None:
                with suppress(OSError):  # it has ended, but not been waited for: its group may live
                    os.killpg(self._popen.pid, signal.SIGKILL) if POLLS else self._popen.kill()
                self._popen.wait()
            for pipe in (self._popen.stdin, self._popen.stdout):
                assert pipe is not None
                pipe.close()


_running: set[Process] = set()


def _tell_number() -> None:
    """Tell all processes how many there are."""
    for process in tuple(_running):
        process.block[worker.OTHERS] = len(_running)


def _physical_memory() -> float:
    """Memory of this machine [bytes], 0 where that is not known."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return 0.0


def _shared(size: int) -> tuple[mmap.mmap, str, tuple[int, ...]]:
    """A block of memory, how the other process finds it, and descriptors that it must inherit."""
    if sys.platform == "win32":
        name = f"exlinn-{uuid.uuid4()}"
        return mmap.mmap(-1, size, name), name, ()
    if sys.platform == "linux":
        descriptor = os.memfd_create("exlinn", 0)
    else:
        with tempfile.TemporaryFile() as file:  # which has no name
            descriptor = os.dup(file.fileno())
            os.set_inheritable(descriptor, True)
    os.ftruncate(descriptor, size)
    return mmap.mmap(descriptor, size), str(descriptor), (descriptor,)

"""Unpacked archives, kept from run to run: a folder per content, filled once, shared by all that run it.

A folder is filled beside its place and then renamed, so that it is there whole or not at all, however many
runs want it at the same time. Who uses one holds a shared lock on it; what nobody uses is removed when the
cache grows over its bound, the folder longest unused first. A folder that was changed since is filled anew.

`EXLINN_CACHE` names the folder (else it is in the user's cache folder), `EXLINN_CACHE_MB` its bound (else
4000). It may be deleted whenever nothing runs.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from exlinn_fmi.toolchain import cache_folder

CONTENT, LISTING = "content", "files.json"
UNFINISHED = "new-"
"""What folders begin with that are being filled or removed, or are one user's alone."""
SETTLED = 60.0
"""Age [s] from which an unfinished folder that nobody has locked is left over from a run that was killed."""

_open: dict[Path, _Hold] = {}
_guard = threading.RLock()  # a lease may be given back by the garbage collector, at any point


@dataclass
class _Hold:
    """A folder in use by this process: the descriptor with the lock, and how many leases there are."""

    lock: int
    users: int = 0


class Lease:
    """A folder in use until `release`, which is harmless when called twice.

    Args:
        folder: with the unpacked files, which are not to be changed.
        release: gives it back.
    """

    def __init__(self, folder: Path, release: Callable[[], None]) -> None:
        self.folder = folder
        self._release: Callable[[], None] | None = release

    def release(self) -> None:
        """Give the folder back."""
        release, self._release = self._release, None
        if release is not None:
            release()


def lease(key: str, fill: Callable[[Path], None], alone: bool = False) -> Lease:
    """The folder of a content, filled if it is not there yet.

    Args:
        key: hash of the content, and of all else that decides what is in the folder.
        fill: puts the files into an empty folder.
        alone: whether this process may have the folder once only: another lease gets a folder of its own.

    Raises:
        OSError: there is no room for it.
    """
    root = _root()
    entry = root / key
    with _guard:
        hold = _open.get(entry) or _hold(entry, fill)
        if hold is not None and not (alone and hold.users):
            hold.users += 1
            _open[entry] = hold
            return Lease(entry / CONTENT, lambda: _leave(entry))
    folder, lock = _filled(root, fill)
    return Lease(folder / CONTENT, lambda: _remove(folder, lock))


def _root() -> Path:
    """The cache, or the folder for temporary files where there can be none."""
    with suppress(OSError, RuntimeError):
        root = cache_folder()
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        if os.access(root, os.W_OK):
            return root
    return Path(tempfile.gettempdir())


def _leave(entry: Path) -> None:
    """One user less."""
    with _guard:
        hold = _open[entry]
        hold.users -= 1
        if not hold.users:
            _unlock(_open.pop(entry).lock)


# ── folders ──────────────────────────────────────────────────────────────────────────────────────────────


def _hold(entry: Path, fill: Callable[[Path], None]) -> _Hold | None:
    """Lock a folder, filled first where it is missing; None where others use it and it was changed."""
    lock = _take(entry)
    if lock is None and not entry.exists():
        folder, lock = _filled(entry.parent, fill)
        try:
            folder.rename(entry)
        except OSError:  # another run was faster
            _remove(folder, lock)
            lock = _take(entry)
        else:
            _trim(entry.parent)
    return None if lock is None else _Hold(lock)


def _take(entry: Path) -> int | None:
    """The lock on a folder if it is there and unchanged; a changed one that nobody uses is removed."""
    lock = _lock(entry)
    if lock is None:
        return None
    with suppress(OSError, ValueError, KeyError):
        listed = json.loads((entry / LISTING).read_text(encoding="utf-8"))["files"]
        if listed == _files(entry / CONTENT):
            os.utime(entry)  # for the order in which folders are removed
            return lock
    _unlock(lock)
    _evict(entry)
    return None


def _filled(root: Path, fill: Callable[[Path], None]) -> tuple[Path, int]:
    """A new folder with its lock, not in its place yet."""
    folder = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=root))
    lock = _lock(folder)
    assert lock is not None
    try:
        (folder / CONTENT).mkdir(mode=0o700)
        fill(folder / CONTENT)
        files = _files(folder / CONTENT)
        listing = {"bytes": sum(size for size, _ in files.values()), "files": files}
        (folder / LISTING).write_text(json.dumps(listing), encoding="utf-8")
    except BaseException:
        _remove(folder, lock)
        raise
    return folder, lock


def _files(content: Path) -> dict[str, list[int]]:
    """Size [bytes] and time of change [ns] of every file: what tells that a folder is as it was filled."""
    found = {}
    for place, _, names in os.walk(content):
        for file in (Path(place, name) for name in names):
            stat = file.stat()
            found[file.relative_to(content).as_posix()] = [stat.st_size, stat.st_mtime_ns]
    return found


def _trim(root: Path) -> None:
    """Remove what killed runs have left, and folders longest unused until the rest is within the bound."""
    bound, sizes = float(os.environ.get("EXLINN_CACHE_MB") or 4000) * 1e6, {}
    for folder in sorted(root.iterdir(), key=lambda f: -f.lstat().st_mtime):
        with suppress(OSError, ValueError, KeyError):
            if folder.name.startswith(UNFINISHED):
                if time.time() - folder.stat().st_mtime > SETTLED:
                    _evict(folder)
            elif (folder / LISTING).is_file():
                sizes[folder] = json.loads((folder / LISTING).read_text(encoding="utf-8"))["bytes"]
                if sum(sizes.values()) > bound and _evict(folder):
                    del sizes[folder]


def _evict(folder: Path) -> bool:
    """Remove a folder if nobody uses it."""
    lock = _lock(folder, exclusive=True)
    if lock is None:
        return False
    try:
        doomed = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder.parent))
        folder.rename(doomed / "old")  # at once for all others; Windows refuses it while files are in use
        shutil.rmtree(doomed, ignore_errors=True)
        return True
    except OSError:
        doomed.rmdir()
        return False
    finally:
        _unlock(lock)


def _remove(folder: Path, lock: int) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    _unlock(lock)


# ── locks ────────────────────────────────────────────────────────────────────────────────────────────────

if sys.platform == "win32":  # pragma: no cover - files of a loaded library cannot be moved there: a lock

    def _lock(folder: Path, exclusive: bool = False) -> int | None:
        return 0 if folder.is_dir() else None

    def _unlock(lock: int) -> None: ...

else:
    import fcntl

    def _lock(folder: Path, exclusive: bool = False) -> int | None:
        """A lock on a folder; None where it is gone or, for an exclusive one, in use."""
        descriptor = None
        with suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB if exclusive else fcntl.LOCK_SH)
            if os.path.samestat(os.fstat(descriptor), folder.lstat()):
                return descriptor
        if descriptor is not None:
            os.close(descriptor)
        return None

    def _unlock(lock: int) -> None:
        os.close(lock)

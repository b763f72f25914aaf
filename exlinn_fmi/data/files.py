"""Results on disk: every file appears whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from exlinn_fmi.errors import DataError, StorageError


@contextmanager
def whole(*paths: Path) -> Iterator[list[Path]]:
    """Paths to write to instead of `paths`; the files come into place together when the block ends well.

    The stand-ins lie in the same folder and keep the suffix. If the block fails they are removed and what was
    there before stays. Missing folders are made.

    Args:
        paths: the files to write.

    Raises:
        StorageError: the disk is full, a folder is read-only, …: names the file and the cause.
    """
    token = secrets.token_hex(4)
    stand_ins = [path.with_name(f".{token}.{path.name}") for path in paths]
    try:
        for path in paths:
            path.parent.mkdir(parents=True, exist_ok=True)
        yield stand_ins
        for stand_in in stand_ins:
            _flush(stand_in)
        for path, stand_in in zip(paths, stand_ins, strict=True):
            stand_in.replace(path)
    except OSError as error:
        first = error
        while isinstance(first.__context__, OSError):  # what is closed after it may fail as well
            first = first.__context__
        raise StorageError(_explain(_concerned(first, paths, stand_ins), first)) from error
    finally:
        for stand_in in stand_ins:
            _discard(stand_in)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file.

    Raises:
        StorageError: it could not be written.
    """
    with whole(path) as (stand_in,):
        stand_in.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    r"""Write a text file in UTF-8 with \n at line ends.

    Raises:
        StorageError: it could not be written.
    """
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, content: object) -> None:
    """Write a JSON file; numbers that are not finite become null, numpy values plain ones.

    Raises:
        StorageError: it could not be written.
    """
    text = json.dumps(_plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file that a run wrote.

    Raises:
        DataError: it is not there or is no JSON.
    """
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read ({one_line(error)}); make it again or remove it") from error


def read_record(path: Path) -> dict[str, Any]:
    """Read a JSON object that a run wrote, empty where there is none.

    Raises:
        DataError: it is no JSON object.
    """
    if not path.is_file():
        return {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise DataError(f"{path}: found {type(content).__name__} where a JSON object is expected; remove it")
    return content


def file_hash(path: Path) -> str:
    """SHA-256 of a file's content in hexadecimal; computed anew only where the file has changed since.

    Raises:
        DataError: it cannot be read.
    """
    try:
        at = path.stat()
        return _hash_of(path, (at.st_mtime_ns, at.st_size, at.st_ino))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error


@lru_cache(maxsize=1024)
def _hash_of(path: Path, stamp: tuple[int, int, int]) -> str:
    """The hash of a file as it was when it had this stamp."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# ── JSON ─────────────────────────────────────────────────────────────────────────────────────────────────


def _plain(value: object) -> object:
    """`value` in JSON's own types."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    return value


# ── storage ──────────────────────────────────────────────────────────────────────────────────────────────


def _flush(file: Path) -> None:
    """Have the system write a file out, which is when a full or broken disk is noticed at the latest."""
    with named(file), file.open("rb+") as stream:
        os.fsync(stream.fileno())


@contextmanager
def named(file: Path) -> Iterator[None]:
    """Errors of the system that do not say so are about this file."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(file)
        raise


def _discard(stand_in: Path) -> None:
    """Remove a stand-in if it is still there, whatever state the disk is in."""
    try:
        stand_in.unlink(missing_ok=True)
    except OSError:
        return


def _concerned(error: OSError, paths: tuple[Path, ...], stand_ins: list[Path]) -> Path:
    """The file that was meant: the one that the error names, else the last one that was begun."""
    pairs = list(zip(paths, stand_ins, strict=True))
    named = [path for path, stand_in in pairs if error.filename == str(stand_in)]
    begun = [path for path, stand_in in pairs if stand_in.exists()]
    return (named or begun or list(paths[:1]))[-1]


def _explain(path: Path, error: OSError) -> str:
    """What could not be written, why, and what to do."""
    advice = {
        errno.ENOSPC: "free some space there",
        errno.EDQUOT: "free some space there",
        errno.EACCES: "check the permissions and close programs that hold the file open",
        errno.EPERM: "check the permissions and close programs that hold the file open",
        errno.EROFS: "make the disk writable",
        errno.ENOTDIR: "remove the file that stands where a folder should be",
        errno.EEXIST: "remove the file that stands where a folder should be",
        errno.EISDIR: "remove the folder of that name",
    }.get(error.errno or 0, "check the disk")
    cause = error.strerror or one_line(error)
    return f"{path}: could not be written ({cause}); {advice}, or choose another folder"


def one_line(error: Exception) -> str:
    """An error's text on one line."""
    return " ".join(str(error).split())

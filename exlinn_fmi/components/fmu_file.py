"""FMU files: what is in one, checked before any of its code is loaded, and unpacking it.

An FMU comes from outside, so nothing in it is believed: names in the archive, sizes, the XML and the model
identifier are checked here; what the model description says is in `fmu_description`.
"""

from __future__ import annotations

import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import fmpy

from exlinn_fmi.components.fmu_description import FmuDescription, describe
from exlinn_fmi.errors import FmuError, StorageError, nearest

DESCRIPTION = "modelDescription.xml"
LARGEST_DESCRIPTION = 256 * 2**20
"""Bytes of XML that are read at most: a compressed file of 1 MB can unpack to gigabytes."""

LARGEST_HARMLESS = 2**30
"""Bytes that an FMU may unpack to however small it is; beyond, a hundredfold growth is an attack."""

_UNREADABLE = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)
"""What zipfile raises for damaged, encrypted and unknown contents."""


def read_description(path: Path) -> FmuDescription:
    """Read an FMU's model description; nothing is unpacked or loaded.

    Raises:
        FmuError: the file is missing or damaged, or no FMI 2.0 or 3.0 FMU for Co-Simulation.
    """
    with _archive(path) as archive:
        root = _xml_root(path, _read_xml(path, archive))
    version = root.get("fmiVersion", "")
    if root.tag != "fmiModelDescription" or not version:
        raise FmuError(f"{path}: {DESCRIPTION} begins with <{root.tag}>, expected <fmiModelDescription>")
    if version != "2.0" and not re.match(r"3\.\d", version):
        raise FmuError(
            f"{path}: FMI version {version}; expected 2.0 or 3.0: export it again for one of these"
        )
    kinds = [kind for kind in ("ModelExchange", "ScheduledExecution") if root.find(kind) is not None]
    if root.find("CoSimulation") is None:
        found = f"it is for {' and '.join(kinds)} only" if kinds else "it names no kind of use"
        raise FmuError(f"{path}: no Co-Simulation: {found}; export it again for Co-Simulation")
    try:
        return describe(path, fmpy.read_model_description(str(path), validate=False))
    except FmuError:
        raise
    except Exception as error:  # FMPy reads what follows the schema; all else fails somewhere in it
        raise FmuError(
            f"{path}: {DESCRIPTION} does not follow FMI {version}: {_schema_problems(path, error)}"
        ) from error


def check_runnable(description: FmuDescription) -> None:
    """Refuse an FMU without a binary for this platform; nothing is unpacked or loaded.

    Raises:
        FmuError: says which platforms it has binaries for, and what to do.
    """
    with _archive(description.path) as archive:
        _check_binary(description, archive.namelist())


def unpack(description: FmuDescription) -> Path:
    """Unpack an FMU into a new temporary folder, less sources, documentation and other platforms' binaries.

    Returns:
        The folder, which is the caller's to remove.

    Raises:
        FmuError: it has no binary for this platform, or is damaged.
        StorageError: it does not fit on the disk.
    """
    check_runnable(description)
    path = description.path
    own = f"binaries/{description.platform}/"
    with _archive(path) as archive:
        wanted = [
            info
            for info in archive.infolist()
            if not info.filename.startswith(("sources/", "documentation/", "binaries/"))
            or info.filename.startswith(own)
        ]
        folder = Path(tempfile.mkdtemp(prefix="exlinn-fmu-"))
        try:
            size, free = sum(info.file_size for info in wanted), shutil.disk_usage(folder).free
            if size > LARGEST_HARMLESS and size > 100 * path.stat().st_size:
                raise FmuError(
                    f"{path}: {path.stat().st_size / 1e6:.1f} MB that unpack to {size / 1e6:.0f} MB: "
                    "this is a zip bomb or a mistake; it is not unpacked"
                )
            if size > free:
                raise StorageError(
                    f"{path}: unpacked it takes {size / 1e6:.0f} MB, but {folder.parent} has only "
                    f"{free / 1e6:.0f} MB free"
                )
            archive.extractall(folder, wanted)
            _check_whole(description, folder)
        except BaseException as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, OSError):
                raise StorageError(f"{path}: cannot be unpacked to {folder.parent}: {error}") from error
            raise
    return folder


# ── the archive ──────────────────────────────────────────────────────────────────────────────────────────


@contextmanager
def _archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """The FMU as a zip archive whose names have been checked.

    Raises:
        FmuError: it cannot be read, also where that shows only while it is used.
    """
    if not path.is_file():
        what = "is a folder, expected an .fmu file" if path.is_dir() else "no such file"
        beside = [p.name for p in path.parent.glob("*.fmu")] if path.parent.is_dir() else []
        raise FmuError(f"{path}: {what}; {nearest(path.name, beside, 'FMUs there')}")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_names(path, archive.namelist())
            yield archive
    except _UNREADABLE as error:
        with path.open("rb") as file:
            is_zip = file.read(2) == b"PK"
        what = "the zip archive is damaged or cut short" if is_zip else "not a zip archive, as every FMU is"
        size = path.stat().st_size
        raise FmuError(f"{path}: {what} ({size} bytes; {error}); copy or export it again") from error
    except OSError as error:
        raise FmuError(f"{path}: cannot be read: {error.strerror or error}") from error


def _check_names(path: Path, names: Sequence[str]) -> None:
    """Refuse archives whose members would land outside the folder or on one another."""
    seen: set[str] = set()
    for name in names:
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or "\\" in name or ":" in name:
            raise FmuError(f"{path}: the archive holds {name!r}, which would be written outside its folder")
        if str(parts) in seen:
            raise FmuError(f"{path}: the archive holds {name!r} twice; export it again")
        seen.add(str(parts))


def _read_xml(path: Path, archive: zipfile.ZipFile) -> bytes:
    """The bytes of the model description."""
    names = archive.namelist()
    if DESCRIPTION not in names:
        deeper = next((n for n in names if n.endswith(f"/{DESCRIPTION}")), None)
        hint = f"it lies in {deeper!r}: zip the folder's contents, not the folder" if deeper else "no FMU"
        raise FmuError(f"{path}: no {DESCRIPTION} at the top of the archive; {hint}")
    size = archive.getinfo(DESCRIPTION).file_size
    if size > LARGEST_DESCRIPTION:
        raise FmuError(
            f"{path}: {DESCRIPTION} is {size / 2**20:.0f} MiB, expected at most "
            f"{LARGEST_DESCRIPTION / 2**20:.0f} MiB"
        )
    return archive.read(DESCRIPTION)


def _xml_root(path: Path, data: bytes) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # also encodings that are unknown
        raise FmuError(f"{path}: {DESCRIPTION} is no well-formed XML: {error}") from error


def _schema_problems(path: Path, error: Exception) -> str:
    """The first problems that the FMI schema finds, or else FMPy's own error."""
    try:
        fmpy.read_model_description(str(path), validate=True)
    except fmpy.model_description.ValidationError as invalid:
        return "; ".join(str(problem) for problem in invalid.problems[:3])
    except Exception as other:
        return f"{type(other).__name__}: {other}"
    return f"{type(error).__name__}: {error}"


def _check_binary(description: FmuDescription, names: Sequence[str]) -> None:
    """Refuse an FMU without a binary for this platform.

    Raises:
        FmuError: says which there are, and what to do.
    """
    path, platform = description.path, description.platform
    library = f"{description.identifier}{fmpy.sharedLibraryExtension}"
    if f"binaries/{platform}/{library}" in names:
        return
    files = [PurePosixPath(n).parts for n in names if n.startswith("binaries/") and not n.endswith("/")]
    platforms = sorted({parts[1] for parts in files if len(parts) > 2})
    if platform in platforms:
        here = ", ".join(sorted(parts[-1] for parts in files if parts[1] == platform))
        raise FmuError(f"{path}: binaries/{platform} has no {library} (found: {here}); export it again")
    sources = any(n.startswith("sources/") and n.endswith(".c") for n in names)
    build = f", or build the sources in it: fmpy compile {path.name}" if sources else ""
    raise FmuError(
        f"{path}: no binary for {platform} in it (found: {', '.join(platforms) or 'none'}); "
        f"export it again for {platform}{build}"
    )


def _check_whole(description: FmuDescription, folder: Path) -> None:
    """Refuse an ELF binary that lacks part of a segment: the loader would not refuse it, but crash on it."""
    library = folder / "binaries" / description.platform / description.identifier
    data = library.with_name(f"{library.name}{fmpy.sharedLibraryExtension}").read_bytes()
    if data[:6] != b"\x7fELF\x02\x01" or len(data) < 64:
        return  # not a 64-bit ELF file: whatever it is, the loader says so
    (table,) = struct.unpack_from("<Q", data, 32)
    entry, count = struct.unpack_from("<HH", data, 54)
    segments = range(table, table + entry * count, max(entry, 1))
    ends = [sum(struct.unpack_from("<Q16xQ", data, k + 8)) for k in segments if k + 40 <= len(data)]
    if len(ends) < count or max(ends, default=0) > len(data):
        raise FmuError(
            f"{description.path}: the binary for {description.platform} is cut short at {len(data)} bytes; "
            "copy or export the FMU again"
        )

"""FMU files: what is in one, checked before any of its code is loaded, and unpacking it.

An FMU comes from outside, so nothing in it is believed: names in the archive, sizes, the XML and the model
identifier are checked here; what the model description says is in `fmu_description`.
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path, PurePosixPath

import fmpy

from exlinn_fmi.components.archive import extract, open_archive, parse_xml, read_member
from exlinn_fmi.components.cache import Lease, lease
from exlinn_fmi.components.fmu_description import FmuDescription, describe
from exlinn_fmi.components.fmu_interfaces import Kind
from exlinn_fmi.errors import FmuError, StorageError

DESCRIPTION = "modelDescription.xml"
UNUSED = ("sources/", "documentation/", "binaries/")
"""Folders of an FMU that are not unpacked, but for the binaries of this machine."""

LARGEST_EXPLAINED = 2**20
"""Bytes of XML that are validated to explain what is wrong: the time grows with the square of the size."""


def read_description(
    path: Path, kind: Kind | None = None, structure: Mapping[str, float] | None = None
) -> FmuDescription:
    """Read an FMU's model description; nothing is unpacked or loaded.

    Args:
        path: the file.
        kind: how the FMU is to be used; Co-Simulation if it can, else Model Exchange, if not given.
        structure: values of structural parameters by name, which decide on the sizes of arrays.

    Raises:
        FmuError: the file is missing or damaged, or no FMU that can be used like that.
    """
    stamp = path.stat() if path.is_file() else None
    sizes = tuple(sorted((structure or {}).items()))
    return _read_description(path, stamp and (stamp.st_mtime_ns, stamp.st_size), kind, sizes)


@lru_cache(maxsize=8)
def _read_description(
    path: Path, stamp: tuple[int, int] | None, kind: Kind | None, structure: tuple[tuple[str, float], ...]
) -> FmuDescription:
    """A large description takes seconds, and is asked for by the checks and again by the run."""
    with open_archive(path) as archive:
        data = read_member(path, archive, DESCRIPTION)
    root = parse_xml(f"{path}: {DESCRIPTION}", data)
    version = root.get("fmiVersion", "")
    if root.tag != "fmiModelDescription" or not version:
        raise FmuError(f"{path}: {DESCRIPTION} begins with <{root.tag}>, expected <fmiModelDescription>")
    if version not in ("1.0", "2.0") and not re.match(r"3\.\d", version):
        raise FmuError(
            f"{path}: FMI version {version}; expected 1.0, 2.0 or 3.0: export it again for one of these"
        )
    try:
        model = fmpy.read_model_description(str(path), validate=False)
        return describe(path, model, root, kind, dict(structure))
    except FmuError:
        raise
    except Exception as error:  # FMPy reads what follows the schema; all else fails somewhere in it
        raise FmuError(
            f"{path}: {DESCRIPTION} does not follow FMI {version}: {_schema_problems(path, len(data), error)}"
        ) from error


def check_runnable(description: FmuDescription) -> None:
    """Refuse an FMU without a binary for this platform; nothing is unpacked or loaded.

    Raises:
        FmuError: says which platforms it has binaries for, and what to do.
    """
    with open_archive(description.path) as archive:
        _check_binary(description, archive.namelist())


def unpack(description: FmuDescription) -> Lease:
    """Unpack an FMU into the cache, less sources, documentation and other platforms' binaries.

    Returns:
        The folder, in use until it is released. An FMU that may be instantiated once per process gets another
        folder each time, so that its binary is loaded anew.

    Raises:
        FmuError: it has no binary for this platform, is damaged or means harm.
        StorageError: it does not fit on the disk.
    """
    check_runnable(description)
    path, own = description.path, f"binaries/{description.platform}/"

    def fill(folder: Path) -> None:
        with open_archive(path) as archive:
            extract(path, archive, folder, lambda name: not name.startswith(UNUSED) or name.startswith(own))
        _check_whole(description, folder)

    try:
        with path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").hexdigest()
        return lease(f"{content[:32]}-{description.platform}", fill, alone=description.interface.once)
    except OSError as error:
        raise StorageError(f"{path}: cannot be unpacked: {error}") from error


# ── checks ───────────────────────────────────────────────────────────────────────────────────────────────


def _schema_problems(path: Path, size: int, error: Exception) -> str:
    """The first problems that the FMI schema finds, or else FMPy's own error."""
    if size <= LARGEST_EXPLAINED:
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

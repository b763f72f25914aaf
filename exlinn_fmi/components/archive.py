"""Zip archives from outside, of FMUs and of systems of them: nothing in one is believed unchecked."""

from __future__ import annotations

import lzma
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

from exlinn_fmi.errors import FmuError, StorageError, nearest

MOST_MEMBERS = 100_000
"""Members of an archive; FMUs that bring an interpreter along have tens of thousands."""

LARGEST_HARMLESS = 2**30
"""Bytes that an archive may unpack to however small it is; beyond, a hundredfold growth is an attack."""

LARGEST = 32 * 2**30
"""Bytes that an archive may unpack to at all."""

LARGEST_XML = 256 * 2**20
"""Bytes of XML that are read at most: a compressed file of 1 MB can unpack to gigabytes."""

_UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    ValueError,
    OverflowError,
    RuntimeError,
)
"""What zipfile raises for damaged, encrypted and unknown contents."""


class _DocumentTypeError(Exception):
    """An XML file defines a document type."""


class _Plain(ElementTree.TreeBuilder):
    """Builds trees of XML without document types."""

    def doctype(self, name: str, *_: object) -> None:
        """Called as soon as one begins."""
        raise _DocumentTypeError(name)


@contextmanager
def open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """An archive whose members have been checked.

    Raises:
        FmuError: it cannot be read, also where that shows only while it is used, or means harm.
    """
    kind = path.suffix.removeprefix(".").upper() or "FMU"
    if not path.is_file():
        what = f"is a folder, expected an .{kind.lower()} file" if path.is_dir() else "no such file"
        beside = [p.name for p in path.parent.glob(f"*{path.suffix}")] if path.parent.is_dir() else []
        raise FmuError(f"{path}: {what}; {nearest(path.name, beside, f'{kind}s there')}")
    try:
        try:
            archive = zipfile.ZipFile(path)
        except OSError as error:
            raise FmuError(f"{path}: cannot be read: {error.strerror or error}") from error
        with archive:
            _check_members(path, archive.infolist())
            yield archive
    except _UNREADABLE as error:
        with path.open("rb") as file:
            is_zip = file.read(2) == b"PK"
        what = (
            "the zip archive is damaged or cut short" if is_zip else f"not a zip archive, as every {kind} is"
        )
        size = path.stat().st_size
        raise FmuError(f"{path}: {what} ({size} bytes; {error}); copy or export it again") from error


def read_member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """The bytes of an XML file in an archive.

    Raises:
        FmuError: there is none of that name at the top, or it is too large.
        BadZipFile: the archive is damaged; `open_archive` tells it.
    """
    names = archive.namelist()
    if name not in names:
        deeper = next((n for n in names if n.endswith(f"/{name}")), None)
        hint = f"it lies in {deeper!r}: zip the folder's contents, not the folder" if deeper else "no FMU"
        raise FmuError(f"{path}: no {name} at the top of the archive; {hint}")
    size = archive.getinfo(name).file_size
    if size > LARGEST_XML:
        raise FmuError(
            f"{path}: {name} is {size / 2**20:.0f} MiB, expected at most {LARGEST_XML / 2**20:.0f} MiB"
        )
    try:
        return archive.read(name)
    except OSError as error:  # places in the file that there cannot be
        raise zipfile.BadZipFile(str(error)) from error


def parse_xml(where: str, data: bytes) -> ElementTree.Element:
    """The root element; document types, which could define entities that grow or read files, are refused.

    Args:
        where: file, for the message.
        data: the XML.

    Raises:
        FmuError: it is not well formed, or has a document type.
    """
    try:
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_Plain()))
    except _DocumentTypeError as error:
        raise FmuError(f"{where}: it defines a document type ({error}), which has no place in it") from None
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # also encodings that are unknown
        raise FmuError(f"{where}: no well-formed XML: {error}") from error


def extract(path: Path, archive: zipfile.ZipFile, folder: Path, wanted: Callable[[str], bool]) -> None:
    """Write the members wanted into a folder, links and the like refused.

    Raises:
        FmuError: what is wanted means harm.
        StorageError: it does not fit on the disk.
    """
    members = [info for info in archive.infolist() if wanted(info.filename)]
    for info in members:
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            what = "a link" if kind == stat.S_IFLNK else "no file"
            raise FmuError(f"{path}: {info.filename!r} in it is {what}; put the file itself into the archive")
    size, free = sum(info.file_size for info in members), shutil.disk_usage(folder).free
    packed = path.stat().st_size
    if size > LARGEST or (size > LARGEST_HARMLESS and size > 100 * packed):
        raise FmuError(
            f"{path}: {packed / 1e6:.1f} MB that unpack to {size / 1e6:.0f} MB: "
            "this is a zip bomb or a mistake; it is not unpacked"
        )
    if size > free:
        raise StorageError(
            f"{path}: unpacked it takes {size / 1e6:.0f} MB, but {folder.parent} has only "
            f"{free / 1e6:.0f} MB free"
        )
    archive.extractall(folder, members)


def _check_members(path: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """Refuse archives whose members would land outside the folder, on one another, or are too many.

    Raises:
        FmuError: names the first such member.
    """
    if len(members) > MOST_MEMBERS:
        raise FmuError(f"{path}: the archive has {len(members)} members, expected at most {MOST_MEMBERS}")
    files, folders = set[PurePosixPath](), set[PurePosixPath]()
    for info in members:
        name = info.filename
        parts = PurePosixPath(name.replace("\\", "/"))
        if parts.is_absolute() or ".." in parts.parts or ":" in name:
            raise FmuError(f"{path}: the archive holds {name!r}, which would be written outside its folder")
        if "\\" in name:
            raise FmuError(
                f"{path}: the archive holds {name!r}, and names in archives take '/': zip it again, or "
                "export it with a newer version of its tool"
            )
        if not name.isprintable():
            raise FmuError(f"{path}: the archive holds {name!r}, which is no file name")
        if parts in files or (parts in folders and not info.is_dir()):
            raise FmuError(f"{path}: the archive holds {name!r} twice; export it again")
        if info.is_dir():
            folders.add(parts)
        else:
            files.add(parts)
        folders.update(parts.parents)
    if both := files & folders:
        raise FmuError(f"{path}: the archive holds {min(both).as_posix()!r} as a file and as a folder")

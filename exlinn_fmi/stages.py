"""Which stages of a run folder are done, told by content: an unchanged stage is not run again.

A stage's key is a hash of everything that its result depends on: settings, files, the stage before and this
package's own code. Its entry in ``stages.json`` also holds the hashes of what it wrote, so that a file that
was changed or removed since brings the stage back.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from exlinn_fmi.data.files import file_hash, read_record, write_json


@cache
def code_hash() -> str:
    """Hash of this package's source files."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    """A settings model as plain data."""
    return value.model_dump(mode="json") if hasattr(value, "model_dump") else str(value)


def fingerprint(*parts: Any, files: Iterable[Path] = ()) -> str:
    """Hash of settings (models, numbers, texts, lists of them), of files and of this package's code."""
    content = [parts, [file_hash(path) for path in files], code_hash()]
    return hashlib.sha256(json.dumps(content, default=_plain, sort_keys=True).encode()).hexdigest()


class Stages:
    """The record ``stages.json`` of a run folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file = folder / "stages.json"
        self._entries: dict[str, dict[str, Any]] = read_record(self._file)

    def key(self, stage: str) -> str | None:
        """Key under which a stage was done last, None if it was not."""
        entry = self._entries.get(stage)
        return entry["key"] if entry else None

    def holds(self, stage: str, key: str) -> bool:
        """Whether a stage was done under this key and all that it wrote is still as it was."""
        entry = self._entries.get(stage)
        return (
            entry is not None
            and entry["key"] == key
            and all(
                (self.folder / name).exists() and file_hash(self.folder / name) == digest
                for name, digest in entry["files"].items()
            )
        )

    def record(self, stage: str, key: str, written: Iterable[Path], seconds: float) -> None:
        """Note that a stage is done and what it wrote."""
        files = {path.name: file_hash(path) for path in written}
        self._entries[stage] = {"key": key, "seconds": round(seconds, 3), "files": files}
        write_json(self._file, self._entries)

    def forget(self, stage: str) -> None:
        """Note that a stage is not done, so that it runs again next time."""
        if self._entries.pop(stage, None) is not None:
            write_json(self._file, self._entries)

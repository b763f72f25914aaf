"""A run on disk: rows in a file that grows, and checkpoints that a killed run goes on from.

`rows.f64` holds rows of float64 one after the other; `checkpoint.json` the whole state at one tick, how many
rows there were then, and which run it is of. It is replaced as a whole, after the rows that it counts are on
the disk: whenever the run is killed, the two fit together.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.packing import pack, unpack
from exlinn_fmi.errors import InputError, StorageError

Rows = NDArray[np.float64]

BLOCK = 2**24
"""Bytes of rows that are in memory at a time."""

FULL_FRAME, THINNED_FRAME = 2**29, 2**26
"""Bytes of rows beyond which a run is kept on disk, and of the n-th rows that are put into a frame then."""


class RowFile:
    """Rows of float64 in a file.

    Args:
        path: the file.
        columns: number of columns.
        keep: whether to go on with the rows that are there; else it begins empty.

    Attributes:
        rows: how many there are.

    Raises:
        StorageError: it cannot be written.
    """

    def __init__(self, path: Path, columns: int, keep: bool = False) -> None:
        self.path, self.columns, self.rows = path, columns, 0
        with _explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            if keep and path.exists():
                self.rows = path.stat().st_size // (8 * columns)
            else:
                path.write_bytes(b"")

    @property
    def block(self) -> int:
        """Rows that are best written and read in one go."""
        return max(1024, BLOCK // (8 * self.columns))

    def cut(self, rows: int) -> None:
        """Forget all rows after the first so many."""
        os.truncate(self.path, 8 * self.columns * rows)
        self.rows = rows

    def append(self, rows: Rows) -> None:
        """Add rows.

        Raises:
            StorageError: the disk is full, …
        """
        with _explained(self.path):
            try:
                with self.path.open("ab") as stream:
                    stream.write(rows.tobytes())
            except OSError:
                self.cut(self.rows)  # part of them may be there
                raise
        self.rows += len(rows)

    def sync(self) -> None:
        """Have all rows on the disk."""
        with _explained(self.path), self.path.open("rb+") as stream:
            os.fsync(stream.fileno())

    def blocks(self) -> Iterator[Rows]:
        """All rows, some at a time."""
        with self.path.open("rb") as stream:
            while data := stream.read(8 * self.columns * self.block):
                yield np.frombuffer(data).reshape(-1, self.columns)

    def thinned(self) -> Rows:
        """Every n-th row, so that they take little memory; all of them if they fit well."""
        size = 8 * self.columns * self.rows
        every = 1 if size <= FULL_FRAME else -(-size // THINNED_FRAME)
        parts, first = [np.empty((0, self.columns))], 0
        for block in self.blocks():
            parts.append(block[-first % every :: every].copy())  # a view would keep all of the block
            first += len(block)
        return np.concatenate(parts)


class Store:
    """Where a run keeps rows and checkpoints.

    Args:
        folder: made as needed.
        every: wall time between two checkpoints [s]; without it there are none.
        key: of the run; a checkpoint of another run is refused.
        resume: whether to go on from the checkpoint there.
        always: whether rows are kept here also if they fit into memory well and there are no checkpoints.
    """

    def __init__(
        self,
        folder: Path,
        every: float | None = None,
        key: str = "",
        resume: bool = False,
        always: bool = False,
    ) -> None:
        self.folder, self.every, self.key, self.resume = folder, every, key, resume
        self._always = always or resume or every is not None

    @property
    def _file(self) -> Path:
        return self.folder / "checkpoint.json"

    def row_file(self, rows: int, columns: int) -> RowFile | None:
        """The file for so many rows; None where they stay in memory."""
        if not self._always and 8 * rows * columns <= FULL_FRAME:
            return None
        return RowFile(self.folder / "rows.f64", columns, keep=self.resume)

    def save(self, state: Mapping[str, Any], rows: RowFile) -> None:
        """Write a checkpoint.

        Raises:
            NotImplementedError: something in it cannot be written.
            StorageError: the disk is full, …
        """
        data = pack({"key": self.key, "rows": rows.rows, **state})
        rows.sync()
        beside = self._file.with_suffix(".new")
        with _explained(self._file):
            with beside.open("wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            beside.replace(self._file)

    def load(self) -> dict[str, Any]:
        """The last checkpoint.

        Raises:
            InputError: there is none, it is damaged, or it is of another run.
        """
        try:
            state: dict[str, Any] = unpack(self._file.read_bytes())
            key = state["key"]
        except FileNotFoundError:
            raise InputError(
                f"{self.folder}: there is no checkpoint to go on from; say `checkpoint: 60` in `simulate` "
                "for one each minute, and run without --resume"
            ) from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{self._file}: cannot be read ({error}); run without --resume") from error
        if key != self.key:
            raise InputError(
                f"{self._file}: is of a run with other settings, files or another version of exlinn; run "
                "without --resume, or with what it was begun with"
            )
        return state


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn errors of the system into one that names the file."""
    try:
        yield
    except OSError as error:
        cause = error.strerror or error
        raise StorageError(f"{path}: could not be written ({cause}); free some space there") from error

"""Tables on disk, which read back to the last bit.

A table is three files: ``stem.csv`` (for people and other tools), ``stem.parquet`` (fast, units inside) and
``stem.meta.json`` (units beside the CSV). The CSV has one header line, plain numbers in the shortest form
that reads back as the same float64, booleans as 0/1, ``nan``/``inf`` where a value is not finite, no blanks
and no comment lines; names that hold a comma are quoted. FMPy, OMSimulator and pandas read it. Of recorded
texts ``stem.texts.csv`` tells when they changed; the Parquet file has them in columns.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from exlinn_fmi.data.files import named, one_line, read_json, whole
from exlinn_fmi.errors import DataError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

UNIT = b"unit"
"""Key of the unit in the metadata of a Parquet field."""


def write_table(stem: Path, frame: pd.DataFrame, units: Mapping[str, str]) -> list[Path]:
    """Write ``stem.csv``, ``stem.parquet`` and ``stem.meta.json``; the index of the frame is left out.

    Args:
        stem: path without suffix.
        frame: columns of numbers, booleans or text; names are unique.
        units: unit by column name; columns without one may be left out.

    Returns:
        The paths of the three files.

    Raises:
        StorageError: one of the files could not be written; none is replaced then.
    """
    return _write_tables(stem, [frame], units, texts_apart=False)


def write_rows(stem: Path, frames: Iterable[pd.DataFrame], units: Mapping[str, str]) -> list[Path]:
    """Write the files of `write_table` frame by frame, so that only one is in memory at a time.

    Columns of texts and binaries are in the Parquet file only; ``stem.texts.csv`` tells of each what it is at
    first and whenever it has changed: ``time,variable,text``, binaries in hexadecimal digits.

    Args:
        stem: path without suffix.
        frames: rows in order, at least one frame, all with the same columns; the first is the time.
        units: unit by column name; columns without one may be left out.

    Returns:
        The paths of the files.

    Raises:
        StorageError: one of the files could not be written; none is replaced then.
    """
    return _write_tables(stem, frames, units, texts_apart=True)


def _write_tables(
    stem: Path, frames: Iterable[pd.DataFrame], units: Mapping[str, str], texts_apart: bool
) -> list[Path]:
    """Write frames one after the other into the files of a table."""
    tables = (_table(frame, units) for frame in frames)
    first = next(tables)
    texts = [f.name for f in first.schema if texts_apart and not _is_number(f.type)]
    paths = [_beside(stem, suffix) for suffix in (".csv", ".parquet", ".meta.json")]
    apart = _beside(stem, ".texts.csv")
    paths += [apart] if texts else []
    numbers = first.drop_columns(texts).schema
    with whole(*paths) as files:
        with (
            csv_file(files[0], numbers) as to_csv,
            parquet_file(files[1], first.schema) as to_parquet,
            texts_file(files[-1], texts) as to_texts,
        ):
            for table in itertools.chain([first], tables):
                to_csv(table.drop_columns(texts))
                to_parquet(table)
                to_texts(table)
        known = {f.name: f.metadata[UNIT].decode() for f in first.schema if f.metadata}
        files[2].write_text(json.dumps({"units": known}, indent=2, ensure_ascii=False) + "\n", "utf-8")
    if not texts:
        apart.unlink(missing_ok=True)  # of an earlier run
    return paths


def _table(frame: pd.DataFrame, units: Mapping[str, str]) -> pa.Table:
    """A frame as an Arrow table, units inside."""
    import pyarrow as pa

    columns = {str(name): _column(frame[name]) for name in frame.columns}
    schema = pa.schema(
        [
            pa.field(name, column.type, metadata={UNIT: units[name].encode()} if name in units else None)
            for name, column in columns.items()
        ]
    )
    return pa.table(list(columns.values()), schema=schema)


def _is_number(kind: pa.DataType) -> bool:
    """Whether values of an Arrow type are numbers or booleans."""
    import pyarrow as pa

    return not (pa.types.is_string(kind) or pa.types.is_binary(kind))


def read_table(stem: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """Read what `write_table` wrote: the Parquet file if there is one, else the CSV file.

    Args:
        stem: path without suffix.

    Returns:
        The frame, and units by column name.

    Raises:
        DataError: there is no such table or it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = next((f for f in (_beside(stem, ".parquet"), _beside(stem, ".csv")) if f.is_file()), None)
    if file is None:
        raise DataError(
            f"{stem}: found neither {stem.name}.parquet nor {stem.name}.csv; "
            "give the path of a table without suffix"
        )
    try:
        table = pq.read_table(file) if file.suffix == ".parquet" else _read_csv(file)
        units = {f.name: f.metadata[UNIT].decode() for f in table.schema if UNIT in (f.metadata or {})}
        meta = _beside(stem, ".meta.json")
        if not units and meta.is_file():
            units = read_json(meta)["units"]
    except (OSError, ValueError, KeyError, TypeError, pa.ArrowException) as error:
        raise DataError(
            f"{file}: cannot be read as a table ({one_line(error)}); make it again or remove it"
        ) from error
    return table.to_pandas(), units


# ── tables ───────────────────────────────────────────────────────────────────────────────────────────────


def _beside(stem: Path, suffix: str) -> Path:
    """Path of a table's file; a dot in the stem's name is no suffix."""
    return stem.with_name(stem.name + suffix)


def _column(series: pd.Series[Any]) -> pa.Array:
    """A pandas column as an Arrow one: NaN stays a number (it is no blank), missing text is empty."""
    import pyarrow as pa

    values = series.to_numpy()
    if values.dtype.kind in "bifu":
        return pa.array(values, from_pandas=False)
    if len(values) and isinstance(values[0], bytes):
        return pa.array(values, pa.binary())
    return pa.array(["" if v is None or v != v else str(v) for v in values], pa.string())


@contextmanager
def csv_file(file: Path, schema: pa.Schema) -> Iterator[Callable[[pa.Table], None]]:
    """A CSV file in the form that the head of this module describes; gives what appends a table to it."""
    import pyarrow as pa
    import pyarrow.csv

    plain = [pa.field(f.name, pa.uint8() if pa.types.is_boolean(f.type) else f.type) for f in schema]
    header = io.StringIO()
    csv.writer(header, lineterminator="\n").writerow(schema.names)
    options = pyarrow.csv.WriteOptions(include_header=False)
    with named(file), file.open("wb") as stream:
        stream.write(header.getvalue().encode("utf-8"))

        def append(table: pa.Table) -> None:
            with named(file):
                pyarrow.csv.write_csv(table.cast(pa.schema(plain)), stream, options)

        yield append


@contextmanager
def texts_file(file: Path, names: Sequence[str]) -> Iterator[Callable[[pa.Table], None]]:
    """A CSV file of when texts change, nothing where there are none; gives what appends a table's to it."""
    if not names:
        yield lambda table: None
        return
    last: dict[str, Any] = {}
    with named(file), file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["time", "variable", "text"])

        def append(table: pa.Table) -> None:
            rows = []
            for place, name in enumerate(names):
                values = table.column(name).to_pylist()
                changed = (
                    k for k, value in enumerate(values) if value != (values[k - 1] if k else last.get(name))
                )
                rows += [(k, place, values[k]) for k in changed]
                last[name] = values[-1] if values else last.get(name)
            times = table.column(0)
            with named(file):
                for k, place, value in sorted(rows, key=lambda row: row[:2]):
                    shown = value.hex() if isinstance(value, bytes) else value
                    writer.writerow([times[k].as_py(), names[place], shown])

        yield append


@contextmanager
def parquet_file(file: Path, schema: pa.Schema) -> Iterator[Callable[[pa.Table], None]]:
    """A Parquet file; gives what appends a table to it."""
    import pyarrow.parquet as pq

    with named(file), pq.ParquetWriter(file, schema, compression="zstd") as writer:

        def append(table: pa.Table) -> None:
            with named(file):
                writer.write_table(table)

        yield append


def _read_csv(file: Path) -> pa.Table:
    """Read a CSV file; ``nan`` is a number, only an empty cell is none."""
    import pyarrow.csv

    options = pyarrow.csv.ConvertOptions(null_values=[""], strings_can_be_null=False)
    return pyarrow.csv.read_csv(file, convert_options=options)

"""Tables that others wrote: CSV of any dialect and Parquet, read column by column and cell by cell checked.

Delimiter, decimal mark, encoding, comments or a title above the column names and a line of units below them
are found out from the file. Whatever is wrong with a table is told with its file and line.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy.typing import NDArray

from exlinn_fmi.errors import DataError, nearest

DELIMITERS = (";", "\t", ",", "|", " ")
HEAD = 100
"""Lines in which column names are looked for, and from which a dialect is found out."""
PARQUET = (".parquet", ".pq")
SUFFIXES = ("deg", "rad", "rpm", "mm", "ms", "mA", "mV", "Nm", "V", "A", "N", "m", "s")
"""Units that stand behind names without brackets."""
SHOWN = 4
"""Most mistakes of one file that a message spells out."""


@dataclass(frozen=True)
class Dialect:
    """How a CSV file is written.

    Args:
        names: the column names, as they stand there.
        delimiter: between cells.
        decimal: decimal mark.
        first: number of the line with the first row of numbers, from 1.
        units: cells of a line between names and numbers, if there is one.
    """

    names: tuple[str, ...]
    delimiter: str
    decimal: str
    first: int
    units: tuple[str, ...] = ()


@dataclass(frozen=True)
class ForeignTable:
    """Some columns of a file as numbers.

    Args:
        path: the file.
        columns: finite numbers by column name, all of one length.
        first: line of the first row, from 1; 0 where rows are no lines.
        notes: what the user should know of the reading.
    """

    path: Path
    columns: dict[str, Float[NDArray[np.float64], " N"]]
    first: int
    notes: list[str] = field(default_factory=list)

    def at(self, row: int) -> str:
        """Where a row stands, for messages: ``run1.csv:57``, or ``run1.parquet, row 56``."""
        return place(self.path, self.first, row)


def place(path: Path, first: int, row: int) -> str:
    """Where a row of a file stands."""
    return f"{path.name}:{first + row}" if first else f"{path.name}, row {row + 1}"


def read_foreign(
    path: Path, names: Iterable[str], delimiter: str | None = None, decimal: str | None = None
) -> ForeignTable:
    """Read columns of a CSV or Parquet file.

    Args:
        path: the file.
        names: the columns; one that is a date and time is given in seconds since its first row.
        delimiter: between the cells of CSV; found out if not given.
        decimal: its decimal mark; found out if not given.

    Raises:
        DataError: with file and line: no such file or column, no rows, a row of another length than the
            others, a cell that holds no finite number.
    """
    wanted = list(dict.fromkeys(names))
    if path.suffix.lower() in PARQUET:
        known, frame = column_names(path), _parquet(path)
        _check_names(path, wanted, known)
        return _numbers(path, frame[wanted], first=0)
    text = _text(path)
    dialect = _dialect(path, text, wanted, delimiter, decimal)
    _check_names(path, wanted, dialect.names)
    try:
        body, notes = _body(path, text, dialect)
    except csv.Error as error:
        raise DataError(f"{path.name}: cannot be read as CSV ({error}); is a quote not closed?") from error
    table = _numbers(path, _cells(path, body, dialect, wanted), dialect.first, dialect, body)
    if dialect.units:
        shown = ", ".join(filter(None, dialect.units))
        notes.append(f"{path.name}:{dialect.first - 1}: taken as units and left out: {shown}")
    return replace(table, notes=notes)


def column_names(
    path: Path, wanted: Iterable[str] = (), delimiter: str | None = None, decimal: str | None = None
) -> tuple[str, ...]:
    """Names of the columns of a CSV or Parquet file.

    Args:
        path: the file.
        wanted: some of the names, by which the line that holds them is found.
        delimiter: between the cells of CSV; found out if not given.
        decimal: its decimal mark; found out if not given.

    Raises:
        DataError: it is not there, or is no table.
    """
    if path.suffix.lower() in PARQUET:
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            return tuple(pq.read_schema(path).names)
        except (OSError, pa.ArrowException) as error:
            raise DataError(f"{path.name}: cannot be read as Parquet ({_line(error)})") from error
    return _dialect(path, _text(path, head=True), list(wanted), delimiter, decimal).names


def columns_with_units(path: Path) -> dict[str, str]:
    """Names of the columns of a CSV or Parquet file, and their units as far as the file tells.

    A unit stands behind the name, ``u [V]``, ``n_rpm``, or in a line of units below the names.

    Raises:
        DataError: it is not there, or is no table.
    """
    if path.suffix.lower() in PARQUET:
        return {name: _unit(name) for name in column_names(path)}
    dialect = _dialect(path, _text(path, head=True), (), None, None)
    below = dict(zip(dialect.names, dialect.units, strict=False))
    return {name: below.get(name, "").strip("[]()") or _unit(name) for name in dialect.names}


def _unit(name: str) -> str:
    """The unit behind a column's name, empty where there is none."""
    behind = re.search(r"[\[(]\s*([^\W\d][^\])]*)[\])]\s*$", name) or re.search(
        rf"_({'|'.join(SUFFIXES)})$", name
    )
    return behind[1].strip() if behind else ""


def _check_names(path: Path, wanted: Sequence[str], known: Sequence[str]) -> None:
    """Refuse columns that are not there, or there twice."""
    for name in wanted:
        if known.count(name) > 1:
            raise DataError(f"{path.name}: column {name!r} is there {known.count(name)} times; rename one")
        if name not in known:
            raise DataError(f"{path.name}: {no_column(name, known)}")


def no_column(name: str, known: Sequence[str]) -> str:
    """Error text on a column that a file does not have."""
    if len(known) == 1:
        return f"no column {name!r}: the line of names is read as one, {known[0]!r}; give another `delimiter`"
    return f"no column {name!r}; {nearest(name, known, 'columns')}"


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────


def _text(path: Path, head: bool = False) -> str:
    """The text of a file (its beginning only, if `head`), ends of lines as newlines, no blank lines behind.

    Raises:
        DataError: it is not there, empty, or no text.
    """
    try:
        with path.open("rb") as stream:
            raw = stream.read(1 << 18) if head else stream.read()
    except OSError as error:
        raise DataError(f"{path.name}: cannot be read ({error.strerror})") from error
    utf16 = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not utf16 and b"\0" in raw[:4096]:
        raise DataError(f"{path.name}: no text file; export the data as CSV or Parquet")
    try:
        text = codecs.getincrementaldecoder("utf-16" if utf16 else "utf-8-sig")().decode(raw)
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    while "\n" in text and not text[text.rindex("\n") :].strip("\n\t ;,|\x1a"):
        text = text[: text.rindex("\n")]
    if not text.strip():
        raise DataError(f"{path.name}: the file is empty; expected a line of column names, then numbers")
    return text


def _dialect(
    path: Path, text: str, wanted: Sequence[str], delimiter: str | None, decimal: str | None
) -> Dialect:
    """Find out how a file is written: the line and delimiter that give most of the wanted names.

    Raises:
        DataError: no line holds column names, or no row follows it.
    """
    lines, marks = text.split("\n", HEAD)[:HEAD], (delimiter,) if delimiter else DELIMITERS
    best: tuple[tuple[int, bool, int], int, str] | None = None
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith(("#", "%", "sep=", '"sep=')):
            continue
        follower = lines[number] if number < len(lines) else ""
        ranked = [(_rank(line, follower, mark, wanted), mark) for mark in marks]
        rank, mark = max(ranked, key=lambda r: r[0])
        if best is None or rank[0] > best[0][0]:
            best = rank, number, mark
    if best is None:
        raise DataError(f"{path.name}: only comments; expected a line of column names, then numbers")
    _, number, mark = best
    names = split_line(lines[number - 1], mark)
    if all(map(_is_number, names)):
        raise DataError(f"{path.name}:{number}: found numbers, expected a line of column names; add one")
    rows = [split_line(line, mark) for line in lines[number:]]
    if not rows:
        raise DataError(f"{path.name}: no rows below the column names")
    units = () if len(rows) < 2 or any(map(_is_number, rows[0])) else tuple(rows[0])
    comma = mark != "," and any(re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", c) for r in rows for c in r)
    return Dialect(tuple(names), mark, decimal or ("," if comma else "."), number + 1 + bool(units), units)


def _rank(line: str, follower: str, delimiter: str, wanted: Sequence[str]) -> tuple[int, bool, int]:
    """How well a line does for column names: those that are wanted, whether the next line fits, how many."""
    names = split_line(line, delimiter)
    return len(set(wanted) & set(names)), len(split_line(follower, delimiter)) == len(names), len(names)


def split_line(line: str, delimiter: str) -> list[str]:
    """Cells of a line, without quotes and blanks around them."""
    if delimiter == " ":
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except csv.Error:  # a cell that is longer than any is
        return [line]
    return [cell.strip() for cell in cells]


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _body(path: Path, text: str, dialect: Dialect) -> tuple[str, list[str]]:
    """The lines of numbers, each with one cell for each name.

    Returns:
        The lines, and what was done to them.

    Raises:
        DataError: a line is blank or has another number of cells.
    """
    body = text.split("\n", dialect.first - 1)[-1]
    if dialect.delimiter == " ":
        body = re.sub(r"[ \t]+", " ", re.sub(r"(?m)^[ \t]+|[ \t]+$", "", body))
    expected = len(dialect.names)
    cells = _count_cells(body, dialect.delimiter, expected)
    if len(cells) > 1 and cells[-1] < expected and (cells[:-1] == expected).all():
        note = f"{place(path, dialect.first, len(cells) - 1)}: the last line is cut off; it was left out"
        return body[: body.rindex("\n")], [note]
    for row in np.flatnonzero(cells != expected)[:1]:
        where, line = place(path, dialect.first, int(row)), body.split("\n", int(row) + 1)[int(row)]
        if not line.strip():
            raise DataError(f"{where}: a blank line; take it out, or make two files of it")
        decimal = dialect.delimiter == "," and cells[row] % expected == 0 and (cells == cells[row]).all()
        hint = (
            "is the decimal mark a comma as well? Use another `delimiter`" if decimal else "repair the line"
        )
        raise DataError(f"{where}: {cells[row]} cells, expected {expected} as there are names; {hint}")
    return body, []


def _count_cells(body: str, delimiter: str, expected: int) -> Int[NDArray[np.int64], " N"]:
    """Number of cells in each line; a delimiter at the end that closes the last cell is not counted."""
    if '"' in body:  # delimiters may stand within quotes
        rows = csv.reader(io.StringIO(body), delimiter=delimiter, skipinitialspace=True)
        return np.array([len(r) - (len(r) == expected + 1 and not r[-1].strip()) for r in rows], np.int64)
    raw = np.frombuffer(body.encode(), dtype=np.uint8)
    ends = np.append(np.flatnonzero(raw == ord("\n")), len(raw))
    marks = np.searchsorted(np.flatnonzero(raw == ord(delimiter)), ends)
    cells = np.diff(marks, prepend=0) + 1
    starts = np.append(0, ends[:-1] + 1)
    closed = (raw[np.maximum(ends - 1, 0)] == ord(delimiter)) & (cells == expected + 1)
    return np.where(ends == starts, 0, cells - closed)


def _cells(path: Path, body: str, dialect: Dialect, wanted: list[str]) -> pd.DataFrame:
    """The wanted columns, as numbers where all cells are."""
    places = [dialect.names.index(name) for name in wanted]
    order = sorted(places)
    try:
        frame = pd.read_csv(
            io.StringIO(body),
            sep=dialect.delimiter,
            decimal=dialect.decimal,
            header=None,
            names=list(range(len(dialect.names))),
            usecols=order,
            index_col=False,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
        )
    except ValueError as error:  # pandas' parser errors are ValueErrors; they count lines from 1
        text = re.sub(r"line (\d+)", lambda m: f"line {int(m[1]) + dialect.first - 1}", _line(error))
        raise DataError(f"{path.name}: cannot be read as CSV ({text})") from error
    return frame[places].set_axis(wanted, axis="columns")


def _parquet(path: Path) -> pd.DataFrame:
    """A Parquet file."""
    import pyarrow as pa

    try:
        return pd.read_parquet(path).reset_index(drop=True)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DataError(f"{path.name}: cannot be read as Parquet ({_line(error)})") from error


# ── numbers ──────────────────────────────────────────────────────────────────────────────────────────────


def _numbers(
    path: Path, frame: pd.DataFrame, first: int, dialect: Dialect | None = None, body: str = ""
) -> ForeignTable:
    """The columns as finite numbers.

    Raises:
        DataError: with the cells that hold none.
    """
    if frame.empty:
        raise DataError(f"{path.name}: no rows below the column names")
    columns, mistakes = {}, []
    for name in frame.columns:
        values = _as_numbers(frame[name], "." if dialect is None else dialect.decimal)
        bad = np.flatnonzero(~np.isfinite(values))
        if not len(bad):
            columns[str(name)] = values
            continue
        where = place(path, first, int(bad[0]))
        cell = _shown(frame[name], int(bad[0]), dialect, body)
        if bad[0] == len(values) - len(bad) and bad[0] > 0 and "nothing" in cell:
            what = f"column {name!r} ends here, {len(bad)} rows before the others; cut them to one length"
        else:
            count = f" ({len(bad)} such rows in all)" if len(bad) > 1 else ""
            what = f"column {name!r}: found {cell}, expected a finite number{count}; repair or remove the row"
        mistakes.append((int(bad[0]), f"{where}: {what}"))
    if mistakes:
        texts = [text for _, text in sorted(mistakes)[:SHOWN]]
        more = [f"… and in {len(mistakes) - SHOWN} other columns"] if len(mistakes) > SHOWN else []
        raise DataError("\n".join(texts + more))
    return ForeignTable(path, columns, first)


def _as_numbers(column: pd.Series[Any], decimal: str) -> Float[NDArray[np.float64], " N"]:
    """A column as numbers, NaN where a cell holds none; date and time as seconds since the first row."""
    if pd.api.types.is_numeric_dtype(column):
        return np.asarray(column.to_numpy(dtype=float, na_value=np.nan))
    if not pd.api.types.is_datetime64_any_dtype(column):
        cells = column.astype(str).str.replace(decimal, ".") if decimal != "." else column
        numbers = pd.to_numeric(cells, errors="coerce").to_numpy(dtype=float)
        if np.isfinite(numbers).any():
            return np.asarray(numbers)
        column = pd.to_datetime(column, errors="coerce", format="ISO8601")
    return np.asarray((column - column.iloc[0]).dt.total_seconds().to_numpy(dtype=float))


def _shown(column: pd.Series[Any], row: int, dialect: Dialect | None, body: str) -> str:
    """What a cell holds, as it stands in the file."""
    if dialect is not None:
        cells = split_line(body.split("\n", row + 1)[row], dialect.delimiter)
        cell = "".join(cells[dialect.names.index(str(column.name)) :][:1])
    else:
        cell = "" if pd.isna(column.iloc[row]) else str(column.iloc[row])
    return repr(cell) if cell.strip() else "nothing"


def _line(error: Exception) -> str:
    """An error's text on one line."""
    return " ".join(str(error).split())

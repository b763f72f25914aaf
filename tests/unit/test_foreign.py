"""Tables that others wrote are read whatever their dialect, and what is wrong with them is told by line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.data.foreign import ForeignTable, column_names, read_foreign
from exlinn_fmi.errors import DataError


def read(folder: Path, content: str | bytes, names: tuple[str, ...] = ("t", "u"), **dialect) -> ForeignTable:
    file = folder / "run.csv"
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_foreign(file, names, **dialect)


@pytest.mark.parametrize(
    "content",
    [
        "t,u\n0.5,1\n1.5,-2e-3\n",
        "t;u\n0,5;1\n1,5;-2e-3\n",
        "t;u\n0.5;1\n1.5;-2E-3\n",
        "t\tu\n0,5\t1\n1,5\t-0,002\n",
        "t|u\n0.5|1\n1.5|-0.002\n",
        "  t     u\n 0.5    1\n 1.5 -0.002\n",
        "u,x,t\n1,9,0.5\n-0.002,9,1.5\n",
        "t, u\n0.5, 1\n1.5, -0.002\n",
        '"t","u"\n"0.5","1"\n"1.5","-0.002"\n',
        "t,u\r\n0.5,1\r\n1.5,-0.002\r\n",
        "t,u\r0.5,1\r1.5,-0.002",
        "sep=;\nt;u\n0,5;1\n1,5;-0,002\n",
        "# bench 3, 2024\n% by me\n\nt,u\n0.5,1\n1.5,-0.002\n",
        "Measured on Monday, late\nby: me\n\nt;u\n0,5;1\n1,5;-0,002\n",
        "t,u,\n0.5,1,\n1.5,-0.002,\n",
        "t,u\n0.5,1,\n1.5,-0.002,\n",
        "t,u\n0.5,1\n1.5,-0.002\n\n,\n \n",
        "\ufefft,u\n0.5,1\n1.5,-0.002\n",
        "t,u\n0.5,1\n1.5,-0.002\n".encode("utf-16"),
    ],
    ids=[
        "comma", "semicolon, decimal comma", "semicolon", "tab, decimal comma", "bar", "blanks",
        "other columns", "blanks after commas", "quotes", "Windows", "old Mac", "Excel's sep", "comments",
        "a title", "closed lines", "closed rows", "empty lines at the end", "byte order mark", "UTF-16",
    ],
)  # fmt: skip
def test_a_table_is_read_whatever_its_dialect(tmp_path, content):
    columns = read(tmp_path, content).columns
    np.testing.assert_allclose(columns["t"], [0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(columns["u"], [1.0, -0.002], rtol=1e-15)


@given(
    st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9)), min_size=1, max_size=20),
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", ","), ("\t", "."), (" ", "."), (" ", ",")]),
)
@settings(max_examples=60, deadline=None)
def test_what_pandas_writes_is_read_back(tmp_path_factory, rows, dialect):
    frame, file = pd.DataFrame(rows, columns=["t", "u"]), tmp_path_factory.mktemp("csv") / "run.csv"
    frame.to_csv(file, index=False, sep=dialect[0], decimal=dialect[1])
    columns = read_foreign(file, ["t", "u"]).columns
    np.testing.assert_allclose(pd.DataFrame(columns), frame, rtol=1e-14)


def test_names_in_an_old_encoding_are_read(tmp_path):
    table = read(tmp_path, "t;T °C\n0;1\n1;2\n".encode("latin-1"), ("T °C",))
    assert table.columns["T °C"].tolist() == [1, 2]


def test_delimiters_within_quotes_belong_to_the_name(tmp_path):
    table = read(tmp_path, 't,"u, measured"\n0,1\n1,2\n', ("t", "u, measured"))
    assert table.columns["u, measured"].tolist() == [1, 2]


def test_a_line_of_units_is_left_out_and_that_is_said(tmp_path):
    table = read(tmp_path, "t;u\n[s];[V]\n0;1\n1;2\n")
    assert table.columns["u"].tolist() == [1, 2]
    assert table.notes == ["run.csv:2: taken as units and left out: [s], [V]"]
    assert table.at(0) == "run.csv:3"


def test_a_last_line_that_is_cut_off_is_left_out_and_that_is_said(tmp_path):
    table = read(tmp_path, "t,u\n0,1\n1,2\n2")
    assert table.columns["t"].tolist() == [0, 1]
    assert table.notes == ["run.csv:4: the last line is cut off; it was left out"]


def test_date_and_time_are_seconds_since_the_first_row(tmp_path):
    table = read(tmp_path, "t,u\n2024-05-03 12:00:59.500,1\n2024-05-03 12:01:00.750,2\n")
    assert table.columns["t"].tolist() == [0, 1.25]


def test_true_and_false_are_one_and_zero(tmp_path):
    assert read(tmp_path, "t,u\n0,True\n1,False\n").columns["u"].tolist() == [1, 0]


def test_the_delimiter_and_decimal_mark_may_be_given(tmp_path):
    table = read(tmp_path, "t;u\n1;1.5\n2;2.5\n", delimiter=";", decimal=".")
    assert table.columns["u"].tolist() == [1.5, 2.5]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "run.csv: the file is empty; expected a line of column names, then numbers"),
        ("\n \n", "run.csv: the file is empty"),
        ("# nothing\n# at all\n", "run.csv: only comments"),
        ("t,u\n", "run.csv: no rows below the column names"),
        ("0,1\n1,2\n", "run.csv:1: found numbers, expected a line of column names; add one"),
        (b"PK\3\4\0\0\0\0", "run.csv: no text file; export the data as CSV or Parquet"),
        ("t,v\n0,1\n", "run.csv: no column 'u'; the columns are: t, v"),
        ("t,u_m\n0,1\n", "run.csv: no column 'u'; the columns are: t, u_m"),
        ("t,u,u\n0,1,2\n", "run.csv: column 'u' is there 2 times; rename one"),
        ("t,u\n0,1\n\n1,2\n", "run.csv:3: a blank line; take it out, or make two files of it"),
        ("t,u\n0,1\n1,2,3\n2,3\n", "run.csv:3: 3 cells, expected 2 as there are names; repair the line"),
        ("t,u\n0,1\n1\n2,3\n", "run.csv:3: 1 cells, expected 2"),
        (
            "t,u\n0,5,1,5\n1,5,2,5\n",
            "run.csv:2: 4 cells, expected 2 as there are names; is the decimal mark a",
        ),
        ("t,u\n0,1\n1,x\n2,y\n", "run.csv:3: column 'u': found 'x', expected a finite number (2 such rows"),
        ("t;u\n0,5;1,5\n1,5;x\n2,5;3,5\n", "run.csv:3: column 'u': found 'x', expected a finite number; rep"),
        ("t,u\n0,1\n1,NA\n2,3\n", "run.csv:3: column 'u': found 'NA'"),
        ("t,u\n0,1\n,\n2,3\n", "run.csv:3: column 't': found nothing"),
        ('"t","u"\n"0","1"\n"1",""\n"2","3"\n', "run.csv:3: column 'u': found nothing"),
        ('"t","u"\n"0","1"\n"1","2","3"\n', "run.csv:3: 3 cells, expected 2"),
        ('t,u\n0,1\n1,"2\n', "run.csv: cannot be read as CSV (Error tokenizing data"),
        (
            't,u\n0,1\n1,"2\n' + 70_000 * "3\n",
            "run.csv: cannot be read as CSV (field larger than field limit",
        ),
        ('"' + 200_000 * "t", "run.csv: no rows below the column names"),
        ('t,u\n0"1,1\n1,2\n', "run.csv:2: column 't': found '0\"1', expected a finite number"),
        ("t,u\n0,1\n1,\n2,\n", "run.csv:3: column 'u' ends here, 2 rows before the others"),
        ("t,u\n0,1e999\n", "run.csv:2: column 'u': found '1e999', expected a finite number"),
    ],
)
def test_a_table_that_cannot_be_used_says_where_and_why(tmp_path, content, message):
    with pytest.raises(DataError, match=re.escape(message)):
        read(tmp_path, content)


def test_all_columns_with_mistakes_are_told_of_in_the_order_of_the_rows(tmp_path):
    names = tuple("abcdef")
    rows = [["1"] * 6 for _ in range(8)]
    for k, name_row in enumerate([7, 3, 5, 4, 6, 2]):
        rows[name_row][k] = "x"
    text = "\n".join(",".join(row) for row in [list(names), *rows])
    with pytest.raises(DataError) as caught:
        read(tmp_path, text, names)
    lines = str(caught.value).splitlines()
    assert [line.split(":")[1] for line in lines[:-1]] == ["4", "5", "6", "7"]
    assert lines[-1] == "… and in 2 other columns"


def test_a_wrong_delimiter_is_seen_in_the_names(tmp_path):
    with pytest.raises(
        DataError, match=r"no column 't': the line of names is read as one, 't;u'; give anoth"
    ):
        read(tmp_path, "t;u\n0;1\n", delimiter=",")


def test_a_file_that_cannot_be_opened_says_why(tmp_path):
    with pytest.raises(DataError, match=r"gone.csv: cannot be read \(No such file"):
        read_foreign(tmp_path / "gone.csv", ["t"])


# ── Parquet ──────────────────────────────────────────────────────────────────────────────────────────────


def test_parquet_is_read(tmp_path):
    file = tmp_path / "run.parquet"
    stamps = pd.to_datetime(["2024-01-01 00:00:00", "2024-01-01 00:00:01"])
    pd.DataFrame({"t": stamps, "u": np.float32([1, 2]), "n": [3, 4]}).to_parquet(file)
    table = read_foreign(file, ["t", "u", "n"])
    assert [values.tolist() for values in table.columns.values()] == [[0, 1], [1, 2], [3, 4]]
    assert column_names(file) == ("t", "u", "n")


def test_a_mistake_in_parquet_names_the_row(tmp_path):
    file = tmp_path / "run.parquet"
    pd.DataFrame({"t": [0.0, 1.0, 2.0], "u": [1.0, np.nan, 3.0], "s": list("abc")}).to_parquet(file)
    with pytest.raises(DataError, match=r"run.parquet, row 2: column 'u': found nothing"):
        read_foreign(file, ["t", "u"])
    with pytest.raises(DataError, match=r"run.parquet, row 1: column 's': found 'a'"):
        read_foreign(file, ["s"])
    with pytest.raises(DataError, match=r"run.parquet: no column 'x'"):
        read_foreign(file, ["x"])


def test_a_damaged_parquet_file_says_so(tmp_path):
    file = tmp_path / "run.parquet"
    file.write_bytes(b"PAR1 and nothing more")
    with pytest.raises(DataError, match=r"run.parquet: cannot be read as Parquet"):
        column_names(file)


def test_a_parquet_file_with_damaged_pages_says_so(tmp_path):
    file = tmp_path / "run.parquet"
    pd.DataFrame({"t": np.random.default_rng(0).standard_normal(5000)}).to_parquet(file)
    content = bytearray(file.read_bytes())
    content[4:400] = bytes(396)
    file.write_bytes(content)
    with pytest.raises(DataError, match=r"run.parquet: cannot be read as Parquet"):
        read_foreign(file, ["t"])


def test_a_parquet_file_without_rows_says_so(tmp_path):
    file = tmp_path / "run.parquet"
    pd.DataFrame({"t": np.zeros(0)}).to_parquet(file)
    with pytest.raises(DataError, match=r"run.parquet: no rows"):
        read_foreign(file, ["t"])


def test_names_alone_need_no_wanted_ones(tmp_path):
    (tmp_path / "run.csv").write_text("# x\na;b\n1;2\n")
    assert column_names(tmp_path / "run.csv") == ("a", "b")

"""Files appear whole or not at all, and tables read back to the last bit in every reader that we promise."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.data import files, tables
from exlinn_fmi.data.files import file_hash, read_record
from exlinn_fmi.errors import DataError, StorageError

AWKWARD = [0.0, -0.0, 0.1, 1 / 3, 1e22, 123456789012345678.0, 5e-324, 1.7976931348623157e308, -1e-7]


def frame_of(values: list[float]) -> pd.DataFrame:
    x = np.array(values)
    return pd.DataFrame({"time": 1e-3 * np.arange(len(x)), "plant.A[1,2]": x, "plant.on": x > 0})


def no_stand_ins(folder: Path) -> bool:
    return not [f for f in folder.iterdir() if f.name.startswith(".")]


# ── tables ───────────────────────────────────────────────────────────────────────────────────────────────


@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None)
def test_csv_reads_back_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, values: list[float]):
    stem = tmp_path_factory.mktemp("t") / "table"
    tables.write_table(stem, frame_of(values), {})
    stem.with_suffix(".parquet").unlink()
    back, _ = tables.read_table(stem)
    assert back["plant.A[1,2]"].to_numpy().astype(float).tobytes() == np.array(values).tobytes()


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_table_keeps_values_names_and_units(tmp_path: Path, suffix: str):
    frame = frame_of(AWKWARD)
    tables.write_table(tmp_path / "t", frame, {"time": "s", "plant.A[1,2]": "N.m"})
    (tmp_path / "t.csv" if suffix == ".parquet" else tmp_path / "t.parquet").unlink()
    back, units = tables.read_table(tmp_path / "t")
    assert list(back) == list(frame)
    assert units == {"time": "s", "plant.A[1,2]": "N.m"}
    np.testing.assert_array_equal(back.to_numpy(float), frame.to_numpy(float))


def test_csv_has_plain_header_numbers_and_booleans(tmp_path: Path):
    tables.write_table(tmp_path / "t", frame_of([0.1, -2.0]), {})
    assert (tmp_path / "t.csv").read_text() == 'time,"plant.A[1,2]",plant.on\n0,0.1,1\n0.001,-2,0\n'


def test_write_table_tells_which_files_it_wrote(tmp_path: Path):
    written = tables.write_table(tmp_path / "t", frame_of([1.0]), {})
    assert sorted(written) == sorted(tmp_path.iterdir())


def test_pandas_reads_the_csv_exactly(tmp_path: Path):
    tables.write_table(tmp_path / "t", frame_of(AWKWARD), {})
    back = pd.read_csv(tmp_path / "t.csv")
    np.testing.assert_array_equal(back.to_numpy(float), frame_of(AWKWARD).to_numpy(float))
    assert list(back) == ["time", "plant.A[1,2]", "plant.on"]


def test_fmpy_reads_the_csv_exactly(tmp_path: Path):
    from fmpy.util import read_csv

    frame = frame_of(AWKWARD).rename(columns={"plant.A[1,2]": "plant.a"})
    tables.write_table(tmp_path / "t", frame, {})
    back = read_csv(str(tmp_path / "t.csv"))
    assert back.dtype.names == tuple(frame)
    for name in frame:
        np.testing.assert_array_equal(back[name], frame[name].to_numpy(float))


def test_nan_is_written_as_nan_and_text_as_text(tmp_path: Path):
    frame = pd.DataFrame({"name": ["j_m", None, 'a "b", c'], "true": [0.1, np.nan, np.inf]})
    tables.write_table(tmp_path / "t", frame, {})
    (tmp_path / "t.parquet").unlink()
    assert ",\n" not in (tmp_path / "t.csv").read_text()
    back, _ = tables.read_table(tmp_path / "t")
    assert list(back["name"]) == ["j_m", "", 'a "b", c']
    np.testing.assert_array_equal(back["true"], frame["true"])


def test_all_nan_column_stays_a_column_of_numbers(tmp_path: Path):
    tables.write_table(tmp_path / "t", pd.DataFrame({"a": [np.nan, np.nan]}), {})
    (tmp_path / "t.parquet").unlink()
    back, _ = tables.read_table(tmp_path / "t")
    assert back["a"].dtype == float
    assert back["a"].isna().all()


def test_parquet_fields_carry_units_and_are_compressed(tmp_path: Path):
    tables.write_table(tmp_path / "t", frame_of(AWKWARD), {"time": "s"})
    meta = pq.ParquetFile(tmp_path / "t.parquet")
    assert meta.schema_arrow.field("time").metadata[b"unit"] == b"s"
    assert meta.metadata.row_group(0).column(0).compression == "ZSTD"


def test_dot_in_the_stem_is_no_suffix(tmp_path: Path):
    tables.write_table(tmp_path / "run.v1", frame_of([1.0]), {})
    assert sorted(f.name for f in tmp_path.iterdir()) == ["run.v1.csv", "run.v1.meta.json", "run.v1.parquet"]


def test_missing_table_is_said_with_its_path(tmp_path: Path):
    with pytest.raises(DataError, match=r"nothing: found neither nothing\.parquet nor nothing\.csv"):
        tables.read_table(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("suffix", "content"),
    [(".parquet", b""), (".parquet", b"PAR1 nonsense"), (".csv", b""), (".csv", b"a,b\n1\n")],
)
def test_damaged_table_is_a_data_error(tmp_path: Path, suffix: str, content: bytes):
    (tmp_path / f"t{suffix}").write_bytes(content)
    with pytest.raises(DataError, match=rf"t\{suffix}: cannot be read as a table \(.*\); make it again"):
        tables.read_table(tmp_path / "t")


def test_damaged_units_are_a_data_error(tmp_path: Path):
    (tmp_path / "t.csv").write_text("a\n1\n")
    (tmp_path / "t.meta.json").write_text("[]")
    with pytest.raises(DataError, match="cannot be read as a table"):
        tables.read_table(tmp_path / "t")


# ── JSON and text ────────────────────────────────────────────────────────────────────────────────────────


def test_json_holds_null_for_what_is_not_finite_and_plain_numbers_for_numpy(tmp_path: Path):
    content = {
        "a": np.float64(0.1),
        "b": [np.nan, np.inf, np.int64(3), np.bool_(True)],
        "c": np.array([[1.0, np.nan]]),
        "d": (Path("x"), None, "ü"),
        5: 1,
    }
    files.write_json(tmp_path / "m.json", content)
    text = (tmp_path / "m.json").read_text("utf-8")
    assert json.loads(text) == {
        "a": 0.1,
        "b": [None, None, 3, True],
        "c": [[1.0, None]],
        "d": ["x", None, "ü"],
        "5": 1,
    }
    assert "ü" in text
    assert text.endswith("}\n")


def test_json_reads_back(tmp_path: Path):
    files.write_json(tmp_path / "m.json", {"a": 0.1, "b": "ü"})
    assert files.read_json(tmp_path / "m.json") == {"a": 0.1, "b": "ü"}


@pytest.mark.parametrize("content", [None, b"{", b"\xff"])
def test_missing_or_damaged_json_is_a_data_error(tmp_path: Path, content: bytes | None):
    if content is not None:
        (tmp_path / "m.json").write_bytes(content)
    with pytest.raises(DataError, match=r"m\.json: cannot be read \(.*\); make it again"):
        files.read_json(tmp_path / "m.json")


def test_text_keeps_its_line_ends_and_folders_are_made(tmp_path: Path):
    files.write_text(tmp_path / "new" / "deep" / "f.txt", "a\nµ\n")
    assert (tmp_path / "new" / "deep" / "f.txt").read_bytes() == "a\nµ\n".encode()


# ── failure ──────────────────────────────────────────────────────────────────────────────────────────────


def test_failure_inside_the_block_keeps_the_old_file_and_leaves_no_other(tmp_path: Path):
    target = tmp_path / "f.txt"
    files.write_text(target, "old")

    def write_half(stand_in: Path) -> None:
        stand_in.write_text("half")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), files.whole(target) as (stand_in,):
        write_half(stand_in)
    assert target.read_text() == "old"
    assert no_stand_ins(tmp_path)


def test_stand_in_lies_beside_and_keeps_the_suffix(tmp_path: Path):
    with files.whole(tmp_path / "f.tar.gz") as (stand_in,):
        assert stand_in.parent == tmp_path
        assert stand_in.name.endswith(".tar.gz")
        stand_in.write_text("")


@pytest.mark.parametrize(
    ("code", "advice"),
    [
        (errno.ENOSPC, "free some space"),
        (errno.EACCES, "check the permissions"),
        (errno.EIO, "check the disk"),
    ],
)
def test_disk_failure_names_file_cause_and_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, advice: str
):
    tables.write_table(tmp_path / "t", frame_of([1.0]), {})
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}

    def refuse(descriptor: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(files.os, "fsync", refuse)
    with pytest.raises(StorageError) as caught:
        tables.write_table(tmp_path / "t", frame_of([2.0]), {})
    assert str(caught.value).startswith(f"{tmp_path / 't.'}")
    assert f"({os.strerror(code)}); {advice}" in str(caught.value)
    assert caught.value.exit_code == 2
    assert {f.name: f.read_bytes() for f in tmp_path.iterdir()} == before


def test_file_in_place_of_a_folder_is_explained(tmp_path: Path):
    (tmp_path / "runs").write_text("")
    with pytest.raises(StorageError, match=r"f\.txt: could not be written .*remove the file that stands"):
        files.write_text(tmp_path / "runs" / "f.txt", "")


def test_folder_in_place_of_a_file_is_explained(tmp_path: Path):
    (tmp_path / "f.txt").mkdir()
    with pytest.raises(StorageError, match=r"f\.txt: could not be written .*remove the folder of that name"):
        files.write_text(tmp_path / "f.txt", "")
    assert no_stand_ins(tmp_path)


def test_stand_in_that_cannot_be_removed_hides_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "broken")

    monkeypatch.setattr(Path, "unlink", refuse)
    monkeypatch.setattr(files.os, "fsync", refuse)
    with pytest.raises(StorageError, match="broken"):
        files.write_text(tmp_path / "f.txt", "")


def test_full_disk_keeps_the_old_table_whole(tiny_disk: Path):
    tables.write_table(tiny_disk / "t", frame_of([1.0]), {"time": "s"})
    before = {f.name: f.read_bytes() for f in tiny_disk.iterdir()}
    with pytest.raises(StorageError, match=r"t\.csv: could not be written \(No space left on device\); free"):
        tables.write_table(tiny_disk / "t", frame_of([1 / 3] * 100_000), {})
    assert {f.name: f.read_bytes() for f in tiny_disk.iterdir()} == before


def test_json_that_is_missing_or_broken_is_a_data_error(tmp_path: Path) -> None:
    (tmp_path / "broken.json").write_text("{")
    for name in ("broken.json", "missing.json"):
        with pytest.raises(DataError, match=name):
            files.read_json(tmp_path / name)


def test_a_hash_follows_the_content_and_an_unchanged_file_is_read_once(tmp_path, monkeypatch):
    file = tmp_path / "a"
    file.write_bytes(b"one")
    first = file_hash(file)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda *_: pytest.fail("read again"))
        assert file_hash(file) == first
    file.write_bytes(b"other")
    assert file_hash(file) == hashlib.sha256(b"other").hexdigest() != first
    with pytest.raises(DataError, match="gone: cannot be read"):
        file_hash(tmp_path / "gone")


def test_a_record_is_a_json_object_or_empty(tmp_path):
    file = tmp_path / "metrics.json"
    assert read_record(file) == {}
    file.write_text('{"a": 1}')
    assert read_record(file) == {"a": 1}
    file.write_text("[1]")
    with pytest.raises(DataError, match="found list where a JSON object is expected"):
        read_record(file)

"""The cache of unpacked archives: filled once, shared, whole or not there, bounded, and nothing left over."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from exlinn_fmi.components import cache
from exlinn_fmi.components.cache import lease


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test alone."""
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Filler:
    """Fills a folder with one file and counts how often it was asked to."""

    def __init__(self, size: int = 10) -> None:
        self.size, self.calls = size, 0

    def __call__(self, folder: Path) -> None:
        self.calls += 1
        (folder / "resources").mkdir()
        (folder / "resources" / "x").write_bytes(bytes(self.size))


def names(root: Path) -> list[str]:
    return sorted(path.name for path in root.iterdir())


def test_a_folder_is_filled_once_and_found_again(root: Path) -> None:
    fill = Filler()
    for _ in range(3):
        held = lease("key", fill)
        assert (held.folder / "resources" / "x").read_bytes() == bytes(10)
        held.release()
    assert fill.calls == 1
    assert names(root) == ["key"]


def test_leases_of_one_process_share_a_folder(root: Path) -> None:
    one, two = lease("key", Filler()), lease("key", Filler())
    assert one.folder == two.folder
    one.release()
    one.release()
    assert not cache._evict(root / "key")
    two.release()
    assert cache._evict(root / "key")


def test_a_folder_that_may_be_had_once_is_filled_again_for_the_second(root: Path) -> None:
    one, two = (lease("key", Filler(), alone=True) for _ in range(2))
    assert one.folder != two.folder
    assert (two.folder / "resources" / "x").is_file()
    two.release()
    one.release()
    assert names(root) == ["key"]


@pytest.mark.parametrize("change", ["content", "more", "less"])
def test_a_folder_that_was_changed_is_filled_anew(root: Path, change: str) -> None:
    held = lease("key", Filler())
    file = held.folder / "resources" / "x"
    held.release()
    if change == "content":
        file.write_bytes(b"0123456789")
    elif change == "more":
        file.with_name("y").write_bytes(b"")
    else:
        file.unlink()
    fill = Filler()
    held = lease("key", fill)
    assert fill.calls == 1
    assert [path.name for path in held.folder.rglob("*")] == ["resources", "x"]
    assert (held.folder / "resources" / "x").read_bytes() == bytes(10)
    held.release()
    assert names(root) == ["key"]


def test_a_folder_that_was_changed_while_others_use_it_is_left_to_them(root: Path) -> None:
    held = lease("key", Filler())
    other = os.open(root / "key", os.O_RDONLY)  # a lock as another process holds it
    cache.fcntl.flock(other, cache.fcntl.LOCK_SH)
    (held.folder / "resources" / "x").write_bytes(b"")
    held.release()
    fresh = lease("key", Filler())
    assert fresh.folder.parent != root / "key"
    assert (fresh.folder / "resources" / "x").stat().st_size == 10
    fresh.release()
    os.close(other)
    assert names(root) == ["key"]


def test_a_failure_leaves_nothing(root: Path) -> None:
    def fail(folder: Path) -> None:
        (folder / "half").write_text("x")
        raise ValueError

    with pytest.raises(ValueError, match=r"^$"):
        lease("key", fail)
    assert names(root) == []


def test_the_folders_longest_unused_go_when_the_bound_is_reached(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EXLINN_CACHE_MB", "0.025")
    for k, key in enumerate("abc"):
        lease(key, Filler(10_000)).release()
        if key != "c":
            os.utime(root / key, (k, k))
    assert names(root) == ["b", "c"]


def test_what_is_in_use_stays_whatever_the_bound(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXLINN_CACHE_MB", "0.001")
    held = lease("a", Filler(10_000))
    lease("b", Filler(10_000)).release()
    assert "a" in names(root)
    held.release()


def test_what_a_killed_run_left_is_removed_by_the_next(root: Path) -> None:
    script = """
        import os, signal
        from exlinn_fmi.components.cache import lease
        lease("key", lambda folder: os.kill(os.getpid(), signal.SIGKILL))
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False)
    assert done.returncode == -signal.SIGKILL
    (left,) = root.iterdir()
    os.utime(left, (time.time() - 2 * cache.SETTLED,) * 2)
    lease("key", Filler()).release()
    assert names(root) == ["key"]


def test_a_cache_that_cannot_be_written_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(cache.tempfile, "tempdir", str(tmp_path))
    held = lease("key", Filler())
    assert (held.folder / "resources" / "x").is_file()
    held.release()


def use(key: str, times: int) -> int:
    """What each of several processes does: ask for a folder and look whether it is whole."""
    good = 0
    for _ in range(times):
        held = lease(key, slow)
        good += sorted(p.name for p in held.folder.iterdir()) == [f"{k:02}" for k in range(20)]
        held.release()
    return good


def slow(folder: Path) -> None:
    for k in range(20):
        (folder / f"{k:02}").write_bytes(os.urandom(100))
        time.sleep(1e-4)


def test_runs_at_the_same_time_never_see_half_a_folder(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXLINN_CACHE_MB", "0.003")  # of three folders one must go: filling and removing race
    with multiprocessing.get_context("fork").Pool(4) as pool:
        done = pool.starmap(use, [(key, 15) for key in "abcabc"])
    assert done == [15] * 6
    assert set(names(root)) <= {"a", "b", "c"}

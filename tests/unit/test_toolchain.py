"""Compilers, and compiled libraries that are kept."""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import sys
from pathlib import Path

import pytest

from exlinn_fmi import toolchain
from exlinn_fmi.errors import InputError, RunError
from exlinn_fmi.toolchain import cache_folder, cached_library, find_compiler

SOURCES = {
    "answer.c": b'#include "number.h"\nint answer(void) { return NUMBER; }',
    "number.h": b"#define NUMBER 42\n",
}


def nothing_found(name: str, *_: object) -> None:
    return None


def test_the_environments_compiler_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", f"{sys.executable} -m some.compiler")
    assert find_compiler() == [sys.executable, "-m", "some.compiler"]


def test_the_compiler_asked_for_goes_before_the_environments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    assert find_compiler(sys.executable) == [sys.executable]


def test_a_compiler_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="compiler: no command 'no-such-cc'"):
        find_compiler("no-such-cc -O3")
    monkeypatch.setenv("CC", "no-such-cc")
    with pytest.raises(InputError, match="environment variable CC: no command 'no-such-cc'"):
        find_compiler()


def test_ziglang_serves_where_there_is_no_system_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", nothing_found)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name == "ziglang" or None)
    assert find_compiler() == [sys.executable, "-m", "ziglang", "cc"]


def test_no_compiler_at_all_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", nothing_found)
    monkeypatch.setattr(importlib.util, "find_spec", nothing_found)
    with pytest.raises(InputError, match=r"no C compiler found.*pip install ziglang"):
        find_compiler()


def test_a_library_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path / "cache"))
    first = cached_library(SOURCES, "answer.c", ("-O1",))
    assert ctypes.CDLL(str(first)).answer() == 42
    monkeypatch.setattr(toolchain, "compile_library", None)
    assert cached_library(SOURCES, "answer.c", ("-O1",)) == first
    assert [file.name for file in first.parent.iterdir()] == [first.name]


def test_other_sources_or_flags_make_another_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path))
    other = SOURCES | {"number.h": b"#define NUMBER 43\n"}
    made = {cached_library(s, "answer.c", flags) for s in (SOURCES, other) for flags in (("-O1",), ("-O2",))}
    assert len(made) == 4


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path / "file"))
    with pytest.raises(RunError, match="EXLINN_CACHE"):
        cached_library(SOURCES, "answer.c", ())


@pytest.mark.parametrize(
    ("system", "variable", "expected"),
    [
        ("linux", "XDG_CACHE_HOME", "exlinn"),
        ("win32", "LOCALAPPDATA", "exlinn"),
        ("darwin", "HOME", "Library/Caches/exlinn"),
    ],
)
def test_the_cache_is_where_each_system_keeps_caches(
    system: str, variable: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EXLINN_CACHE", raising=False)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setenv(variable, str(tmp_path))
    assert cache_folder() == tmp_path / expected

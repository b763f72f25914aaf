"""C sources to shared libraries: find a compiler, compile, and keep what was compiled.

Libraries are kept by what they were made from (sources, flags, compiler, processor) in the user's cache
folder, so that each is compiled once on a machine; the environment variable EXLINN_CACHE names another.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from exlinn_fmi.errors import InputError, RunError

# Linux alone would otherwise let a library through that lacks a symbol.
PLATFORM_FLAGS = {"linux": ("-fPIC", "-Wl,-z,defs", "-lm"), "darwin": ("-fPIC",)}


def find_compiler(compiler: str | None = None) -> list[str]:
    """The C compiler's command line.

    Args:
        compiler: command asked for, with its arguments; default: the environment's CC, else cc, gcc or clang,
            else the Python package ziglang.

    Raises:
        InputError: there is none, or not the one asked for.
    """
    asked = compiler or os.environ.get("CC")
    if asked:
        command = shlex.split(asked, posix=os.name == "posix")
        if shutil.which(command[0]) is None:
            source = "compiler" if compiler else "environment variable CC"
            raise InputError(f"{source}: no command {command[0]!r}; give the name or path of a C compiler")
        return command
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        return [sys.executable, "-m", "ziglang", "cc"]
    raise InputError(
        "no C compiler found (looked for the environment variable CC, then cc, gcc, clang, then the Python "
        "package ziglang); install one: `pip install ziglang` works everywhere"
    )


def compile_library(
    sources: Mapping[str, bytes],
    main: str,
    name: str,
    flags: Sequence[str],
    compiler: list[str],
    system: str = sys.platform,
) -> bytes:
    """Compile C sources to a shared library that holds no path of this machine, debug information included.

    Args:
        sources: file names and contents.
        main: the source that is compiled; it includes the others.
        name: file name of the library, which some platforms write into it.
        flags: besides those that a shared library needs.
        compiler: its command line.
        system: what it compiles for, as `sys.platform` calls it.

    Raises:
        RunError: with what the compiler said.
    """
    with tempfile.TemporaryDirectory(prefix="exlinn-build-") as folder:
        for file, content in sources.items():
            (Path(folder) / file).write_bytes(content)
        fixed = (f"-ffile-prefix-map={folder}=.", "-o", name, *PLATFORM_FLAGS.get(system, ()))
        command = [*compiler, "-shared", *flags, main, *fixed]
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode:
            said = (result.stderr or result.stdout).strip()[:4000]
            raise RunError(
                f"the C compiler failed: {shlex.join(command)}\n{said}\n"
                "choose another C compiler with the environment variable CC"
            )
        return (Path(folder) / name).read_bytes()


def cached_library(sources: Mapping[str, bytes], main: str, flags: Sequence[str]) -> Path:
    """The compiled library of these sources, from the cache where it was made before.

    Args:
        sources: file names and contents.
        main: the source that is compiled; it includes the others.
        flags: besides those that a shared library needs.

    Raises:
        InputError: there is no C compiler.
        RunError: the compiler failed, or the cache folder could not be written.
    """
    compiler = find_compiler()
    key = hashlib.sha256(repr((sorted(sources.items()), main, flags, *_machine(tuple(compiler)))).encode())
    suffix = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
    file = cache_folder() / f"{Path(main).stem}-{key.hexdigest()[:32]}{suffix}"
    if file.is_file():
        return file
    binary = compile_library(sources, main, f"{Path(main).stem}{suffix}", flags, compiler)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        # Others may be at it too: it appears whole or not at all.
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as stand_in:
            stand_in.write(binary)
        Path(stand_in.name).replace(file)
    except OSError as error:
        raise RunError(
            f"cannot keep compiled code in {file.parent}: {error.strerror}; name a folder that can be "
            "written in the environment variable EXLINN_CACHE"
        ) from error
    return file


def cache_folder() -> Path:
    """Where compiled libraries and unpacked FMUs are kept; it need not exist.

    Raises:
        RuntimeError: the user has no home.
    """
    if folder := os.environ.get("EXLINN_CACHE"):
        return Path(folder).absolute()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "exlinn"


@functools.cache
def _machine(compiler: tuple[str, ...]) -> tuple[str, ...]:
    """What else compiled code depends on: the compiler's version, and the processor that it is meant for."""
    version = subprocess.run([*compiler, "--version"], capture_output=True, text=True, check=False).stdout
    processor = platform.processor()
    about = Path("/proc/cpuinfo")
    if about.is_file():
        lines = about.read_text(encoding="utf-8", errors="replace").splitlines()
        processor = "\n".join(sorted({x for x in lines if x.startswith(("model name", "flags", "Features"))}))
    return " ".join(compiler), version, platform.machine(), processor

"""Platforms: what an FMU can be built for on this machine, and how."""

from __future__ import annotations

import importlib.util
import platform
import struct
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from exlinn_fmi.errors import InputError
from exlinn_fmi.export.c_code import SOURCE
from exlinn_fmi.toolchain import compile_library, find_compiler

# No contraction to fused multiply-add: every platform gives the same trajectory. Loops over units are
# vectorised, which changes no result.
FLAGS = ("-O3", "-std=c99", "-fvisibility=hidden", "-ffp-contract=off")
EXPLICIT = ("-O2", *FLAGS[1:])
"""For a controller, whose vectors are written out: to look for more takes the compiler twice as long."""


@dataclass(frozen=True)
class Platform:
    """One of the platforms.

    Args:
        target: what ziglang calls it.
        folder: of its binary in an FMI 2.0 FMU, where macOS has one library for both processors; that of
            FMI 3.0 is the platform's name.
        suffix: of a shared library.
        system: what `sys.platform` calls its operating system.
    """

    target: str
    folder: str
    suffix: str
    system: str


WINDOWS_SOURCE = "windows.c"
WINDOWS_IMPORTS = """
    calloc malloc free memcpy memmove memset memcmp strlen strcmp strcpy __stdio_common_vsprintf
    sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp expm1 log log10 log1p
    sqrt cbrt pow hypot floor ceil round fmod fabs fmin fmax copysign erf
"""
"""What an FMU may need of Windows: linking to no more spares building a C runtime, which takes minutes."""

ZIG = (sys.executable, "-m", "ziglang")

PLATFORMS = {
    "x86_64-linux": Platform("x86_64-linux-gnu.2.17", "linux64", ".so", "linux"),
    "aarch64-linux": Platform("aarch64-linux-gnu.2.17", "aarch64-linux", ".so", "linux"),
    "x86_64-windows": Platform("x86_64-windows-gnu", "win64", ".dll", "win32"),
    "x86_64-darwin": Platform("x86_64-macos", "darwin64", ".dylib", "darwin"),
    "aarch64-darwin": Platform("aarch64-macos", "darwin64", ".dylib", "darwin"),
}
"""By the names of FMI 3.0."""


def host() -> str:
    """The name of this machine's platform."""
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    return f"{machine}-{system}"


def has_zig() -> bool:
    """Whether the compiler for all platforms is installed."""
    return importlib.util.find_spec("ziglang") is not None


def buildable() -> tuple[str, ...]:
    """The platforms that this machine can build for."""
    return tuple(PLATFORMS) if has_zig() else (host(),)


def compile_for(
    names: Sequence[str], files: Mapping[str, bytes], identifier: str, compiler: str | None = None
) -> dict[str, bytes]:
    """Compile sources to a shared library for each platform.

    The libraries hold no path of this machine.

    Args:
        names: platforms, of `PLATFORMS`.
        files: sources by file name.
        identifier: name of the libraries, without suffix.
        compiler: as for `find_compiler`, for this machine's platform alone.

    Raises:
        InputError: a platform is not known, or cannot be built for here.
        RunError: the compiler failed; with what it said.
    """
    for name in names:
        if name not in PLATFORMS and name != host():
            raise InputError(f"unknown platform {name!r}; expected one of {', '.join(PLATFORMS)}")
        if name not in buildable():
            raise InputError(
                f"no compiler for {name} here, for {host()} alone; `pip install ziglang` builds for all"
            )
    with ThreadPoolExecutor(2) as pool:
        # This machine's own compiler is asked for this machine alone: the other one builds for older Linux.
        build = _build_here if tuple(names) == (host(),) else _build_anywhere
        made = pool.map(lambda name: build(name, files, f"{identifier}{suffix(name)}", compiler), names)
        return dict(zip(names, made, strict=True))


def _build_here(name: str, files: Mapping[str, bytes], library: str, compiler: str | None) -> bytes:
    """The library for this machine."""
    return compile_library(files, SOURCE, library, _flags(files), find_compiler(compiler))


def _flags(files: Mapping[str, bytes]) -> tuple[str, ...]:
    return EXPLICIT if "controller.c" in files else FLAGS


def _build_anywhere(name: str, files: Mapping[str, bytes], library: str, _: str | None) -> bytes:
    """The library for any platform, by ziglang."""
    target = PLATFORMS[name]
    compiler, flags = [*ZIG, "cc", "-target", target.target], [*_flags(files), "-g0", "-s"]
    if target.system == "darwin":
        flags.append(f"-Wl,-install_name,@rpath/{library}")
    if target.system != "win32":
        return compile_library(files, SOURCE, library, flags, compiler, target.system)
    import ziglang

    headers = Path(ziglang.__file__).parent / "lib" / "libc" / "include" / "any-windows-any"
    flags += ["-nostdlib", "-isystem", str(headers), "ucrt.lib"]
    shim = (resources.files("exlinn_fmi.export") / "templates" / WINDOWS_SOURCE).read_bytes()
    more = {WINDOWS_SOURCE: shim, "ucrt.lib": _import_library()}
    return compile_library({**files, **more}, WINDOWS_SOURCE, library, flags, compiler, target.system)


def _import_library() -> bytes:
    """What tells the linker of the functions in Windows' own ucrtbase.dll."""
    exports = "\n".join(["LIBRARY ucrtbase.dll", "EXPORTS", *WINDOWS_IMPORTS.split(), ""])
    with tempfile.TemporaryDirectory(prefix="exlinn-build-") as folder:
        (Path(folder) / "ucrt.def").write_text(exports, "utf-8")
        command = [*ZIG, "dlltool", "-m", "i386:x86-64", "-d", "ucrt.def", "-l", "ucrt.lib"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        return (Path(folder) / "ucrt.lib").read_bytes()


def suffix(name: str) -> str:
    """Suffix of a shared library on a platform."""
    return PLATFORMS[name].suffix if name in PLATFORMS else ".so"


def universal(parts: Mapping[str, bytes]) -> bytes:
    """One library for both processors of macOS.

    Args:
        parts: libraries by platform; a single one is given back as it is.
    """
    if len(parts) == 1:
        return next(iter(parts.values()))
    kinds = {"x86_64-darwin": (0x01000007, 3), "aarch64-darwin": (0x0100000C, 0)}  # CPU type and subtype
    page = 1 << 14
    header, body = struct.pack(">II", 0xCAFEBABE, len(parts)), b""
    for name, content in parts.items():
        header += struct.pack(">IIIII", *kinds[name], page + len(body), len(content), 14)
        body += content + bytes(-len(content) % page)
    return header.ljust(page, b"\0") + body

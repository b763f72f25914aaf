"""From a model to an FMU file: generate, compile, pack. The same input gives the same bytes.

An FMU has C inside and no Python: FMI 2.0, Co-Simulation and Model Exchange in one, sources included.
"""

from __future__ import annotations

import importlib.util
import io
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

from exlinn_fmi.data.files import write_bytes
from exlinn_fmi.errors import InputError, RunError
from exlinn_fmi.export.c_code import fmu_texts
from exlinn_fmi.export.model import StateSpaceModel, plant_model, system_model
from exlinn_fmi.export.model_description import SOURCE
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.plant import Plant

# No contraction to fused multiply-add: every platform gives the same trajectory.
FLAGS = ("-O2", "-std=c99", "-fvisibility=hidden", "-ffp-contract=off", "-shared")
# Linux alone would otherwise let a library through that lacks a symbol.
PLATFORM_FLAGS = {"linux": ("-fPIC", "-Wl,-z,defs"), "darwin": ("-fPIC",)}


def export_plant(plant: Plant, path: Path, *, compiler: str | None = None) -> Path:
    """Build a ground-truth plant as an FMU.

    Args:
        plant: one of `exlinn_fmi.plants`.
        path: the file to write, or the folder to write ``<model name>.fmu`` into.
        compiler: C compiler command; default: the environment's CC, else cc, gcc or clang, else ziglang.

    Returns:
        The file written.

    Raises:
        InputError: there is no C compiler.
        RunError: the compiler failed, or the file could not be written.
    """
    return export_model(plant_model(plant), path, compiler=compiler)


def export_system(
    system: LagrangianSystem,
    path: Path,
    *,
    name: str,
    description: str = "",
    start: Mapping[str, float] | None = None,
    compiler: str | None = None,
) -> Path:
    """Build any extended Lagrangian system, a learned one for instance, as an FMU.

    Outputs are the states, the accelerations and the stored energy, named ``energy``.

    Args:
        system: the equations of motion.
        path: the file to write, or the folder to write ``<name>.fmu`` into.
        name: name of the FMU, a C identifier.
        description: one line.
        start: initial state by name, 0 where not given.
        compiler: as for `export_plant`.

    Raises:
        InputError: there is no C compiler.
        RunError: the compiler failed, or the file could not be written.
    """
    return export_model(system_model(system, name, description, start), path, compiler=compiler)


def export_model(model: StateSpaceModel, path: Path, *, compiler: str | None = None) -> Path:
    """Build a state-space model as an FMU; arguments and errors as for `export_plant`."""
    import fmpy

    file = path / f"{model.identifier}.fmu" if path.is_dir() else path
    members = {name: text.encode() for name, text in fmu_texts(model).items()}
    binary = f"{model.identifier}{fmpy.sharedLibraryExtension}"
    members[f"binaries/{fmpy.platform}/{binary}"] = _compile(members, binary, find_compiler(compiler))
    write_bytes(file, _pack(members))
    return file


def find_compiler(compiler: str | None = None) -> list[str]:
    """The C compiler's command line.

    Args:
        compiler: command asked for, with its arguments; default as said at `export_plant`.

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


def _compile(members: Mapping[str, bytes], binary: str, compiler: list[str]) -> bytes:
    """Compile the sources to a shared library that holds no path of this machine, debug information included.

    Raises:
        RunError: with what the compiler said.
    """
    with tempfile.TemporaryDirectory(prefix="exlinn-export-") as folder:
        for name, content in members.items():
            if name.startswith("sources/"):
                (Path(folder) / Path(name).name).write_bytes(content)
        here = f"-ffile-prefix-map={folder}=."
        command = [
            *compiler,
            *FLAGS,
            *PLATFORM_FLAGS.get(sys.platform, ()),
            here,
            SOURCE,
            "-o",
            binary,
            "-lm",
        ]
        result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if result.returncode:
            said = (result.stderr or result.stdout).strip()[:4000]
            raise RunError(
                f"the C compiler failed: {shlex.join(command)}\n{said}\n"
                "choose another C compiler with the environment variable CC"
            )
        return (Path(folder) / binary).read_bytes()


def _pack(members: Mapping[str, bytes]) -> bytes:
    """A zip file of sorted members with a fixed date, so that it depends on their contents alone."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(members):
            info = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            info.create_system = 3  # Unix, wherever it is packed
            info.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
            archive.writestr(info, members[name])
    return stream.getvalue()

"""From a model to an FMU file: generate, compile, pack. The same input gives the same bytes.

An FMU has C inside and no Python: FMI 2.0, Co-Simulation and Model Exchange in one, sources included.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

from exlinn_fmi.data.files import write_bytes
from exlinn_fmi.export.c_code import fmu_texts
from exlinn_fmi.export.model import StateSpaceModel, plant_model, system_model
from exlinn_fmi.export.model_description import SOURCE
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.toolchain import compile_library, find_compiler

# No contraction to fused multiply-add: every platform gives the same trajectory.
FLAGS = ("-O2", "-std=c99", "-fvisibility=hidden", "-ffp-contract=off")


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
    sources = {name.removeprefix("sources/"): c for name, c in members.items() if name.startswith("sources/")}
    command = find_compiler(compiler)
    members[f"binaries/{fmpy.platform}/{binary}"] = compile_library(sources, SOURCE, binary, FLAGS, command)
    write_bytes(file, _pack(members))
    return file


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

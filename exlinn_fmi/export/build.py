"""From a model to an FMU file: generate, compile, pack. The same input gives the same bytes.

An FMU has C inside and no Python: Co-Simulation and Model Exchange in one, sources included.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from exlinn_fmi.data.files import write_bytes
from exlinn_fmi.errors import InputError
from exlinn_fmi.export.card import Card
from exlinn_fmi.export.contents import fmu_members
from exlinn_fmi.export.model import Ranges, StateSpaceModel, expanded_model, plant_model, system_model
from exlinn_fmi.export.model_description import Version
from exlinn_fmi.export.platforms import PLATFORMS, compile_for, host, suffix, universal
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.expansion import expand
from exlinn_fmi.mechanics.learned import ModelSpec, Weights, learned_system
from exlinn_fmi.mechanics.plant import Plant


@dataclass(frozen=True)
class Options:
    """How an FMU is written.

    Args:
        fmi: major version of FMI.
        arrays: whether states form an array variable (FMI 3 alone).
        platforms: what to compile for, names of FMI 3.0 such as ``x86_64-linux``; this machine if not given.
        compiler: C compiler command for this machine's platform; default: the environment's CC, else cc,
            gcc or clang, else ziglang.
    """

    fmi: Version = 2
    arrays: bool = False
    platforms: Sequence[str] = ()
    compiler: str | None = None

    def __post_init__(self) -> None:
        if self.arrays and self.fmi == 2:
            raise InputError("FMI 2.0 knows no arrays; ask for FMI 3.0 (--fmi 3)")


def export_plant(plant: Plant, path: Path, options: Options | None = None) -> Path:
    """Build a ground-truth plant as an FMU.

    Args:
        plant: one of `exlinn_fmi.plants`.
        path: the file to write, or the folder to write ``<model name>.fmu`` into.
        options: how.

    Returns:
        The file written.

    Raises:
        InputError: there is no C compiler, or none for a platform asked for.
        RunError: the compiler failed, or the file could not be written.
    """
    return export_model(plant_model(plant), path, options)


def export_system(
    system: LagrangianSystem,
    path: Path,
    *,
    name: str,
    description: str = "",
    start: Mapping[str, float] | None = None,
    options: Options | None = None,
) -> Path:
    """Build any extended Lagrangian system as an FMU.

    Outputs are the states, the accelerations and the stored energy, named ``energy``.

    Args:
        system: the equations of motion.
        path: the file to write, or the folder to write ``<name>.fmu`` into.
        name: name of the FMU, a C identifier.
        description: one line.
        start: initial state by name, 0 where not given.
        options: how.

    Raises:
        InputError: there is no C compiler, or none for a platform asked for.
        RunError: the compiler failed, or the file could not be written.
    """
    return export_model(system_model(system, name, description, start), path, options)


def export_learned(
    spec: ModelSpec,
    weights: Weights,
    path: Path,
    *,
    name: str,
    description: str = "learned extended Lagrangian model",
    start: Mapping[str, float] | None = None,
    ranges: Ranges | None = None,
    card: Card | None = None,
    options: Options | None = None,
) -> Path:
    """Build a learned model as an FMU: networks in loops, its range watched, with a model card.

    Args:
        spec: its description.
        weights: its weights.
        path: the file to write, or the folder to write ``<name>.fmu`` into.
        name: name of the FMU, a C identifier.
        description: one line.
        start: initial state by name; where not given, what is nearest to 0 in its range.
        ranges: smallest and largest value of states and inputs in the training data, by name.
        card: where the model came from and how good it is.
        options: how.

    Raises:
        InputError: there is no C compiler, or none for a platform asked for.
        RunError: the compiler failed, or the file could not be written.
    """
    return export_model(learned_model(spec, weights, name, description, start, ranges), path, options, card)


def learned_model(
    spec: ModelSpec,
    weights: Weights,
    name: str,
    description: str = "",
    start: Mapping[str, float] | None = None,
    ranges: Ranges | None = None,
) -> StateSpaceModel:
    """What the FMU of a learned model is made from; arguments as for `export_learned`."""
    expansion = expand(spec, weights)
    if expansion is None:
        return system_model(learned_system(spec, weights), name, description, start, ranges)
    return expanded_model(expansion, name, description, start, ranges)


def export_model(
    model: StateSpaceModel, path: Path, options: Options | None = None, card: Card | None = None
) -> Path:
    """Build a state-space model as an FMU; arguments and errors as for `export_learned`."""
    options = options or Options()
    members = fmu_members(model, options.fmi, options.arrays, card)
    files = {Path(name).name: content for name, content in members.items() if name.startswith("sources/")}
    names = tuple(options.platforms) or (host(),)
    libraries = compile_for(names, files, model.identifier, options.compiler)
    for folder, parts in _folders(libraries, options.fmi).items():
        library = f"{model.identifier}{suffix(next(iter(parts)))}"
        members[f"binaries/{folder}/{library}"] = universal(parts)
    file = path / f"{model.identifier}.fmu" if path.is_dir() else path
    write_bytes(file, _pack(members))
    return file


def _folders(libraries: Mapping[str, bytes], fmi: Version) -> dict[str, dict[str, bytes]]:
    """Libraries by the folder that FMI wants them in."""
    found: dict[str, dict[str, bytes]] = {}
    for name, library in libraries.items():
        folder = PLATFORMS[name].folder if fmi == 2 and name in PLATFORMS else name
        found.setdefault(folder, {})[name] = library
    return found


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

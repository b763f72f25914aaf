"""What `exlinn init` writes: a scenario to go on with, for an FMU or for recordings."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from exlinn_fmi.data.files import write_text
from exlinn_fmi.errors import InputError

FMU, TABLES = ".fmu", (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq")


def draft(files: Sequence[Path], out: Path | None = None) -> str:
    """Write a scenario for an FMU, or for recordings.

    Args:
        files: one FMU, or tables.
        out: the file to write; ``<stem of the first>.yaml`` in the present folder if not given.

    Returns:
        What was written, and what to do next.

    Raises:
        InputError: the files cannot be used, or the scenario is there already.
    """
    kinds = {FMU if file.suffix.lower() == FMU else "table" for file in files if _checked(file)}
    if len(kinds) > 1 or (kinds == {FMU} and len(files) > 1):
        raise InputError("expected one FMU, or one recording or more; found both, or several FMUs")
    target = out or Path(f"{files[0].stem}.yaml")
    if target.exists():
        raise InputError(f"{target}: is there already, and is left as it is; give another file by --out")
    names = [Path(os.path.relpath(file, target.parent)).as_posix() for file in files]
    text = _fmu(files[0], names[0], target) if kinds == {FMU} else _tables(files[0], names, target)
    write_text(target, text)
    todo = sum("TODO" in line for line in text.splitlines())
    following = f"next: exlinn validate {shlex.quote(str(target))}"
    return f"{target}  ({todo} places to look at, marked TODO)\n\n{following}"


def held_inputs(file: Path) -> str:
    """What the user of an FMU by itself should know of its inputs; nothing where it has none."""
    from exlinn_fmi.components.fmu_file import read_description
    from exlinn_fmi.scenario.draft import PLANT

    names = [f"{PLANT}.{v.name}" for v in read_description(file).variables if v.causality == "input"]
    shown = ", ".join(names[:6]) + (", …" if len(names) > 6 else "")
    ways = f"--set {names[0]}=VALUE, or signals: exlinn init {shlex.quote(str(file))}" if names else ""
    return f"inputs are held at their start values: {shown} ({ways})" if names else ""


def _checked(file: Path) -> bool:
    """Whether a file is there and of a kind that a scenario can be written for.

    Raises:
        InputError: it is not.
    """
    if not file.is_file():
        raise InputError(f"{file}: no such file; give an FMU (.fmu), or recordings (.csv, .parquet)")
    if file.suffix.lower() not in (FMU, *TABLES):
        raise InputError(f"{file}: expected an FMU (.fmu), or recordings ({', '.join(TABLES)})")
    return True


def _fmu(file: Path, name: str, target: Path) -> str:
    from exlinn_fmi.components.fmu_file import check_runnable, read_description
    from exlinn_fmi.scenario.draft import fmu_draft

    description = read_description(file)
    check_runnable(description)
    return fmu_draft(description, name, shlex.quote(target.as_posix()))


def _tables(first: Path, names: Sequence[str], target: Path) -> str:
    from exlinn_fmi.data.foreign import columns_with_units
    from exlinn_fmi.scenario.draft_data import data_draft

    return data_draft(names, columns_with_units(first), shlex.quote(target.as_posix()))

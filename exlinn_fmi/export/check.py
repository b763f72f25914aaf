"""`exlinn export check`: is an FMU valid, and does it do what its reference trajectories say?

Validity is FMPy's word (XML schema, model structure, units), the schemas of FMI 3's other files, and what
neither looks at: that each binary and source has the name it should have. Trajectories run through FMPy as
Co-Simulation; derivatives are compared through Model Exchange at every point of the run.
"""

from __future__ import annotations

import csv
import io
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import c_double
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.errors import FmuError
from exlinn_fmi.export.contents import EXTRA
from exlinn_fmi.export.platforms import PLATFORMS
from exlinn_fmi.export.reference import INPUTS, OUTPUTS

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""Largest difference from a reference trajectory, relative to the largest value of each variable."""


@dataclass(frozen=True)
class Finding:
    """What a check found.

    Args:
        problems: what is wrong, one line each.
        runs: largest relative difference from the reference by interface; none without a reference.
    """

    problems: tuple[str, ...]
    runs: dict[str, float]


def check_fmu(path: Path) -> Finding:
    """Validate an FMU and run it against the reference trajectories inside.

    Args:
        path: the FMU.

    Raises:
        FmuError: it is no FMU.
    """
    from fmpy.validation import validate_fmu

    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            problems = [*_schemas(archive, names)]
            tables = [
                _table(archive.read(f"{EXTRA}/{name}").decode()) if f"{EXTRA}/{name}" in names else None
                for name in (INPUTS, OUTPUTS)
            ]
    except (OSError, zipfile.BadZipFile) as error:
        raise FmuError(
            f"{path}: cannot be read as an FMU ({error}); give a file that `exlinn export` wrote"
        ) from error
    if "modelDescription.xml" not in names:
        raise FmuError(f"{path}: there is no modelDescription.xml in it; give an FMU")
    problems = [*map(str, validate_fmu(str(path))), *problems]
    if problems:
        return Finding(tuple(problems), {})
    problems = _names(path, names)
    inputs, outputs = tables
    if inputs is None and not _has_states(path):
        return Finding(tuple(problems), {})  # a controller, which is held to the one in process by a test
    if inputs is None or outputs is None:
        return Finding((*problems, "there are no reference trajectories in it"), {})
    runs = {kind: _compare(path, kind, inputs, outputs) for kind in ("CoSimulation", "ModelExchange")}
    for kind, (off, where) in runs.items():
        if not off <= TOLERANCE:
            problems.append(f"{kind}: {where} differs from the reference by {off:.3g} of its size")
    return Finding(tuple(problems), {kind: off for kind, (off, _) in runs.items()})


def _has_states(path: Path) -> bool:
    """Whether anything in it moves by itself."""
    import fmpy

    return bool(fmpy.read_model_description(str(path)).derivatives)


def _schemas(archive: zipfile.ZipFile, names: list[str]) -> Iterator[str]:
    """What XML schemas say of FMI 3's other files."""
    import fmpy
    from lxml import etree

    folder = Path(fmpy.__file__).parent / "schema" / "fmi3"
    files = {
        "sources/buildDescription.xml": "fmi3BuildDescription.xsd",
        "terminalsAndIcons/terminalsAndIcons.xml": "fmi3TerminalsAndIcons.xsd",
    }
    for name, schema in files.items():
        if name in names:
            validator = etree.XMLSchema(file=str(folder / schema))
            if not validator.validate(etree.fromstring(archive.read(name))):
                yield from (f"{name}: {entry.message}" for entry in validator.error_log)


def _names(path: Path, names: list[str]) -> list[str]:
    """Files that are missing: binaries of the right name, sources, icon, documentation."""
    import fmpy

    description = fmpy.read_model_description(str(path))
    interface = description.coSimulation or description.modelExchange
    identifier, problems = interface.modelIdentifier, []
    fmi2 = description.fmiVersion.startswith("2")
    known = {p.folder if fmi2 else name: p.suffix for name, p in PLATFORMS.items()}
    folders = sorted(
        {name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") > 1}
    )
    problems += [] if folders else ["there is no binary in it"]
    for folder in folders:
        wanted = f"binaries/{folder}/{identifier}{known.get(folder, '.so')}"
        if wanted not in names:
            problems.append(f"{wanted} is missing")
    wanted_files = ["documentation/index.html", "model.png" if fmi2 else "terminalsAndIcons/icon.png"]
    wanted_files += [f"sources/{name}" for build in description.buildConfigurations for name in _files(build)]
    return problems + [f"{name} is missing" for name in wanted_files if name not in names]


def _files(build: Any) -> list[str]:
    return [name for part in build.sourceFileSets for name in part.sourceFiles]


def _table(text: str) -> tuple[list[str], Array]:
    """Names and numbers of a CSV file."""
    rows = list(csv.reader(io.StringIO(text)))
    return rows[0], np.array(rows[1:], dtype=float)


def _compare(
    path: Path, kind: str, inputs: tuple[list[str], Array], outputs: tuple[list[str], Array]
) -> tuple[float, str]:
    """Largest relative difference from the reference, and the variable that has it."""
    (drives, u), (shown, y) = inputs, outputs
    with _opened(path, kind) as fmu:
        own = np.array([*_run(fmu, kind, drives[1:], u, shown[1:], y[:, 1:])])
    expected = y[: len(own), 1:]
    size = np.maximum(np.abs(expected).max(axis=0), 1e-9)
    difference = np.abs(own - expected).max(axis=0) / size
    difference[np.isnan(difference)] = np.inf
    worst = int(np.argmax(difference))
    return float(difference[worst]), shown[1 + worst]


def _run(
    fmu: Driven, kind: str, drives: list[str], u: Array, shown: list[str], y: Array
) -> Iterator[list[float]]:
    """Outputs at each point: of a run (Co-Simulation), or at the states of the reference (Model Exchange)."""
    for k, row in enumerate(u):
        if kind == "ModelExchange":
            fmu.set_states(y[k])
        fmu.set(drives, row[1:])
        yield fmu.get(shown)
        if kind == "CoSimulation" and k + 1 < len(u):
            fmu.step(float(row[0]), float(u[k + 1, 0] - row[0]))


class Driven:
    """An instance of either version, driven through FMPy's raw classes.

    Args:
        path: the FMU.
        kind: ``CoSimulation`` or ``ModelExchange``.
    """

    def __init__(self, path: Path, kind: str) -> None:
        import fmpy
        from fmpy.simulation import instantiate_fmu

        self.folder = Path(fmpy.extract(str(path)))
        self._description = fmpy.read_model_description(str(path))
        self._references = {v.name: v.valueReference for v in self._description.modelVariables}
        derivatives = [d.variable for d in self._description.derivatives]
        self._states = sum(
            int(np.prod([d.start for d in v.dimensions] or [1], dtype=int)) for v in derivatives
        )
        self._fmi2 = self._description.fmiVersion.startswith("2")
        self._fmu = instantiate_fmu(str(self.folder), self._description, kind)
        self._start(kind)

    def _start(self, kind: str) -> None:
        if self._fmi2:
            self._fmu.setupExperiment(startTime=0.0)
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        if kind == "ModelExchange":
            (self._fmu.newDiscreteStates if self._fmi2 else self._fmu.updateDiscreteStates)()
            self._fmu.enterContinuousTimeMode()

    def set(self, names: list[str], values: Array) -> None:
        """Set real variables."""
        call = self._fmu.setReal if self._fmi2 else self._fmu.setFloat64
        call([self._references[n] for n in names], [float(v) for v in values])

    def set_states(self, values: Array) -> None:
        """Set the continuous states to the first of these values: the reference begins with them."""
        self._fmu.setContinuousStates((c_double * self._states)(*values[: self._states]), self._states)

    def get(self, names: list[str]) -> list[float]:
        """Values of real variables."""
        call = self._fmu.getReal if self._fmi2 else self._fmu.getFloat64
        return list(call([self._references[n] for n in names]))

    def step(self, t: float, h: float) -> None:
        """A communication step."""
        self._fmu.doStep(currentCommunicationPoint=t, communicationStepSize=h)

    def close(self) -> None:
        """Free the instance and its folder."""
        self._fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[Driven]:
    driven = Driven(path, kind)
    try:
        yield driven
    finally:
        driven.close()

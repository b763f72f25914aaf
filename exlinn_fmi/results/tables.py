"""The files of a run folder: reading them for figures and report, and writing where a result came from."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import pandas as pd

from exlinn_fmi.data.files import file_hash, read_record, write_json
from exlinn_fmi.data.tables import read_table
from exlinn_fmi.errors import DataError, Problem, ScenarioError
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.explain import schema_findings
from exlinn_fmi.scenario.schema import Scenario
from exlinn_fmi.scenario.words import key_path

DISTRIBUTION = "exlinn-fmi"
LEARNED = "_learned"
"""Suffix of the evaluation column that holds the learned model's side of a measured one."""


@dataclass(frozen=True)
class Table:
    """A table of a run with the units of its columns."""

    frame: pd.DataFrame
    units: Mapping[str, str] = field(default_factory=dict)

    def unit(self, column: str) -> str:
        """Unit of a column as text, empty where none is known or the column has no dimension."""
        unit = self.units.get(column) or ""
        return "" if unit == "1" else unit


@dataclass(frozen=True)
class RunFiles:
    """What a run folder holds; parts of the run that did not happen are None or empty.

    Args:
        folder: the run folder.
        scenario: the scenario as run.
        scenario_text: its text.
        evaluation: measured (``name``) against learned (``name_learned``) on the first unseen test.
        training: loss over iterations.
        parameters: identified parameters with their true values.
        curves: functions of position and velocity that the model holds, with 95 % bands.
        trajectories: what the co-simulation recorded.
        study: one row for each run of a robustness study.
        metrics: value (or text) by flat key, None where it was not finite.
        provenance: what `provenance` gave.
    """

    folder: Path
    scenario: Scenario
    scenario_text: str
    evaluation: Table | None = None
    training: pd.DataFrame | None = None
    parameters: pd.DataFrame | None = None
    curves: pd.DataFrame | None = None
    trajectories: Table | None = None
    study: pd.DataFrame | None = None
    metrics: Mapping[str, float | str | None] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)


def read_run(folder: Path) -> RunFiles:
    """Read whatever a run has left in its folder.

    Args:
        folder: a run folder; all it needs to hold is ``scenario.yaml``.

    Raises:
        DataError: it is no run folder, or one of its files cannot be read.
        ScenarioError: its scenario has mistakes.
    """
    file = folder / "scenario.yaml"
    if not file.is_file():
        raise DataError(
            f"{folder}: found no scenario.yaml, so this is not the folder of a run; "
            "give one that `exlinn run` has written, e.g. runs/<scenario>"
        )
    text = file.read_text("utf-8")
    return RunFiles(
        folder=folder,
        scenario=_scenario(file, text),
        scenario_text=text,
        evaluation=_table(folder / "evaluation"),
        training=_csv(folder / "training.csv"),
        parameters=_csv(folder / "parameters.csv"),
        curves=_csv(folder / "curves.csv"),
        trajectories=_table(folder / "trajectories"),
        study=_csv(folder / "study.csv"),
        metrics=read_record(folder / "metrics.json"),
        provenance=read_record(folder / "provenance.json"),
    )


def provenance(
    scenario_file: Path, inputs: Sequence[Path], seed: int, stages: Mapping[str, Any]
) -> dict[str, Any]:
    """Where a result comes from: versions, seed, SHA-256 of all files that went in, command line, stages.

    Args:
        scenario_file: the scenario.
        inputs: FMUs, data and signal files that the run read.
        seed: the scenario's seed.
        stages: what was done, by stage: ``status`` (``ran``, ``cached``, ``failed``) and ``seconds`` of each.

    Returns:
        A record for `write_provenance`; the caller may add ``error`` (text) and ``warnings`` (texts).

    Raises:
        DataError: an input cannot be read.
    """
    seconds = [stage.get("seconds") for stage in stages.values() if isinstance(stage, Mapping)]
    return {
        "exlinn": _version(DISTRIBUTION),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "scenario": scenario_file.name,
        "seed": seed,
        "duration_s": float(sum(s for s in seconds if s is not None)),
        "stages": dict(stages),
        "files": _hashes([scenario_file, *inputs]),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": _packages(),
    }


def write_provenance(folder: Path, record: Mapping[str, Any]) -> None:
    """Write ``provenance.json``.

    Raises:
        StorageError: it could not be written.
    """
    write_json(folder / "provenance.json", record)


def _hashes(files: Sequence[Path]) -> dict[str, str]:
    """Hash by name, or by path where two files have the same name."""
    files = list(dict.fromkeys(files))
    names = [file.name for file in files]
    return {file.name if names.count(file.name) == 1 else file.as_posix(): file_hash(file) for file in files}


def _scenario(file: Path, text: str) -> Scenario:
    """A scenario that was run before; the files that it names need not be there any more."""
    document = parse(text)
    findings = schema_findings(document.data, document.faulty)
    problems = [Problem(key_path(at), message, document.line(at)) for at, message in findings]
    if document.problems or problems:
        raise ScenarioError(str(file), [*document.problems, *problems])
    return Scenario.model_validate(document.data)


def _version(distribution: str) -> str | None:
    """Installed version of a distribution, None where it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _packages() -> dict[str, str]:
    """Installed version of each package that exlinn depends on, by name."""
    try:
        requirements = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:  # run from a source tree that is not installed
        return {}
    names = sorted(re.split(r"[^\w.-]", r)[0] for r in requirements if "extra ==" not in r)
    return {name: version for name in names if (version := _version(name)) is not None}


def _table(stem: Path) -> Table | None:
    """A table with its units, None where there is none or it has no rows."""
    if not any(stem.with_name(stem.name + suffix).is_file() for suffix in (".parquet", ".csv")):
        return None
    frame, units = read_table(stem)
    return Table(frame, units) if len(frame) else None


def _csv(file: Path) -> pd.DataFrame | None:
    """A small CSV file, None where there is none or it has no rows."""
    if not file.is_file():
        return None
    try:
        frame = pd.read_csv(file)
    except (OSError, ValueError) as error:
        raise DataError(f"{file}: cannot be read as CSV ({error}); make it again or remove it") from error
    return frame if len(frame) else None

"""Scenario files: read, override, check. All mistakes are reported at once, before anything runs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from exlinn_fmi.components.base import Variable
from exlinn_fmi.errors import Problem, ScenarioError
from exlinn_fmi.scenario import (
    check_data,
    check_design,
    check_events,
    check_graph,
    check_learn,
    check_study,
)
from exlinn_fmi.scenario.document import Document, parse
from exlinn_fmi.scenario.editor import json_schema
from exlinn_fmi.scenario.explain import Finding, schema_findings
from exlinn_fmi.scenario.learning import Measured
from exlinn_fmi.scenario.overrides import apply
from exlinn_fmi.scenario.places import unfilled
from exlinn_fmi.scenario.schema import (
    FmuComponent,
    ModelComponent,
    NmpcComponent,
    PythonComponentSpec,
    Scenario,
)
from exlinn_fmi.scenario.signals import Table
from exlinn_fmi.scenario.ssp import SUFFIXES, scenario_text
from exlinn_fmi.scenario.survey import Inspect, survey
from exlinn_fmi.scenario.words import KeyPath, key_path, missing_file

__all__ = ["Inspect", "LoadedScenario", "json_schema", "load_scenario", "named_files"]

TABLES = (".csv", ".tsv", ".parquet", ".pq")
"""Suffixes of files that hold data."""
CHECKS = (
    check_graph.components,
    check_graph.trusted,
    check_graph.connections,
    check_graph.start_values,
    check_graph.steps,
    check_graph.coupling,
    check_graph.recorded,
    check_events.events,
    check_learn.signals,
    check_learn.learning,
    check_learn.control,
    check_data.measured,
    check_design.design,
    check_study.study,
)


@dataclass(frozen=True)
class LoadedScenario:
    """A scenario that was read and checked.

    Args:
        scenario: what it says.
        file: the file it was read from.
        folder: the folder that its relative paths start from.
        text: the scenario as run: the file's text, with overrides written in.
        overrides: what was written in.
    """

    scenario: Scenario
    file: Path
    folder: Path
    text: str
    _lines: dict[str, int] = field(repr=False, compare=False)
    overrides: tuple[str, ...] = ()

    def line(self, path: str) -> int:
        """Line in the file of a key path such as ``learn.training[0].duration``, 0 where it has none."""
        return self._lines.get(re.sub(r"\.(\d+)(?=[.\[]|$)", r"[\1]", path), 0)


def load_scenario(
    path: Path | str, overrides: Sequence[str] = (), inspect: Inspect | None = None
) -> LoadedScenario:
    """Read a scenario file and check it.

    Args:
        path: the file, YAML 1.2; or an FMU, which is run by itself, or a system of SSP.
        overrides: ``key.path=value`` each, e.g. ``simulate.stop=5`` or ``learn.training[0].duration=2``.
        inspect: finds the variables of a component without running it, for the checks of their use.

    Raises:
        ScenarioError: with every mistake in the file and the overrides.
    """
    file = Path(path)
    foreign = file.suffix.lower() in (*SUFFIXES, ".fmu", *TABLES)
    text, folder = _translated(file, inspect) if foreign else (_read(file), file.parent)
    document = parse(text)
    if foreign:
        document = replace(document, lines={})  # there are none in the file
    problems = list(document.problems)
    if document.data is None and not problems:
        problems.append(Problem("", "the file is empty; a scenario has at least `name` and `components`"))
    applied: dict[KeyPath, str] = {}
    data: Any = document.data
    if overrides and isinstance(data, dict) and not problems:
        text, applied, misfits = apply(text, overrides)
        problems += misfits
        overridden = parse(text)
        data = overridden.data
        # Lines of this text are not those of the file.
        problems += [Problem(p.path, f"{p.message} (after the overrides)") for p in overridden.problems]
    if data is not None:
        findings = list(unfilled(data)) if isinstance(data, dict) else []
        findings += schema_findings(data, document.faulty.union(at for at, _ in findings))
        if not any(text.startswith("still TODO") for _, text in findings):
            known, more = survey(data, folder, inspect)
            findings += more
            for check in CHECKS:
                findings += check(known)
        problems += [_problem(finding, document, applied) for finding in dict.fromkeys(findings)]
    if problems:
        raise ScenarioError(str(file), list(dict.fromkeys(problems)))
    lines = {key_path(at): line for at, line in document.lines.items()}
    return LoadedScenario(Scenario.model_validate(data), file, folder, text, lines, tuple(overrides))


def _translated(file: Path, inspect: Inspect | None) -> tuple[str, Path]:
    """The scenario that an FMU or a system structure (SSP) stands for, and the folder of its files.

    Raises:
        ScenarioError: the file cannot be used.
    """
    if not file.is_file():
        raise ScenarioError(str(file), [Problem("", missing_file(file.name, file.parent))])
    if file.suffix.lower() in TABLES:
        hint = f"a table of data, no scenario; `exlinn init {file}` writes one that learns from it"
        raise ScenarioError(str(file), [Problem("", hint)])
    if file.suffix.lower() == ".fmu":
        from exlinn_fmi.components.fmu_file import read_description
        from exlinn_fmi.scenario.draft import lone_fmu

        return lone_fmu(read_description(file)), file.parent

    def look(fmu: Path) -> Sequence[Variable]:
        return inspect(FmuComponent(fmu=str(fmu)), Path()) if inspect is not None else ()

    return scenario_text(file, look)


def saved_scenario(file: Path) -> Scenario:
    """The scenario in a run folder: it was checked when it ran, and files that it names lie elsewhere.

    Args:
        file: ``scenario.yaml`` of a run folder.

    Raises:
        ScenarioError: there is none.
    """
    return Scenario.model_validate(parse(_read(file)).data)


def _read(file: Path) -> str:
    """The text of a file.

    Raises:
        ScenarioError: there is none, or it is no text.
    """
    try:
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ScenarioError(str(file), [Problem("", missing_file(file.name, file.parent))]) from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise ScenarioError(str(file), [Problem("", "not UTF-8 text; save it as UTF-8", line)]) from None
    except IsADirectoryError:
        message = "is a folder; give a scenario (YAML), an FMU or a system of SSP"
        raise ScenarioError(str(file), [Problem("", message)]) from None
    except OSError as error:
        raise ScenarioError(str(file), [Problem("", f"cannot be read: {error.strerror}")]) from None


def _problem(finding: Finding, document: Document, applied: dict[KeyPath, str]) -> Problem:
    """A finding with its line, or with the override that it comes from."""
    at, message = finding
    for path, override in applied.items():
        if at[: len(path)] == path:
            return Problem(key_path(at), f"{message} (override {override!r})")
    return Problem(key_path(at), message, document.line(at))


def named_files(*sections: object, folder: Path | None = None) -> list[str]:
    """Names of the files that sections of a scenario name, relative to its folder, each once.

    Args:
        sections: sections, or lists of them.
        folder: the scenario's folder; with it the Python modules that lie there count as well.
    """
    return list(dict.fromkeys(name for section in sections for name in _named(section, folder)))


def _named(section: object, folder: Path | None) -> Iterator[str]:
    if isinstance(section, FmuComponent):
        yield section.fmu
    elif isinstance(section, Table):
        yield section.file
    elif isinstance(section, Measured):
        yield from (*section.files, *section.test)
    elif isinstance(section, PythonComponentSpec):
        module = section.python.split(":")[0].replace(".", "/") + ".py"
        if folder is not None and (folder / module).is_file():
            yield module
    elif isinstance(section, ModelComponent):
        yield from _model_files(section.model)
    elif isinstance(section, NmpcComponent):
        yield from _model_files(section.nmpc.model)
    members: Any = vars(section).values() if isinstance(section, BaseModel) else section
    if isinstance(members, dict):
        members = members.values()
    if not isinstance(members, str | bytes) and hasattr(members, "__iter__"):
        for member in members:
            yield from _named(member, folder)


def _model_files(model: str) -> tuple[str, ...]:
    if model == "learned" or model.startswith("plant:"):
        return ()
    return f"{model}/model.json", f"{model}/model.safetensors"

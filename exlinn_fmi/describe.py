"""What `exlinn info` says of a scenario, an FMU or a run folder, as plain text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from exlinn_fmi.components.base import TEXT_TYPES, Variable
from exlinn_fmi.components.texts import shown
from exlinn_fmi.data.files import read_json
from exlinn_fmi.errors import InputError

if TYPE_CHECKING:
    from exlinn_fmi.scenario.schema import Scenario
    from exlinn_fmi.workspace import Run

ORDER = ("independent", "input", "output", "parameter", "local")
"""Causalities as variables are listed."""


def describe(target: Path, overrides: Sequence[str] = ()) -> str:
    """Describe a file or folder by what it is.

    Args:
        target: a scenario file, an FMU or a run folder.
        overrides: ``key.path=value`` texts for a scenario.

    Raises:
        InputError: it is none of these, or is at fault itself.
    """
    if target.is_dir():
        return describe_run(target)
    if not target.exists():
        raise InputError(f"{target}: no such file or folder; give a scenario, an FMU or a run folder")
    if target.suffix == ".fmu":
        return f"{target}\n" + describe_fmu(target)
    return describe_scenario(target, overrides)


def describe_fmu(file: Path) -> str:
    """An FMU: how it can be used, what it is capable of, its arrays, clocks and variables."""
    from exlinn_fmi.components.fmu_file import read_description

    d = read_description(file)
    lines = [f"FMI {d.version}.0, made by {d.tool}"]
    for use in d.interfaces:
        can = [word for word, there in use.capabilities() if there]
        lines.append(f"{use.kind}: {', '.join(can) or 'no more than stepping'}")
    if d.state_count or d.indicator_count:
        lines.append(f"{d.state_count} continuous states, {d.indicator_count} event indicators")
    for name, shape in d.arrays.items():
        lines.append(f"array {name}[{','.join(map(str, shape))}]")
    for clock in d.clocks:
        every = "" if clock.interval is None else f", every {clock.interval:g} s from {clock.shift:g} s on"
        lines.append(f"clock {clock.name}: {clock.causality}, {clock.kind}{every}")
    if d.structural:
        lines.append(f"structural parameters, which size arrays: {', '.join(sorted(d.structural))}")
    return "\n".join([*lines, "", describe_variables(d.variables)])


def describe_variables(variables: Iterable[Variable]) -> str:
    """Variables as a table: causality, name, unit, type, start, direct feed-through, description."""
    rows = [("causality", "name", "unit", "type", "start", "depends on", "")]
    for v in sorted(variables, key=lambda v: ORDER.index(v.causality)):
        through = "" if v.causality != "output" else "?" if v.depends_on is None else " ".join(v.depends_on)
        start = "" if v.start is None else f"{v.start:.9g}"
        if v.start is not None and v.type in TEXT_TYPES:
            start = repr(shown(v.start))
        rows.append((v.causality, v.name, v.unit or "", v.type, start, through, v.description))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(f"{t:<{w}}" for t, w in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def describe_scenario(file: Path, overrides: Sequence[str]) -> str:
    """A scenario: its components in stepping order, connections, loops and delays, and what it will do.

    A controller or model that is still to be learned is described without being made.
    """
    from exlinn_fmi.cosim.graph import Graph
    from exlinn_fmi.factory import outline
    from exlinn_fmi.scenario.events import event_names
    from exlinn_fmi.workspace import Run

    work = Run.open(file, None, overrides)
    components = {name: outline(name, work.scenario, work.loaded.folder) for name in work.scenario.components}
    lines = [f"{work.scenario.name}: {work.scenario.description}".rstrip(": ")]
    lines += describe_purpose(work.scenario)
    apart = [name for name in components if runs_apart(name, work)]
    if apart:
        lines.append(f"isolated, in processes of their own: {', '.join(apart)}")
    if components:
        span = work.scenario.simulate
        loops = span.loop_settings if span else None
        graph = Graph(components, work.scenario.connection_list())
        lines.append(graph.describe(loops.solver if loops else None))
    if work.scenario.events:
        labels = event_names(work.scenario.events)
        width = max(map(len, labels))
        lines.append("events")
        lines += [f"  {n:<{width}}  {e.words()}" for n, e in zip(labels, work.scenario.events, strict=True)]
    return "\n".join(lines)


def describe_purpose(scenario: Scenario) -> list[str]:
    """What a scenario does: what it learns, from what, and what it simulates."""
    from exlinn_fmi.scenario.learning import LearnFromData

    lines, learn, span = [], scenario.learn, scenario.simulate
    if learn:
        names = ", ".join(c.name for c in learn.coordinates)
        if isinstance(learn, LearnFromData):
            tests = learn.data.hold_out or len(learn.data.test)
            training = len(learn.data.files) - learn.data.hold_out
            lines.append(f"learns from measured files in {names}: {training} for training, {tests} held out")
        else:
            experiments = f"{len(learn.training)} training experiments, {len(learn.test)} tests"
            lines.append(f"learns {learn.plant} in {names}: {experiments}")
    if span:
        lines.append(f"simulates {span.stop - span.start:g} s in steps of {span.step:g} s")
    return lines or ["does nothing yet: it has neither `learn` nor `simulate`"]


def runs_apart(name: str, work: Run) -> bool:
    """Whether a component is an FMU that runs in a process of its own."""
    from exlinn_fmi.factory import is_isolated
    from exlinn_fmi.scenario.schema import FmuComponent

    spec = work.scenario.components[name]
    return isinstance(spec, FmuComponent) and is_isolated(spec, work.scenario, work.loaded.folder)


def describe_run(folder: Path) -> str:
    """A run folder: its stages, metrics and files.

    Raises:
        InputError: the folder was not written by a run.
    """
    if not (folder / "scenario.yaml").exists():
        raise InputError(
            f"{folder}: not a run folder (it has no scenario.yaml); give one that `exlinn run` wrote"
        )
    lines = [str(folder)]
    for title in ("stages", "metrics"):
        file = folder / f"{title}.json"
        lines.append(f"\n{title}")
        for name, value in (read_json(file) if file.exists() else {}).items():
            shown = (
                f"done in {value['seconds']} s"
                if title == "stages"
                else f"{value:.6g}"
                if isinstance(value, float)
                else value
            )
            lines.append(f"  {name:<36} {shown}")
    lines.append(
        "\nfiles\n  "
        + "\n  ".join(sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()))
    )
    return "\n".join(lines)

"""Checks across sections: connections, start values, steps, what is recorded and judged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any

from exlinn_fmi.components.base import TEXT_TYPES, Variable
from exlinn_fmi.components.starts import takes_start, value_problem
from exlinn_fmi.scenario.explain import Finding
from exlinn_fmi.scenario.learning import LearnFromData
from exlinn_fmi.scenario.schema import Link
from exlinn_fmi.scenario.spec import flat_starts
from exlinn_fmi.scenario.survey import Survey
from exlinn_fmi.scenario.units import linear
from exlinn_fmi.scenario.words import KeyPath, suggestion

_FITS = {("Integer", "Enumeration"), ("Enumeration", "Integer"), ("Boolean", "Integer")}
"""Pairs of types, from and to, between which no value is lost; a Real takes any."""


def components(survey: Survey) -> Iterator[Finding]:
    """A scenario without components that does more than learn from data."""
    scenario, cut = survey.scenario, survey.sound.cut
    learns_only = isinstance(scenario.learn, LearnFromData) or ("learn",) in cut
    simulates = scenario.simulate is not None or ("simulate",) in cut
    if survey.names or survey.sound.in_doubt((), "components") or (learns_only and not simulates):
        return
    yield (), "missing key 'components': what takes part, by name"


def trusted(survey: Survey) -> Iterator[Finding]:
    """Folders to trust that are not there."""
    for k, place in enumerate(survey.scenario.trust):
        if not (survey.folder / place).is_dir():
            yield ("trust", k), f"there is no folder {place!r} in {survey.folder.as_posix()!r}"


def connections(survey: Survey) -> Iterator[Finding]:
    """Ends that do not exist or do not fit, and targets that are driven twice."""
    driven: dict[str, str] = {}
    for source, targets in survey.scenario.connections.items():
        at: KeyPath = ("connections", source)
        tail, problem = survey.find(source, "output")
        if problem:
            yield at, problem
        several = isinstance(targets, list)
        for k, entry in enumerate(targets if isinstance(targets, list) else [targets]):
            here = (*at, k) if several else at
            link = entry if isinstance(entry, Link) else None
            target = entry if isinstance(entry, str) else entry.to
            head, problem = survey.find(target, "input")
            if problem:
                yield here, problem
            if target in driven:
                yield here, f"{target} is driven twice, by {driven[target]} and by {source}; keep one"
            driven.setdefault(target, source)
            if tail is not None and head is not None:
                yield from ((here, message) for message in _misfits(source, tail, target, head, link))


def _misfits(source: str, tail: Variable, target: str, head: Variable, link: Link | None) -> Iterator[str]:
    """Why one variable cannot drive another."""
    converts = link is None or link.convert
    factor, offset = (linear(tail, head) if converts else None) or (1.0, 0.0)
    changes = (factor, offset) != (1.0, 0.0) or (
        link is not None and (link.factor, link.offset) != (1.0, 0.0)
    )
    if tail.causality == "input" and head.causality == "output":
        yield f"{source} is an input and {target} an output; a connection reads from: to, so swap them"
        return
    if tail.causality == "input":
        yield f"{source} is an input; a connection begins at an output"
    elif head.causality == "parameter" and head.variability != "tunable":
        component, name = target.split(".", 1)
        yield f"{target} is a {head.variability} parameter; set it in components.{component}.start.{name}"
    elif head.clocked:
        yield f"{target} is an input of a clock, which keeps its start value; connect one without a clock"
    elif head.causality not in ("input", "parameter"):
        kind = "an output" if head.causality == "output" else "no input"
        yield f"{target} is {kind}; a connection ends at an input"
    elif converts and linear(tail, head) is None:
        yield f"unit mismatch: {source} [{tail.unit}] → {target} [{head.unit}]"
    elif changes and head.type != "Real":
        yield f"{target} is of type {head.type}, and the connection changes the value"
    elif (
        (tail.type in TEXT_TYPES or head.type != "Real")
        and head.type != tail.type
        and (tail.type, head.type) not in _FITS
    ):
        yield f"type mismatch: {source} is {tail.type}, {target} is {head.type}"


def start_values(survey: Survey) -> Iterator[Finding]:
    """Start values of what is not there, or that a variable does not take."""
    for name, spec in survey.scenario.components.items():
        known = survey.variables.get(name)
        if known is not None:
            yield from misfit_starts(("components", name, "start"), spec.start, name, known)


def misfit_starts(
    at: KeyPath, starts: Mapping[str, Any], component: str, known: Mapping[str, Variable]
) -> Iterator[Finding]:
    """Start values that the variables of a component do not take.

    Args:
        at: where the start values stand.
        starts: the values by variable.
        component: name of the component.
        known: its variables by name.
    """
    for name, value in flat_starts(starts).items():
        variable, text = known.get(name), isinstance(value, str)
        if variable is None:
            names = [v.name for v in known.values() if takes_start(v)]
            hint = suggestion(name, names, "those that take a start value")
            yield (*at, name), f"{component} has no variable {name!r}{hint}"
        elif not takes_start(variable):
            yield (*at, name), f"{component}.{name} is calculated by the component and takes no start value"
        elif text != (variable.type in TEXT_TYPES):
            found = f"text {value!r}" if text else f"{value:g}"
            yield (*at, name), f"expected {'a number' if text else 'text'}, found {found}"
        elif isinstance(value, bool) and variable.type != "Boolean":
            yield (*at, name), f"expected a number, found {'true' if value else 'false'}"
        elif text:
            continue
        elif problem := value_problem(variable, value):
            yield (*at, name), problem


def steps(survey: Survey) -> Iterator[Finding]:
    """Steps that do not fit the run or each other."""
    simulate, at = survey.scenario.simulate, ("simulate",)
    if simulate is None:
        return
    if simulate.stop <= simulate.start:
        yield (*at, "stop"), f"expected > {simulate.start:g} (simulate.start), found {simulate.stop:g}"
    elif survey.sound.in_doubt(at, "step"):
        return
    elif simulate.step > simulate.stop - simulate.start:
        span = simulate.stop - simulate.start
        yield (*at, "step"), f"the step, {simulate.step:g} s, is longer than the run, {span:g} s"
        return
    for name, spec in survey.scenario.components.items():
        if spec.step is not None and not is_multiple(spec.step, simulate.step):
            yield ("components", name, "step"), no_multiple(spec.step, simulate.step, "simulate.step")


def coupling(survey: Survey) -> Iterator[Finding]:
    """Settings of adaptive steps that do not fit the step or name what is not there."""
    simulate = survey.scenario.simulate
    if simulate is None or simulate.adaptive is None:
        return
    at, shortest = ("simulate", "adaptive"), simulate.adaptive.min_step
    if (
        shortest is not None
        and not survey.sound.in_doubt(("simulate",), "step")
        and 2 * shortest > simulate.step
    ):
        yield (
            (*at, "min_step"),
            f"expected at most half of simulate.step, {simulate.step / 2:g} s, found {shortest:g} s",
        )
    for pattern in simulate.adaptive.tolerances:
        if problem := _no_match(survey, pattern):
            yield (*at, "tolerances", pattern), problem


def is_multiple(own: float, base: float) -> bool:
    """Whether a step is an integer multiple of another, as far as decimals can be."""
    ratio = own / base
    return round(ratio) >= 1 and abs(ratio - round(ratio)) <= 1e-9 * ratio


def no_multiple(own: float, base: float, name: str) -> str:
    """Error text on a step that is not a multiple of another."""
    near = max(1, round(own / base)) * base
    return f"expected a multiple of {name}, {base:g} s, found {own:g} s; the nearest is {near:g} s"


def recorded(survey: Survey) -> Iterator[Finding]:
    """Names to record that match nothing, and a metric of what is not recorded."""
    simulate = survey.scenario.simulate
    patterns = simulate.record if simulate is not None else []
    if simulate is not None and simulate.pace is not None and "timing" in survey.names:
        yield ("components", "timing"), "the columns that tell of `pace` are called timing.NAME; rename it"
    for k, pattern in enumerate(patterns):
        problem = _no_match(survey, pattern)
        if problem:
            yield ("simulate", "record", k), problem
    metrics = survey.scenario.metrics
    several = isinstance(metrics.output, list)
    for k, output in enumerate(metrics.outputs):
        variable, problem = survey.find(output, "output")
        if simulate is not None and variable is not None:
            recorded = any(records(pattern, output, variable) for pattern in patterns)
            problem = None if recorded else f"{output} is not recorded; add it to simulate.record"
            if variable.type in TEXT_TYPES:
                problem = f"{output} is a text; metrics are of numbers"
        if problem:
            yield ("metrics", "output", k) if several else ("metrics", "output"), problem


def records(pattern: str, path: str, variable: Variable) -> bool:
    """Whether a name to record stands for a variable, as the recorder of a run takes it.

    ``*`` alone stands for inputs and outputs; another pattern for local variables as well; a name in full for
    any variable. Brackets stand for themselves.
    """
    if pattern == path:
        return True
    kinds = ("input", "output") if pattern == "*" else ("input", "output", "local")
    return variable.causality in kinds and fnmatchcase(path, pattern.replace("[", "[[]"))


def _no_match(survey: Survey, pattern: str) -> str | None:
    """Why a name to record stands for nothing, None where it stands for something or that is not known."""
    if not any(wildcard in pattern for wildcard in "*?"):
        if "." not in pattern:
            return f"expected component.variable or a pattern such as '*' or 'plant.*', found {pattern!r}"
        return survey.find(pattern, "output")[1]
    known = ((f"{name}.{v.name}", v) for name, all_ in survey.variables.items() for v in all_.values())
    if pattern == "*" or any(records(pattern, path, variable) for path, variable in known):
        return None
    component = pattern.split(".", 1)[0]
    unknown = [name for name in survey.names if name not in survey.variables]
    if any(fnmatchcase(name, component) for name in unknown) or not survey.names_are_known:
        return None
    return f"nothing fits {pattern!r}; components: {', '.join(survey.names)}"

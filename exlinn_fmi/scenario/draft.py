"""Scenarios for what a user comes with: an FMU to run by itself, and drafts for FMUs and recordings.

A draft is a scenario that is valid as it stands, with comments. What was guessed from names and units
(`guess.py`) is marked ``TODO``; where nothing could be guessed, ``TODO`` stands in the place of a value, and
the section is a comment.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from textwrap import indent

from exlinn_fmi.components.base import TEXT_TYPES, Variable
from exlinn_fmi.components.fmu_description import DefaultExperiment, FmuDescription
from exlinn_fmi.scenario.draft_text import (
    as_comment,
    as_key,
    as_name,
    as_text,
    distinct,
    kind_lines,
    scenario_name,
)
from exlinn_fmi.scenario.guess import Guess, Quantity, guess_coordinates

PLANT = "plant"
"""Name of the component that an FMU becomes."""
STOP, STEPS = 10.0, 1000
"""Stop time [s], and steps of a run, where an FMU states none."""
MOST_STEPS = 1_000_000
"""Steps of a run beyond which the step that an FMU states is not taken."""
LISTED = 20
"""Most parameters that a draft lists."""


def lone_fmu(fmu: FmuDescription) -> str:
    """A scenario that runs an FMU by itself; recorded are inputs and outputs, or all if it has no outputs."""
    start, (stop, step) = fmu.experiment.start, span(fmu.experiment)
    lines = [
        f"name: {scenario_name(fmu.path)}_fmu",
        f"description: {as_text(f'{fmu.path.name} by itself')}",
        "components:",
        f"  {PLANT}: {{fmu: {as_key(fmu.path.name)}, isolate: true}}",
        f"simulate: {{start: {start:.12g}, stop: {stop:.12g}, step: {step:.12g}{_record(fmu)}}}",
    ]
    return "\n".join(lines) + "\n"


def span(experiment: DefaultExperiment) -> tuple[float, float]:
    """Stop time and step [s] of a run, as the FMU proposes them where it does."""
    stop = experiment.stop if experiment.stop is not None else experiment.start + STOP
    duration, step = stop - experiment.start, experiment.step
    sensible = step is not None and duration / MOST_STEPS <= step <= duration / 10
    return stop, step if step is not None and sensible else float(f"{duration / STEPS:.6g}")


def _record(fmu: FmuDescription) -> str:
    """What is recorded: inputs and outputs, or all if it has no outputs."""
    kinds = {v.causality for v in fmu.variables}
    return f', record: ["{PLANT}.*"]' if "local" in kinds and "output" not in kinds else ""


# ── an FMU ───────────────────────────────────────────────────────────────────────────────────────────────


def fmu_draft(fmu: FmuDescription, where: str, written: str) -> str:
    """A scenario to go on with for an FMU.

    Args:
        fmu: the FMU.
        where: the file as the scenario is to name it.
        written: the file that the scenario is to be written to, for the commands in its comments.
    """
    inputs = [v for v in fmu.variables if v.causality == "input" and v.type == "Real"]
    found = guess_coordinates(
        _quantities(fmu), [Quantity(v.name, v.unit or "") for v in inputs], fmu.state_count
    )
    found = [g for g in found if g.velocity is not None]
    units = {v.name: v.unit or "" for v in fmu.variables}
    stop, step = span(fmu.experiment)
    stated = "as the FMU proposes" if fmu.experiment.stop is not None else "the FMU states none"
    sources = _source_names(inputs)
    learn = "\n".join(_learn(fmu, found, inputs, units, stop - fmu.experiment.start, step))
    sound = any(g.input for g in found) and _distinct(found)
    lines = [
        f"# {where}: FMI {fmu.version}.0, made by {as_comment(fmu.tool)}",
        "#",
        f"#   exlinn simulate {written}    the FMU under the signals below",
        f"#   exlinn run {written}         the same{', learn a model of it,' if sound else ''} and a report",
        f"#   exlinn validate {written}    what is wrong with this file, all at once",
        f"#   exlinn info {where}    all variables of the FMU",
        "#",
        "# TODO marks what was guessed from names and units, or is left to you.",
        f"name: {scenario_name(fmu.path)}",
        "",
        "components:",
        f"  {PLANT}:",
        f"    fmu: {as_text(where)}",
        *_use(fmu),
        *_parameters(fmu),
    ]
    for v in inputs:
        lines += [f"  {sources[v.name]}:", f"    source: {_step_signal(v, fmu.experiment.start, stop)}"]
    lines += [f"  {line}" for line in _controller(found, step)]
    if inputs:
        lines += [
            "",
            "connections:",
            *(f"  {sources[v.name]}.y: {as_text(f'{PLANT}.{v.name}')}" for v in inputs),
        ]
        lines += [f"  {line}" for line in _loop(found)]
    lines += ["", "simulate:"]
    lines += [f"  start: {fmu.experiment.start:g}"] if fmu.experiment.start else []
    lines += [f"  stop: {stop:g}   # s; {stated}", f"  step: {step:g}"]
    lines += [] if not _record(fmu) else [f'  record: ["{PLANT}.*"]   # it has no outputs']
    lines += ["", *_above(sound), learn if sound else indent(learn, "# ", lambda _: True)]
    return "\n".join(lines).rstrip() + "\n"


def _distinct(found: Sequence[Guess]) -> bool:
    """Whether the model's quantities all have names of their own."""
    quantities: list[str] = []
    for guess, own in zip(found, _names(found), strict=True):
        velocity = guess.velocity.name if guess.velocity else f"{own}_dot"
        quantities += [guess.position.name if guess.position else own, velocity]
        quantities.append(guess.acceleration.name if guess.acceleration else f"{velocity}_dot")
        quantities += [guess.input.name] if guess.input else []
    return len(set(quantities)) == len(quantities)


def _quantities(fmu: FmuDescription) -> list[Quantity]:
    """What may be a coordinate or its derivative."""
    states = set(fmu.states.references)
    return [
        Quantity(v.name, v.unit or "", (v.causality == "output") + 2 * (reference in states))
        for v, reference in zip(fmu.variables, fmu.references, strict=True)
        if v.type == "Real" and v.variability == "continuous" and v.causality in ("output", "local")
    ]


def _use(fmu: FmuDescription) -> list[str]:
    """How the FMU is used."""
    lines = []
    if fmu.state_count and {"co_simulation", "model_exchange"} <= {use.kind for use in fmu.interfaces}:
        why = "integrated here, to a tolerance; co_simulation: by the FMU's own solver"
        lines.append(f"    interface: model_exchange   # {why}")
    return [*lines, "    isolate: true   # in a process of its own; faster without, once you trust it"]


def _parameters(fmu: FmuDescription) -> list[str]:
    """The FMU's parameters with their values, as comments."""
    numbers = [
        v
        for v in fmu.variables
        if v.causality == "parameter"
        and v.start is not None
        and v.type not in TEXT_TYPES
        and v.name[0] != "_"
    ]
    if not numbers:
        return ["    # start: {x: 0}   # start values of states and inputs"]
    more = [f"    #   … {len(numbers)} in all"] if len(numbers) > LISTED else []
    shown = [f"    #   {as_text(v.name)}: {v.start:.9g}{_told(v)}" for v in numbers[:LISTED]]
    return ["    # start:   # other values of parameters; of states and inputs as well", *shown, *more]


def _told(v: Variable) -> str:
    said = as_comment(f"{f'[{v.unit}] ' if v.unit else ''}{v.description}")
    return f"   # {said}" if said else ""


def _source_names(inputs: Sequence[Variable]) -> dict[str, str]:
    """Names of the sources on the inputs, each its own."""
    names: dict[str, str] = {}
    taken = {PLANT, "controller"}
    for v in inputs:
        names[v.name] = distinct(as_name(v.name, "input"), taken)
        taken.add(names[v.name])
    return names


def _size(v: Variable) -> tuple[float, float, str]:
    """Middle and amplitude of a signal on an input, and what they rest on."""
    if v.min is not None and v.max is not None and v.min < v.max and v.max - v.min < 1e6:
        return 0.5 * (v.min + v.max), 0.25 * (v.max - v.min), "half of its range"
    middle = v.start or 0.0
    return middle, 0.1 * abs(middle) or 1.0, "TODO: a size that makes sense"


def _step_signal(v: Variable, start: float, stop: float) -> str:
    middle, size, why = _size(v)
    at = float(f"{start + 0.1 * (stop - start):.3g}")
    unit = f", unit: {as_key(v.unit)}" if v.unit else ""
    return f"{{signal: step, time: {at:g}, before: {middle:g}, after: {middle + size:g}{unit}}}   # {why}"


def _above(sound: bool) -> list[str]:
    """What is said of the section that learns."""
    if sound:
        return [
            "# Learning: generalised coordinates, and signals on the inputs that move all of them.",
            "# TODO: check them; a model knows what it has seen.",
        ]
    return [
        '# Learning: take the "# " away, and fill in each TODO. A generalised coordinate q is a position, an',
        "# angle or a charge; named are the plant's variables.",
    ]


def _learn(
    fmu: FmuDescription,
    found: Sequence[Guess],
    inputs: Sequence[Variable],
    units: Mapping[str, str],
    duration: float,
    step: float,
) -> Iterator[str]:
    """The section `learn`, line by line."""
    yield "learn:"
    yield f"  plant: {PLANT}"
    yield "  coordinates:"
    names = _names(found)
    for guess, name in zip(found, names, strict=True):
        yield from indent("\n".join(_coordinate(guess, name, units)), "    ").splitlines()
    if not found:
        yield from indent("\n".join(_unknown_coordinate(fmu)), "    ").splitlines()
    fine, known = min(step, 1e-3 * duration), {g.input.name for g in found if g.input}
    driven = [v for v in inputs if not known or v.name in known]
    for key, seed in (("training", 1), ("test", 11)):
        yield f"  {key}:" + ("   # never seen by training" if key == "test" else "")
        for offset in (0, 1) if key == "training" else (0,):
            yield f"    - duration: {duration:g}"
            yield f"      step: {fine:g}"
            yield "      inputs:" + ("" if driven else " {TODO: {signal: multisine, rms: 1, band: [0.1, 5]}}")
            for k, v in enumerate(driven):
                signal = _multisine(v, duration, seed + 2 * k + offset, fine)
                yield f"        {as_text(f'{PLANT}.{v.name}')}: {signal}   # TODO: size, band in Hz"


def _multisine(v: Variable, duration: float, seed: int, step: float) -> str:
    middle, size, _ = _size(v)
    low, high = 1 / duration, min(50 / duration, 0.02 / step)
    unit = f", unit: {as_key(v.unit)}" if v.unit else ""
    offset = f"offset: {middle:g}, " if middle else ""
    band = f"[{low:.3g}, {max(high, 2 * low):.3g}]"
    return f"{{signal: multisine, {offset}rms: {size:g}, band: {band}, seed: {seed}{unit}}}"


def _coordinate(guess: Guess, name: str, units: Mapping[str, str]) -> Iterator[str]:
    def path(q: Quantity) -> str:
        return as_text(f"{PLANT}.{q.name}")

    def unit(q: Quantity | None, otherwise: str) -> str:
        return (units.get(q.name) if q else "") or otherwise

    own = unit(guess.position, guess.unit)
    yield f"- name: {name}"
    yield f"  unit: {as_text(own)}"
    yield from kind_lines(guess.kind, guess.topology, "only its velocity counts")
    yield from ([f"  position: {path(guess.position)}"] if guess.position else [])
    if guess.velocity:
        yield f"  velocity: {path(guess.velocity)}"
        speed = unit(guess.velocity, guess.velocity_unit)
        yield from ([f"  velocity_unit: {as_text(speed)}"] if speed != f"{own}/s" else [])
    if guess.acceleration:
        yield f"  acceleration: {path(guess.acceleration)}"
    if guess.input:
        yield f"  input: {path(guess.input)}"
        yield f"  input_unit: {as_text(unit(guess.input, guess.input_unit))}"
    else:
        yield "  # input: none found; TODO: name it if one acts here"


def _unknown_coordinate(fmu: FmuDescription) -> Iterator[str]:
    outputs = [v.name for v in fmu.variables if v.causality == "output"] or [q.name for q in _quantities(fmu)]
    inputs = [v.name for v in fmu.variables if v.causality == "input"]
    yield "- name: q"
    yield "  unit: TODO"
    yield "  topology: line   # circle: an angle that may turn; cyclic: only its velocity counts"
    yield f"  position: TODO   # outputs: {_some(f'{PLANT}.{name}' for name in outputs)}"
    yield "  velocity: TODO"
    yield f"  input: TODO   # inputs: {_some(f'{PLANT}.{name}' for name in inputs)}"


def _some(names: Iterable[str]) -> str:
    known = list(names)
    return ", ".join(known[:8]) + (", …" if len(known) > 8 else "") if known else "none"


def _names(found: Sequence[Guess]) -> list[str]:
    """Names for the coordinates: of the position, or Q for a charge."""
    names: list[str] = []
    for guess in found:
        leaf = guess.position.name.rpartition(".")[2] if guess.position else "Q"
        names.append(distinct(as_name(leaf, "q"), names))
    return names


def _controller(found: Sequence[Guess], step: float) -> list[str]:
    """A controller around the learned model, as a comment."""
    driven = [g for g in found if g.input]
    if not driven:
        return []
    bounds = ", ".join(f"{as_key(g.input.name)}: {{min: TODO, max: TODO}}" for g in driven if g.input)
    leader = next((g for g in found if g.position), driven[0])
    named = leader.position or leader.velocity
    return [
        '# controller:   # TODO: take the "# " away here and below, and the connections of the sources out',
        f"#   step: {10 * step:g}",
        "#   nmpc:",
        "#     model: learned",
        f"#     inputs: {{{bounds}}}",
        f"#     reference: {{coordinate: {as_key(named.name if named else 'TODO')}, "
        "trajectory: {signal: sine, amplitude: TODO, frequency: TODO}}",
    ]


def _loop(found: Sequence[Guess]) -> list[str]:
    """Connections of the controller, as comments."""
    driven = [g.input.name for g in found if g.input]
    if not driven:
        return []
    states = [q.name for g in found for q in (g.position, g.velocity) if q is not None]
    lines = [f"# {as_text(f'{PLANT}.{name}')}: {as_text(f'controller.{name}')}" for name in states]
    return lines + [f"# {as_text(f'controller.{name}')}: {as_text(f'{PLANT}.{name}')}" for name in driven]

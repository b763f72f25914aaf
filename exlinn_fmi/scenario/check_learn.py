"""Checks across sections: signals, what is learned from which plant, and the controller around the model."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from exlinn_fmi.components.base import Variable
from exlinn_fmi.errors import DataError, ModelError
from exlinn_fmi.mechanics.coordinates import TURN, Coordinate, check_coordinates
from exlinn_fmi.scenario.check_graph import is_multiple, misfit_starts, no_multiple
from exlinn_fmi.scenario.control import Nmpc, Reference
from exlinn_fmi.scenario.explain import Finding
from exlinn_fmi.scenario.learning import (
    AnyLearn,
    Experiment,
    Identify,
    LearnFromPlant,
    Paper,
    PlantCoordinate,
    Structured,
    Terms,
)
from exlinn_fmi.scenario.schema import ModelComponent, NmpcComponent, SignalComponent
from exlinn_fmi.scenario.signals import Chirp, Multisine, Ramp, Signal, Table
from exlinn_fmi.scenario.spec import Bounds
from exlinn_fmi.scenario.survey import Role, Survey
from exlinn_fmi.scenario.units import same_unit
from exlinn_fmi.scenario.words import KeyPath, suggestion

# ── signals ──────────────────────────────────────────────────────────────────────────────────────────────


def signals(survey: Survey) -> Iterator[Finding]:
    """Signals, wherever they stand, that make no sense."""
    for name, spec in survey.scenario.components.items():
        if isinstance(spec, SignalComponent):
            yield from _signal(("components", name, "source"), spec.source, survey.folder)
        if isinstance(spec, NmpcComponent):
            for at, reference in _references(("components", name, "nmpc"), spec.nmpc):
                yield from _signal((*at, "trajectory"), reference.trajectory, survey.folder)
    for at, experiment in _experiments(survey.scenario.learn):
        for target, signal in experiment.inputs.items():
            yield from _signal((*at, "inputs", target), signal, survey.folder)


def _signal(at: KeyPath, signal: Signal, folder: Path) -> Iterator[Finding]:
    if isinstance(signal, Multisine | Chirp):
        low, high = signal.band
        if not low < high:
            yield (*at, "band"), f"expected the lower frequency first, found [{low:g}, {high:g}]"
    if isinstance(signal, Ramp) and signal.stop is not None and signal.stop <= signal.start:
        yield (*at, "stop"), f"expected > {signal.start:g} (start), found {signal.stop:g}"
    if isinstance(signal, Table):
        from exlinn_fmi.data.excitation import signal_function

        try:
            signal_function(signal, folder)
        except DataError as error:
            yield (*at, "file"), str(error)


# ── learning ─────────────────────────────────────────────────────────────────────────────────────────────


def learning(survey: Survey) -> Iterator[Finding]:
    """A `learn` section that does not fit its plant, or what cannot be learned wherever the data are from."""
    learn = survey.scenario.learn
    if learn is None:
        return
    found = list(_from_plant(learn, survey)) if isinstance(learn, LearnFromPlant) else []
    yield from found
    if not any(at[:2] == ("learn", "coordinates") for at, _ in found):
        if all(c.input is None for c in learn.coordinates) and not _in_coordinates(survey):
            message = "none has an `input`; without a known force or voltage the model's scale stays open"
            yield ("learn", "coordinates"), message
        try:
            check_coordinates(tuple(c.coordinate() for c in learn.coordinates))
        except ModelError as error:
            yield ("learn", "coordinates"), str(error)
    yield from _monomials(learn, survey.coordinates)


def _from_plant(learn: LearnFromPlant, survey: Survey) -> Iterator[Finding]:
    """Coordinates and experiments that do not fit the plant."""
    problem = _wrong_plant(learn, survey)
    if problem:
        yield ("learn", "plant"), problem
    plant = None if problem else learn.plant
    for k, c in enumerate(learn.coordinates):
        yield from _coordinate(k, c, plant, survey)
    for at, experiment in _experiments(learn):
        yield from _experiment(at, experiment, plant, survey)


def _in_coordinates(survey: Survey) -> bool:
    """Whether a mistake was cut out of the coordinates, so that they may have been meant otherwise."""
    return any(path[:2] == ("learn", "coordinates") for path in survey.sound.cut)


def _wrong_plant(learn: LearnFromPlant, survey: Survey) -> str | None:
    """Why the component to learn cannot be that, None where it can."""
    name, plant = learn.plant, survey.scenario.components.get(learn.plant)
    if name not in survey.names and survey.names_are_known:
        return f"there is no component {name!r}{suggestion(name, survey.names, 'components')}"
    if isinstance(plant, SignalComponent):
        return f"{name} is a signal source; name the component to learn from"
    if isinstance(plant, NmpcComponent):
        return f"{name} is a controller; name the component to learn from"
    if isinstance(plant, ModelComponent) and plant.model == "learned":
        return f"{name} is the model that is learned; name the component to learn from"
    owners = {c.velocity.split(".", 1)[0] for c in learn.coordinates}
    if len(owners) == 1 and name not in owners:
        return f"{name} has none of the coordinates' variables, they are of {owners.pop()}"
    return None


def _coordinate(k: int, spec: PlantCoordinate, plant: str | None, survey: Survey) -> Iterator[Finding]:
    """Plant variables of a coordinate that are not there, or not what they are said to be."""
    at: KeyPath = ("learn", "coordinates", k)
    if spec.position is None and spec.topology != "cyclic" and not _in_coordinates(survey):
        yield (
            at,
            f"missing key 'position': the plant variable that is {spec.name}; only a cyclic one has none",
        )
    whole, unit_is_wrong = spec.coordinate(), False
    ends = (
        ("position", spec.position, whole.unit, "unit"),
        ("velocity", spec.velocity, whole.velocity_unit, "velocity_unit"),
        ("acceleration", spec.acceleration, whole.acceleration_unit, "velocity_unit"),
        ("input", spec.input, whole.input_unit, "input_unit"),
    )
    for key, path, unit, unit_key in ends:
        if path is None:
            continue
        variable, problem = _plant_variable(path, plant, survey, "input" if key == "input" else "output")
        if problem is not None:
            yield (*at, key), problem
        elif variable is not None and not same_unit(unit, variable.unit):
            if key == "input" or not unit_is_wrong:  # the units of derivatives follow from the one before
                message = f"unit mismatch: {spec.name} has {key} [{unit}], {path} is [{variable.unit}]"
                yield (*at, key), f"{message}; say `{unit_key}: {variable.unit}`"
            unit_is_wrong = True


def _plant_variable(
    path: str, plant: str | None, survey: Survey, role: Role
) -> tuple[Variable | None, str | None]:
    """A variable of the plant to learn (None where that is not known), or what is wrong with it."""
    component, name = path.split(".", 1)
    if plant is not None and component != plant and component in survey.names:
        return None, f"{path} is no variable of the plant to learn; write {plant}.{name}"
    variable, problem = survey.find(path, role)
    if variable is not None and (variable.causality == "input") != (role == "input"):
        found = "an input" if variable.causality == "input" else "no input"
        problem = f"{path} is {found}; expected an {role}"
    return variable, problem


def _experiments(learn: AnyLearn | None) -> Iterator[tuple[KeyPath, Experiment]]:
    if isinstance(learn, LearnFromPlant):
        for section, experiments in (("training", learn.training), ("test", learn.test)):
            yield from ((("learn", section, k), experiment) for k, experiment in enumerate(experiments))


def _experiment(at: KeyPath, experiment: Experiment, plant: str | None, survey: Survey) -> Iterator[Finding]:
    """An experiment whose step, inputs or start values do not fit the plant (None where not known)."""
    step, doubt = experiment.step, survey.sound.in_doubt(at, "step")
    if step > experiment.duration and not doubt:
        yield (*at, "step"), f"the step, {step:g} s, is longer than the run, {experiment.duration:g} s"
    spec, simulate = survey.scenario.components.get(plant or ""), survey.scenario.simulate
    told = doubt or (simulate is not None and simulate.step == step)  # where the component's step stands
    if spec is not None and spec.step is not None and not told and not is_multiple(spec.step, step):
        message = no_multiple(spec.step, step, "the experiment's step")
        yield (*at, "step"), f"{plant} has a step of its own: {message}"
    modelled = [c.input for c in survey.coordinates if c.input]
    for target, signal in experiment.inputs.items():
        variable, problem = _plant_variable(target, plant, survey, "input")
        if problem is None and modelled and target.split(".", 1)[1] not in modelled:
            problem = f"{target} is driven, but is `input` of no coordinate: the model would not know of it"
        if problem is not None:
            yield (*at, "inputs", target), problem
        elif variable is not None and not same_unit(signal.unit, variable.unit):
            yield (
                (*at, "inputs", target),
                f"unit mismatch: signal [{signal.unit}] → {target} [{variable.unit}]",
            )
    known = survey.variables.get(plant or "")
    if plant is not None and known is not None:
        yield from misfit_starts((*at, "start"), experiment.start, plant, known)


def _monomials(learn: AnyLearn, coordinates: tuple[Coordinate, ...]) -> Iterator[Finding]:
    """Features and terms that cannot be read, or that name what the model does not have."""
    method, identify = learn.method, learn.identify
    inside = {"identify": identify.shapes, "method": method.shapes if isinstance(method, Terms) else {}}
    texts: dict[str, list[str]] = {"identify": [], "method": []}
    for at, text in _terms(method, identify):
        texts[str(at[1])].append(text)
        if coordinates:
            yield from _monomial(at, text, coordinates, inside[str(at[1])])
    for section, shapes in inside.items():
        yield from _shapes(("learn", section), shapes, texts[section])
    candidates = [*texts["method"], *inside["method"]]
    for section, names in (("identify", identify.names), ("method", candidates)):
        for name in getattr(getattr(learn, section), "known", {}):
            if name not in names:
                message = f"{name!r} is not among the parameters{suggestion(name, names, 'they')}"
                yield ("learn", section, "known", name), message
    for name in sorted({name for name in identify.names if identify.names.count(name) > 1}):
        yield ("learn", "identify"), f"{name!r} is the name of two parameters; rename one of them"


def _monomial(
    at: KeyPath, text: str, coordinates: tuple[Coordinate, ...], shapes: Mapping[str, float]
) -> Iterator[Finding]:
    """A monomial that cannot be read, or that takes degrees for radians."""
    from exlinn_fmi.mechanics.learned import angular
    from exlinn_fmi.mechanics.monomials import parse_term

    try:
        monomial = parse_term(text, coordinates, "dissipation" in str(at[2]), shapes)
    except ModelError as error:
        yield at, str(error)
        return
    angles = {c.name: c for c in coordinates if c.unit in TURN and c.unit != "rad"}
    for factor in monomial.factors:
        if factor.function in ("sin", "cos") and factor.name in angles and factor.scale == 1:
            c, call = angles[factor.name], f"{factor.function}({factor.name})"
            fix = f"{factor.function}({angular(c):.17g}*{c.name})"
            yield at, f"{call} takes its argument in rad, and {c.name} is in {c.unit}; write {fix}"


def _shapes(at: KeyPath, shapes: Mapping[str, float], texts: Iterable[str]) -> Iterator[Finding]:
    """Shapes that no monomial has, or that cannot be looked for from where they start."""
    used = {word for text in texts for word in re.findall(r"[A-Za-z_]\w*", text)}
    for name, value in shapes.items():
        if name not in used:
            yield (*at, "shapes", name), f"no monomial holds {name!r}; write e.g. `{name}*logcosh(v/{name})`"
        if not (math.isfinite(value) and value != 0):
            yield (*at, "shapes", name), f"expected a start of the right sign and size, found {value:g}"


def _terms(method: Structured | Terms | Paper, identify: Identify) -> Iterator[tuple[KeyPath, str]]:
    """All monomials of a `learn` section, with where they stand."""
    if isinstance(method, Paper):
        for key in ("lagrangian_features", "dissipation_features"):
            yield from ((("learn", "method", key, k), text) for k, text in enumerate(getattr(method, key)))
    if isinstance(method, Terms):
        for key in ("lagrangian", "dissipation"):
            yield from ((("learn", "method", key, k), text) for k, text in enumerate(getattr(method, key)))
    for key in ("lagrangian", "dissipation"):
        for name, text in getattr(identify, key).items():
            yield ("learn", "identify", key, name), text


# ── control ──────────────────────────────────────────────────────────────────────────────────────────────


def control(survey: Survey) -> Iterator[Finding]:
    """Components that lack the learned model they need, and controllers that do not fit their model."""
    for name, spec in survey.scenario.components.items():
        at: KeyPath = ("components", name)
        if isinstance(spec, ModelComponent) and spec.model == "learned":
            yield from _learned((*at, "model"), survey)
        if isinstance(spec, NmpcComponent):
            if spec.nmpc.model == "learned" and not survey.sound.in_doubt((*at, "nmpc"), "model"):
                yield from _learned((*at, "nmpc", "model"), survey)
            known = survey.variables.get(name)
            states = inputs = None
            first = next(iter(spec.nmpc.references))
            if known is not None and first in known:
                states = {v.name: v for v in known.values() if v.causality == "input"}
                outputs = [v.name for v in known.values() if v.causality == "output"]
                inputs = outputs[: outputs.index(first)]
            yield from _controller((*at, "nmpc"), spec.nmpc, states, inputs)
            if states is not None and known is not None:
                heads = [target.split(".", 1) for _, target in survey.scenario.connection_list()]
                connected = [variable for owner, variable in heads if owner == name]
                yield from _estimator(
                    (*at, "nmpc", "estimator"), spec.nmpc, list(states), list(known), connected
                )


def _learned(at: KeyPath, survey: Survey) -> Iterator[Finding]:
    if survey.scenario.learn is None and not survey.sound.in_doubt((), "learn"):
        yield (
            at,
            "`learned` is the model of the `learn` section, and there is none; add it or name a folder",
        )


def _controller(
    at: KeyPath, nmpc: Nmpc, states: dict[str, Variable] | None, inputs: list[str] | None
) -> Iterator[Finding]:
    """Settings that do not fit the model's states and inputs (None where these are not known)."""
    for key, bounds in (("inputs", nmpc.inputs), ("states", nmpc.states)):
        for name, bound in bounds.items():
            if bound.min is not None and bound.max is not None and not bound.min < bound.max:
                yield (*at, key, name), f"expected min < max, found min {bound.min:g} and max {bound.max:g}"
    for name, value in nmpc.safe_input.items():
        limits = nmpc.inputs.get(name, Bounds())
        low = -math.inf if limits.min is None else limits.min
        high = math.inf if limits.max is None else limits.max
        if not low <= value <= high:
            yield (*at, "safe_input", name), f"expected {low:g} … {high:g} (its bounds), found {value:g}"
    weights = nmpc.weights
    if nmpc.terminal_set and (nmpc.cost == "paper" or weights.terminal != "dare"):
        found = "`cost: paper`" if nmpc.cost == "paper" else f"`weights.terminal: {weights.terminal:g}`"
        yield (*at, "terminal_set"), f"needs `cost: tracking` and `weights.terminal: dare`, found {found}"
    if states is None or inputs is None:
        return
    yield from _unknown((*at, "states"), nmpc.states, states, "states")
    yield from _unknown((*at, "inputs"), nmpc.inputs, inputs, "inputs")
    yield from _unknown((*at, "safe_input"), nmpc.safe_input, inputs, "inputs")
    for key, known in (("states", list(states)), ("inputs", inputs)):
        given = getattr(weights, key)
        if isinstance(given, dict):
            yield from _unknown((*at, "weights", key), given, known, key)
    for here, reference in _references(at, nmpc):
        yield from _unknown((*here, "coordinate"), [reference.coordinate], states, "states")
        state, unit = states.get(reference.coordinate), reference.trajectory.unit
        if state is not None and reference.through is None and not same_unit(unit, state.unit):
            message = f"unit mismatch: trajectory [{unit}] → {state.name} [{state.unit}]"
            yield (*here, "trajectory"), f"{message}; give the kinematics as `through`"


def _estimator(
    at: KeyPath, nmpc: Nmpc, states: list[str], known: list[str], connected: list[str]
) -> Iterator[Finding]:
    """Names that the model does not have, and measurements that nothing brings."""
    spec, prefix = nmpc.estimation, "disturbance_"
    coordinates = [name.removeprefix(prefix) for name in known if name.startswith(prefix)]
    noise = spec.noise if isinstance(spec.noise, dict) else {}
    named = (("noise", noise, states), ("process", spec.process, states))
    for key, given, names in (*named, ("disturbances", spec.disturbances or [], coordinates)):
        yield from _unknown((*at, key), given, names, "states" if names is states else "coordinates")
    for k, name in enumerate(spec.measured or []):
        if name not in states:
            hint = suggestion(name, states, "its states")
            yield (*at, "measured", k), f"the model has no state {name!r}{hint}"
        elif name not in connected:
            yield (*at, "measured", k), f"nothing is connected to {name}; connect a sensor or leave it out"


def _references(at: KeyPath, nmpc: Nmpc) -> Iterator[tuple[KeyPath, Reference]]:
    """What a controller follows, with where it stands."""
    if isinstance(nmpc.reference, Reference):
        yield (*at, "reference"), nmpc.reference
    else:
        yield from (((*at, "reference", k), spec) for k, spec in enumerate(nmpc.reference))


def _unknown(at: KeyPath, given: Iterable[str], known: Iterable[str], kind: str) -> Iterator[Finding]:
    """Names that the model does not have."""
    names = list(known)
    for name in given:
        if name not in names:
            where = at if at[-1] == "coordinate" else (*at, name)
            yield (
                where,
                f"the model has no {kind.removesuffix('s')} {name!r}{suggestion(name, names, f'its {kind}')}",
            )

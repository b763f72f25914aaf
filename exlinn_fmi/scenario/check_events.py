"""Checks of events: what they do, to what, and when."""

from __future__ import annotations

from collections.abc import Iterator

from exlinn_fmi.components.base import Variable
from exlinn_fmi.components.starts import value_problem
from exlinn_fmi.scenario.events import EFFECTS, Event
from exlinn_fmi.scenario.explain import Finding
from exlinn_fmi.scenario.survey import Survey
from exlinn_fmi.scenario.words import KeyPath, either, suggestion

_REAL = ("add", "scale", "noise")
"""Effects that need values between others."""
_PARAMETER = ("set", "add", "scale")
"""Effects that a parameter can have."""


def events(survey: Survey) -> Iterator[Finding]:
    """Events that cannot happen."""
    found, names = survey.scenario.events, set[str]()
    if found and survey.scenario.simulate is None and not survey.sound.in_doubt((), "simulate"):
        yield ("events",), "events happen during a run, and there is no `simulate` section"
    if found and "events" in survey.names:
        yield ("components", "events"), "the columns that tell of events are called events.NAME; rename it"
    for k, event in enumerate(found):
        at: KeyPath = ("events", k)
        if event.name in names:
            yield (*at, "name"), f"there is another event {event.name!r}"
        names |= {event.name} if event.name else set()
        yield from _times(survey, event, at)
        given = [key for key in EFFECTS if getattr(event, key) is not None]
        if len(given) != 1:
            what = f"this has {' and '.join(given)}" if given else "this has none"
            yield at, f"an event has one effect, {either(EFFECTS)}; {what}"
        else:
            yield from ((place, text) for place, text in _target(survey, event, at))


def _times(survey: Survey, event: Event, at: KeyPath) -> Iterator[Finding]:
    """When it begins and ends."""
    if (event.at is None) == (event.when is None):
        yield at, f"an event begins `at` a time or `when` something is crossed; this has {_both(event.at)}"
    if event.until is not None and event.duration is not None:
        yield (*at, "until"), "an event has `until` or `duration`, and this has both; keep one"
    if event.until is not None and event.at is not None and event.until <= event.at:
        yield (*at, "until"), f"expected > {event.at:g} (at), found {event.until:g}"
    simulate = survey.scenario.simulate
    if simulate is not None and event.at is not None and event.at > simulate.stop:
        yield (*at, "at"), f"expected at most {simulate.stop:g} (simulate.stop), found {event.at:g}"
    if event.when is not None:
        if (event.when.above is None) == (event.when.below is None):
            both = _both(event.when.above)
            yield (*at, "when"), f"give `above` or `below`, a value to be crossed; this has {both}"
        _, problem = survey.find(event.when.variable, "output")
        if problem:
            yield (*at, "when", "variable"), problem


def _both(one: object) -> str:
    return "neither" if one is None else "both"


def _target(survey: Survey, event: Event, at: KeyPath) -> Iterator[Finding]:
    """What it happens to."""
    here = (*at, "on")
    if event.effect == "freeze" or not event.variable:
        if event.component not in survey.names:
            hint = suggestion(event.component, survey.names, "components")
            yield here, f"there is no component {event.component!r}{hint}"
        elif event.effect == "freeze" and event.variable:
            yield (
                here,
                f"`freeze` is for a whole component; write {event.component!r}, or `hold` the variable",
            )
        elif event.effect != "freeze":
            yield here, f"`{event.effect}` is for a variable; write {event.component}.VARIABLE"
        return
    variable, problem = survey.find(event.on, "output")
    if problem:
        yield here, problem
    if variable is None:
        return
    kind, effect = variable.causality, event.effect
    if kind not in ("input", "output") and not (kind == "parameter" and variable.variability == "tunable"):
        what = f"a {variable.variability} parameter" if kind == "parameter" else f"of causality {kind}"
        yield here, f"{event.on} is {what}; events happen to outputs, inputs and tunable parameters"
    elif kind == "parameter" and effect not in _PARAMETER:
        yield (*at, effect), f"{event.on} is a parameter: an event can {either(_PARAMETER)} it"
    elif effect == "disconnect" and kind != "input":
        yield here, f"{event.on} is an {kind}; `disconnect` is for inputs"
    elif effect in _REAL and variable.type != "Real":
        others = [key for key in EFFECTS[:-1] if key not in _REAL]
        yield (*at, effect), f"{event.on} is of type {variable.type}: an event can {either(others)} it"
    elif effect == "set":
        yield from _value(event, variable, (*at, "set"))


def _value(event: Event, variable: Variable, at: KeyPath) -> Iterator[Finding]:
    """A value that the variable does not take; that of an output may be as wrong as the user likes."""
    assert event.set is not None
    if isinstance(event.set, bool) and variable.type != "Boolean":
        yield at, f"expected a number, found {'true' if event.set else 'false'}"
    elif variable.causality != "output" and (problem := value_problem(variable, float(event.set))):
        yield at, problem

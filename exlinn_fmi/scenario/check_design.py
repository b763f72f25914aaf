"""Checks of `learn.design` before anything runs: names of states and inputs, limits and frequencies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from exlinn_fmi.mechanics.coordinates import input_names, state_names
from exlinn_fmi.scenario.explain import Finding
from exlinn_fmi.scenario.learning import Design, LearnFromPlant
from exlinn_fmi.scenario.survey import Survey
from exlinn_fmi.scenario.words import KeyPath, missing_file, suggestion

AT: KeyPath = ("learn", "design")


def design(survey: Survey) -> Iterator[Finding]:
    """A `learn.design` section that does not fit what is learned."""
    learn = survey.scenario.learn
    if not isinstance(learn, LearnFromPlant):
        return
    yield from _settings(learn.design, survey)
    if not survey.coordinates:
        return
    states, inputs = state_names(survey.coordinates), input_names(survey.coordinates)
    noise, limits = learn.design.noise, learn.design.limits
    yield from _unknown((*AT, "noise"), noise if isinstance(noise, dict) else (), states, "state")
    yield from _unknown((*AT, "limits", "inputs"), limits.inputs, inputs, "input")
    yield from _unknown((*AT, "limits", "states"), limits.states, states, "state")


def _unknown(at: KeyPath, given: Iterable[str], known: list[str], kind: str) -> Iterator[Finding]:
    for name in given:
        if name not in known:
            yield (*at, name), f"the model has no {kind} {name!r}{suggestion(name, known, f'its {kind}s')}"


def _settings(options: Design, survey: Survey) -> Iterator[Finding]:
    """Limits and frequencies the wrong way round, and models that are not there."""
    for key in ("inputs", "states"):
        for name, bound in getattr(options.limits, key).items():
            if bound.min is not None and bound.max is not None and not bound.min < bound.max:
                message = f"expected min < max, found min {bound.min:g} and max {bound.max:g}"
                yield (*AT, "limits", key, name), message
    if options.band is not None and not options.band[1] >= 2 * options.band[0]:
        low, high = options.band
        yield (*AT, "band"), f"expected an octave or more, the lower first, found [{low:g}, {high:g}]"
    if options.noise == {}:
        yield (*AT, "noise"), "nothing is measured; name a state, or give one share for all"
    model = options.model
    if model is None or model == "learned" or model.startswith("plant:"):
        return
    if not (survey.folder / model / "model.json").is_file():
        yield (
            (*AT, "model"),
            "expected `learned`, `plant:NAME` or a folder with a model.json: "
            + missing_file(model, survey.folder),
        )

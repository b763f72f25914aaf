"""Checks of robustness studies: what varies must be there, and ranges must be some."""

from __future__ import annotations

import json
from collections.abc import Iterator

from exlinn_fmi.scenario.check_graph import misfit_starts
from exlinn_fmi.scenario.explain import Finding
from exlinn_fmi.scenario.overrides import apply
from exlinn_fmi.scenario.study import Choice, Distribution, Normal, Range
from exlinn_fmi.scenario.survey import Survey


def study(survey: Survey) -> Iterator[Finding]:
    """Values to vary that are none of the scenario's, and ranges the wrong way round."""
    spec = survey.scenario.study
    if spec is None:
        return
    if survey.scenario.simulate is None and not survey.sound.in_doubt((), "simulate"):
        yield ("study",), "a study runs the closed loop, and there is no `simulate` section; add it"
    text = json.dumps(survey.scenario.model_dump(mode="json", exclude_unset=True))
    for path, distribution in spec.vary.items():
        at = ("study", "vary", path)
        if isinstance(distribution, Range) and not distribution.min < distribution.max:
            yield at, f"expected min < max, found min {distribution.min:g} and max {distribution.max:g}"
        value = _example(distribution)
        problems = apply(text, [f"{path}={json.dumps(value)}"])[2]
        yield from ((at, problem.message.partition(" (override")[0]) for problem in problems)
        parts = path.split(".", 3)
        known = survey.variables.get(parts[1]) if len(parts) == 4 and parts[2] == "start" else None
        if known is not None and isinstance(value, bool | float):
            found = misfit_starts(at, {parts[3]: value}, parts[1], known)
            yield from ((at, message) for _, message in found)


def _example(distribution: Distribution) -> object:
    """A value that may be drawn; for a share of what is not known here, a number."""
    if isinstance(distribution, Choice):
        return distribution.values[0]
    if isinstance(distribution, Range):
        return distribution.min
    return distribution.mean if isinstance(distribution, Normal) else 1.0

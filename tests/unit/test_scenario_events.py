"""Checks of events: each mistake with its line, what was found, and what to do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from scenario_helpers import SCENARIO, line_of, load, problems

EVENTS = """\
events:
  - {name: drift, on: plant.alpha, at: 2, until: 4, add: 0.05}
  - {on: ctl, when: {variable: plant.x, above: 0.1}, duration: 0.5, freeze: true}
  - {on: plant.b_m, at: 5, scale: 2}
  - {on: plant.tau_ext, at: 1, drop: 0.3}
  - {on: plant.brake, at: 1, set: true}
  - {on: plant.brake, at: 3, hold: true}
"""


def with_events(text: str) -> str:
    return SCENARIO + "events:\n  - " + text + "\n"


def test_right_events_are_taken(tmp_path: Path) -> None:
    loaded = load(tmp_path, SCENARIO + EVENTS)
    assert [event.effect for event in loaded.scenario.events] == [
        "add",
        "freeze",
        "scale",
        "drop",
        "set",
        "hold",
    ]


@pytest.mark.parametrize(
    ("text", "path", "message"),
    [
        ("{on: plant.alhpa, at: 1, add: 1}", "events[0].on", "no variable 'alhpa'; did you mean 'alpha'?"),
        ("{on: plnt.alpha, at: 1, add: 1}", "events[0].on", "no component 'plnt'; did you mean 'plant'?"),
        ("{on: plnt, at: 1, freeze: true}", "events[0].on", "no component 'plnt'; did you mean 'plant'?"),
        ("{on: plant, at: 1, add: 1}", "events[0].on", "`add` is for a variable; write plant.VARIABLE"),
        ("{on: plant.x, at: 1, freeze: true}", "events[0].on", "is for a whole component; write 'plant'"),
        ("{on: plant.x, at: 1}", "events[0]", "noise or freeze; this has none"),
        ("{on: plant.x, at: 1, add: 1, set: 2}", "events[0]", "one effect, .*; this has set and add"),
        ("{on: plant.x, add: 1}", "events[0]", "begins `at` a time or `when` .*; this has neither"),
        (
            "{on: plant.x, add: 1, at: 1, when: {variable: plant.x, above: 1}}",
            "events[0]",
            "this has both",
        ),
        ("{on: plant.x, at: 1, until: 1, add: 1}", "events[0].until", r"expected > 1 \(at\), found 1"),
        ("{on: plant.x, at: 1, until: 2, duration: 1, add: 1}", "events[0].until", "keep one"),
        ("{on: plant.x, at: 11, add: 1}", "events[0].at", r"expected at most 10 \(simulate.stop\), found 11"),
        ("{on: plant.l, at: 1, set: 1}", "events[0].on", "plant.l is a fixed parameter"),
        ("{on: plant.heat, at: 1, set: 1}", "events[0].on", "plant.heat is of causality local"),
        (
            "{on: plant.b_m, at: 1, noise: 1}",
            "events[0].noise",
            "a parameter: an event can set, add or scale",
        ),
        ("{on: plant.x, at: 1, disconnect: true}", "events[0].on", "plant.x is an output; `disconnect`"),
        ("{on: plant.brake, at: 1, add: 1}", "events[0].add", "is of type Boolean: an event can set, hold"),
        ("{on: plant.brake, at: 1, set: 0.5}", "events[0].set", "expected true or false, found 0.5"),
        ("{on: plant.v, at: 1, set: true}", "events[0].set", "expected a number, found true"),
        ("{on: plant.x, at: 1, drop: 1.5}", "events[0].drop", "expected ≤ 1, found 1.5"),
        ("{on: plant.x, at: 1, delay: 0}", "events[0].delay", "expected > 0, found 0"),
        ("{on: plant.x, at: 1, hold: false}", "events[0].hold", "expected true, found false"),
        ("{on: plant.x, at: 1, sett: 1}", "events[0].sett", "unknown key 'sett'; did you mean 'set'?"),
        (
            "{on: plant.x, when: {variable: plant.y, above: 1}, add: 1}",
            "events[0].when.variable",
            "plant has no variable 'y'",
        ),
        ("{on: plant.x, when: {variable: plant.x}, add: 1}", "events[0].when", "this has neither"),
        (
            "{on: plant.x, when: {variable: plant.x, above: 1, below: 2}, add: 1}",
            "events[0].when",
            "this has both",
        ),
    ],
)
def test_an_event_that_cannot_happen_says_why(tmp_path: Path, text: str, path: str, message: str) -> None:
    scenario = with_events(text)
    found = problems(tmp_path, scenario)
    assert path in [p.path for p in found], found
    problem = next(p for p in found if p.path == path)
    assert re.search(message, problem.message), problem.message
    assert problem.line == line_of(scenario, "- {on: pl")


def test_names_of_events_are_told_apart(tmp_path: Path) -> None:
    text = SCENARIO + EVENTS.replace("on: ctl", "name: drift, on: ctl")
    (found,) = problems(tmp_path, text)
    assert (found.path, found.message) == ("events[1].name", "there is another event 'drift'")


def test_a_component_may_not_have_the_name_of_the_events(tmp_path: Path) -> None:
    text = (SCENARIO + EVENTS).replace("  load:\n", "  events:\n").replace("  load.y", "  events.y")
    (found,) = problems(tmp_path, text)
    assert found.path == "components.events"


def test_events_need_a_run(tmp_path: Path) -> None:
    text = SCENARIO[: SCENARIO.index("simulate:")] + EVENTS
    assert "events happen during a run" in "; ".join(p.message for p in problems(tmp_path, text))

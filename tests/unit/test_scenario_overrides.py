"""Overrides: values set from outside, written into the text with its comments kept."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenario_helpers import SCENARIO, line_of, load, problems

from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.overrides import apply


def test_without_overrides_the_text_is_the_files(tmp_path):
    assert load(tmp_path).text == SCENARIO


def test_an_override_is_in_the_scenario_and_in_its_text(tmp_path):
    loaded = load(tmp_path, overrides=["simulate.stop=5e-1"])
    assert loaded.scenario.simulate.stop == 0.5
    assert parse(loaded.text).data["simulate"]["stop"] == 0.5


def test_comments_and_all_else_stay_as_written(tmp_path):
    changed = load(tmp_path, overrides=["simulate.stop=5"]).text
    assert changed == SCENARIO.replace("stop: 10\n", "stop: 5\n")


@pytest.mark.parametrize(
    ("override", "keys", "value"),
    [
        ("seed=4", ("seed",), 4),
        ("plant.mass.m=2", ("components", "plant", "start", "mass.m"), 2),
        ("plant.x[1]=3", ("components", "plant", "start", "x[1]"), 3),
        ("description='a: b'", ("description",), "a: b"),
        ("learn.training[1].duration=2", ("learn", "training", 1, "duration"), 2),
        ("learn.training.0.duration=3", ("learn", "training", 0, "duration"), 3),
        ("simulate.record[0]=plant.x", ("simulate", "record", 0), "plant.x"),
        ("simulate.record=[plant.x]", ("simulate", "record"), ["plant.x"]),
        ("connections.plant.i=ctl.i", ("connections", "plant.i"), "ctl.i"),
        ("connections.plant.x=meter.speed", ("connections", "plant.x"), "meter.speed"),
        ("components.ctl.nmpc.solver=sqp", ("components", "ctl", "nmpc", "solver"), "sqp"),
        ("components.load.start.y.z=1", ("components", "load", "start", "y.z"), 1),
        ("learn.test[0].inputs.plant.v.slope=2", ("learn", "test", 0, "inputs", "plant.v", "slope"), 2),
        ("components.b={fmu: Motor.fmu}", ("components", "b"), {"fmu": "Motor.fmu"}),
        (" learn.seed =7", ("learn", "seed"), 7),
    ],
)
def test_a_key_path_leads_to_its_value(override, keys, value):
    text, applied, misfits = apply(SCENARIO, [override])
    found = parse(text).data
    for key in keys:
        found = found[key]
    assert (found, misfits, list(applied)) == (value, [], [keys])


def test_a_section_goes_with_the_comments_inside():
    text = "learn:\n  test:\n    # why\n    - duration: 2  # short\n  method:\n    preset: paper\n"
    changed, _, _ = apply(text, ["learn.test=[]"])
    assert changed == "learn:\n  test: []\n  method:\n    preset: paper\n"


def test_missing_sections_are_made(tmp_path):
    text = "name: a\ncomponents:\n  src: {source: {signal: constant, value: 1}}\n"
    loaded = load(tmp_path, text, ["simulate.stop=2", "metrics.settle=1"])
    assert loaded.scenario.simulate.stop == 2
    assert loaded.scenario.metrics.settle == 1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("simulate.stop", "an override reads key.path=value, found 'simulate.stop'"),
        ("=3", "an override reads key.path=value"),
        ("simulate.stp=3", "no key 'stp' in 'simulate'; did you mean 'stop'?"),
        ("simulte.stop=3", "no key 'simulte' in the scenario; did you mean 'simulate'?"),
        ("components.plnt.fmu=a.fmu", "no 'plnt' in 'components'; did you mean 'plant'?"),
        (
            "learn.test[0].inputs.plnt.v.slope=2",
            "no 'plnt.v' in 'learn.test[0].inputs'; did you mean 'plant.v'?",
        ),
        (
            "learn.training[2].duration=2",
            "'learn.training' is a list of 2, counted from 0: there is no '2' in it",
        ),
        ("learn.training.first.duration=2", "there is no 'first' in it"),
        ("name.first=2", "'name' is no section"),
        ("seed.x=1", "'seed' is no section"),
        ("simulate.stop=[1", "not YAML: expected ',' or ']'"),
        ("simulate.stop={a: 1, a: 2}", "key 'a' is given twice"),
    ],
)
def test_an_override_that_does_not_fit_says_why(tmp_path, override, message):
    (problem,) = problems(tmp_path, overrides=[override])
    assert message in problem.message
    assert f"(override {override!r})" in problem.message


def test_an_item_of_a_list_that_is_not_given_cannot_be_set(tmp_path):
    text = SCENARIO.replace('  record: ["*", "plant.*", meter.mean]\n', "")
    (problem,) = problems(tmp_path, text, ["simulate.record[0]=plant.x"])
    assert "'simulate.record' is not given yet; set the whole of it" in problem.message


def test_a_wrong_value_is_reported_with_its_override_and_no_line(tmp_path):
    (problem,) = problems(tmp_path, overrides=["simulate.stop=ten"])
    assert problem.message == "expected a number, found text 'ten' (override 'simulate.stop=ten')"
    assert (problem.path, problem.line) == ("simulate.stop", 0)


def test_other_problems_keep_the_lines_of_the_file(tmp_path):
    text = SCENARIO.replace("settle: 2", "settle: -2")
    found = problems(tmp_path, text, ["components.load.source={signal: constant}", "seed=-1"])
    assert [(p.path, p.line) for p in found] == [
        ("seed", 0),
        ("components.load.source", 0),
        ("metrics.settle", line_of(text, "settle")),
    ]


def test_overrides_are_left_alone_where_the_file_is_not_yaml(tmp_path):
    (problem,) = problems(tmp_path, "name: [", ["seed=1"])
    assert problem.message.startswith("not YAML")


@settings(deadline=None, max_examples=20)
@given(st.sampled_from(SCENARIO.splitlines()), st.integers(-5, 5))
def test_all_but_the_override_reads_as_before(line, value):
    text = SCENARIO + f"# {line}\n"
    before, after = parse(text).data, parse(apply(text, [f"seed={value}"])[0]).data
    assert after == before | {"seed": value}

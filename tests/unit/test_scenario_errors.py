"""Mistakes in a scenario: each in words that name the place and the remedy, and all of them at once."""

from __future__ import annotations

import io
import json
import random
import re
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML
from scenario_helpers import SCENARIO, line_of, load, problem, problems

from exlinn_fmi.errors import ScenarioError
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.explain import PATTERNS, schema_findings, sound_part
from exlinn_fmi.scenario.load import json_schema, load_scenario

TWELVE = """\
name: a dozen
components:
  plant:
    fmu: Motr.fmu
  motor:
    fmu: Motor.fmu
    stepp: 0.01
    start: {alhpa: 1}
  ctl:
    step: 0.0015
    nmpc:
      horizon: -1
      reference:
        coordinate: alpha
        trajectory: {signal: sin, amplitude: 1, frequency: 1}
  src:
    source:
      signal: sine
      amplitude: "2"
      frequency: 1
connections:
  src.y: motor.v
  motor.x: motor.tau_ext
  mottor.i: motor.tau_ext
simulate:
  step: 1e-3
  stpo: 10
  algorithm: gauss
  record:
    - "*"
    - motor.y
metrics:
  output: motor.x
"""


def test_twelve_mistakes_are_twelve_problems_with_their_lines(tmp_path):
    expected = {
        (1, "name"): "expected a name of letters, digits, _, . and -, found text 'a dozen'",
        (4, "components.plant.fmu"): "no such file 'Motr.fmu'; did you mean 'Motor.fmu'?",
        (7, "components.motor.stepp"): "unknown key 'stepp'; did you mean 'step'?",
        (8, "components.motor.start.alhpa"): "motor has no variable 'alhpa'; did you mean 'alpha'?",
        (12, "components.ctl.nmpc.horizon"): "expected ≥ 1, found -1",
        (15, "components.ctl.nmpc.reference.trajectory.signal"): "expected constant, step, ramp, sine, "
        "multisine, chirp, prbs or table, found text 'sin'; did you mean 'sine'?",
        (19, "components.src.source.amplitude"): "expected a number, found text '2'; take away the quotes",
        (23, "connections.motor.x"): "unit mismatch: motor.x [m] → motor.tau_ext [N.m]",
        (24, "connections.mottor.i"): "there is no component 'mottor'; did you mean 'motor'?",
        (
            24,
            "connections.mottor.i",
            2,
        ): "motor.tau_ext is driven twice, by motor.x and by mottor.i; keep one",
        (27, "simulate.stpo"): "unknown key 'stpo'; did you mean 'stop'?",
        (28, "simulate.algorithm"): "expected jacobi or gauss-seidel, found text 'gauss'",
    }
    found = problems(tmp_path, TWELVE)
    assert [(p.line, p.path, p.message) for p in found] == [(*at[:2], text) for at, text in expected.items()]


def test_the_text_of_the_error_lists_file_line_path_and_count(tmp_path):
    with pytest.raises(ScenarioError) as caught:
        load(tmp_path, TWELVE)
    lines = str(caught.value).splitlines()
    assert (
        lines[2]
        == f"{tmp_path / 'valid.yaml'}:7: components.motor.stepp: unknown key 'stepp'; did you mean 'step'?"
    )
    assert lines[-1] == f"12 problems found in {tmp_path / 'valid.yaml'}"
    assert caught.value.exit_code == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("step: 0.01", "stepp: 0.01", "unknown key 'stepp'; did you mean 'step'?"),
        ("seed: 3", "colour: red", "unknown key 'colour'; valid keys: name, description, seed, components"),
        ("seed: 3", "seed: 3.0", "expected a whole number, found 3.0"),
        ("seed: 3", "seed: true", "expected a whole number, found true"),
        ("seed: 3", "seed: -3", "expected ≥ 0, found -3"),
        ("seed: 3", "seed:", "expected a whole number, found nothing"),
        ("name: valid", "name: 5", "expected text, found 5"),
        ("step: 0.01", "step: abc", "expected a number, found text 'abc'"),
        ("step: 0.01", "step: '0.01'", "found text '0.01'; take away the quotes"),
        ("step: 0.01", "step: 10 ms", "found text '10 ms'; write the number alone, in the unit that the key"),
        ("step: 0.01", "step: 1/100", "found text '1/100'; formulas are not evaluated"),
        ("step: 0.01", "step: 0_1", "found text '0_1'; take '_' out"),
        ("step: 0.01", "step: [1]", "expected a number, found a list"),
        ("step: 0.01", "step: {}", "expected a number, found an empty mapping"),
        ("step: 0.01", "step: 0", "expected > 0, found 0"),
        ("stop: 10", "stop: .inf", "expected a finite number, found inf"),
        ("stop: 10", "stop: 1" + 400 * "0", "expected a number, found 10000"),
        ("horizon: 20", "horizon: 10_001", "take '_' out"),
        ("horizon: 20", "horizon: 10001", "expected ≤ 10000, found 10001"),
        ("  stop: 10\n", "", "missing key 'stop': stop time [s]"),
        (
            "  algorithm: jacobi",
            "  algorithm: jakobi",
            "expected jacobi or gauss-seidel, found text 'jakobi'; did",
        ),
        ("  algorithm: jacobi", "  algorithm: on", "expected jacobi or gauss-seidel, found text 'on'"),
        (
            "    fmu: Motor.fmu",
            "    step: 1e-3",
            "nothing says what kind of component this is; give one of the keys",
        ),
        ("    fmu: Motor.fmu", "    fmuu: Motor.fmu", "unknown key 'fmuu'; did you mean 'fmu'?"),
        (
            "    fmu: Motor.fmu",
            "    fmu: Motor.fmu\n    plant: x",
            "has the keys 'fmu' and 'plant'; keep one of them",
        ),
        (
            "    python: meter:Meter\n    options: {window: 3}",
            "    - a",
            "expected a mapping with one of the keys",
        ),
        ("python: meter:Meter", "python: meter.Meter", "expected a class as module:Class"),
        (
            "  load:\n",
            "  2load: {fmu: Motor.fmu}\n  load:\n",
            "that begins with no digit, found text '2load'",
        ),
        ("signal: constant", "signal: constnat", "did you mean 'constant'?"),
        ("signal: constant, ", "", "missing key 'signal'; one of: constant, step"),
        ("signal: constant", "sgnal: constant", "unknown key 'sgnal'; did you mean 'signal'?"),
        (
            "{signal: constant, value: 0, unit: N.m}",
            "5",
            "expected a mapping with a key 'signal': constant, step",
        ),
        ("value: 0, ", "", "missing key 'value': the value, at all times"),
        ("band: [0.1, 5], unit: V", "band: [0.1]", "expected a list of 2, found one of 1"),
        ("band: [0.1, 5], unit: V", "band: [0.1, 5, 6]", "expected a list of 2, found one of 3"),
        (
            "band: [0.1, 5], unit: V",
            "band: [0.1, '5']",
            "expected a number, found text '5'; take away the quotes",
        ),
        ("band: [0.1, 5], unit: V", "band: 5", "expected a list, found 5"),
        ("inputs: 1e-3", "inputs: off", "expected a number or a mapping, found text 'off'"),
        ("inputs: 1e-3", "inputs: {v: -1}", "expected ≥ 0, found -1"),
        ("terminal: dare", "terminal: dara", "expected dare, found text 'dara'; did you mean 'dare'?"),
        ("terminal: dare", "terminal: [1]", "expected 'dare' or a number, found a list"),
        ("alpha: 1.5", "alpha: up", "expected a number, found text 'up'"),
        ("  ctl.v: plant.v", "  ctl: plant.v", "expected a variable as component.variable, found text 'ctl'"),
        (
            "  ctl.v: plant.v",
            "  ctl.v: plant",
            "expected a variable as component.variable, found text 'plant'",
        ),
        ("  ctl.v: plant.v", "  ctl.v: 1", "expected text, a mapping or a list, found 1"),
        (
            "preset: paper",
            "preset: papers",
            "expected structured, terms or paper, found text 'papers'; did you mean",
        ),
        ("[alpha_dot^2, i*alpha]", "[]", "expected at least 1 entry, found an empty list"),
        ("record: [", "record: [2, ", "expected text, found 2"),
        ("topology: circle", "topology: round", "expected line, circle or cyclic, found text 'round'"),
        ("topology: circle", "topologie: circle", "unknown key 'topologie'; did you mean 'topology'?"),
        ("options: {window: 3}", "options: 3", "expected a mapping of names to values, found 3"),
        ("metrics:\n  settle: 2\n  output: plant.x", "metrics: 2", "expected a mapping, found 2"),
    ],
)
def test_a_mistake_is_one_problem_in_our_words(tmp_path, old, new, message):
    found = problem(tmp_path, old, new)
    assert message in found.message
    assert "pydantic" not in found.message
    assert found.line


def test_a_scenario_without_its_name_says_what_is_missing(tmp_path):
    found = problem(tmp_path, "name: valid", "")
    assert found.message == "missing key 'name': name of the scenario and of its result folder"


def test_two_unknown_keys_near_one_missing_key_are_two_problems(tmp_path):
    found = problems(tmp_path, SCENARIO.replace("  stop: 10\n", "  stpo: 10\n  sotp: 10\n"))
    assert [p.path for p in found] == ["simulate.stpo", "simulate.sotp"]


def test_a_value_that_cannot_be_read_is_reported_once(tmp_path):
    assert problem(tmp_path, "seed: 3", "seed: !int 3").message.startswith("the tag !int has no meaning here")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("# only a comment\n", "the file is empty"),
        ("- a\n", "expected a mapping, found a list"),
        ("name: a\ncomponents: {}\n", "missing key 'components': what takes part, by name"),
        ("name: a\n", "missing key 'components': what takes part, by name"),
    ],
)
def test_a_file_that_is_no_scenario_says_so(tmp_path, text, message):
    assert message in problems(tmp_path, text)[0].message


def test_a_missing_file_names_the_nearest(tmp_path):
    load(tmp_path)
    with pytest.raises(
        ScenarioError, match=r"vaild.yaml: no such file 'vaild.yaml'; did you mean 'valid.yaml'\?"
    ):
        load_scenario(tmp_path / "vaild.yaml")


def test_a_folder_is_no_scenario(tmp_path):
    with pytest.raises(ScenarioError, match="is a folder; give a scenario"):
        load_scenario(tmp_path)


def test_a_file_that_is_not_utf_8_names_the_line(tmp_path):
    file = tmp_path / "latin.yaml"
    file.write_bytes("name: a\ndescription: für\n".encode("latin-1"))
    with pytest.raises(ScenarioError, match=r"latin\.yaml:2: not UTF-8 text"):
        load_scenario(file)


def test_lines_of_a_loaded_scenario(tmp_path):
    loaded = load(tmp_path)
    assert loaded.line("simulate.stop") == line_of(SCENARIO, "stop: 10")
    assert loaded.line("learn.training[1].inputs.plant.v.band[0]") == line_of(SCENARIO, "chirp")
    assert loaded.line("learn.training.1.duration") == line_of(SCENARIO, "duration: 5\n"[:-1])
    assert loaded.line("nothing.like.it") == 0


def test_what_is_cut_out_leaves_the_rest():
    sound = sound_part(parse(TWELVE).data)
    assert set(sound.scenario.components) == {"plant", "motor"}
    assert sound.scenario.connections["src.y"] == "motor.v"
    assert sound.scenario.simulate is None


def test_a_default_in_the_place_of_a_misspelt_key_is_in_doubt():
    sound = sound_part(parse(TWELVE).data)
    assert sound.in_doubt(("components", "motor"), "step")
    assert not sound.in_doubt(("components", "plant"), "step")


def test_without_components_nothing_is_said_of_what_names_them(tmp_path):
    text = SCENARIO[: SCENARIO.index("components:")] + SCENARIO[SCENARIO.index("connections:") :]
    (found,) = problems(tmp_path, text)
    assert found.message == "missing key 'components': what takes part, by name"


def test_every_pattern_of_the_vocabulary_has_words():
    schema = json.dumps(json_schema())
    patterns = {json.loads(p) for p in re.findall(r'"pattern": ("(?:[^"\\\\]|\\\\.)*")', schema)}
    assert patterns == set(PATTERNS)


def places(data: Any, path: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """All key paths of plain data."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [here for key, value in items for here in ((*path, key), *places(value, (*path, key)))]


def mutated(path: tuple[str | int, ...], mutation: Any) -> dict[str, Any]:
    """The valid scenario with what stands at `path` renamed, removed or replaced."""
    data = parse(SCENARIO).data
    holder = data
    for key in path[:-1]:
        holder = holder[key]
    if mutation == "remove":
        del holder[path[-1]]
    elif mutation == "rename" and isinstance(holder, dict):
        key = list(str(path[-1]))
        random.Random(str(path)).shuffle(key)
        holder["".join(key)] = holder.pop(path[-1])
    else:
        holder[path[-1]] = mutation
    return data


PLACES = places(parse(SCENARIO).data)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES = st.recursive(
    SCALARS, lambda v: st.lists(v, max_size=3) | st.dictionaries(st.text(max_size=6), v, max_size=3)
)
MUTATIONS = st.sampled_from(["remove", "rename"]) | VALUES


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(st.sampled_from(PLACES), MUTATIONS)
def test_any_mutation_loads_or_is_a_scenario_error(tmp_path, path, mutation):
    stream = io.StringIO()
    YAML(typ="safe", pure=True).dump(mutated(path, mutation), stream)
    for found in problems(tmp_path, stream.getvalue()):
        assert found.message


@settings(deadline=None, max_examples=100)
@given(st.builds(mutated, st.sampled_from(PLACES), MUTATIONS) | VALUES)
def test_the_sound_part_of_anything_is_sound(data):
    assert sound_part(data).scenario is not None
    assert all(message for _, message in schema_findings(data))

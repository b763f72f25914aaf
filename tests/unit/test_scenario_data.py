"""Scenarios that learn from measured data: what fits, and what is told before any row is read."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from measured_helpers import recording, write
from scenario_helpers import SCENARIO, line_of, problem, problems

from exlinn_fmi.describe import describe_scenario
from exlinn_fmi.scenario.check_data import measured
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.load import json_schema, load_scenario, named_files
from exlinn_fmi.scenario.survey import survey
from exlinn_fmi.scenario.units import conversion

DATA = """\
name: valid
learn:
  data:
    files: [a.csv, b.csv]
    test: [c.csv]
    time: {column: time, unit: s}
    columns:
      alpha: {column: phi, unit: rad}
      v: u
    filter: {type: low-pass, cutoff: 50}
  coordinates:
    - {name: alpha, unit: rad, topology: circle}
    - name: Q
      unit: C
      kind: electrical
      topology: cyclic
      velocity: i
      velocity_unit: A
      input: v
      input_unit: V
  identify:
    lagrangian: {l: 0.5*i^2}
"""


@pytest.fixture
def folder(tmp_path):
    write(tmp_path, a=recording(30), b=recording(30, phase=1), c=recording(30, phase=2))
    return tmp_path


def one(folder, old: str, new: str):
    return problem(folder, old, new, DATA)


def test_a_scenario_of_measured_data_needs_no_component(folder):
    assert problems(folder, DATA) == ()
    assert Draft202012Validator(json_schema()).is_valid(parse(DATA).data)


def test_its_files_are_those_that_its_results_depend_on(folder):
    file = folder / "valid.yaml"
    file.write_text(DATA)
    assert named_files(load_scenario(file).scenario) == ["a.csv", "b.csv", "c.csv"]


def test_it_is_described(folder):
    file = folder / "valid.yaml"
    file.write_text(DATA)
    text = describe_scenario(file, ())
    assert text.splitlines()[1] == "learns from measured files in alpha, Q: 2 for training, 1 held out"


def test_the_controller_around_a_model_of_data_is_checked_against_its_quantities(folder):
    text = SCENARIO[: SCENARIO.index("learn:\n")] + DATA[DATA.index("learn:\n") :]
    text += SCENARIO[SCENARIO.index("simulate:\n") :]
    assert problems(folder, text) == ()
    found = problem(folder, "states: {i: {min", "states: {j: {min", text)
    assert "the model has no state 'j'; its states: alpha, alpha_dot, i" in found.message


@pytest.mark.parametrize(
    ("old", "new", "path", "message"),
    [
        ("[a.csv, b.csv]", "[a.csv, d.csv]", "data.files[1]", "no such file 'd.csv'"),
        ("[a.csv, b.csv]", "[a.csv, a.csv]", "data.files[1]", "'a.csv' is there twice; take one out"),
        ("test: [c.csv]", "test: [a.csv]", "data.test[0]", "'a.csv' is trained on as well, so it"),
        ("test: [c.csv]", "test: [c.csv]\n    hold_out: 1", "data.hold_out", "`test` or drawn by `hold_out`"),
        ("test: [c.csv]", "hold_out: 2", "data.hold_out", "expected ≤ 1, so that a file is left"),
        ("unit: s}", "unit: s}\n    step: 1e-3", "data.step", "the time is a column, `time`, or has a fixed"),
        ("column: time", "column: tiem", "data.time", "a.csv: no column 'tiem'; did you mean 'time'?"),
        ("unit: s}", "unit: m}", "data.time.unit", "no conversion from 'm' to 's'"),
        ("column: phi", "column: phy", "data.columns.alpha", "a.csv: alpha: no column 'phy'; did"),
        ("unit: rad}\n", "unit: mm}\n", "data.columns.alpha.unit", "no conversion from 'mm' to 'rad'; leave"),
        ("unit: rad}\n", "scale: 0}\n", "data.columns.alpha.scale", "expected a factor other than 0"),
        ("      v: u\n", "      vv: u\n", "data.columns.vv", "the model has no quantity 'vv'; did"),
        ("      v: u\n", "      v: [u]\n", "data.columns.v", "expected text or a mapping, found a list"),
        ("      v: u\n", "      v: {colum: u}\n", "data.columns.v.colum", "did you mean 'column'?"),
        ("cutoff: 50", "cutoff: 50}\n    resample: {step: 0.01", "data.filter.cutoff", "half of the sam"),
        ("cutoff: 50}", "cutoff: 50}\n    resample: 0.01", "data.filter.cutoff", "expected less than half"),
        ("cutoff: 50}", "cutoff: 50}\n    resample: fine", "data.resample", "expected a number or a mapping"),
        ("type: low-pass", "type: high-pass", "data.filter.type", "expected low-pass, found"),
        ("cutoff: 50}", "cutoff: 50}\n    delimiter: '; '", "data.delimiter", "expected one character"),
        ("cutoff: 50}", "cutoff: 50}\n    delimiter: ','\n    decimal: ','", "data.decimal", "is the deli"),
        ("name: alpha,", "name: plant.alpha,", "coordinates[0].name", "a name of letters, digits and _"),
        ("velocity: i\n", "velocity: plant.i\n", "coordinates[1].velocity", "a name of letters, digits"),
        ("      input: v\n      input_unit: V\n", "", "coordinates", "none has an `input`"),
        ("    files: [a.csv, b.csv]\n", "", "data", "missing key 'files': files, relative to the scenario"),
        ("0.5*i^2", "0.5*j^2", "identify.lagrangian.l", "unknown name 'j'"),
        ("  coordinates:", "  training: []\n  coordinates:", "training", "'training' goes with 'plant'"),
        ("  coordinates:", "  colour: 1\n  coordinates:", "colour", "unknown key 'colour'; valid keys: "),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_files_is_told_before_anything_runs(folder, old, new, path, message):
    text = DATA if "input: v" not in old else DATA.replace("      v: u\n", "")
    found = problem(folder, old, new, text)
    assert found.path == f"learn.{path}"
    assert message in found.message


def test_a_column_that_no_file_has_is_told_of_once(folder):
    text = DATA.replace("velocity: i\n", "velocity: j\n").replace("0.5*i^2", "0.5*j^2")
    (found,) = problems(folder, text)
    assert (found.path, found.message) == (
        "learn.data.files[0]",
        "a.csv: j: no column 'j'; the columns are: time, phi, alpha_dot, i, u",
    )


def test_the_section_of_the_guide_fits_the_recordings_that_come_with_exlinn(root):
    blocks = re.findall(r"^```yaml\n(.*?)^```", (root / "docs/guide.md").read_text("utf-8"), re.S | re.M)
    (section,) = [block for block in blocks if "  data:\n" in block]
    folder = root / "scenarios"
    found = survey(parse(f"name: guide\n{section}").data, folder, None)[0]
    assert found.coordinates
    assert list(measured(found)) == []


def test_a_header_that_cannot_be_read_is_told_at_its_file(folder):
    (folder / "b.csv").write_text("")
    (found,) = problems(folder, DATA)
    assert (found.path, found.line) == ("learn.data.files[1]", line_of(DATA, "files:"))
    assert "b.csv: the file is empty" in found.message


def test_a_file_without_a_time_says_how_to_name_it(folder):
    text = DATA.replace("    time: {column: time, unit: s}\n", "")
    write(folder, a=recording(30).rename(columns={"time": "t"}))
    (found,) = problems(folder, text)
    assert found.message == (
        "a.csv: no column 'time'; the columns are: t, phi, alpha_dot, i, u; say which column is the time: "
        "`time: NAME`"
    )


def test_with_a_step_no_time_is_needed(folder):
    text = DATA.replace("    time: {column: time, unit: s}\n", "    step: 2e-3\n")
    write(folder, a=recording(30).drop(columns="time"))
    assert problems(folder, text) == ()


def test_a_model_is_learned_from_a_plant_or_from_data(folder):
    found = problem(folder, "  coordinates:", "  plant: motor\n  coordinates:", DATA)
    assert "a model has one source, and this has the keys 'plant' and 'data'; keep one" in found.message
    found = problem(folder, "  plant: plant\n", "", SCENARIO)
    assert (found.path, found.message) == (
        "learn",
        "nothing says what to learn from; give one of the keys plant, data",
    )


@pytest.mark.parametrize("section", ["simulate: {stop: 1}\n", "simulate: {stpo: 1}\n"])
def test_what_is_to_be_simulated_takes_components(folder, section):
    assert "missing key 'components'" in problems(folder, DATA + section)[0].message


# ── units ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("unit", "wanted", "factor"),
    [
        ("deg", "rad", np.pi / 180),
        ("°", "rad", np.pi / 180),
        ("deg/s", "rad/s", np.pi / 180),
        ("rpm", "rad/s", np.pi / 30),
        ("rev", "rad", 2 * np.pi),
        ("rad", "deg", 180 / np.pi),
        ("mm", "m", 1e-3),
        ("cm/s2", "m/s2", 1e-2),
        ("mm2", "m2", 1e-6),
        ("mA", "A", 1e-3),
        ("µA", "mA", 1e-3),
        ("kV", "V", 1e3),
        ("ms", "s", 1e-3),
        ("min", "s", 60),
        ("h", "s", 3600),
        ("m/min", "m/s", 1 / 60),
        ("mN.m", "N.m", 1e-3),
        ("Nm", "N.m", 1),
        ("g", "kg", 1e-3),
        ("mg", "kg", 1e-6),
        ("N·m", "N.m", 1),
        ("V", "V", 1),
        ("turns!", "turns!", 1),
    ],
)
def test_units_are_converted(unit, wanted, factor):
    assert conversion(unit, wanted) == pytest.approx(factor, rel=1e-14)


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [("m", "s"), ("C/s", "A"), ("rad/s", "rad"), ("Hz", "rad/s"), ("inch", "m"), ("!", "m")],
)
def test_units_without_a_conversion_have_none(unit, wanted):
    assert conversion(unit, wanted) is None


@given(*[st.sampled_from(["rad/s", "deg/s", "rpm", "mrad/s", "rev/min", "deg/h"])] * 3)
def test_conversions_go_there_and_on_as_they_go_directly(one, two, three):
    assert conversion(one, two) * conversion(two, three) == pytest.approx(conversion(one, three), rel=1e-12)

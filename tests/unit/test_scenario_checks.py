"""Checks across sections of a scenario: what is connected, learned, controlled and recorded fits together."""

from __future__ import annotations

import pytest
from scenario_helpers import SCENARIO, line_of, load, problem, problems

from exlinn_fmi.scenario.load import load_scenario
from exlinn_fmi.scenario.units import same_unit

CURRENT = "  plant.i: ctl.i\n"
VOLTAGE = "  ctl.v: plant.v\n"


def test_a_right_scenario_has_no_problem(tmp_path):
    assert load(tmp_path).scenario.name == "valid"


def test_without_variables_only_what_the_scenario_settles_is_checked(tmp_path):
    load(tmp_path)
    assert load_scenario(tmp_path / "valid.yaml").scenario.name == "valid"


@pytest.mark.parametrize(
    ("new", "message"),
    [
        ("  plnt.i: ctl.i\n", "there is no component 'plnt'; did you mean 'plant'?"),
        ("  plant.i: clt.i\n", "there is no component 'clt'; did you mean 'ctl'?"),
        ("  plant.alhpa: ctl.i\n", "plant has no variable 'alhpa'; did you mean 'alpha'?"),
        ("  plant.I_A: ctl.i\n", "its outputs: alpha, alpha_dot, i, alpha_ddot, i_dot, x"),
        ("  plant.i: ctl.current\n", "ctl has no variable 'current'; its inputs: alpha, alpha_dot, i"),
        ("  plant.i: meter.Gear\n", "meter has no variable 'Gear'; did you mean 'gear'?"),
        ("  plant.v: ctl.i\n", "plant.v is an input; a connection begins at an output"),
        (
            "  plant.brake: ctl.v\n",
            "plant.brake is an input and ctl.v an output; a connection reads from: to",
        ),
        ("  plant.i: plant.x\n", "plant.x is an output; a connection ends at an input"),
        ("  plant.i: plant.heat\n", "plant.heat is no input; a connection ends at an input"),
        ("  plant.i: plant.l\n", "plant.l is a fixed parameter; set it in components.plant.start.l"),
        ("  plant.x: ctl.i\n", "unit mismatch: plant.x [m] → ctl.i [A]"),
        ("  plant.i: meter.gear\n", "type mismatch: plant.i is Real, meter.gear is Integer"),
        ("  plant.i: plant.brake\n", "type mismatch: plant.i is Real, plant.brake is Boolean"),
        ("  plant.alpha_dot: ctl.alpha_dot\n", "key 'plant.alpha_dot' is given twice, first on line 28"),
    ],
)
def test_a_connection_that_does_not_fit_says_why(tmp_path, new, message):
    found = problem(tmp_path, CURRENT, new)
    assert message in found.message
    assert found.line == line_of(SCENARIO, CURRENT.strip())


@pytest.mark.parametrize(
    "new",
    [
        "  plant.i: [ctl.i, plant.b_m]\n",  # a tunable parameter is driven: refused for its unit only
        "  plant.b_m: ctl.i\n",
    ],
)
def test_a_tunable_parameter_may_be_an_end_of_a_connection(tmp_path, new):
    assert problem(tmp_path, CURRENT, new).message.startswith("unit mismatch")


def test_a_boolean_may_drive_a_whole_number(tmp_path):
    assert problems(tmp_path, SCENARIO.replace(CURRENT, f"{CURRENT}  meter.on: meter.gear\n")) == ()


def test_a_target_driven_twice_names_both_sources(tmp_path):
    found = problem(tmp_path, "  load.y: plant.tau_ext\n", "  load.y: [plant.tau_ext, plant.tau_ext]\n")
    assert found.message == "plant.tau_ext is driven twice, by load.y and by load.y; keep one"
    assert found.path == "connections.load.y[1]"


def test_variables_of_a_component_with_a_mistake_are_not_judged(tmp_path):
    text = SCENARIO.replace("options: {window: 3}", "options: 3")
    assert [p.path for p in problems(tmp_path, text)] == ["components.meter.options"]


@pytest.mark.parametrize(
    ("new", "path", "message"),
    [
        ("b_n: 0.4", "b_n", "plant has no variable 'b_n'; did you mean 'b_m'?"),
        ("x: 0.4", "x", "plant.x is calculated by the component and takes no start value"),
        ("i: 101", "i", "expected -100 … 100 A, found 101"),
        ("poles: 2.5", "poles", "expected a whole number, found 2.5"),
        ("brake: 2", "brake", "expected true or false, found 2"),
        ("v: true", "v", "expected a number, found true"),
    ],
)
def test_a_start_value_that_is_not_taken_says_why(tmp_path, new, path, message):
    found = problem(tmp_path, "b_m: 0.4", new)
    assert message in found.message
    assert found.path == f"components.plant.start.{path}"


def test_true_is_a_start_value_of_a_boolean(tmp_path):
    assert problems(tmp_path, SCENARIO.replace("b_m: 0.4", "brake: true")) == ()


@pytest.mark.parametrize(
    ("old", "new", "path", "message"),
    [
        (
            "step: 0.01",
            "step: 0.0015",
            "components.ctl.step",
            "multiple of simulate.step, 0.001 s, found 0.0015 s",
        ),
        ("step: 0.01", "step: 0.0004", "components.ctl.step", "the nearest is 0.001 s"),
        ("step: 1e-3", "step: 11", "simulate.step", "the step, 11 s, is longer than the run, 10 s"),
        (
            "algorithm: jacobi",
            "algorithm: jacobi\n  adaptive: {min_step: 6e-4}",
            "simulate.adaptive.min_step",
            "expected at most half of simulate.step, 0.0005 s, found 0.0006 s",
        ),
        (
            "algorithm: jacobi",
            "algorithm: jacobi\n  adaptive: {tolerances: {plant.alhpa: 1e-3}}",
            "simulate.adaptive.tolerances.plant.alhpa",
            "did you mean 'alpha'?",
        ),
        (
            "algorithm: jacobi",
            "loops: {solver: newtn}",
            "simulate.loops.solver",
            "did you mean 'newton'?",
        ),
        ("stop: 10", "stop: 0", "simulate.stop", "expected > 0 (simulate.start), found 0"),
        ("duration: 2\n", "duration: 2\n      step: 3\n", "learn.test[0].step", "longer than the run, 2 s"),
        (
            "duration: 2\n",
            "duration: 2\n      step: 4e-3\n      start: {alhpa: 0}\n",
            "learn.test[0].start.alhpa",
            "did you mean 'alpha'?",
        ),
    ],
)
def test_steps_and_spans_fit_each_other(tmp_path, old, new, path, message):
    found = problem(tmp_path, old, new)
    assert (found.path, message in found.message) == (path, True)


def test_a_step_with_a_mistake_is_not_compared_with(tmp_path):
    text = SCENARIO.replace("step: 0.01", "step: 3e-4")
    assert problem(tmp_path, "step: 1e-3", "step: 0.1 ms", text).path == "simulate.step"


def test_the_plants_own_step_fits_the_experiments(tmp_path):
    text = SCENARIO.replace("fmu: Motor.fmu", "fmu: Motor.fmu\n    step: 2e-3")
    found = problem(tmp_path, "duration: 2\n", "duration: 2\n      step: 1.5e-3\n", text)
    assert found.path == "learn.test[0].step"
    assert found.message.startswith("plant has a step of its own: expected a multiple")


def test_a_step_in_decimals_is_a_multiple_although_its_binary_form_is_not(tmp_path):
    assert (
        problems(tmp_path, SCENARIO.replace("step: 0.01", "step: 0.3").replace("1e-3\n  alg", "0.1\n  alg"))
        == ()
    )


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("plant.y", "plant has no variable 'y'"),
        ("plnt.*", "nothing fits 'plnt.*'; components: plant, ctl, load, meter"),
        ("plant.b*_m", "nothing fits 'plant.b*_m'"),
        ("plant", "expected component.variable or a pattern such as '*' or 'plant.*', found 'plant'"),
    ],
)
def test_a_name_to_record_that_fits_nothing_is_a_problem(tmp_path, pattern, message):
    found = problem(tmp_path, '"plant.*"', f'"{pattern}"')
    assert message in found.message
    assert found.path == "simulate.record[1]"


@pytest.mark.parametrize("pattern", ["plant.l", "*.?", "plant.heat", "p*t.alpha*"])
def test_what_fits_a_variable_is_recorded(tmp_path, pattern):
    assert problems(tmp_path, SCENARIO.replace('"plant.*"', f'"{pattern}"')) == ()


def test_what_may_be_in_an_unknown_component_may_be_recorded(tmp_path):
    text = SCENARIO.replace("options: {window: 3}", "options: 3")
    assert problem(tmp_path, '"plant.*"', '"meter.*_x"', text).path == "components.meter.options"


def test_a_metric_is_of_what_is_recorded(tmp_path):
    found = problem(tmp_path, '["*", "plant.*", meter.mean]', "[meter.mean]")
    assert (found.path, found.message) == (
        "metrics.output",
        "plant.x is not recorded; add it to simulate.record",
    )


def test_inputs_and_outputs_are_what_a_star_records(tmp_path):
    text = SCENARIO.replace('["*", "plant.*", meter.mean]', '["*"]')
    assert problem(tmp_path, "output: plant.x", "output: plant.heat", text).path == "metrics.output"


def test_a_metric_is_of_what_there_is(tmp_path):
    assert "did you mean 'x'?" in problem(tmp_path, "output: plant.x", "output: plant.xx").message


@pytest.mark.parametrize(
    ("old", "new", "path", "message"),
    [
        (
            "  plant: plant\n",
            "  plant: plnt\n",
            "plant",
            "there is no component 'plnt'; did you mean 'plant'?",
        ),
        ("  plant: plant\n", "  plant: load\n", "plant", "load is a signal source"),
        ("  plant: plant\n", "  plant: ctl\n", "plant", "ctl is a controller"),
        ("  plant: plant\n", "  plant: meter\n", "plant", "variables, they are of plant"),
        (
            "position: plant.alpha",
            "position: plant.v",
            "coordinates[0].position",
            "is an input; expected an output",
        ),
        ("position: plant.alpha", "position: ctl.alpha", "coordinates[0].position", "write plant.alpha"),
        ("      position: plant.alpha\n", "", "coordinates[0]", "missing key 'position'"),
        (
            "velocity: plant.i\n",
            "velocity: plant.j\n",
            "coordinates[1].velocity",
            "plant has no variable 'j'",
        ),
        ("unit: rad\n", "unit: deg\n", "coordinates[0].position", "plant.alpha is [rad]; say `unit: rad`"),
        ("      velocity_unit: A\n", "", "coordinates[1].velocity", "say `velocity_unit: A`"),
        ("input_unit: V", "input_unit: mV", "coordinates[1].input", "say `input_unit: V`"),
        (
            "input: plant.v\n",
            "input: plant.x\n",
            "coordinates[1].input",
            "plant.x is no input; expected an input",
        ),
        ("velocity: plant.alpha_dot", "velocity: plant.i", "coordinates[0].velocity", "unit mismatch"),
        ("[0.1, 5], unit: V", "[0.1, 5], unit: A", "training[0].inputs.plant.v", "signal [A] → plant.v [V]"),
        (
            "{signal: ramp, slope: 1, stop: 1}",
            "{signal: ramp, slope: 1, stop: 0}",
            "test[0].inputs.plant.v.stop",
            "",
        ),
        ("[0.1, 5], unit", "[5, 0.1], unit", "training[0].inputs.plant.v.band", "found [5, 0.1]"),
        ("{alpha: 0.5}", "{alhpa: 0.5}", "training[1].start.alhpa", "did you mean 'alpha'?"),
        (
            "plant.v: {signal: ramp",
            "plant.tau_ext: {signal: ramp",
            "test[0].inputs.plant.tau_ext",
            "no coordinate",
        ),
        ("plant.v: {signal: ramp", "plant.x: {signal: ramp", "test[0].inputs.plant.x", "plant.x is no input"),
        ("plant.v: {signal: ramp", "load.y: {signal: ramp", "test[0].inputs.load.y", "write plant.y"),
        ("i*alpha]", "i*alhpa]", "method.lagrangian_features[1]", "did you mean 'alpha'?"),
        (
            "features: [i^2]",
            "features: [sin(alpha)]",
            "method.dissipation_features[0]",
            "unknown name 'alpha'",
        ),
        ("{l: 0.5*i^2}", "{l: 0.5*i^x}", "identify.lagrangian.l", "is not a factor"),
        ("{r: 0.5*i^2}", "{r: 0.5*alpha^2}", "identify.dissipation.r", "unknown name 'alpha'"),
        ("{r: 0.5*i^2}", "{r: s*logcosh(i/s)}", "identify.dissipation.r", "unknown name 's'"),
        ("{r: 0.5*i^2}", "{r: logcosh(i/s)}", "identify.dissipation.r", "'s' is no shape"),
        (
            "{r: 0.5*i^2}",
            "{r: 0.5*i^2}\n    shapes: {s: 1}",
            "identify.shapes.s",
            "no monomial holds 's'; write e.g. `s*logcosh(v/s)`",
        ),
        (
            "{r: 0.5*i^2}",
            "{r: s*logcosh(i/s)}\n    shapes: {s: 0}",
            "identify.shapes.s",
            "expected a start of the right sign and size, found 0",
        ),
        ("{r: 0.5*i^2}", "{r: 0.5*i^2}\n    known: {rr: 5}", "identify.known.rr", "did you mean 'r'?"),
        ("{r: 0.5*i^2}", "{l: 0.5*i^2}", "identify", "'l' is the name of two parameters"),
        (
            "      topology: circle\n",
            "      topology: circle\n      friction: [dry]\n",
            "coordinates[0].friction[0]",
            "viscous",
        ),
    ],
)
def test_learning_fits_its_plant(tmp_path, old, new, path, message):
    found = problem(tmp_path, old, new)
    assert found.path == f"learn.{path}"
    assert message in found.message


def test_a_model_needs_an_input(tmp_path):
    text = SCENARIO.replace("  ctl.v: plant.v\n", "").replace("      safe_input: {v: 0}\n", "")
    text = text.replace("      inputs: {v: {min: -24, max: 24}}\n", "")
    found = problem(tmp_path, "      input: plant.v\n", "", text)
    assert (found.path, found.message[:21]) == ("learn.coordinates", "none has an `input`; ")


def test_two_coordinates_do_not_share_a_name(tmp_path):
    found = problem(tmp_path, "acceleration: plant.alpha_ddot", "acceleration: plant.i")
    assert "unit mismatch" in found.message
    text = SCENARIO.replace("      acceleration: plant.alpha_ddot\n", "").replace(
        "name: Q", "name: alpha_ddot"
    )
    assert problem(tmp_path, "name: alpha\n", "name: alpha\n", text).message.endswith("rename one of them")


def test_a_model_is_not_learned_from_itself(tmp_path):
    text = SCENARIO.replace("  load:", "  twin: {model: learned}\n  load:")
    assert (
        "twin is the model that is learned"
        in problem(tmp_path, "  plant: plant\n", "  plant: twin\n", text).message
    )


def test_a_learned_model_has_the_variables_of_its_coordinates(tmp_path):
    text = SCENARIO.replace("  load:", "  twin: {model: learned}\n  load:")
    assert problems(tmp_path, text.replace("ctl.v: plant.v", "ctl.v: [plant.v, twin.v]")) == ()
    found = problem(tmp_path, "ctl.v: plant.v", "ctl.v: [plant.v, twin.w]", text)
    assert "twin has no variable 'w'; its inputs: v" in found.message


@pytest.mark.parametrize(
    ("old", "new", "path", "message"),
    [
        ("inputs: {v: {min", "inputs: {u: {min", "inputs.u", "the model has no input 'u'; its inputs: v"),
        ("{min: -24, max: 24}", "{min: 24, max: -24}", "inputs.v", "expected min < max"),
        ("states: {i:", "states: {j:", "states.j", "the model has no state 'j'; its states: alpha,"),
        ("alpha: 10, i: 1", "alpha: 10, x: 1", "weights.states.x", "the model has no state 'x'"),
        ("inputs: 1e-3", "inputs: {w: 1}", "weights.inputs.w", "the model has no input 'w'"),
        ("safe_input: {v: 0}", "safe_input: {w: 0}", "safe_input.w", "the model has no input 'w'"),
        ("safe_input: {v: 0}", "safe_input: {v: 30}", "safe_input.v", "expected -24 … 24 (its bounds)"),
        (
            "safe_input: {v: 0}",
            "cost: paper\n      terminal_set: {}",
            "terminal_set",
            "needs `cost: tracking` and `weights.terminal: dare`, found `cost: paper`",
        ),
        ("terminal: dare}", "terminal: 2}\n      terminal_set: {}", "terminal_set", "terminal: 2`"),
        ("coordinate: alpha", "coordinate: alhpa", "reference.coordinate", "did you mean 'alpha'?"),
        ("{map: scotch_yoke, crank: 0.2}", "~", "reference.trajectory", "trajectory [m] → alpha [rad]"),
        ("{signal: sine, amplitude: 0.15, frequency: 0.4, unit: m}",
         "{signal: table, file: r.csv, column: x}",
         "reference.trajectory.file", "r.csv: no such file"),
        ("model: learned", "model: leaned", "model", "did you mean 'learned'?"),
        ("model: learned", "model: .", "model", "it has no model.json"),
    ],
)  # fmt: skip
def test_a_controller_fits_its_model(tmp_path, old, new, path, message):
    if path == "inputs.v":  # else the safe input is outside of them as well
        old, new = f"inputs: {{v: {old}}}", f"inputs: {{v: {new}}}"
        text = SCENARIO.replace("      safe_input: {v: 0}\n", "")
    else:
        text = SCENARIO
    found = problem(tmp_path, old, new, text)
    assert found.path == f"components.ctl.nmpc.{path}"
    assert message in found.message


ESTIMATOR = "      safe_input: {v: 0}\n      estimator: {type: ekf, "


@pytest.mark.parametrize(
    ("given", "path", "message"),
    [
        ("measured: [alpha, w]", "measured[1]", "the model has no state 'w'"),
        ("measured: [alpha, i]", "measured[1]", "nothing is connected to i; connect a sensor"),
        ("noise: {w: 1}", "noise.w", "the model has no state 'w'"),
        ("process: {w: 1}", "process.w", "the model has no state 'w'"),
        ("disturbances: [i]", "disturbances.i", "the model has no coordinate 'i'; its coordinates: alpha, Q"),
        ("disturbances: {Q: 0}", "disturbances.Q", "expected > 0, found 0"),
        ("gain: best", "gain", "expected updated or steady, found text 'best'"),
    ],
)  # fmt: skip
def test_an_estimator_fits_its_model_and_what_is_connected(tmp_path, given, path, message):
    text = SCENARIO.replace("  plant.i: ctl.i\n", "")
    found = problem(tmp_path, "      safe_input: {v: 0}\n", f"{ESTIMATOR}{given}}}\n", text)
    assert found.path == f"components.ctl.nmpc.estimator.{path}"
    assert message in found.message


@pytest.mark.parametrize("given", ["mhe", "{type: ekf, gain: steady, disturbances: []}"])
def test_an_estimator_is_a_word_or_a_mapping(tmp_path, given):
    text = SCENARIO.replace("      safe_input", f"      estimator: {given}\n      safe_input")
    assert problems(tmp_path, text.replace("  plant.i: ctl.i\n", "")) == ()


def test_several_references_are_a_list_each_with_its_place(tmp_path):
    at, end = SCENARIO.index("        coordinate: alpha\n"), SCENARIO.index("  load:\n")
    several = (
        "        - {coordinate: alpha, trajectory: {signal: constant, value: 1}}\n"
        "        - {coordinate: w, trajectory: {signal: constant, value: 1}}\n"
    )
    found = problems(tmp_path, SCENARIO[:at] + several + SCENARIO[end:])
    assert [(p.path, p.message.split(";")[0]) for p in found] == [
        ("components.ctl.nmpc.reference[1].coordinate", "the model has no state 'w'")
    ]


def test_a_learned_model_needs_a_learn_section(tmp_path):
    text = SCENARIO[: SCENARIO.index("learn:\n")] + SCENARIO[SCENARIO.index("simulate:\n") :]
    found = problems(tmp_path, text.replace("  load:", "  twin: {model: learned}\n  load:"))
    assert [p.path for p in found] == ["components.ctl.nmpc.model", "components.twin.model"]
    assert "this scenario" in found[0].message or "there is none" in found[0].message


def test_a_model_of_our_own_is_not_looked_for_in_a_folder(tmp_path):
    text = SCENARIO.replace("model: learned", "model: plant:dc_motor_cart")
    assert [p for p in problems(tmp_path, text) if "nmpc" in p.path] == []


def test_a_folder_with_a_model_is_one(tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "model.json").write_text("{}")
    assert problems(tmp_path, SCENARIO.replace("  load:", "  twin: {model: old}\n  load:")) == ()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Motr.fmu", "no such file 'Motr.fmu'; did you mean 'Motor.fmu'?"),
        ("Pump.fmu", "no such file 'Pump.fmu'; there is: Motor.fmu"),
        ("sub/Motor.fmu", "no such file 'sub/Motor.fmu': there is no folder"),
        (".", "'.' is a folder, expected an .fmu file"),
    ],
)
def test_a_file_that_is_not_there_names_what_is(tmp_path, name, message):
    found = problem(tmp_path, "fmu: Motor.fmu", f"fmu: {name}")
    assert found.message.startswith(message)
    assert found.path == "components.plant.fmu"


def test_a_file_that_is_where_the_user_stands_says_where_paths_start(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "Pump.fmu").touch()
    monkeypatch.chdir(tmp_path / "work")
    found = problem(tmp_path, "fmu: Motor.fmu", "fmu: Pump.fmu")
    assert "relative paths start from the scenario's folder" in found.message


def test_what_inspection_finds_wrong_stands_at_the_component(tmp_path):
    load(tmp_path)
    (tmp_path / "Far.fmu").write_bytes(b"foreign")
    found = problem(tmp_path, "fmu: Motor.fmu", "fmu: Far.fmu")
    assert (found.path, found.line) == ("components.plant.fmu", line_of(SCENARIO, "Motor.fmu"))
    assert found.message == "no binary for linux64 in Far.fmu (found: win64). Re-export it for linux64."


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("N.m", "N.m"),
        ("N.m.s/rad", "N·m·s·rad-1"),
        ("rad/s2", "rad/s^2"),
        ("kg.m2", "m2 kg".replace(" ", ".")),
        ("1", "rad"),
        (None, "m"),
        ("", "m"),
        ("Ω", "Ohm"),
        ("W/(m2.K)", "W.m-2.K-1"),
        ("what ever!", "what ever!"),
    ],
)
def test_units_that_mean_the_same_agree(one, other):
    assert same_unit(one, other)
    assert same_unit(other, one)


@pytest.mark.parametrize(
    ("one", "other"), [("m", "mm"), ("rad", "deg"), ("rad/s", "rad"), ("C/s", "A"), ("!", "m")]
)
def test_units_that_differ_do_not_agree(one, other):
    assert not same_unit(one, other)


def test_sines_of_degrees_are_refused_with_the_factor_to_rad(tmp_path):
    rows = "".join(f"{0.01 * k},{k % 7},{k % 5}\n" for k in range(50))
    (tmp_path / "data.csv").write_text("time,phi,u\n" + rows)
    text = """\
name: degrees
learn:
  data: {files: [data.csv]}
  coordinates:
    - {name: phi, unit: deg, topology: circle, input: u, input_unit: N.m}
  identify:
    lagrangian: {j: 0.5*phi_dot^2, m: cos(0.017453292519943295*phi), w: cos(phi)}
"""
    found = problems(tmp_path, text)
    assert [f.path for f in found] == ["learn.identify.lagrangian.w"]
    assert "write cos(0.017453292519943295*phi)" in found[0].message

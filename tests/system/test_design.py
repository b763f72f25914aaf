"""`exlinn design` as a user meets it: a table, a snippet that trains, exit codes and error texts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from scenario_helpers import MOTOR_COORDINATES

from exlinn_fmi.cli import exit_code
from exlinn_fmi.interrupts import StopRequest
from exlinn_fmi.pipeline import design, simulate
from exlinn_fmi.scenario.load import load_scenario
from exlinn_fmi.workspace import Run

SCENARIO = (
    """\
name: designed
components:
  plant: {plant: dc_motor_cart, start: {r: 4.0}}
learn:
  plant: plant
  coordinates:
"""
    + MOTOR_COORDINATES
    + """\
      acceleration: plant.i_dot
      input: plant.v
      input_unit: V
  training:
    - duration: 4
      step: 0.005
      start: {alpha: 0.5}
      inputs:
        plant.v: {signal: sine, offset: 4, amplitude: 1, frequency: 0.3183098861837907, unit: V}
  identify:
    lagrangian: {j_m: 0.5*alpha_dot^2, "m_c*d^2": 0.5*sin(alpha)^2*alpha_dot^2, l: 0.5*i^2, k_e: i*alpha}
    dissipation: {b_m: 0.5*alpha_dot^2, r: 0.5*i^2}
  design:
    noise: {alpha: {std: 0.01}, alpha_dot: {std: 0.01}, i: {std: 0.01}}
    limits: {inputs: {v: {min: -12, max: 12}}, states: {i: {min: -4, max: 4}}}
    candidates: 30
"""
)


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """The motor, its parameters known, under the paper's excitation."""
    (tmp_path / "designed.yaml").write_text(SCENARIO)
    return tmp_path / "designed.yaml"


def test_design_proposes_an_excitation_that_is_better_and_fits_the_scenario(
    scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = scenario.parent / "run"
    assert exit_code(["design", str(scenario), "--out", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "times better" in told
    assert "design.yaml" in told
    found = json.loads((folder / "design.json").read_text())
    assert found["improvement"] > 2
    assert found["values"]["r"] == 4.0
    assert found["noise"]["alpha"] == 0.01
    data = YAML(typ="safe").load(scenario)
    data["learn"]["training"] = YAML(typ="safe").load(folder / "design.yaml")["training"]
    again = scenario.with_name("again.yaml")
    YAML().dump(data, again)
    experiment = load_scenario(again).scenario.learn.training[0]
    assert experiment.start == {"alpha": 0.5}
    assert experiment.duration == 4
    # What was promised is what the scenario with the proposal has.
    assert exit_code(["design", str(again), "--out", str(scenario.parent / "second")]) == 0
    second = json.loads((scenario.parent / "second" / "design.json").read_text())
    assert second["present"]["worst"] == pytest.approx(found["proposed"]["worst"], rel=1e-6)


def test_an_unchanged_design_is_not_searched_again(
    scenario: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = scenario.parent / "run"
    first = ["design", str(scenario), "--out", str(folder)]
    assert exit_code(first) == 0
    table = capsys.readouterr().out
    assert exit_code(first) == 0
    again = capsys.readouterr()
    assert again.out == table
    assert "unchanged" in again.err


def test_a_stopped_design_keeps_the_best_and_goes_on_next_time(scenario: Path) -> None:
    class AfterTheFirst(StopRequest):
        def __call__(self) -> bool:
            self.requested, before = True, self.requested
            return before

    work = Run.open(scenario, scenario.parent / "run")
    work.stop = AfterTheFirst()
    design(work)
    assert (work.folder / "design.yaml").exists()
    assert "stopped" in work.warnings[0]
    assert work.stages.key("design") is None


def test_design_counts_on_the_learned_model_where_the_plant_is_not_known(scenario: Path) -> None:
    folder = scenario.parent / "run"
    learned = ["--out", str(folder), "--set", "learn.design.model=learned"]
    assert (
        exit_code(
            ["train", str(scenario), *learned, "--set", "learn.method={preset: structured, iterations: 30}"]
        )
        == 0
    )
    assert exit_code(["design", str(scenario), *learned]) == 0
    by_plant = scenario.parent / "plant"
    assert exit_code(["design", str(scenario), "--out", str(by_plant)]) == 0
    one, two = (json.loads((f / "design.json").read_text())["present"]["worst"] for f in (folder, by_plant))
    assert one == pytest.approx(two, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("learn.design.model=learned", "run `exlinn train"),
        ("learn.design.limits.inputs.v={min: 5, max: 5}", "expected min < max"),
        ("learn.design.limits.states.i={min: 50, max: 51}", "keeps the limits"),
        ("learn.design.limits.states.w={min: 0}", "the model has no state 'w'"),
        ("learn.design.limits.inputs.tau={min: 0}", "the model has no input 'tau'"),
        ("learn.design.noise={speed: 0.1}", "the model has no state 'speed'"),
        ("learn.design.noise={}", "nothing is measured"),
        ("learn.design.noise=-1", "expected > 0"),
        ("learn.design.band=[1, 1.5]", "an octave"),
        ("learn.design.model=nowhere", "model.json"),
        ("learn.identify={}", "no parameters to find out"),
        ("learn.identify.dissipation={friction: 0.5*i^2}", "no value of 'friction'"),
    ],
)
def test_what_cannot_be_designed_is_the_users_to_mend(
    scenario: Path, capsys: pytest.CaptureFixture[str], change: str, words: str
) -> None:
    arguments = ["design", str(scenario), "--out", str(scenario.parent / "run"), "--set", change]
    assert exit_code(arguments) == 1
    assert words in capsys.readouterr().err


def test_an_input_that_is_held_needs_limits(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = SCENARIO.replace("inputs: {v: {min: -12, max: 12}}, ", "").replace("amplitude: 1", "amplitude: 0")
    scenario.write_text(text)
    assert exit_code(["design", str(scenario), "--out", str(scenario.parent / "run")]) == 1
    assert "expected room between them" in capsys.readouterr().err


def test_measured_data_cannot_be_excited(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measured = Path(__file__).parents[2] / "scenarios" / "measured.yaml"
    assert exit_code(["design", str(measured), "--out", str(tmp_path)]) == 1
    assert "nothing to excite" in capsys.readouterr().err


def test_what_is_to_be_designed_does_not_bring_the_simulation_back(tmp_path: Path) -> None:
    text = SCENARIO + "connections: {}\nsimulate: {stop: 0.1, step: 0.01}\n"
    (tmp_path / "designed.yaml").write_text(text)
    runs = []
    for candidates in (30, 40):
        override = f"learn.design.candidates={candidates}"
        runs.append(Run.open(tmp_path / "designed.yaml", tmp_path / "run", [override]))
        simulate(runs[-1])
    assert [run.history["simulate"]["status"] for run in runs] == ["ran", "cached"]

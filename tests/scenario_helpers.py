"""A scenario that is right in every respect, and ways to get things wrong in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from exlinn_fmi.components.base import Variable
from exlinn_fmi.errors import FmuError, Problem, ScenarioError
from exlinn_fmi.scenario.load import LoadedScenario, load_scenario
from exlinn_fmi.scenario.schema import FmuComponent, PythonComponentSpec

MOTOR_COORDINATES = """\
    - name: alpha
      unit: rad
      topology: circle
      position: plant.alpha
      velocity: plant.alpha_dot
      acceleration: plant.alpha_ddot
    - name: Q
      unit: C
      kind: electrical
      topology: cyclic
      velocity: plant.i
      velocity_unit: A
"""
"""The motor's coordinates, but for the rest of the charge's keys."""

SCENARIO = (
    """\
name: valid
description: every section, nothing wrong   # line 2
seed: 3
components:
  plant:
    fmu: Motor.fmu
    start: {alpha: 1.5, b_m: 0.4}
  ctl:
    step: 0.01
    nmpc:
      model: learned
      horizon: 20
      inputs: {v: {min: -24, max: 24}}
      states: {i: {min: -4, max: 4}}
      weights: {states: {alpha: 10, i: 1}, inputs: 1e-3, terminal: dare}
      safe_input: {v: 0}
      reference:
        coordinate: alpha
        trajectory: {signal: sine, amplitude: 0.15, frequency: 0.4, unit: m}
        through: {map: scotch_yoke, crank: 0.2}
  load:
    source: {signal: constant, value: 0, unit: N.m}
  meter:
    python: meter:Meter
    options: {window: 3}
connections:
  plant.alpha: ctl.alpha
  plant.alpha_dot: [ctl.alpha_dot, meter.speed]
  plant.i: ctl.i
  ctl.v: plant.v
  load.y: plant.tau_ext
learn:
  plant: plant
  coordinates:
"""
    + MOTOR_COORDINATES
    + """\
      input: plant.v
      input_unit: V
  training:
    - duration: 10
      inputs:
        plant.v: {signal: multisine, rms: 2, band: [0.1, 5], unit: V}
    - duration: 5
      start: {alpha: 0.5}
      inputs:
        plant.v: {signal: chirp, amplitude: 2, band: [0.1, 5], duration: 5}
  test:
    - duration: 2
      inputs:
        plant.v: {signal: ramp, slope: 1, stop: 1}
  method:
    preset: paper
    lagrangian_features: [alpha_dot^2, i*alpha]
    dissipation_features: [i^2]
  identify:
    lagrangian: {l: 0.5*i^2}
    dissipation: {r: 0.5*i^2}
simulate:
  stop: 10
  step: 1e-3
  algorithm: jacobi
  record: ["*", "plant.*", meter.mean]
metrics:
  settle: 2
  output: plant.x
"""
)

MOTOR = (
    Variable("tau_ext", "input", unit="N.m", start=0.0),
    Variable("v", "input", unit="V", start=0.0),
    Variable("alpha", "output", unit="rad", start=0.0),
    Variable("alpha_dot", "output", unit="rad/s", start=0.0),
    Variable("i", "output", unit="A", start=0.0, min=-100.0, max=100.0),
    Variable("alpha_ddot", "output", unit="rad/s2"),
    Variable("i_dot", "output", unit="A/s"),
    Variable("x", "output", unit="m"),
    Variable("b_m", "parameter", "tunable", unit="N.m.s/rad", start=0.5),
    Variable("l", "parameter", "fixed", unit="H", start=1.0),
    Variable("poles", "parameter", "fixed", type="Integer", start=2.0),
    Variable("brake", "input", type="Boolean", start=0.0),
    Variable("heat", "local", unit="W"),
)
METER = (
    Variable("speed", "input", unit="rad/s", start=0.0),
    Variable("gear", "input", type="Integer", start=1.0),
    Variable("mean", "output", unit="rad/s"),
    Variable("on", "output", type="Boolean"),
)


def inspect(spec: object, folder: Path) -> Sequence[Variable]:
    """Variables of the components above, without their files."""
    if isinstance(spec, FmuComponent):
        if (folder / spec.fmu).read_bytes() == b"foreign":
            raise FmuError(f"no binary for linux64 in {spec.fmu} (found: win64). Re-export it for linux64.")
        return MOTOR
    return METER if isinstance(spec, PythonComponentSpec) else ()


def load(folder: Path, text: str = SCENARIO, overrides: Sequence[str] = ()) -> LoadedScenario:
    """Write the text as a scenario file beside an FMU file, and load it."""
    (folder / "Motor.fmu").write_bytes(b"")
    file = folder / "valid.yaml"
    file.write_text(text, encoding="utf-8")
    return load_scenario(file, overrides, inspect)


def problems(folder: Path, text: str = SCENARIO, overrides: Sequence[str] = ()) -> tuple[Problem, ...]:
    """All problems of the text as a scenario; none if it loads."""
    try:
        load(folder, text, overrides)
    except ScenarioError as error:
        return error.problems
    return ()


def problem(folder: Path, old: str, new: str, text: str = SCENARIO) -> Problem:
    """The one problem that comes of putting `new` in the place of `old`."""
    assert text.count(old) == 1, f"{old!r} is there {text.count(old)} times"
    found = problems(folder, text.replace(old, new))
    assert len(found) == 1, "\n".join(map(str, found)) or "no problem"
    return found[0]


def line_of(text: str, part: str) -> int:
    """Number of the first line that holds `part`."""
    return next(k for k, line in enumerate(text.splitlines(), 1) if part in line)

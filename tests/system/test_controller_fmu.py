"""Controllers and closed loops as FMUs: their answers are those of the controller in process."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from export_helpers import instance
from fmpy.ssp.simulation import simulate_ssp

from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.lagrangian import LagrangianComponent
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.errors import InputError, ModelError
from exlinn_fmi.export.build import Options, export_model
from exlinn_fmi.export.check import check_fmu
from exlinn_fmi.export.controller import controller_model
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import ModelSpec, Scales, learned_system
from exlinn_fmi.plants import plant
from exlinn_fmi.scenario.control import Nmpc
from exlinn_fmi.shipping import Origin, ship_controller, ship_loop

STEP, HERE = 0.01, Path()
MOTOR = plant("dc_motor_cart").system.with_inputs({"v"})
YOKE = {
    "coordinate": "alpha",
    "trajectory": {"signal": "sine", "amplitude": 0.15, "frequency": 0.4},
    "through": {"map": "scotch_yoke", "crank": 0.2},
}
DISTURBED = {"type": "ekf", "measured": ["alpha", "i"], "disturbances": ["alpha"]}


def follow(signal: str, **more: Any) -> dict[str, Any]:
    return {"coordinate": "alpha", "trajectory": {"signal": signal, **more}}


SPEED = {"signal": "chirp", "amplitude": 1.0, "band": [0.2, 1.0], "duration": 0.7, "offset": 3.0}
CASES: dict[str, dict[str, Any]] = {
    "Kalman filter, rates": {"estimator": DISTURBED, "rates": {"v": 300.0}},
    "steady gain, late by a computation": {
        "estimator": {**DISTURBED, "gain": "steady"},
        "delay": "computation",
        "reference": follow("step", time=0.3, before=1.0, after=1.3),
    },
    "a speed, to convergence": {
        "solver": "sqp",
        "reference": {"coordinate": "alpha_dot", "trajectory": SPEED},
    },
    "random levels, measured late": {
        "delay": "measurement",
        "reference": follow("prbs", amplitude=0.2, hold=0.15, order=4, offset=1.0),
    },
    "several sines": {"reference": follow("multisine", rms=0.2, band=[0.5, 2.0], lines=5, offset=1.0)},
    "a terminal set": {"terminal_set": {"weight": 20}, "horizon": 10, "solver": "sqp"},
}


def options(**more: Any) -> Nmpc:
    given = {
        "model": "plant:dc_motor_cart",
        "horizon": 20,
        "inputs": {"v": {"min": -24, "max": 24}},
        "states": {"i": {"min": -4, "max": 4}},
        "reference": YOKE,
    }
    return Nmpc.model_validate({**given, **more})


def networks() -> LagrangianSystem:
    """A learned motor with small random networks beside the true terms' like."""
    coordinates = MOTOR.coordinates
    spec = ModelSpec(
        "structured", coordinates, 4, Scales(0.2, 1.0, (1.0, 0.5), (0.0,) * 2, (1.0,) * 2), (0.3, 0.3)
    )
    rng = np.random.default_rng(3)
    weights = {name: 0.15 * rng.normal(size=shape) for name, shape in spec.shapes().items()}
    weights["lagrangian.coupling"][:], weights["dissipation.viscous"][:] = 1.0, 1.0
    return learned_system(spec, weights)


def in_loop(
    controller: Any, system: LagrangianSystem, ticks: int, names: list[str], stuck: range = range(0)
) -> np.ndarray:
    """Outputs of a controller at each tick, in a loop with its own model; one sensor is stuck for a while."""
    motor = LagrangianComponent("motor", system)
    for component in (controller, motor):
        component.enter_initialization(0.0, ticks * STEP, {"alpha": 1.2} if component is motor else {})
        component.exit_initialization()
    states, rows = np.zeros(3), np.zeros((ticks, len(names)))
    measured = np.array([motor.index(name) for name in system.state_names])
    given = np.array([controller.index(name) for name in system.state_names])
    told, v = np.array([controller.index(name) for name in names]), np.array([motor.index("v")])
    for k in range(ticks):
        held = states[0]
        motor.get(measured, states)
        states[0] = held if k in stuck else states[0]
        controller.set(given, states)
        controller.get(told, rows[k])
        motor.set(v, rows[k, :1])
        motor.step(k * STEP, STEP)
        controller.step(k * STEP, STEP)
    return rows


def told(controller: NmpcController) -> list[str]:
    """Outputs that are compared: neither times nor counts of iterations, which rounding may change by one."""
    left = ("solve_time", "feedback_time", "iterations", "kkt")
    return [v.name for v in controller.variables if v.causality == "output" and v.name not in left]


@pytest.mark.parametrize("case", CASES)
def test_answers_equal_those_of_the_controller_in_process(case: str, tmp_path: Path) -> None:
    settings = options(**CASES[case])
    controller = NmpcController("c", MOTOR, settings, STEP, HERE)
    model = controller_model(controller, settings, HERE, "Nmpc")
    path = export_model(model, tmp_path, Options(3 if case == "several sines" else 2))
    assert check_fmu(path).problems == ()
    names = told(controller)
    expected = in_loop(controller, MOTOR, 100, names)
    found = in_loop(FmuComponent("f", path), MOTOR, 100, names)
    np.testing.assert_allclose(found[:, 0], expected[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("estimator", ["none", DISTURBED], ids=["none", "ekf"])
def test_measurements_are_found_lost_as_in_process(estimator: Any, tmp_path: Path) -> None:
    settings = options(
        estimator=estimator, dropout={"stale": 2, "timeout": 0.1}, safe_input={"v": 1}, horizon=10
    )
    controller = NmpcController("c", MOTOR, settings, STEP, HERE)
    path = export_model(controller_model(controller, settings, HERE, "Nmpc"), tmp_path)
    names, stuck = told(controller), range(30, 50)
    expected = in_loop(controller, MOTOR, 80, names, stuck)
    assert set(expected[:, names.index("solve_status")]) == {0.0, 3.0}
    found = in_loop(FmuComponent("f", path), MOTOR, 80, names, stuck)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)


def test_networks_predict_as_in_process(tmp_path: Path) -> None:
    system, settings = networks(), options(horizon=15)
    controller = NmpcController("c", system, settings, STEP, HERE)
    path = export_model(controller_model(controller, settings, HERE, "Nmpc"), tmp_path)
    names = told(controller)
    expected = in_loop(controller, system, 60, names)
    np.testing.assert_allclose(
        in_loop(FmuComponent("f", path), system, 60, names), expected, rtol=1e-7, atol=1e-8
    )


def test_a_missing_measurement_is_borne_and_between_ticks_outputs_are_held(run: Path, tmp_path: Path) -> None:
    path = ship_controller(Origin.find(run), tmp_path / "Controller.fmu", Options())
    assert check_fmu(path).problems == ()
    with instance(path) as made:
        made.start({"alpha": 0.0})
        (first,) = made.get("v")
        assert abs(first) < 24.0
        made.fmu.doStep(0.0, 0.004)
        made.set("alpha", 0.01)
        assert made.get("v") == [first]
        made.fmu.doStep(0.004, 0.006)
        assert made.get("v") != [first]
        made.fmu.doStep(0.01, STEP)
        made.set("i", float("nan"))
        assert made.get("missing") == [1.0]
        assert np.isfinite(made.get("v")).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"solver": "ipopt"}, "only the compiled `rti` and `sqp` become an FMU"),
        ({"estimator": "mhe"}, "estimator `mhe`: there is no C code for it; choose `ekf` or `none`"),
    ],
)
def test_what_cannot_become_an_fmu_is_named(settings: dict[str, Any], message: str) -> None:
    given = options(**settings)
    with pytest.raises(ModelError, match=message):
        controller_model(NmpcController("c", MOTOR, given, STEP, HERE), given, HERE, "Nmpc")


# ── from a run ───────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of a closed loop around a plant's formulas."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "scenario.yaml").write_text(
        """
name: shipped
components:
  motor: {plant: dc_motor_cart}
  controller:
    step: 0.01
    nmpc:
      model: plant:dc_motor_cart
      horizon: 20
      inputs: {v: {min: -24, max: 24}}
      reference:
        coordinate: alpha
        trajectory: {signal: sine, amplitude: 0.02, frequency: 0.4}
connections:
  motor.alpha: controller.alpha
  motor.alpha_dot: controller.alpha_dot
  motor.i: controller.i
  controller.v: motor.v
simulate: {stop: 1, step: 0.01}
"""
    )
    return folder


def test_a_loop_in_one_fmu_runs_as_its_parts_do(run: Path, tmp_path: Path) -> None:
    origin = Origin.find(run)
    path = ship_loop(origin, tmp_path / "Loop.fmu", Options())
    assert check_fmu(path).problems == ()
    controller = origin.controller()
    expected = in_loop(controller, controller.parts.ocp.system, 50, ["v", "estimate_alpha"])
    rows = []
    with instance(path) as made:
        made.start({"alpha": 1.2})
        for k in range(50):
            rows.append(made.get("v", "alpha"))
            made.fmu.doStep(k * STEP, STEP)
    np.testing.assert_allclose(rows, expected, rtol=0, atol=1e-9)


def test_a_loop_as_a_structure_names_its_parts_and_wires(run: Path, tmp_path: Path) -> None:
    path = ship_loop(Origin.find(run), tmp_path / "Loop.ssp", Options())
    with zipfile.ZipFile(path) as archive:
        assert set(archive.namelist()) == {
            "SystemStructure.ssd",
            "resources/controller.fmu",
            "resources/model.fmu",
        }
        root = ET.fromstring(archive.read("SystemStructure.ssd"))
    ends = ("startElement", "startConnector", "endElement", "endConnector")
    wires = {tuple(e.get(end) for end in ends) for e in root.iter() if e.tag.endswith("}Connection")}
    assert ("controller", "v", "model", "v") in wires
    assert ("model", "alpha_dot", "controller", "alpha_dot") in wires
    result = simulate_ssp(str(path), stop_time=0.2, step_size=STEP)
    assert np.isfinite([list(row) for row in result]).all()


def test_what_is_no_run_or_has_no_such_controller_is_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        Origin.find(tmp_path)
    with pytest.raises(InputError, match="no controller 'other'"):
        Origin.find(run, name="other")
    with pytest.raises(InputError, match="a loop is an"):
        ship_loop(Origin.find(run), tmp_path / "Loop.zip", Options())

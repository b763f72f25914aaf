"""How well the controller tracks the cart: `scenarios/dcwc_tracking.yaml`, with and without what disturbs it.

    python benchmarks/tracking.py [--json FILE]

Root mean square errors of the cart over the last 8 of 10 s, `track.…_rmse_um`:

- `perfect`: the plant itself is the model; `learned`: the scenario as it is.
- `load`: a load torque of 0.1 N·m that the controller is not told of, angle and current alone measured;
  `load_step`: it comes at 5 s; `no_observer`: all is measured, nothing estimated.
- `noise`: the load, an encoder of 16 bits with 0.1 mrad of noise, and 2 mA of noise on the current.

`track.step_over_optimum`: cost of a step in closed loop with 30 intervals, over that of the optimum with 300.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from exlinn_fmi import Run
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.pipeline import simulate, train
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.control import Nmpc, Reference, Weights
from exlinn_fmi.scenario.signals import Constant
from exlinn_fmi.scenario.spec import Bounds
from exlinn_fmi.workspace import metrics

BARS = {
    "track.perfect_rmse_um": 1.0,
    "track.learned_rmse_um": 10.0,
    "track.load_rmse_um": 20.0,
    "track.step_over_optimum": 1.03,
}
"""What a figure must not exceed."""

ROOT = Path(__file__).parents[1]
NMPC = "components.controller.nmpc"
TWO_MEASURED = "plant.alpha: controller.alpha, plant.i: controller.i"
ALL_MEASURED = f"{TWO_MEASURED}, plant.alpha_dot: controller.alpha_dot"
NOISY = "plant.alpha: sensor.alpha, plant.i: sensor.i, sensor.alpha_measured: controller.alpha, "
NOISY += "sensor.i_measured: controller.i"
SENSOR = (
    "components.sensor={step: 0.01, sensor: {alpha: {noise: 1e-4, resolution: 9.587e-5, unit: rad}, "
    "i: {noise: 2e-3, unit: A}}}"
)


def load(measured: str, time: float = 0.0) -> list[str]:
    """Overrides that put 0.1 N·m on the motor from `time` [s] on."""
    return [
        f"components.load={{source: {{signal: step, time: {time}, after: 0.1, unit: N.m}}}}",
        f"connections={{{measured}, controller.v: plant.v, load.y: plant.tau_ext}}",
    ]


CASES = {
    "perfect": [f"{NMPC}.model=plant:dc_motor_cart"],
    "learned": [],
    "load": load(TWO_MEASURED),
    "load_step": load(TWO_MEASURED, 5.0),
    "no_observer": load(ALL_MEASURED),
    "noise": [SENSOR, *load(NOISY), f"{NMPC}.estimator={{type: ekf, noise: {{alpha: 1e-4, i: 2e-3}}}}"],
}


def tracking(folder: Path) -> dict[str, float]:
    """Root mean square error of the cart over the last 8 of 10 s [µm] in each case, and bounds broken."""
    scenario = ROOT / "scenarios/dcwc_tracking.yaml"
    train(Run.open(scenario, folder))  # what is learned serves all cases
    found: dict[str, float] = {}
    for name, overrides in CASES.items():
        simulate(Run.open(scenario, folder, overrides))
        judged = metrics(folder)
        found[f"track.{name}_rmse_um"] = 1e6 * judged["control.rmse_x_m"]
        found[f"track.{name}_violations"] = judged["control.violations"]
    return found


def controller(horizon: int, solver: str) -> NmpcController:
    """A controller that brings the motor from rest at π/2 to rest at π/3 within bounds."""
    options = Nmpc(
        reference=Reference(coordinate="alpha", trajectory=Constant(signal="constant", value=np.pi / 3)),
        horizon=horizon,
        solver=solver,
        weights=Weights(states=10.0, inputs=1e-3),
        inputs={"v": Bounds(min=-24.0, max=24.0)},
        states={"i": Bounds(min=-4.0, max=4.0)},
    )
    made = NmpcController("controller", PLANT.system.with_inputs(["v"]), options, STEP, ROOT)
    made.enter_initialization(0.0, STEP * LENGTH, {})
    made.exit_initialization()
    return made


STEP, LENGTH, START = 0.01, 300, np.array([np.pi / 2, 0.0, 0.0])


def answer(made: NmpcController, x: np.ndarray) -> dict[str, float]:
    """Outputs of a controller that measures x."""
    made.set(made.indices("input"), x)
    outputs = made.indices("output")
    values = np.zeros(len(outputs))
    made.get(outputs, values)
    return {made.variables[k].name: float(v) for k, v in zip(outputs, values, strict=True)}


def step_over_optimum() -> dict[str, float]:
    """Closed-loop cost of a step over the optimum of the same problem with a horizon of all 3 s.

    Plant and model are the same discrete system, so that nothing but the horizon makes a difference.
    """
    system, made, x, total = PLANT.system.with_inputs(["v"]), controller(30, "rti"), START, 0.0
    for k in range(LENGTH):
        outputs = answer(made, x)
        total += outputs["stage_cost"]
        made.step(k * STEP, STEP)
        x = evaluate(system.rk4(), x, [outputs["v"]], system.parameter_values, [STEP])[0]
    best = answer(controller(LENGTH, "sqp"), START)
    if best["solve_status"] != 0 or best["slack"] > 0:
        raise RuntimeError(f"the optimum was not found: {best}")
    return {"track.step_over_optimum": total / best["cost"]}


def track(quick: bool) -> dict[str, float]:
    """All figures; they take seconds, `quick` or not."""
    with TemporaryDirectory() as folder:
        return tracking(Path(folder)) | step_over_optimum()


FIGURES: dict[str, Callable[[bool], dict[str, float]]] = {"track": track}
"""For `nmpc.py`, which shows them in its table."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    given = parser.parse_args()
    found = track(quick=False)
    for name, value in found.items():
        bar = f"   must {BARS[name]:g}" if name in BARS else ""
        print(f"{name:<32} {value:10.5g}{bar}")
    if given.json:
        given.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""Model Exchange: trajectories of the paper's motor by our compiled solver, by our master, and by FMPy.

    python benchmarks/model_exchange.py [--json FILE]

10 s at outputs of 10 ms and tolerance 1e-8, with a voltage that is constant (`constant`) or a sine told at
the same points (`sine`): milliseconds of processor time for a trajectory, best of several, and the largest
error of the angle against SciPy's DOP853 at 1e-12. `me.trajectories_per_s_over_fmpy` is the lesser ratio.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import fmpy
import numpy as np
from scipy.integrate import solve_ivp

from exlinn_fmi.components.fmu import FmuComponent, FmuSettings
from exlinn_fmi.components.fmu_trajectory import trajectory
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.plants import plant

FMU = Path(__file__).parents[1] / "fmus" / "DCMotorCart.fmu"
STATES, START, TOLERANCE = ("alpha", "alpha_dot", "i"), {"alpha": 0.3}, 1e-8
TIMES = np.linspace(0.0, 10.0, 1001)
VOLTAGES = {"constant": np.full_like(TIMES, 5.0), "sine": 5.0 + 4.0 * np.sin(3.0 * TIMES)}


def milliseconds(run: Callable[[], object], times: int) -> float:
    """Processor time of a call, the best of several after one that does not count."""
    run()
    taken = []
    for _ in range(times):
        began = time.process_time()
        run()
        taken.append(time.process_time() - began)
    return 1e3 * min(taken)


def exact(voltage: np.ndarray) -> np.ndarray:
    """The states (rows, 3) by SciPy, from knot to knot of the voltage."""
    system, x = plant("dc_motor_cart").system, np.array([0.3, 0.0, 0.0])
    rows = [x]
    for k in range(len(TIMES) - 1):
        slope = (voltage[k + 1] - voltage[k]) / (TIMES[k + 1] - TIMES[k])

        def rate(t: float, x: np.ndarray, k: int = k, slope: float = slope) -> np.ndarray:
            u = [0.0, voltage[k] + slope * (t - TIMES[k])]
            return evaluate(system.derivative, x, u, system.parameter_values).ravel()

        x = solve_ivp(rate, (TIMES[k], TIMES[k + 1]), x, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        rows.append(x)
    return np.array(rows)


def ours(component: FmuComponent, name: str) -> np.ndarray:
    """A trajectory in compiled code."""
    if name == "constant":
        return trajectory(component, TIMES, STATES, starts={**START, "v": 5.0})
    return trajectory(component, TIMES, STATES, {"v": VOLTAGES[name]}, START)


def by_master() -> float:
    """Milliseconds of a run under the master, the FMU a component like any other (constant voltage)."""

    def run() -> None:
        component = FmuComponent("motor", FMU, FmuSettings("model_exchange", tolerance=TOLERANCE))
        result = Master(Graph({"motor": component}, []), 0.0, 10.0, 0.01).run({"motor": {**START, "v": 5.0}})
        assert result.error is None, result.error

    return milliseconds(run, 5)


def by_fmpy(name: str) -> tuple[float, np.ndarray]:
    """Milliseconds of a trajectory by FMPy and CVode, instantiated beforehand, and its angle."""
    with TemporaryDirectory() as folder:
        fmpy.extract(FMU, folder)
        description = fmpy.read_model_description(folder)
        signal = np.array(
            [(t, v, 0.0) for t, v in zip(TIMES, VOLTAGES[name], strict=True)],
            dtype=[("time", float), ("v", float), ("tau_ext", float)],
        )
        instance = fmpy.instantiate_fmu(folder, description, "ModelExchange")

        def run() -> np.ndarray:
            instance.reset()
            return fmpy.simulate_fmu(
                folder,
                stop_time=10.0,
                output_interval=0.01,
                relative_tolerance=TOLERANCE,
                solver="CVode",
                fmi_type="ModelExchange",
                start_values={**START, "v": 5.0} if name == "constant" else START,
                input=None if name == "constant" else signal,
                output=STATES,
                record_events=False,
                model_description=description,
                fmu_instance=instance,
                terminate=False,
            )

        taken = milliseconds(run, 5)
        found = run()
        return taken, np.interp(TIMES, found["time"], found["alpha"])


def figures() -> dict[str, float]:
    """All figures by key."""
    found: dict[str, float] = {}
    with closing(FmuComponent("motor", FMU, FmuSettings("model_exchange", tolerance=TOLERANCE))) as component:
        for name, voltage in VOLTAGES.items():
            reference = exact(voltage)[:, 0]
            mine = milliseconds(lambda name=name: ours(component, name), 50)
            theirs, angle = by_fmpy(name)
            found |= {
                f"me.{name}.ms": mine,
                f"me.{name}.fmpy_ms": theirs,
                f"me.{name}.over_fmpy": theirs / mine,
                f"me.{name}.error": float(np.abs(ours(component, name)[:, 0] - reference).max()),
                f"me.{name}.fmpy_error": float(np.abs(angle - reference).max()),
            }
    found["me.master.ms"] = by_master()
    found["me.trajectories_per_s_over_fmpy"] = min(found[f"me.{name}.over_fmpy"] for name in VOLTAGES)
    return found


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = figures()
    for name, value in found.items():
        print(f"{name:<36} {value:10.3g}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

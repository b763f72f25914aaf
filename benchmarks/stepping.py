"""Cost of a communication step: our master and FMPy's on the same FMU in the same run, and Python components.

    python benchmarks/stepping.py [--steps 20000] [--json FILE]

Times are the best of three runs, in µs per step with all outputs recorded, without load and start of the FMU.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import fmpy
import numpy as np
import pandas as pd

from exlinn_fmi.components.base import Component, Variable
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.data.files import write_table

FMU = Path(__file__).parents[1] / "fmus" / "DCMotorCart.fmu"
STEP = 1e-3


class Integrator(PythonComponent):
    """As little work as a component can do."""

    variables = (Variable("u", "input"), Variable("y", "output", start=1.0))

    def advance(self, t: float, h: float) -> None:
        """Explicit Euler."""
        self.values[1] += h * self.values[0]


class Voltage(PythonComponent):
    """A proportional controller with direct feed-through."""

    variables = (Variable("i", "input"), Variable("v", "output", depends_on=("i",)))

    @property
    def sampled(self) -> bool:
        """It holds its output."""
        return True

    def outputs(self, t: float) -> None:
        """Towards 1 A."""
        self.values[1] = 10 * (1 - self.values[0])


def best_of(runs: int, measure: Callable[[], float]) -> float:
    """The least of several measurements."""
    return min(measure() for _ in range(runs))


def us_per_step(seconds: Callable[[int], float], steps: int) -> float:
    """µs per step, without what a run costs before its first step."""
    few = steps // 10
    more, less = (best_of(3, lambda n=n: seconds(n)) for n in (steps, few))
    return 1e6 * (more - less) / (steps - few)


def ours(make: Callable[[], list[Component]], connections: list[tuple[str, str]], steps: int) -> float:
    """µs per step of a graph under our master."""

    def seconds(n: int) -> float:
        graph = Graph({c.name: c for c in make()}, connections)
        result = Master(graph, 0.0, n * STEP, STEP).run()
        assert result.error is None, result.error
        return result.statistics["seconds"]

    return us_per_step(seconds, steps)


def by_fmpy(steps: int) -> float:
    """µs per step of FMPy's own loop on the FMU."""
    with TemporaryDirectory() as folder:
        unzipped = fmpy.extract(FMU, folder)
        description = fmpy.read_model_description(unzipped)
        outputs = [v.name for v in description.modelVariables if v.causality in ("input", "output")]

        def seconds(n: int) -> float:
            began = time.perf_counter()
            fmpy.simulate_fmu(
                unzipped,
                stop_time=n * STEP,
                step_size=STEP,
                output_interval=STEP,
                fmi_type="CoSimulation",
                output=outputs,
                model_description=description,
            )
            return time.perf_counter() - began

        return us_per_step(seconds, steps)


def files(rows: int) -> float:
    """µs per row of three columns, CSV and Parquet together."""
    frame = pd.DataFrame(np.random.default_rng(0).normal(size=(rows, 3)), columns=["time", "a.y", "b.y"])
    with TemporaryDirectory() as folder:
        began = time.perf_counter()
        write_table(Path(folder) / "t", frame, {})
        return 1e6 * (time.perf_counter() - began) / rows


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    n = options.steps
    ring = [("a.y", "b.u"), ("b.y", "a.u")]
    loop = [("plant.i", "control.i"), ("control.v", "plant.v")]

    def pair() -> list[Component]:
        return [Integrator("a"), Integrator("b")]

    def plant_and_control() -> list[Component]:
        return [FmuComponent("plant", FMU), Voltage("control")]

    figures = {
        "python.us_per_step": ours(pair, ring, n),
        "one_fmu.us_per_step": ours(lambda: [FmuComponent("plant", FMU)], [], n),
        "fmu_python.us_per_step": ours(plant_and_control, loop, n),
        "fmpy.us_per_step": by_fmpy(n),
        "files.us_per_row": best_of(3, lambda: files(200_000)),
    }
    figures["fmpy_over_ours"] = figures["fmpy.us_per_step"] / figures["one_fmu.us_per_step"]
    for name, value in figures.items():
        print(f"{name:<24} {value:8.2f}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()

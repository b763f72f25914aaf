"""Cost of a communication step: ours beside a loop in C and other masters, on the same FMU in the same run.

    python benchmarks/stepping.py [--quick] [--only NAME …] [--json FILE]

Times are CPU times per step with all outputs recorded, without load and start of the FMU, the best of
several runs that alternate. `over_c` is our time over that of `stepping_loop.c`, built here with the C
compiler that is found; it makes the same calls. FMPy, libcosim and ecos are the packages `fmpy`,
`libcosimpy` and `ecospy`; ecos records by writing a CSV file, `ecos_unrecorded` does not record at all.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fmpy
import isolated
import model_exchange
import numpy as np
import pyarrow as pa

from exlinn_fmi.components.base import Component, Variable
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.recorder import select
from exlinn_fmi.data.tables import csv_file, parquet_file
from exlinn_fmi.scenario.signals import Sine
from exlinn_fmi.toolchain import compile_library, find_compiler

FMU = Path(__file__).parents[1] / "fmus" / "DCMotorCart.fmu"
STEP = 1e-3
Connections = list[tuple[str, str]]
Make = Callable[[], list[Component]]


# ── components ───────────────────────────────────────────────────────────────────────────────────────────


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


def one_fmu() -> list[Component]:
    return [FmuComponent("plant", FMU)]


def two_fmus() -> list[Component]:
    return [FmuComponent("a", FMU), FmuComponent("b", FMU)]


def fmu_and_python() -> list[Component]:
    return [FmuComponent("plant", FMU), Voltage("control")]


def ring(size: int) -> tuple[Make, Connections]:
    """FMUs that drive each other in a circle."""
    names = [f"m{k}" for k in range(size)]
    wires = [(f"{a}.alpha_dot", f"{b}.v") for a, b in zip(names, names[1:] + names[:1], strict=True)]
    return lambda: [FmuComponent(name, FMU) for name in names], wires


# ── measuring ────────────────────────────────────────────────────────────────────────────────────────────


def best(measures: Sequence[Callable[[], float]], runs: int = 5) -> list[float]:
    """The least of several measurements of each, made in turn so that all meet the same machine."""
    results = [[measure() for measure in measures] for _ in range(runs)]
    return [min(column) for column in zip(*results, strict=True)]


def per_step(
    measures: Sequence[Callable[[int], float]], steps: int | Sequence[int], runs: int = 5
) -> list[float]:
    """µs per step of each, without what a run costs before its first step."""
    many = [steps] * len(measures) if isinstance(steps, int) else steps
    more = best([lambda m=m, n=n: m(n) for m, n in zip(measures, many, strict=True)], runs)
    less = best([lambda m=m, n=n: m(n // 10) for m, n in zip(measures, many, strict=True)], runs)
    return [1e6 * (a - b) / (n - n // 10) for a, b, n in zip(more, less, many, strict=True)]


def ours(make: Make, wires: Connections, record: Sequence[str] = ("*",)) -> Callable[[int], float]:
    """Seconds that our master takes for so many steps."""

    def seconds(steps: int) -> float:
        graph = Graph({c.name: c for c in make()}, wires)
        master = Master(graph, 0.0, steps * STEP, STEP, record=record, compiled=True)
        began = time.process_time()
        result = master.run()
        assert result.error is None, result.error
        return time.process_time() - began

    return seconds


class _Visit(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("fmu", "set", "get", "inputs", "outputs", "sources")),
        ("input_count", ctypes.c_size_t),
        ("output_count", ctypes.c_size_t),
        ("given", ctypes.c_void_p),
        ("taken", ctypes.c_void_p),
    ]


@contextmanager
def c_loop() -> Iterator[ctypes.CDLL]:
    """The loop in C, built."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(__file__).with_name("stepping_loop.c"), Path(folder) / "loop.so"
        sources = {source.name: source.read_bytes()}
        library.write_bytes(
            compile_library(sources, source.name, library.name, ["-O2", "-std=c99"], find_compiler())
        )
        yield ctypes.CDLL(str(library))


def in_c(
    library: ctypes.CDLL, make: Make, wires: Connections, record: Sequence[str] = ("*",)
) -> Callable[[int], float]:
    """Seconds that the loop in C takes for so many steps; the calls are those of our plan."""

    def seconds(steps: int) -> float:
        graph = Graph({c.name: c for c in make()}, wires)
        parts = list(graph.components.values())
        recorded = select(graph.components, record)
        plan = Plan(graph, parts, recorded, [1] * len(parts), steps, STEP, False)
        plan.initialize(0.0, steps * STEP, {})
        kept: list[Any] = []

        def address(array: np.ndarray) -> int:
            kept.append(array)
            return array.ctypes.data

        visits = (_Visit * len(plan.visits))()
        for visit, (_, x) in zip(visits, plan.visits, strict=True):
            native = parts[x.component].native()
            visit.fmu = native.step.handle
            if x.inputs is not None:
                (call,) = native.access("Set", x.inputs)
                visit.set, visit.inputs, visit.input_count = (
                    call.function,
                    address(call.references),
                    len(x.inputs),
                )
                visit.sources, visit.given = address(x.sources.astype(np.uintp)), address(x.given)
            if x.outputs is not None:
                (call,) = native.access("Get", x.outputs)
                visit.get, visit.outputs, visit.output_count = (
                    call.function,
                    address(call.references),
                    len(x.outputs),
                )
                visit.taken = address(x.taken)
        step = [part.native().step for part in parts]
        handles = (ctypes.c_void_p * len(parts))(*(s.handle for s in step))
        functions = (ctypes.c_void_p * len(parts))(*(s.function for s in step))
        columns = plan.columns.astype(np.uintp)
        size, number, real = ctypes.c_size_t, ctypes.c_double, ctypes.c_void_p
        began = time.process_time()
        table = np.empty((steps + 1, len(columns)))
        failed = library.run(
            size(len(visits)), visits, size(len(parts)), handles, functions, size(steps), number(0.0),
            number(STEP), size(len(columns)), real(columns.ctypes.data), real(plan.signals.ctypes.data),
            real(table.ctypes.data),
        )  # fmt: skip
        took = time.process_time() - began
        assert not failed
        assert np.isfinite(table).all()
        for part in parts:
            part.close()
        return took

    return seconds


# ── other masters ────────────────────────────────────────────────────────────────────────────────────────


def by_fmpy(make_input: Callable[[int], np.ndarray] | None = None) -> Callable[[int], float]:
    """Seconds that FMPy's own loop takes for so many steps."""
    folder = tempfile.TemporaryDirectory()
    unzipped = fmpy.extract(FMU, folder.name)
    description = fmpy.read_model_description(unzipped)
    outputs = [v.name for v in description.modelVariables if v.causality in ("input", "output")]

    def seconds(steps: int) -> float:
        _ = folder  # which goes with this function
        given = None if make_input is None else make_input(steps)
        began = time.process_time()
        fmpy.simulate_fmu(
            unzipped, stop_time=steps * STEP, step_size=STEP, output_interval=STEP, fmi_type="CoSimulation",
            output=outputs, input=given, model_description=description,
        )  # fmt: skip
        return time.process_time() - began

    return seconds


def by_libcosim() -> Callable[[int], float]:
    """Seconds that libcosim takes, all outputs in its time series observer."""
    from libcosimpy.CosimEnums import CosimVariableType
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    log_output_level(CosimLogLevel.WARNING)
    description = fmpy.read_model_description(str(FMU))
    references = [v.valueReference for v in description.modelVariables if v.causality in ("input", "output")]

    def seconds(steps: int) -> float:
        execution = CosimExecution.from_step_size(1e9 * STEP)
        slave = execution.add_local_slave(CosimLocalSlave(str(FMU), "plant"))
        observer = CosimObserver.create_time_series(steps + 1)
        assert execution.add_observer(observer)
        for reference in references:
            assert observer.start_time_series(slave, reference, CosimVariableType.REAL)
        began = time.process_time()
        assert execution.step(steps)
        return time.process_time() - began

    return seconds


def by_ecos(record: bool) -> Callable[[int], float]:
    """Seconds that ecos takes; it records by writing a CSV file, all outputs."""
    library = Path(sys.prefix) / "lib" / "libtbb.so.12"
    ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)
    from ecospy import EcosLib, EcosSimulation, EcosSimulationStructure

    variables = fmpy.read_model_description(str(FMU)).modelVariables
    names = [f"plant::{v.name}" for v in variables if v.causality in ("input", "output")]

    def seconds(steps: int) -> float:
        with tempfile.TemporaryDirectory() as folder, EcosSimulationStructure() as structure:
            EcosLib.set_log_level("off")
            structure.add_model("plant", FMU)
            with EcosSimulation(structure=structure, step_size=STEP) as simulation:
                if record:
                    simulation.add_csv_writer(str(Path(folder) / "out.csv"), identifiers=names)
                simulation.init()
                began = time.process_time()
                simulation.step(steps)
                took = time.process_time() - began
                simulation.terminate()
                return took

    return seconds


# ── figures ──────────────────────────────────────────────────────────────────────────────────────────────

Figures = dict[str, float]


def over_c(name: str, make: Make, wires: Connections, steps: int, record: Sequence[str] = ("*",)) -> Figures:
    """Our time and that of the loop in C."""
    with c_loop() as library:
        mine, c = per_step([ours(make, wires, record), in_c(library, make, wires, record)], steps)
    return {f"{name}.us_per_step": mine, f"{name}.c_us_per_step": c, f"{name}.over_c": mine / c}


def fmus(quick: bool) -> Figures:
    """One FMU, and two that drive each other."""
    steps = 20_000 if quick else 100_000
    both = [("a.alpha_dot", "b.v"), ("b.alpha_dot", "a.v")]
    return over_c("one_fmu", one_fmu, [], steps) | over_c("two_fmus", two_fmus, both, steps)


def apart(quick: bool) -> Figures:
    """An FMU in a process of its own, wall time; see `isolated.py`."""
    return isolated.figures(1000 if quick else 5000)


def exchanged(quick: bool) -> Figures:
    """Trajectories of a Model Exchange FMU per second, ours over FMPy's; see `model_exchange.py`."""
    return model_exchange.figures()


def circle(quick: bool) -> Figures:
    """Many FMUs in a ring."""
    size = 50 if quick else 1000
    make, wires = ring(size)
    return over_c("ring", make, wires, 200 if quick else 1000, ["*.alpha_dot"]) | {"ring.components": size}


def with_python(quick: bool) -> Figures:
    """An FMU and a controller in Python."""
    wires = [("plant.i", "control.i"), ("control.v", "plant.v")]
    (took,) = per_step([ours(fmu_and_python, wires)], 5_000 if quick else 50_000)
    return {"fmu_python.us_per_step": took}


def others(quick: bool) -> Figures:
    """FMPy, libcosim and ecos on one FMU, all outputs recorded."""
    few, many = (5_000, 20_000) if quick else (20_000, 100_000)
    names = ["ours", "fmpy", "libcosim", "ecos", "ecos_unrecorded"]
    makers = [ours(one_fmu, []), by_fmpy(), by_libcosim(), by_ecos(True), by_ecos(False)]
    took = dict(zip(names, per_step(makers, [many, few, few, few, many]), strict=True))
    figures = {f"{name}.us_per_step": value for name, value in took.items()}
    return figures | {f"{name}_over_ours": took[name] / took["ours"] for name in names[1:]}


def driven(quick: bool) -> Figures:
    """FMPy and ours on one FMU whose input is a signal."""

    def make() -> list[Component]:
        return [SignalSource("drive", Sine(signal="sine", amplitude=12, frequency=1.0), Path()), *one_fmu()]

    def wave(steps: int) -> np.ndarray:
        t = STEP * np.arange(steps + 1)
        rows = list(zip(t, 12 * np.sin(2 * np.pi * t), np.zeros(len(t)), strict=True))
        return np.array(rows, dtype=[("time", float), ("v", float), ("tau_ext", float)])

    makers = [ours(make, [("drive.y", "plant.v")]), by_fmpy(wave)]
    mine, theirs = per_step(makers, [20_000, 5_000] if quick else [100_000, 20_000])
    return {
        "driven.us_per_step": mine,
        "driven.fmpy_us_per_step": theirs,
        "driven.fmpy_over_ours": theirs / mine,
    }


def files(quick: bool) -> Figures:
    """Rows of three columns onto the disk."""
    rows = 100_000 if quick else 1_000_000
    values = np.random.default_rng(0).normal(size=(3, rows))
    table = pa.table(list(values), names=["time", "a.y", "b.y"])
    with tempfile.TemporaryDirectory() as folder:

        def seconds(kind: Callable[..., Any]) -> float:
            began = time.process_time()
            with kind(Path(folder) / "t", table.schema) as write:
                write(table)
            return 1e6 * (time.process_time() - began) / rows

        csv, parquet = best([lambda: seconds(csv_file), lambda: seconds(parquet_file)], 3)
    return {"csv.us_per_row": csv, "parquet.us_per_row": parquet}


FIGURES: dict[str, Callable[[bool], Figures]] = {
    "fmus": fmus,
    "python": with_python,
    "others": others,
    "driven": driven,
    "isolated": apart,
    "me": exchanged,
    "files": files,
    "ring": circle,
}
"""What is measured: each makes figures, given whether to be quick."""


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer steps")
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES), help="what to measure")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    figures: Figures = {}
    for name in options.only:
        new = FIGURES[name](options.quick)
        for key, value in new.items():
            print(f"{key:<28} {value:10.4g}", flush=True)
        figures |= new
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()

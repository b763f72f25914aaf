"""Cost of a communication step: our master beside a loop in C and other masters, on the same FMU in the same run.

    python benchmarks/stepping.py [--quick] [--only NAME …] [--json FILE]

Times are CPU times per step with all outputs recorded, without load and start of the FMU, the best of several
runs that alternate. `over_c` is our time over that of `stepping_loop.c`, built here with the C compiler that is
found; it makes the same calls. FMPy, libcosim and ecos are the packages `fmpy`, `libcosimpy`, `ecospy`.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pandas as pd

from exlinn_fmi.components.base import Component, Variable
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.recorder import select
from exlinn_fmi.export.build import find_compiler

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


def per_step(measures: Sequence[Callable[[int], float]], steps: int, runs: int = 5) -> list[float]:
    """µs per step of each, without what a run costs before its first step."""
    few = steps // 10
    more = best([lambda m=m: m(steps) for m in measures], runs)
    less = best([lambda m=m: m(few) for m in measures], runs)
    return [1e6 * (a - b) / (steps - few) for a, b in zip(more, less, strict=True)]


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
        library = Path(folder) / "loop.so"
        source = Path(__file__).with_suffix("").with_name("stepping_loop.c")
        flags = ["-O2", "-std=c99", "-shared", "-fPIC"]
        subprocess.run([*find_compiler(), *flags, str(source), "-o", str(library)], check=True)
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
            size(len(visits)), visits, size(len(parts)), handles, functions, size(steps), number(0.0), number(STEP),
            size(len(columns)), real(columns.ctypes.data), real(plan.signals.ctypes.data), real(table.ctypes.data),
        )  # fmt: skip
        took = time.process_time() - began
        assert not failed
        assert np.isfinite(table).all()
        for part in parts:
            part.close()
        return took

    return seconds


# ── other masters ────────────────────────────────────────────────────────────────────────────────────────


def by_fmpy() -> Callable[[int], float]:
    """Seconds that FMPy's own loop takes for so many steps."""
    folder = tempfile.TemporaryDirectory()
    unzipped = fmpy.extract(FMU, folder.name)
    description = fmpy.read_model_description(unzipped)
    outputs = [v.name for v in description.modelVariables if v.causality in ("input", "output")]

    def seconds(steps: int) -> float:
        began = time.process_time()
        fmpy.simulate_fmu(
            unzipped,
            stop_time=steps * STEP,
            step_size=STEP,
            output_interval=STEP,
            fmi_type="CoSimulation",
            output=outputs,
            model_description=description,
        )
        _ = folder
        return time.process_time() - began

    return seconds

"""Cost of isolation: an FMU in a process of its own beside the same FMU in this one, all outputs recorded.

    python benchmarks/isolated.py [--steps 10000] [--json FILE]

`isolated.us_per_step` is wall time per communication step, without load and start: the lower quartile over
windows of 50 steps, since two processes that take turns suffer from whatever else runs.
`isolated.detect_ms` is from a crash to the error that names it.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from exlinn_fmi.components.base import Component
from exlinn_fmi.components.isolated import isolated_fmu
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.errors import ComponentError

FMU = Path(__file__).parents[1] / "fmus" / "DCMotorCart.fmu"
STEP = 1e-3
WINDOW = 50


def isolated() -> Component:
    """The FMU in a process of its own."""
    return isolated_fmu("plant", FMU, timeout=60.0, memory=None)


def us_per_step(make: Callable[[], Component], steps: int) -> float:
    """Wall time of a step [µs], the lower quartile over windows."""
    times: list[float] = []

    def look() -> bool:
        times.append(time.perf_counter())
        return False

    result = Master(Graph({"plant": make()}, []), 0.0, steps * STEP, STEP).run(should_stop=look)
    assert result.error is None, result.error
    assert len(times) == steps, "it was not asked after every step"
    return 1e6 * float(np.percentile(np.diff(times[::WINDOW]), 25)) / WINDOW


def start_ms() -> float:
    """From nothing to an FMU that can be initialised [ms], the least of several."""

    def once() -> float:
        began = time.perf_counter()
        component = isolated()
        took = time.perf_counter() - began
        component.close()
        return 1e3 * took

    return min(once() for _ in range(3))


def detect_ms() -> float:
    """From the end of a process by SIGSEGV to the error [ms], the least of several."""

    def once() -> float:
        component = isolated()
        component.enter_initialization(0.0, 1.0, {})
        component.exit_initialization()
        began = time.perf_counter()
        os.kill(component._process._popen.pid, signal.SIGSEGV)
        try:
            while True:
                component.step(0.0, STEP)
        except ComponentError:
            return 1e3 * (time.perf_counter() - began)

    return min(once() for _ in range(3))


def figures(steps: int = 10_000) -> dict[str, float]:
    """All figures by name."""
    return {
        "isolated.us_per_step": us_per_step(isolated, steps),
        "isolated.start_ms": start_ms(),
        "isolated.detect_ms": detect_ms(),
    }


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = figures(options.steps)
    for name, value in found.items():
        print(f"{name:<28} {value:8.2f}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

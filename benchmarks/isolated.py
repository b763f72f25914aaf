"""Cost of isolation: an FMU in a process of its own beside the same FMU in this one, all outputs recorded.

    python benchmarks/isolated.py [--steps 5000] [--json FILE]

`isolated.us_per_step` is wall time per communication step, without load and start: the least of several runs,
since two processes that take turns suffer from whatever else runs. `isolated.cpu_us_per_step` is time that
both processes spend on a processor. `isolated.detect_ms` is from a crash to the error that names it.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

from exlinn_fmi.components.base import Component
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.isolated import isolated_fmu
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.errors import ComponentError

FMU = Path(__file__).parents[1] / "fmus" / "DCMotorCart.fmu"
STEP = 1e-3
RUNS = 7


def isolated() -> Component:
    """The FMU in a process of its own."""
    return isolated_fmu("plant", FMU, timeout=60.0, memory=None)


def seconds(make: Callable[[], Component], steps: int) -> tuple[float, float]:
    """Wall time of a run, and processor time of this process and of those that it had [s]."""
    component = make()
    before = os.times()
    result = Master(Graph({"plant": component}, []), 0.0, steps * STEP, STEP).run()
    after = os.times()
    assert result.error is None, result.error
    used = sum(after[:4]) - sum(before[:4])  # own and children's, user and system
    return result.statistics["seconds"], used


def per_step(make: Callable[[], Component], steps: int) -> tuple[float, float]:
    """Wall and processor time of a step [µs], the least of several runs each."""
    few = max(steps // 10, 1)
    pairs = [(seconds(make, steps), seconds(make, few)) for _ in range(RUNS)]
    wall = min(more[0] for more, _ in pairs) - min(less[0] for _, less in pairs)
    used = min(more[1] for more, _ in pairs) - min(less[1] for _, less in pairs)
    return 1e6 * wall / (steps - few), 1e6 * used / (steps - few)


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


def figures(steps: int = 5000) -> dict[str, float]:
    """All figures by name."""
    wall, used = per_step(isolated, steps)
    return {
        "isolated.us_per_step": wall,
        "isolated.cpu_us_per_step": used,
        "isolated.plain_us_per_step": per_step(lambda: FmuComponent("plant", FMU), steps)[0],
        "isolated.start_ms": start_ms(),
        "isolated.detect_ms": detect_ms(),
    }


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = figures(options.steps)
    for name, value in found.items():
        print(f"{name:<28} {value:8.2f}")
    if options.json:
        options.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

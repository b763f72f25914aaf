"""Speed, scaling and exactness of the model predictive controller, and peers on the same problem.

    python benchmarks/nmpc.py [--quick] [--only NAME …] [--json FILE]

The problem is that of the paper's DC motor with cart: a learned model with 1×32 tanh units, 30 intervals of
10 ms, |v| ≤ 24 V, |i| ≤ 4 A, the cart on a sine of 150 mm at 0.4 Hz. A closed loop around the true plant is
recorded; then each contestant solves it tick by tick. Times are CPU times of one pinned core, calls from
Python included. Peers: CasADi with IPOPT as it is usually written (exact Hessian, interpreted), our own
CasADi path, do-mpc (the real library), and acados with HPIPM where ACADOS_SOURCE_DIR is set. What
`tracking.py` measures stands in the same table.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from baselines.bench import multisine, paper, trained
from baselines.record import record
from numpy.typing import NDArray

from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.compiled import Kernel
from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.realtime import CompiledGaussNewton
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.control.solver import Plan, Solver, SolveStatus, make_solver
from exlinn_fmi.mechanics.learned import ModelSpec, Weights, learned_system
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.control import Nmpc, Reference, ScotchYoke
from exlinn_fmi.scenario.control import Weights as Cost
from exlinn_fmi.scenario.learning import Structured
from exlinn_fmi.scenario.signals import Sine
from exlinn_fmi.scenario.spec import Bounds

Figures = dict[str, float | str]
STEP = 0.01
START = np.array([np.pi / 2, 0.0, 0.0])
HERE = Path(__file__).parent
CART = Reference(
    coordinate="alpha",
    trajectory=Sine(signal="sine", amplitude=0.15, frequency=0.4, unit="m"),
    through=ScotchYoke(map="scotch_yoke", crank=0.2),
)


# ── the problem ──────────────────────────────────────────────────────────────────────────────────────────


@lru_cache
def weights() -> tuple[ModelSpec, Weights]:
    """The learned model: 32 tanh units, from two trajectories of the plant."""
    data = record(PLANT, "v", [paper(), multisine(1)], 10)
    model, _ = trained(data, Structured(preset="structured", hidden=32, iterations=60), 0)
    return model.spec, model.weights


def widened(spec: ModelSpec, given: Weights, factor: int) -> tuple[ModelSpec, Weights]:
    """The same function with that many times the hidden units."""
    wide = {name: np.array(value) for name, value in given.items()}
    for name in ("hidden.weight", "hidden.bias"):
        key = f"lagrangian.{name}"
        wide[key] = np.concatenate([wide[key]] * factor)
    output = wide["lagrangian.output"]
    direct, hidden = output[:, : -spec.hidden], output[:, -spec.hidden :]
    wide["lagrangian.output"] = np.hstack([direct, *[hidden / factor] * factor])
    for name, by in (("friction", np.sqrt(factor)), ("width", 1.0)):
        wide[f"dissipation.{name}"] = np.hstack([wide[f"dissipation.{name}"] / by] * factor)
    return replace(spec, hidden=spec.hidden * factor), wide


class Problem(NamedTuple):
    """A learned model's optimal control problem, and its references."""

    ocp: Ocp
    references: ReferenceGenerator

    def aim(self, time: float, x: NDArray[np.float64], last: References | None = None) -> References:
        """The reference over the horizon that begins at `time` [s]."""
        return self.references.over(time, x, self.references.branch(x), last)


@lru_cache
def problem(horizon: int = 30, factor: int = 1) -> Problem:
    """The problem, with another horizon or a wider network."""
    system = learned_system(*widened(*weights(), factor)).with_inputs({"v"})
    options = Nmpc(
        reference=CART,
        horizon=horizon,
        substeps=1,
        weights=Cost(states=10.0, inputs=1e-3),
        inputs={"v": Bounds(min=-24.0, max=24.0)},
        states={"i": Bounds(min=-4.0, max=4.0)},
    )
    references = ReferenceGenerator(system, options.reference, HERE, STEP, horizon)
    return Problem(Ocp(system, options, STEP, references.states), references)


class Loop(NamedTuple):
    """A closed loop: measured states (T, n), the references at each tick, plans that go with them."""

    states: NDArray[np.float64]
    aims: list[References]


def closed_loop(given: Problem, kernel: Kernel, ticks: int) -> Loop:
    """The kernel around the true plant."""
    true = PLANT.system.with_inputs({"v"})
    plant, p = Batch(true.rk4(10), 1), true.parameter_values
    x, aim, states, aims = START, None, [], []
    for k in range(ticks):
        aim = given.aim(k * STEP, x, aim)
        states.append(x)
        aims.append(aim)
        tick(kernel, x, aim, first=k == 0)
        x = plant(x, kernel.u[0], p, STEP)[0][0, :, 0].copy()
    return Loop(np.array(states), aims)


def tick(kernel: Kernel, x: NDArray[np.float64], aim: References, first: bool) -> None:
    """One tick of the fast path."""
    kernel.x_ref[:], kernel.u_ref[:], kernel.x0[:] = aim.x, aim.u, x
    if first:
        kernel.solve(False)
        return
    kernel.shift()
    kernel.prepare()
    kernel.feedback()
    kernel.finish()
    if kernel.head.status != SolveStatus.SOLVED:
        raise RuntimeError(f"the kernel failed with reason {kernel.head.reason}")


# ── times ────────────────────────────────────────────────────────────────────────────────────────────────


def pin() -> None:
    """Stay on one core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def seconds(work: Callable[[], object]) -> float:
    """CPU time of a call."""
    began = time.thread_time_ns()
    work()
    return (time.thread_time_ns() - began) * 1e-9


class Times(NamedTuple):
    """CPU seconds of each tick: all of it, and the part that waits for the measurement."""

    step: NDArray[np.float64]
    feedback: NDArray[np.float64]


def our_times(given: Problem, ticks: int) -> tuple[Times, Loop]:
    """Our times in a closed loop, after one that warms up."""
    kernel = Kernel(given.ocp, 50, 1e-8, real_time=True)
    loop = closed_loop(given, kernel, ticks)
    rows = []
    for k, (x, aim) in enumerate(zip(loop.states, loop.aims, strict=True)):
        if k == 0:
            tick(kernel, x, aim, first=True)
            continue
        kernel.x_ref[:], kernel.u_ref[:] = aim.x, aim.u
        shift, prepare = seconds(kernel.shift), seconds(kernel.prepare)
        kernel.x0[:] = x
        feedback, finish = seconds(kernel.feedback), seconds(kernel.finish)
        rows.append((shift + prepare + feedback + finish, feedback))
    return Times(*np.array(rows).T), loop


def solver_times(solver: Solver, loop: Loop) -> NDArray[np.float64]:
    """Those of one of our other solvers, started from its last plan as in the controller."""
    plan, spent = None, []
    for x, aim in zip(loop.states, loop.aims, strict=True):
        found = None

        def solve(x: NDArray[np.float64] = x, aim: References = aim, plan: Plan | None = plan) -> None:
            nonlocal found
            found = solver.solve(x, aim, plan)

        spent.append(seconds(solve))
        assert found is not None
        if found.status == SolveStatus.FAILED:
            raise RuntimeError(f"{type(solver).__name__}: {found.stats.message}")
        plan = Plan(*solver.ocp.shift(found.x, found.u, aim.force))
    return np.array(spent[1:])


def microseconds(times: NDArray[np.float64], name: str) -> Figures:
    """Median and 99th percentile."""
    median, late = 1e6 * np.percentile(times, [50, 99])
    return {f"{name}_us": float(median), f"{name}_p99_us": float(late)}


def speed(quick: bool) -> Figures:
    """A step of the real-time iteration, and of the peers."""
    pin()
    given = problem()
    ours, loop = our_times(given, 200 if quick else 1000)
    figures = microseconds(ours.step, "speed.step") | microseconds(ours.feedback, "speed.feedback")
    step = float(np.median(ours.step))
    few = Loop(loop.states[: 20 if quick else 150], loop.aims[: 20 if quick else 150])
    for name, times in peers(given, few):
        figures |= microseconds(times, f"speed.{name}")
        figures[f"speed.{name}_over_ours"] = float(np.median(times)) / step
    return figures


def peers(given: Problem, loop: Loop) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Names and times of the peers."""
    yield "casadi_backend", solver_times(make_solver(given.ocp, "rti", 50, 1e-8, "casadi"), loop)
    # The tolerance of ours is that of IPOPT times 1e4: it stops at its own default of 1e-8.
    yield "ipopt_vm", solver_times(make_solver(given.ocp, "ipopt", 100, 1e-4), loop)
    if importlib.util.find_spec("do_mpc"):
        from baselines.do_mpc import DoMpc

        yield "dompc", DoMpc(given.ocp).times(loop.states, loop.aims)
    if os.environ.get("ACADOS_SOURCE_DIR"):
        from baselines.acados import Acados

        yield "acados", Acados(given.ocp).times(loop.states, loop.aims)


def scaling(quick: bool) -> Figures:
    """How a step grows with the horizon and with the network."""
    pin()
    ticks = 60 if quick else 300
    base, longer, wider = (
        float(np.median(our_times(given, ticks)[0].step))
        for given in (problem(), problem(horizon=300), problem(factor=8))
    )
    return {"scaling.N300_over_N30": longer / base, "scaling.width256_over_width32": wider / base}


# ── exactness ────────────────────────────────────────────────────────────────────────────────────────────


def agree(quick: bool) -> Figures:
    """Converged plans against hpipm, each hundredth against IPOPT: random states, bounds and weights."""
    count = 200 if quick else 10_000
    given, rng = problem.__wrapped__(), np.random.default_rng(0)  # one of its own, since it is changed
    ocp = given.ocp
    ours = make_solver(ocp, "sqp", 100, 1e-9, "compiled")
    hpipm = make_solver(ocp, "sqp", 100, 1e-9, "casadi")
    assert isinstance(ours, CompiledGaussNewton)
    lost: Counter[str] = Counter()
    first, whole, by_ipopt, excess = [0.0], [0.0], [0.0], [0.0]
    for k in range(count):
        x0 = rng.uniform([0.2, -5.0, -4.5], [2.9, 5.0, 4.5])
        draw(ocp, ours.kernel, rng)
        aim = given.aim(rng.uniform(0.0, 2.5), x0)
        one, other = ours.solve(x0, aim), hpipm.solve(x0, aim)
        lost["ours"] += one.status != SolveStatus.SOLVED
        lost["hpipm"] += other.status != SolveStatus.SOLVED
        if one.status == other.status == SolveStatus.SOLVED:
            first.append(float(np.abs(one.u[0] - other.u[0]).max()))
            whole.append(float(np.abs(one.u - other.u).max()))
            costs = [found.stats.cost + ocp.penalty(found.x) for found in (one, other)]
            excess.append((costs[0] - costs[1]) / max(1.0, costs[1]))
        if k % 100 == 0:
            # Bounds and weights are constants of its problem: it is made anew.
            third = make_solver(ocp, "ipopt", 300, 1e-9).solve(x0, aim)
            lost["ipopt"] += third.status != SolveStatus.SOLVED
            if third.status == one.status == SolveStatus.SOLVED:
                cost = third.stats.cost + ocp.penalty(third.x)
                gain = (cost - one.stats.cost - ocp.penalty(one.x)) / max(1.0, cost)
                if abs(gain) < 1e-6:
                    by_ipopt.append(float(np.abs(one.u[0] - third.u[0]).max()))
                else:  # the problem is not convex: both are minima
                    lost["lower" if gain > 0.0 else "higher"] += 1
    return {
        "agree.problems": count,
        "agree.failures": lost["ours"],
        "agree.hpipm_failures": lost["hpipm"],
        "agree.ipopt_failures": lost["ipopt"],
        "agree.max_dv_converged": max(first),
        "agree.max_dv_whole_plan": max(whole),
        "agree.max_dv_ipopt": max(by_ipopt),
        "agree.lower_minima_than_ipopt": lost["lower"],
        "agree.higher_minima_than_ipopt": lost["higher"],
        "agree.max_cost_excess": max(excess),
    }


def draw(ocp: Ocp, kernel: Kernel, rng: np.random.Generator) -> None:
    """Put random bounds and a random weight into a problem."""
    lim, bound, current = ocp.limits, rng.uniform(4.0, 24.0), rng.uniform(1.0, 4.0)
    changed = {"u_min": (lim.u_min, -bound), "u_max": (lim.u_max, bound), "x_min": (lim.x_min, -current)}
    changed |= {"x_max": (lim.x_max, current), "R": (ocp.R, 10.0 ** rng.uniform(-4.0, -2.0))}
    for name, (array, value) in changed.items():
        array[:] = value
        kernel.array(name, *array.shape)[:] = array


# ── memory ───────────────────────────────────────────────────────────────────────────────────────────────


def memory(quick: bool) -> Figures:
    """What a thousand ticks of the fast path leave behind or ask for."""
    given = problem()
    kernel = Kernel(given.ocp, 50, 1e-8, real_time=True)
    aim = given.aim(0.0, START)
    tick(kernel, START, aim, first=True)

    def ticks() -> None:
        for _ in range(1000):
            kernel.shift()
            kernel.prepare()
            kernel.feedback()
            kernel.finish()

    ticks()
    before = sys.getallocatedblocks()
    ticks()
    blocks = sys.getallocatedblocks() - before
    tracemalloc.start()
    size = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    ticks()
    peak = tracemalloc.get_traced_memory()[1] - size
    tracemalloc.stop()
    return {"memory.blocks_per_step": max(0, blocks) // 1000, "memory.peak_bytes_per_step": peak / 1000}


FIGURES: dict[str, Callable[[bool], Figures]] = {
    "speed": speed,
    "scaling": scaling,
    "agree": agree,
    "memory": memory,
}
"""What is measured: each makes figures, given whether to be quick."""

if importlib.util.find_spec("tracking"):
    import tracking

    FIGURES |= tracking.FIGURES

BARS: dict[str, tuple[float, float]] = {
    "speed.ipopt_vm_over_ours": (300, 1500),
    "speed.dompc_over_ours": (200, 1000),
    "speed.feedback_us": (20, 2),
    "speed.step_us": (200, 40),
    "scaling.N300_over_N30": (12, 12),
    "scaling.width256_over_width32": (12, 12),
    "agree.max_dv_converged": (1e-4, 1e-4),
    "agree.failures": (0, 0),
    "memory.blocks_per_step": (0, 0),
}
"""What a figure must reach, and what it should; ratios to peers at least, all else at most."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer ticks and problems")
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES), help="what to measure")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args(arguments)
    figures: Figures = {}
    for name in options.only:
        for key, value in FIGURES[name](options.quick).items():
            figures[key] = value
            must, should = BARS.get(key, (None, None))
            bar = "" if must is None else f"   must {must:g}, stretch {should:g}"
            shown = f"{value:12.5g}" if isinstance(value, float | int) else f"{value:>12}"
            print(f"{key:<34} {shown}{bar}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()

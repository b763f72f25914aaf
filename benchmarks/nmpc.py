"""Speed and scaling of the model predictive controller, and peers on the same problem.

    python benchmarks/nmpc.py [--quick] [--only NAME …] [--json FILE]

The problem is the cart's, see `baselines/cart.py`. A closed loop around the true plant is recorded; then each
contestant solves it tick by tick. Times are CPU times of one pinned core, calls from Python included. Peers:
CasADi with IPOPT as it is usually written (exact Hessian, interpreted), our own CasADi path, do-mpc (the real
library), and where ACADOS_SOURCE_DIR is set, acados in real-time iteration with HPIPM, as it is fastest and
(`acados_default`) as its options are if nothing is said. What `agreement.py` and `tracking.py` measure stands
in the same table.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import agreement
import numpy as np
import tracking
from baselines.cart import START, STEP, Problem, problem
from numpy.typing import NDArray

from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.compiled import Kernel
from exlinn_fmi.control.estimator import Estimator, ExtendedKalman, Noise
from exlinn_fmi.control.moving_horizon import MovingHorizon
from exlinn_fmi.control.realtime import CompiledGaussNewton
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.solver import Plan, Solver, SolveStatus, make_solver
from exlinn_fmi.plants.dc_motor_cart import PLANT

Figures = dict[str, float | str]


# ── a closed loop ────────────────────────────────────────────────────────────────────────────────────────


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
    step, feedback = float(np.median(ours.step)), float(np.median(ours.feedback))
    few = Loop(loop.states[: 20 if quick else 150], loop.aims[: 20 if quick else 150])
    for name, times in peers(given, few):
        figures |= microseconds(times, f"speed.{name}")
        mine = feedback if name.endswith("feedback") else step
        figures[f"speed.{name}_over_ours"] = float(np.median(times)) / mine
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
        from baselines.acados import SeparateAcados

        acados = SeparateAcados()
        step, feedback = acados.times(True, loop.states, loop.aims)
        yield "acados", step
        yield "acados_feedback", feedback
        yield "acados_default", acados.times(False, loop.states, loop.aims)[0]


def cold(quick: bool) -> Figures:
    """The quadratic program alone, from no set: random states, bounds and weights, far from the plan."""
    pin()
    given, rng, spent, methods = problem.__wrapped__(), np.random.default_rng(0), [], []
    ours = make_solver(given.ocp, "rti", 1, 1e-8, "compiled")
    assert isinstance(ours, CompiledGaussNewton)
    kernel = ours.kernel
    for _ in range(300 if quick else 3000):
        x0 = rng.uniform([0.2, -5.0, -4.5], [2.9, 5.0, 4.5])
        agreement.draw(ours, rng)
        aim = given.aim(rng.uniform(0.0, 2.5), x0)
        ours.prepare(aim, Plan(aim.x, aim.u))
        kernel.x0[:] = x0
        spent.append(seconds(kernel.feedback))
        methods.append(kernel.head.method)
    shares = np.bincount(methods, minlength=3) / len(methods)
    figures = {"cold.qp_mean_us": 1e6 * np.mean(spent), "cold.failures": shares[0], "cold.circles": shares[2]}
    return microseconds(np.array(spent), "cold.qp") | figures


def scaling(quick: bool) -> Figures:
    """How a step grows with the horizon and with the network."""
    pin()
    ticks = 60 if quick else 300
    base, longer, wider = (
        float(np.median(our_times(given, ticks)[0].step))
        for given in (problem(), problem(horizon=300), problem(factor=8))
    )
    return {"scaling.N300_over_N30": longer / base, "scaling.width256_over_width32": wider / base}


def estimate(quick: bool) -> Figures:
    """A sample of the estimators, angle and current measured; `mhe` over 10 samples in 2 iterations."""
    pin()
    system, loop = problem().ocp.system, closed_loop(problem(), Kernel(problem().ocp, 50, 1e-8, True), 300)
    spread = np.array([1e-3, 1.0, 1e-2])
    spec = Noise(
        measured=np.array([True, False, True]),
        measurement=spread,
        process=np.zeros(3),
        force=np.full(2, 0.01),
        disturbed=np.array([0]),
        walk=np.array([0.5]),
        first=np.append(spread, 1.0),
    )
    makers = {
        "ekf": ExtendedKalman(system, spec, STEP, 1),
        "mhe": MovingHorizon(system, spec, STEP, 1, 10, 2, "compiled"),
        "mhe_plain": MovingHorizon(system, spec, STEP, 1, 10, 2, "casadi"),
    }
    figures: Figures = {}
    for name, made in makers.items():
        beliefs, spent = [made.begin(loop.states[0], START)], []
        for y, aim in zip(loop.states[1:], loop.aims, strict=False):

            def sample(y: NDArray[np.float64] = y, aim: References = aim, made: Estimator = made) -> None:
                beliefs[0] = made.update(made.predict(beliefs[0], aim.u[0]), y)  # noqa: B023

            spent.append(seconds(sample))
        figures |= microseconds(np.array(spent[20:]), f"estimate.{name}")
    return figures


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
    "cold": cold,
    "estimate": estimate,
    "scaling": scaling,
    "memory": memory,
    **agreement.FIGURES,
    **tracking.FIGURES,
}
"""What is measured: each makes figures, given whether to be quick."""

BARS: dict[str, tuple[float, float]] = {
    "speed.ipopt_vm_over_ours": (300, 1500),
    "speed.dompc_over_ours": (200, 1000),
    "speed.feedback_us": (20, 2),
    "speed.step_us": (200, 40),
    "scaling.N300_over_N30": (12, 12),
    "scaling.width256_over_width32": (12, 12),
    "agree.max_dv_converged": (1e-4, 1e-4),
    "agree.failures": (0, 0),
    "cold.failures": (0, 0),
    "estimate.mhe_us": (1000, 200),
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

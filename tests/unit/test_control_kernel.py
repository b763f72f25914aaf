"""The compiled kernel beside CasADi: models, derivatives, quadratic programs, steps, closed loops."""

from __future__ import annotations

import contextlib
import ctypes
import io
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from control_helpers import (
    LIMITS,
    STEP,
    arm,
    close_loop,
    constant,
    controller,
    generator,
    levitation,
    motor_cart,
    oscillator,
    problem,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from exlinn_fmi.control import compiled
from exlinn_fmi.control.compiled import Kernel, kernel_sources
from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.pack import pack_networks
from exlinn_fmi.control.qp import ConicQp, StageQp, make_qp_solver
from exlinn_fmi.control.realtime import CompiledGaussNewton
from exlinn_fmi.control.solver import Plan, SolveStatus, make_solver
from exlinn_fmi.errors import RunError, SolverError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import ModelSpec, Scales, learned_system
from exlinn_fmi.mechanics.structure import Structure
from exlinn_fmi.plants import plant
from exlinn_fmi.scenario.control import Nmpc, Weights
from exlinn_fmi.scenario.spec import Bounds

ANGLE = Coordinate("alpha", "rad", topology="circle", input="tau")
DEGREES = Coordinate("beta", "deg", topology="circle")
CHARGE = Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v")
PLACE = Coordinate("x", "m", topology="line", input="F")
PLATE = Coordinate("y", "C", "electrical", "line", velocity="iy", velocity_unit="A", input="vy")
SETS = [(ANGLE, CHARGE), (PLACE, CHARGE), (CHARGE,), (PLACE, DEGREES, PLATE), (DEGREES, PLACE, CHARGE, ANGLE)]
RICH = ("viscous", "coulomb", "stribeck", "quadratic")


def network(
    coordinates: tuple[Coordinate, ...], seed: int = 0, hidden: int = 6, depth: int = 1
) -> LagrangianSystem:
    """A structured model with random weights, of units and scales that are not one."""
    rng, n = np.random.default_rng(seed), len(coordinates)
    lines = [c.topology == "line" for c in coordinates]
    spec = ModelSpec(
        "structured",
        coordinates,
        hidden,
        Scales(
            0.3,
            2.0,
            tuple(rng.uniform(0.5, 2.0, n)),
            tuple(0.1 if line else 0.0 for line in lines),
            tuple(0.4 if line else 1.0 for line in lines),
        ),
        (0.1,) * n,
        structure=Structure(friction=(RICH,) * n, offset=(True,) * n),
        depth=depth,
    )
    return learned_system(spec, {k: 0.4 * rng.normal(size=shape) for k, shape in spec.shapes().items()})


def made(system: LagrangianSystem, **options) -> tuple[Kernel, Ocp]:
    """A kernel with its problem, and a plan that goes nowhere in particular."""
    given_ = Nmpc(reference=constant(system.state_names[0], 0.1), **({"horizon": 5} | options))
    ocp = Ocp(system, given_, STEP, generator(system, given_.reference, given_.horizon).states)
    kernel = Kernel(ocp, 50, 1e-8, real_time=False)
    rng = np.random.default_rng(3)
    kernel.x[:], kernel.u[:] = rng.normal(size=kernel.x.shape), rng.normal(size=kernel.u.shape)
    kernel.p[-system.n :] = rng.normal(size=system.n)
    return kernel, ocp


def linearised(kernel: Kernel, ocp: Ocp) -> tuple[NDArray, NDArray, NDArray]:
    kernel.linearise()
    N, n, m = ocp.horizon, ocp.n, ocp.m
    return (
        kernel.array("next", N + 1, n)[:N],
        kernel.array("A", N, n, n),
        kernel.array("B", N, n, m),
    )


@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("coordinates", SETS, ids=lambda c: "+".join(x.name for x in c))
def test_networks_and_their_derivatives_are_those_of_casadi(coordinates, depth):
    system = network(coordinates, depth=depth)
    kernel, ocp = made(system, substeps=2)
    expected = ocp.linearise(kernel.x, kernel.u, kernel.p[-system.n :])
    for one, other in zip(linearised(kernel, ocp), vars(expected).values(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(-3.0, 7.0))
def test_networks_agree_however_far_the_state_is(seed, size):
    system = network((ANGLE, PLACE), seed)
    kernel, ocp = made(system)
    kernel.x[:] *= 10.0**size
    kernel.x[:, 2:] *= 10.0 ** min(0.0, 1.0 - size)  # RK4 of a step of 10 ms is wild at high speeds
    expected = ocp.linearise(kernel.x, kernel.u, kernel.p[-2:])
    for one, other in zip(linearised(kernel, ocp), vars(expected).values(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("system", [motor_cart(), arm(), levitation()], ids=["cart", "arm", "levitation"])
def test_other_models_reach_the_kernel_as_generated_code(system):
    kernel, ocp = made(system)
    kernel.x[:] = 0.1 * kernel.x + 0.2
    expected = ocp.linearise(kernel.x, kernel.u, kernel.p[-system.n :])
    for one, other in zip(linearised(kernel, ocp), vars(expected).values(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_another_model_of_the_same_kind_compiles_nothing(monkeypatch):
    made(network((ANGLE, CHARGE), seed=1))
    monkeypatch.setattr("exlinn_fmi.toolchain.compile_library", None)
    made(network((ANGLE, CHARGE), seed=2, hidden=9))


def test_inputs_that_are_left_out_are_left_out():
    system = network((ANGLE, CHARGE)).with_inputs({"v"})
    kernel, ocp = made(system)
    assert kernel.u.shape == (5, 1)
    expected = ocp.linearise(kernel.x, kernel.u, kernel.p[-2:])
    np.testing.assert_allclose(linearised(kernel, ocp)[2], expected.B, rtol=1e-12, atol=1e-14)


def test_systems_without_networks_or_too_large_are_not_packed():
    assert pack_networks(motor_cart()) is None
    many = tuple(
        replace(CHARGE, name=f"Q{k}", velocity=f"i{k}", acceleration=f"a{k}", input=f"v{k}") for k in range(9)
    )
    assert pack_networks(network(many, hidden=0)) is None


# ── quadratic programs ───────────────────────────────────────────────────────────────────────────────────


def program(seed: int, kernel: Kernel) -> StageQp:
    """A random program of the kernel's size, from easy to one with most of its bounds active."""
    rng, head = np.random.default_rng(seed), kernel.head
    N, n, m, s, rated = head.horizon, head.states, head.inputs, head.softened, bool(head.rated)
    more = m if rated else 0

    def longer(a: NDArray, *axes: int) -> NDArray:
        return np.pad(a, [(0, more if axis in axes else 0) for axis in range(a.ndim)])

    B = longer(rng.uniform(0.1, 1.0) * rng.normal(size=(N, n, m)), 1)
    if rated:
        B[:, n:] = np.eye(m)
    W, bound = rng.normal(size=(n, n)), rng.choice([0.05, 0.3, 1.0, 3.0])
    low = -rng.choice([0.1, 0.5, 2.0])
    return StageQp(
        A=longer(np.eye(n) + rng.uniform(0.0, 0.3) * rng.normal(size=(N, n, n)), 1, 2),
        B=B,
        c=longer(0.1 * rng.normal(size=(N, n)), 1),
        dx0=longer(rng.normal(size=n), 0),
        H_x=longer(np.diag(rng.uniform(0.0, 2.0, n)), 0, 1),
        H_end=longer(W @ W.T, 0, 1),
        H_u=np.diag(10 ** rng.uniform(-2, 0, m)),
        g=longer(rng.normal(size=(N + 1, n)), 1),
        r=rng.normal(size=(N, m)),
        u_low=np.full((N, m), -bound),
        u_high=np.full((N, m), rng.uniform(0.5, 1.0) * bound),
        low=np.full((N, s), low),
        high=np.full((N, s), -0.8 * low),
        l1=np.full(s, rng.choice([1.0, 10.0, 100.0])),
        l2=np.full(s, rng.choice([1.0, 10.0])),
        rate_low=np.full((N - 1, m), -0.6 * bound) if rated else None,
        rate_high=np.full((N - 1, m), 0.5 * bound) if rated else None,
    )


def solved(kernel: Kernel, qp: StageQp) -> tuple[NDArray, NDArray]:
    """Steps dz and du."""
    N, m = qp.r.shape
    names = {"H_x": "H"}
    for key, value in vars(qp).items():
        if value is not None and key not in ("dx0", "rate_low", "rate_high"):
            kernel.array(names.get(key, key), *value.shape)[:] = value
    if qp.rate_low is not None and qp.rate_high is not None:
        kernel.array("rate_low", N, m)[1:], kernel.array("rate_high", N, m)[1:] = qp.rate_low, qp.rate_high
    dz, du = kernel.array("dz", N + 1, len(qp.dx0)), kernel.array("du", N, m)
    dz[0] = qp.dx0
    kernel.on[:], kernel.slew[:], kernel.state[:] = 0, 0, 0
    kernel.program()
    return dz.copy(), du.copy()


def programs(rated: bool) -> Kernel:
    options = {"rates": {"ta": 1.0, "tb": 1.0}} if rated else {}
    states = {"a": Bounds(min=-1.0, max=1.0), "a_dot": Bounds(min=-1.0, max=1.0)}
    return made(arm(), horizon=8, states=states, **options)[0]


SOFT = np.array([0, 2])
PROGRAMS = {rated: programs(rated) for rated in (False, True)}
OTHERS = {rated: make_qp_solver(8, 4 + 2 * rated, 2, SOFT, rated) for rated in (False, True)}


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 1_000_000))
@pytest.mark.parametrize("rated", [False, True], ids=["plain", "rated"])
def test_random_programs_are_solved_as_by_hpipm(rated, seed):
    qp = program(seed, PROGRAMS[rated])
    dz, du = solved(PROGRAMS[rated], qp)
    assert PROGRAMS[rated].head.status == SolveStatus.SOLVED
    other = OTHERS[rated].solve(qp)
    if other.solved:
        assert objective(qp, dz, du) <= objective(qp, other.dx, other.du) + 1e-6
        np.testing.assert_allclose(du, other.du, atol=1e-3)
    following = np.einsum("kij,kj->ki", qp.A, dz[:-1]) + np.einsum("kij,kj->ki", qp.B, du) + qp.c
    np.testing.assert_allclose(dz[1:], following, atol=1e-9 * (1.0 + np.abs(dz).max()))
    assert (du >= qp.u_low - 1e-7).all()
    assert (du <= qp.u_high + 1e-7).all()


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "rated"])
def exact(request):
    """A kernel, and qpOASES for its programs: an active-set method, exact where it succeeds."""
    with contextlib.redirect_stdout(io.StringIO()):  # it shows its licence
        return PROGRAMS[request.param], ConicQp("qpoases", 8, 4 + 2 * request.param, 2, SOFT, request.param)


def test_programs_whose_sets_go_round_in_circles_are_solved_exactly(exact):
    kernel, other = exact
    methods = set()
    for seed in range(60):
        qp = program(seed, kernel)
        _, du = solved(kernel, qp)
        assert kernel.head.status == SolveStatus.SOLVED
        methods.add(kernel.head.method)
        with contextlib.redirect_stdout(io.StringIO()):
            reference = other.solve(qp)
        assert reference.solved
        np.testing.assert_allclose(du, reference.du, atol=1e-8)
    assert methods == {1, 2}


def test_a_program_that_once_had_no_solution():
    solved(PROGRAMS[True], program(698, PROGRAMS[True]))
    assert PROGRAMS[True].head.status == SolveStatus.SOLVED


def objective(qp: StageQp, dx: NDArray, du: NDArray) -> float:
    """What the program minimises."""
    out = np.maximum(np.maximum(qp.low - dx[1:, SOFT], dx[1:, SOFT] - qp.high), 0.0)
    quadratic = (
        np.sum((dx[1:-1] @ qp.H_x) * dx[1:-1]) + dx[-1] @ qp.H_end @ dx[-1] + np.sum((du @ qp.H_u) * du)
    )
    return float(
        quadratic / 2
        + np.sum(qp.g[1:] * dx[1:])
        + np.sum(qp.r * du)
        + np.sum(out @ qp.l1 + out**2 @ qp.l2 / 2)
    )


def test_equal_bounds_fix_an_input():
    qp = program(5, PROGRAMS[False])
    fixed = replace(qp, u_low=np.full_like(qp.u_low, 0.2), u_high=np.full_like(qp.u_high, 0.2))
    _, du = solved(PROGRAMS[False], fixed)
    assert PROGRAMS[False].head.status == SolveStatus.SOLVED
    np.testing.assert_array_equal(du, 0.2)


def test_state_bounds_that_exclude_each_other_are_a_compromise():
    qp = program(5, PROGRAMS[False])
    crossed = replace(qp, low=np.full_like(qp.low, 0.5), high=np.full_like(qp.high, -0.5))
    dz, du = solved(PROGRAMS[False], crossed)
    assert PROGRAMS[False].head.status == SolveStatus.SOLVED
    assert np.isfinite(du).all()
    assert np.isfinite(dz).all()


def test_a_program_that_is_not_convex_fails_as_a_status():
    qp = program(5, PROGRAMS[False])
    solved(PROGRAMS[False], replace(qp, H_u=-np.eye(2), H_x=-np.eye(4), H_end=-np.eye(4)))
    assert PROGRAMS[False].head.status == SolveStatus.FAILED


@pytest.mark.parametrize("place", ["A", "g", "u_low", "high", "dx0"])
def test_a_program_that_is_not_finite_fails_or_ignores_it_but_never_hangs(place):
    qp = program(5, PROGRAMS[False])
    broken = getattr(qp, place).copy()
    broken[0] = np.nan
    _, du = solved(PROGRAMS[False], replace(qp, **{place: broken}))
    assert PROGRAMS[False].head.status == SolveStatus.FAILED or np.isfinite(du).all()


def test_sets_that_mean_nothing_are_dropped():
    kernel, qp = PROGRAMS[True], program(7, PROGRAMS[True])
    _, du = solved(kernel, qp)
    kernel.array("dz", 9, 6)[0] = qp.dx0
    kernel.on[:], kernel.slew[:], kernel.state[:] = 77, -3, 4
    kernel.program()
    np.testing.assert_allclose(kernel.array("du", 8, 2), du, atol=1e-7)


# ── solves ───────────────────────────────────────────────────────────────────────────────────────────────

RATED = {"rates": {"v": 300.0}}
"""At most 3 V from one interval of 10 ms to the next."""


@pytest.mark.parametrize("options", [LIMITS, LIMITS | RATED], ids=["plain", "rated"])
@pytest.mark.parametrize("kind", ["rti", "sqp"])
def test_solves_are_those_of_the_casadi_path(kind, options):
    one, references = problem(motor_cart(), f"{kind}/compiled", **options)
    other, _ = problem(motor_cart(), f"{kind}/casadi", **options)
    rng = np.random.default_rng(0)
    for _ in range(20):
        x0, applied = rng.uniform([0.2, -5.0, -5.0], [2.9, 5.0, 5.0]), rng.uniform(-24.0, 24.0, 1)
        aim = references.over(0.3, x0, references.branch(x0))
        guess = Plan(aim.x, aim.u) if kind == "rti" else None
        a, b = one.solve(x0, aim, guess, applied), other.solve(x0, aim, guess, applied)
        assert a.status == b.status == SolveStatus.SOLVED
        assert a.stats.iterations == b.stats.iterations
        # hpipm is exact to 1e-9 of what it solves, and keeps off bounds that are hardly active.
        np.testing.assert_allclose(a.u, b.u, atol=1e-3)
        assert a.stats.cost == pytest.approx(b.stats.cost, rel=1e-7, abs=1e-8)
        if "rates" in options:
            assert np.abs(np.diff(np.append(applied, a.u[:, 0]))).max() <= 3.0 + 1e-6


def test_a_plant_of_many_decades_is_solved_alike():
    """Millimetres under kilovolts and nanocoulombs: in the model's own units few digits would be left."""
    system = plant("mems_actuator").system.with_inputs({"v"})
    options = {
        "reference": constant("x", 5e-4),
        "inputs": {"v": Bounds(min=0.0, max=1400.0)},
        "states": {"x": Bounds(min=-1e-3, max=5.2e-4)},
        "substeps": 2,
        "weights": Weights(states=1e13, inputs=1e-3),
    }
    plans = []
    for backend in ("compiled", "casadi"):
        solver, references = problem(system, f"sqp/{backend}", **options)
        x0 = np.array([1e-4, 2e-8, 0.0, 0.0])
        plans.append(solver.solve(x0, references.over(0.0, x0, references.branch(x0))))
        assert plans[-1].status == SolveStatus.SOLVED
    np.testing.assert_allclose(plans[0].u, plans[1].u, atol=1e-3)
    assert np.ptp(plans[0].u) > 100.0  # bounds of the input are active


def test_rates_agree_with_ipopt():
    x0 = np.array([1.0, 1.0, 0.0])
    plans = []
    for kind in ("sqp", "ipopt"):
        solver, references = problem(motor_cart(), kind, iterations=200, **LIMITS, **RATED)
        aim = references.over(0.3, x0, references.branch(x0))
        plans.append(solver.solve(x0, aim, None, np.array([-20.0])))
        assert plans[-1].status == SolveStatus.SOLVED
    np.testing.assert_allclose(plans[0].u, plans[1].u, atol=2e-3)
    assert abs(plans[0].u[0, 0] + 20.0) <= 3.0 + 1e-9


def test_a_last_input_beyond_its_bounds_is_left_at_once():
    solver, references = problem(motor_cart(), "sqp", **LIMITS, **RATED)
    x0 = np.array([1.0, 1.0, 0.0])
    aim = references.over(0.3, x0, references.branch(x0))
    found = solver.solve(x0, aim, None, np.array([40.0]))
    assert found.status == SolveStatus.SOLVED
    assert found.u[0, 0] == 24.0


@pytest.mark.parametrize("backend", ["compiled", "casadi"])
def test_preparation_and_feedback_are_a_step_of_real_time_iteration(backend):
    solver, references = problem(motor_cart(), f"rti/{backend}", **LIMITS)
    x0 = np.array([1.0, 2.0, 0.5])
    aim = references.over(0.3, x0, references.branch(x0))
    plan = solver.solve(x0, aim)
    guess = Plan(*solver.ocp.shift(plan.x, plan.u, aim.force))
    solver.prepare(aim, guess, plan.u[0])
    expected = solver.feedback(guess.x[0])
    np.testing.assert_allclose(expected.u, solver.solve(guess.x[0], aim, guess).u, atol=1e-8)
    solver.prepare(aim, guess, plan.u[0])
    off = guess.x[0] + np.array([1e-3, -1e-2, 1e-2])
    found = solver.feedback(off)
    np.testing.assert_array_equal(found.x[0], off)
    # The linearisation is that at the guess: right but for second order.
    np.testing.assert_allclose(found.u, solver.solve(off, aim, guess).u, atol=2e-2)


def test_feedback_is_the_same_from_both_backends():
    inputs = []
    for backend in ("compiled", "casadi"):
        solver, references = problem(motor_cart(), f"rti/{backend}", **LIMITS)
        x0 = np.array([1.0, 2.0, 0.5])
        aim = references.over(0.3, x0, references.branch(x0))
        solver.prepare(aim, Plan(aim.x, aim.u))
        found = solver.feedback(aim.x[0] + 1e-2)
        assert found.stats.iterations == 1
        inputs.append(found.u)
    np.testing.assert_allclose(*inputs, atol=1e-6)


@pytest.mark.parametrize("backend", ["compiled", "casadi"])
def test_feedback_to_what_is_not_finite_fails_as_a_status(backend):
    solver, references = problem(motor_cart(), f"rti/{backend}", **LIMITS)
    aim = references.over(0.3, np.array([1.0, 2.0, 0.5]), (0,))
    solver.prepare(aim, Plan(aim.x, aim.u))
    assert solver.feedback(np.array([1.0, np.nan, 0.0])).status == SolveStatus.FAILED
    solver.prepare(aim, Plan(np.full_like(aim.x, np.nan), aim.u))
    assert solver.feedback(np.array([1.0, 2.0, 0.5])).status == SolveStatus.SOLVED


def test_what_the_kernel_cannot_solve_casadi_is_asked(monkeypatch):
    solver, references = problem(motor_cart(), "sqp/compiled", **LIMITS)
    assert isinstance(solver, CompiledGaussNewton)
    x0 = np.array([1.0, 2.0, 0.5])
    aim = references.over(0.3, x0, references.branch(x0))
    expected = solver.solve(x0, aim)

    def lost(planned: bool) -> None:
        solver.kernel.head.status, solver.kernel.head.reason = 2, 3

    monkeypatch.setattr(solver.kernel, "solve", lost)
    found = solver.solve(x0, aim)
    assert found.stats.qp == "hpipm"
    np.testing.assert_allclose(found.u, expected.u, atol=1e-6)


def test_closed_loops_of_both_backends_are_the_same():
    start = np.array([np.pi / 2 - 0.3, 0.0, 0.0])
    # Where bounds are active hpipm keeps off them; two volts more and none is.
    wide = {"inputs": {"v": Bounds(min=-300.0, max=300.0)}, "solver": "sqp", "tolerance": 1e-10}
    one, other = (
        close_loop(controller(motor_cart(), backend=backend, **wide), start, 0.5)
        for backend in ("compiled", "casadi")
    )
    np.testing.assert_allclose(one["v"], other["v"], rtol=0, atol=1e-9 * np.abs(one["v"]).max())


def test_a_tick_of_the_kernel_is_a_tick_of_the_controller():
    """Preparation, feedback and shift by themselves do what `solve` and `Ocp.shift` do, with warm sets."""
    solver, references = problem(motor_cart(), "rti/compiled", **LIMITS)
    assert isinstance(solver, CompiledGaussNewton)
    x0 = np.array([0.6, 0.0, 0.0])
    kernel, ocp = Kernel(solver.ocp, 50, 1e-8, True), solver.ocp
    aim = references.over(0.0, x0, references.branch(x0))
    plan = solver.solve(x0, aim)
    kernel.x_ref[:], kernel.u_ref[:], kernel.x0[:] = aim.x, aim.u, x0
    kernel.solve(False)
    for k in range(1, 40):
        x0 = plan.x[1] + 1e-3
        aim = references.over(k * STEP, x0, references.branch(x0))
        guess = Plan(*ocp.shift(plan.x, plan.u, aim.force))
        solver.prepare(aim, guess)
        plan = solver.feedback(x0)
        kernel.shift()
        kernel.x_ref[:], kernel.u_ref[:], kernel.x0[:] = aim.x, aim.u, x0
        kernel.prepare()
        kernel.feedback()
        kernel.finish()
        assert kernel.head.status == plan.status == SolveStatus.SOLVED
        np.testing.assert_allclose(kernel.u, plan.u, atol=1e-8)
        assert kernel.head.cost == pytest.approx(plan.stats.cost, rel=1e-9)


def test_nothing_is_created_in_a_tick():
    kernel, _ = made(network((ANGLE, CHARGE)), horizon=30, inputs={"v": Bounds(min=-1.0, max=1.0)})
    kernel.solve(False)

    def ticks() -> int:
        before = sys.getallocatedblocks()
        for _ in range(1000):
            kernel.shift()
            kernel.prepare()
            kernel.feedback()
            kernel.finish()
        return sys.getallocatedblocks() - before

    ticks()
    assert ticks() <= 2  # the range and its numbers


# ── backends ─────────────────────────────────────────────────────────────────────────────────────────────


def test_without_a_compiler_casadi_takes_over_and_the_controller_says_so(monkeypatch):
    def none(*_: object) -> None:
        raise RunError("no C compiler found")

    monkeypatch.setattr(compiled, "cached_library", none)
    silent = controller()
    assert silent.facts == {"solver_backend": "casadi"}
    assert any("no C compiler found" in warning for warning in silent.warnings)
    asked = controller(backend="casadi")
    assert not any("compile" in warning for warning in asked.warnings)
    with pytest.raises(SolverError, match="no C compiler found"):
        controller(backend="compiled")


def test_a_compiler_that_knows_no_native_processor_compiles_for_any(monkeypatch):
    inner, asked = compiled.cached_library, []

    def old(sources, main, flags):
        asked.append("-march=native" in flags)
        if asked[-1]:
            raise RunError("unknown argument: -march=native")
        return inner(sources, main, flags)

    monkeypatch.setattr(compiled, "cached_library", old)
    solver, references = problem(oscillator(), "sqp", reference=constant("x", 0.0))
    assert solver.backend == "compiled"
    assert asked == [True, False, True, False]
    assert (
        solver.solve(np.array([0.1, 0.0]), references.over(0.0, np.zeros(2), (0,))).status
        == SolveStatus.SOLVED
    )


def test_nothing_in_the_kernel_can_allocate():
    """It has no other C library than that of numbers and of copying."""
    sources = b"".join(kernel_sources().values()).decode()
    assert set(re.findall(r"#include <(.*)>", sources)) == {"math.h", "stddef.h", "string.h"}


def test_the_controller_says_that_it_is_compiled():
    assert controller().facts == {"solver_backend": "compiled"}


def test_ipopt_is_never_compiled():
    solver, _ = problem(motor_cart(), "ipopt")
    with pytest.raises(SolverError, match="take `rti` or `sqp`"):
        make_solver(solver.ocp, "ipopt", 10, 1e-8, "compiled")


def test_models_too_long_to_be_compiled_go_through_casadi(monkeypatch):
    monkeypatch.setattr(compiled, "MOST_INSTRUCTIONS", 10)
    solver, _ = problem(motor_cart(), "rti")
    assert solver.backend == "casadi"
    assert "too long" in solver.reason


def test_problems_too_large_go_through_casadi(monkeypatch):
    monkeypatch.setattr(compiled, "MOST_STATES", 2)
    assert "room for" in problem(motor_cart(), "rti")[0].reason


SANITISED = """
#include <stdio.h>
#include <stdlib.h>
#include "nmpc.c"
int main(int count, char **names) {
    FILE *file = fopen(names[1], "rb");
    nmpc head;
    long long sizes[2];
    if (count < 2 || !file || !fread(sizes, sizeof sizes, 1, file)) return 2;
    long long *integers = malloc(8 * (size_t)sizes[0]);
    double *numbers = malloc(8 * (size_t)sizes[1]);
    if (!fread(integers, 8, (size_t)sizes[0], file) || !fread(numbers, 8, (size_t)sizes[1], file)) return 2;
    if (!fread(&head, sizeof head, 1, file)) return 2;
    nmpc_model model = {integers, numbers, 0, 0, 0};
    size_t size = nmpc_size(&head, &model);
    nmpc *block = aligned_alloc(64, (8 * size + 63) / 64 * 64);
    if (!fread(block, 8, size, file)) return 2;
    nmpc_solve(block, &model, 0);
    for (int k = 0; k < 20; ++k) {
        nmpc_shift(block, &model);
        nmpc_prepare(block, &model);
        nmpc_feedback(block, &model);
        nmpc_finish(block, &model);
    }
    printf("%lld %.17g", block->status, nmpc_array(block, &model, "u")[0]);
    free(integers), free(numbers), free(block), fclose(file);
    return 0;
}
"""


@pytest.mark.skipif(not shutil.which("gcc"), reason="the sanitizers are gcc's")
def test_sanitizers_find_nothing(tmp_path):
    rates = {"rates": {"v": 300.0, "tau": 10.0}}
    bounds = {"inputs": {"v": Bounds(min=-2.0, max=2.0)}, "states": {"i": Bounds(min=-0.1, max=0.1)}}
    kernel, ocp = made(network((ANGLE, CHARGE)), horizon=7, **bounds, **rates)
    kernel.x0[:], kernel.u_last[:] = [0.5, 0.1, 0.0], 0.0
    packed = pack_networks(ocp.system)
    assert packed is not None
    integers, numbers = packed
    for name, content in kernel_sources().items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "main.c").write_text(SANITISED)
    flags = ["-std=c11", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    flags += ["-Wall", "-Wextra", "-Wno-psabi", "-Wno-unused-function", "-DLANES=4"]
    build = subprocess.run(
        ["gcc", *flags, "main.c", "-o", "main", "-lm"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    if "sanitize" in build.stderr and build.returncode:
        pytest.skip("this gcc comes without its sanitizers")
    assert build.returncode == 0, build.stderr
    assert "warning" not in build.stderr
    head = ctypes.string_at(ctypes.addressof(kernel.head), ctypes.sizeof(kernel.head))
    sizes = np.array([len(integers), len(numbers)], dtype=np.int64)
    parts = [sizes, integers, numbers, np.frombuffer(head, dtype=np.uint8)]
    # The block is laid out for these lanes, longer or shorter at its end alone.
    room = np.concatenate([kernel._block, np.zeros(100_000)])
    (tmp_path / "problem").write_bytes(b"".join(part.tobytes() for part in (*parts, room)))
    run = subprocess.run(
        [tmp_path / "main", tmp_path / "problem"], capture_output=True, text=True, check=False, timeout=120
    )
    assert run.returncode == 0, run.stderr
    status, u = run.stdout.split()
    kernel.solve(False)
    for _ in range(20):
        kernel.shift()
        kernel.prepare()
        kernel.feedback()
        kernel.finish()
    assert int(status) == kernel.head.status == SolveStatus.SOLVED
    assert float(u) == pytest.approx(kernel.u[0, 0], abs=1e-9)

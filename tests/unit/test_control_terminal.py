"""The terminal set: its level in closed form, that it is kept, and what it is good for."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from control_helpers import STEP, close_loop, constant, controller, generator, motor_cart, problem
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.control.ocp import FALLBACK_TERMINAL, Ocp, Targets
from exlinn_fmi.control.terminal import EVERYWHERE, terminal_level
from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants import plant
from exlinn_fmi.scenario.control import Nmpc, TerminalSet, Weights
from exlinn_fmi.scenario.spec import Bounds

SET = TerminalSet(weight=10.0)
BALL = plant("magnetic_levitation").system.with_inputs(["v"])


def cart(friction: float = 0.0) -> LagrangianSystem:
    """A mass of 2 kg that a force moves: without friction a double integrator."""
    return LagrangianSystem.build(
        (Coordinate("x", "m", input="f", input_unit="N"),),
        lambda q, v, p: v[0] ** 2,
        lambda v, p: friction * v[0] ** 2,
    )


def coil() -> LagrangianSystem:
    """1 H and 3 Ω: one state."""
    return LagrangianSystem.build(
        (Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v"),),
        lambda q, v, p: 0.5 * v[0] ** 2,
        lambda v, p: 1.5 * v[0] ** 2,
    )


def targets(system: LagrangianSystem, coordinate: str, value: float, **options) -> tuple[Ocp, Targets]:
    given_ = Nmpc(reference=constant(coordinate, value), horizon=5, terminal_set=SET, **options)
    made = generator(system, given_.reference, 5)
    ocp = Ocp(system, given_, STEP, made.states)
    return ocp, ocp.targets(made.over(0.0, np.zeros(ocp.n), (0,)))


# ── its level ────────────────────────────────────────────────────────────────────────────────────────────


def test_level_of_one_state_is_that_of_the_closed_form():
    bounds = {"v": Bounds(min=-10.0, max=7.0)}
    ocp, found = targets(coil(), "i", 1.0, inputs=bounds, weights=Weights(states=2.0, inputs=0.1))
    z = -3.0 * STEP
    a, q, r = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24, 2.0, 0.1
    b = (a - 1.0) / -3.0
    # b²p² + (r (1 − a²) − b²q) p = q r
    p = max(np.roots([b**2, r * (1 - a**2) - b**2 * q, -q * r]))
    gain = a * b * p / (r + b**2 * p)
    np.testing.assert_allclose(found.P, [[10.0 * p]], rtol=1e-9)
    assert found.level == pytest.approx(p * (4.0 / gain) ** 2)  # v* = 3 V is 4 V below its bound
    assert (found.weight, ocp.set_weight) == (10.0, 10.0)


def test_level_of_a_double_integrator_is_where_the_first_bound_touches():
    # Of a P and a bounded state j alone, α = d² / (P⁻¹)_jj.
    _, found = targets(cart(), "x", 0.3, states={"x_dot": Bounds(min=-0.5, max=0.5)})
    inverse = np.linalg.inv(found.P / 10.0)
    assert found.level == pytest.approx((0.5 * 0.995) ** 2 / inverse[1, 1], rel=1e-6)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 5), m=st.integers(1, 3))
def test_within_the_set_the_feedback_keeps_all_bounds_and_the_set(seed, n, m):
    rng = np.random.default_rng(seed)
    A, B, Q, R = (
        rng.normal(size=(n, n)),
        rng.normal(size=(n, m)),
        np.eye(n),
        np.diag(rng.uniform(0.1, 2.0, m)),
    )
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    soft, u_room, x_room = (
        np.arange(n)[::2],
        rng.uniform(0.1, 2.0, m),
        rng.uniform(0.1, 2.0, len(range(0, n, 2))),
    )
    level = terminal_level(A, B, R, P, u_room, soft, x_room)
    rows, room = np.vstack([K, np.eye(n)[soft]]), np.concatenate([u_room, x_room])
    # Points of the boundary, among them those furthest along each row.
    inverse = np.linalg.inv(P)
    edge = np.vstack([rows @ inverse, rng.normal(size=(50, n))])
    edge *= np.sqrt(level / np.sum((edge @ P) * edge, axis=1))[:, None]
    share = np.abs(edge @ rows.T) / room
    assert share.max() == pytest.approx(1.0, rel=1e-6)
    after = edge @ (A + B @ K).T
    stage = np.sum((edge @ Q) * edge, axis=1) + np.sum((edge @ K.T @ R) * (edge @ K.T), axis=1)
    np.testing.assert_allclose(np.sum((after @ P) * after, axis=1), level - stage, atol=1e-8 * level)


def test_what_is_no_riccati_solution_has_no_set():
    A, B, R, P = np.eye(2), np.eye(2), np.eye(2), np.diag([1.0, -0.5])
    none = np.zeros(0)
    assert terminal_level(A, B, R, P, np.ones(2), none.astype(int), none) == 0.0


def test_without_bounds_the_set_is_everywhere():
    assert targets(cart(), "x", 0.3)[1].level == EVERYWHERE


@pytest.mark.parametrize("bounds", [{"states": {"x": Bounds(max=0.3)}}, {"inputs": {"f": Bounds(min=0.0)}}])
def test_a_reference_on_a_bound_leaves_no_set_and_is_told(bounds):
    assert targets(cart(), "x", 0.3, **bounds)[1].level == 0.0
    made = controller(cart(), reference=constant("x", 0.3), terminal_set=SET, **bounds)
    assert any("terminal_set: there is none" in w and "lies on a bound" in w for w in made.warnings)


def test_a_bounded_state_that_costs_nothing_leaves_no_set():
    # Where it is does not matter to a speed: it may be anywhere at no cost.
    bounds = {"states": {"x": Bounds(min=-1.0, max=1.0)}, "inputs": {"f": Bounds(min=-9.0, max=9.0)}}
    _, found = targets(cart(1.0), "x_dot", 0.0, **bounds)
    assert found.riccati
    assert found.level < 1e-6
    assert targets(cart(1.0), "x_dot", 0.0, inputs=bounds["inputs"])[1].level > 0.1


def test_without_a_riccati_solution_there_is_no_set_and_it_is_told():
    lost = LagrangianSystem.build(
        (Coordinate("a", "rad", input="t"), Coordinate("b", "rad")),
        lambda q, v, p: 0.5 * ca.sumsqr(v) - 10.0 * ca.cos(q[1]),
        lambda v, p: 0.0 * v[0],
    )
    ocp, found = targets(lost, "b", 0.1)
    assert (found.level, found.weight, found.riccati) == (0.0, 1.0, False)
    np.testing.assert_array_equal(found.P, FALLBACK_TERMINAL * ocp.Q)
    made = controller(lost, reference=constant("b", 0.1), terminal_set=SET)
    assert any("no solution" in w and "without a terminal set" in w for w in made.warnings)


@pytest.mark.parametrize("options", [{"cost": "paper"}, {"weights": Weights(terminal=3.0)}])
def test_a_set_that_nothing_is_known_of_is_refused(options):
    with pytest.raises(
        ModelError, match=r"terminal_set: needs `cost: tracking` and `weights.terminal: dare`"
    ):
        controller(terminal_set=SET, **options)


def test_rates_are_no_part_of_the_set_and_that_is_told():
    made = controller(terminal_set=SET, rates={"v": 100.0})
    assert any("terminal_set: the set knows nothing of `rates`" in w for w in made.warnings)


# ── in the solver ────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("system", [motor_cart(), BALL], ids=["motor", "ball"])
@pytest.mark.parametrize("kind", ["rti", "sqp"])
def test_both_backends_have_the_same_set_and_plan(kind, system):
    coordinate, value, bounds = (
        ("x", 0.02, {"v": Bounds(min=0.0, max=24.0)})
        if system is BALL
        else ("alpha", 1.0, {"v": Bounds(min=-3.0, max=3.0)})
    )
    given_ = {"reference": constant(coordinate, value), "horizon": 8, "inputs": bounds}
    given_ |= {"states": {"i": Bounds(min=-2.0, max=2.0)}, "terminal_set": SET}
    solutions = []
    for backend in ("compiled", "casadi"):
        solver, made = problem(system, f"{kind}/{backend}", **given_)
        x0 = np.array([1.2 * value, 0.0, 0.5])
        solutions.append(solver.solve(x0, made.over(0.0, x0, (0,))))
    one, other = solutions
    np.testing.assert_allclose(one.u, other.u, atol=1e-6)
    assert one.targets.level == pytest.approx(other.targets.level, rel=1e-9)
    assert 0.0 < one.targets.level < EVERYWHERE
    assert one.targets.weight == other.targets.weight == 10.0
    np.testing.assert_allclose(one.targets.P, other.targets.P, rtol=1e-9, atol=1e-9 * one.targets.P.max())


def test_a_heavier_weight_ends_nearer_to_the_reference():
    ends = []
    for terminal_set in (None, TerminalSet(weight=1.0), TerminalSet(weight=10.0), TerminalSet(weight=100.0)):
        solver, made = problem(
            motor_cart(), reference=constant("alpha", 1.0), horizon=8, terminal_set=terminal_set
        )
        found = solver.solve(np.array([1.3, 0.0, 0.0]), made.over(0.0, np.zeros(3), (0,)))
        off = found.x[-1] - found.targets.x[-1]
        ends.append(off @ found.targets.P @ off / found.targets.weight)
    assert ends[0] == ends[1] > 1.2 * ends[2] > 1.2**2 * ends[3]


# ── in the loop ──────────────────────────────────────────────────────────────────────────────────────────


def ball(start: float, terminal_set: TerminalSet | None, horizon: int = 3) -> dict[str, np.ndarray]:
    """A ball below the coil, where it falls by itself, is to go up to 20 mm with at most 0.75 A."""
    made = controller(
        BALL,
        step=5e-3,
        reference=constant("x", 0.02),
        horizon=horizon,
        inputs={"v": Bounds(min=0.0, max=24.0)},
        states={"i": Bounds(min=0.0, max=0.75)},
        weights=Weights(states=1e3, inputs=1.0),
        terminal_set=terminal_set,
    )
    return close_loop(made, np.array([start, 0.0, 0.6264]), 1.0, step=5e-3, system=BALL)


def test_a_short_horizon_catches_the_ball_with_the_set_and_loses_it_without():
    lost, caught = ball(0.026, None), ball(0.026, SET)
    assert np.abs(lost["x"] - 0.02).max() > 0.1
    assert np.abs(caught["x"] - 0.02)[-20:].max() < 1e-4
    inside = caught["terminal_cost"] <= caught["terminal_level"]
    assert inside[-1]
    assert np.all(np.diff(inside.astype(int)) >= 0)  # once inside, always inside


def test_once_plans_end_in_the_set_the_cost_falls_by_what_a_sample_costs():
    rows = ball(0.024, SET, horizon=6)
    inside = rows["terminal_cost"] <= rows["terminal_level"]
    cost, stage = rows["cost"], rows["stage_cost"]
    later = np.flatnonzero(inside[:-1])
    assert len(later) > 150
    assert np.all(cost[later + 1] <= (cost - stage)[later] * (1 + 1e-3) + 1e-9 * cost.max())


def test_the_loop_keeps_names_for_its_outputs():
    assert "terminal_cost" not in [v.name for v in controller().variables]
    names = [v.name for v in controller(terminal_set=SET).variables]
    assert names[-2:] == ["terminal_cost", "terminal_level"]

"""Solvers of the optimal control problem, beside known solutions and beside each other."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from control_helpers import CART, LIMITS, constant, motor_cart, oscillator, problem
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.control.gauss_newton import GaussNewton
from exlinn_fmi.control.qp import QpSolution, QpSolver, StageQp
from exlinn_fmi.control.solver import Plan, Solution, SolveStatus
from exlinn_fmi.errors import SolverError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.scenario.control import Weights
from exlinn_fmi.scenario.spec import Bounds

BACKENDS = ["compiled", "casadi"]
SQP = [f"sqp/{backend}" for backend in BACKENDS]
KINDS = [*(f"rti/{backend}" for backend in BACKENDS), *SQP, "ipopt"]
REST = constant("x", 0.0)


def solve(kind: str, system: LagrangianSystem, x0: list[float], time: float = 0.3, **options) -> Solution:
    solver, references = problem(system, kind, **options)
    state = np.array(x0)
    return solver.solve(state, references.over(time, state, references.branch(state)))


@pytest.mark.parametrize("kind", KINDS)
def test_unconstrained_linear_problem_has_the_riccati_solution(kind):
    solver, references = problem(oscillator(), kind, reference=REST, weights=Weights(states=2.0, inputs=0.1))
    x0 = np.array([0.7, -0.4])
    made = references.over(0.0, x0, (0,))
    found = solver.solve(x0, made)
    P, ocp = solver.ocp.targets(made).P, solver.ocp
    A, B = ocp.linearise_at(np.zeros(2), np.zeros(1), np.zeros(1))
    K = np.linalg.solve(ocp.R + B.T @ P @ B, B.T @ P @ A)
    x = x0
    for k in range(ocp.horizon):
        np.testing.assert_allclose(found.u[k], -K @ x, atol=1e-7)
        x = (A - B @ K) @ x
    assert found.status == SolveStatus.SOLVED
    assert found.stats.cost == pytest.approx(x0 @ P @ x0, rel=1e-7)


@settings(max_examples=10, deadline=None)
@given(alpha=st.floats(0.2, 2.9), alpha_dot=st.floats(-5, 5), i=st.floats(-5, 5), time=st.floats(0, 2.5))
@pytest.mark.parametrize("cost", ["tracking", "paper"])
def test_sqp_and_ipopt_agree_where_bounds_are_active(cost, alpha, alpha_dot, i, time):
    x0 = [alpha, alpha_dot, i]
    one = solve("sqp", motor_cart(), x0, time, cost=cost, **LIMITS)
    other = solve("ipopt", motor_cart(), x0, time, cost=cost, iterations=200, **LIMITS)
    assert one.status == other.status == SolveStatus.SOLVED
    assert one.stats.cost == pytest.approx(other.stats.cost, rel=1e-7, abs=1e-7)
    np.testing.assert_allclose(one.u[0], other.u[0], atol=1e-5)
    # IPOPT's barrier keeps off a bound that is hardly active: no more can be said of the rest of the plan.
    np.testing.assert_allclose(one.u, other.u, atol=2e-3)


@pytest.mark.parametrize("kind", SQP)
def test_bound_of_the_input_is_reached_and_kept(kind):
    found = solve(kind, motor_cart(), [0.3, 0.0, 0.0], **LIMITS)
    assert found.u.max() == pytest.approx(24.0, abs=1e-12)
    assert found.u.min() >= -24.0


@pytest.mark.parametrize("kind", SQP)
def test_a_state_bound_that_can_be_kept_is_kept_exactly(kind):
    limits = {"inputs": {"v": Bounds(min=-24.0, max=24.0)}, "states": {"i": Bounds(min=-0.5, max=0.5)}}
    found = solve(kind, motor_cart(), [2.5, 0.0, 0.0], **limits)
    assert np.abs(found.x[:, 2]).max() == pytest.approx(0.5 * (1 - 0.005), abs=1e-6)
    assert found.stats.slack == 0.0


@pytest.mark.parametrize("kind", SQP)
def test_a_state_bound_that_cannot_be_kept_yields_to_the_input_bound(kind):
    found = solve(kind, motor_cart(), [np.pi / 2, 0.0, 6.0], **LIMITS)
    assert found.status == SolveStatus.SOLVED
    assert np.abs(found.u).max() <= 24.0
    assert found.stats.slack > 0.1


@pytest.mark.parametrize("kind", SQP)
def test_plan_obeys_the_model(kind):
    found = solve(kind, motor_cart(), [1.0, 2.0, 1.0], **LIMITS)
    system = motor_cart()
    following = evaluate(system.rk4(1), found.x[:-1], found.u, system.parameter_values, [0.01])
    np.testing.assert_allclose(found.x[1:], following, atol=1e-8)


@pytest.mark.parametrize("backend", BACKENDS)
def test_real_time_iterations_converge_to_the_converged_solution(backend):
    x0 = np.array([0.8, 1.0, 0.0])
    rti, references = problem(motor_cart(), f"rti/{backend}", **LIMITS)
    made = references.over(0.0, x0, (0,))
    guess = Plan(made.x, made.u)
    for _ in range(8):
        found = rti.solve(x0, made, guess)
        assert found.stats.iterations == 1
        guess = Plan(found.x, found.u)
    converged = problem(motor_cart(), "sqp", **LIMITS)[0].solve(x0, made)
    np.testing.assert_allclose(found.u, converged.u, atol=1e-6)
    assert found.stats.kkt < 1e-8


@pytest.mark.parametrize("kind", ["rti/compiled", "rti/casadi"])
def test_a_start_without_plan_is_iterated_to_convergence_in_real_time_too(kind):
    found = solve(kind, motor_cart(), [0.8, 1.0, 0.0], **LIMITS)
    assert found.stats.iterations > 1
    assert found.stats.kkt <= 1e-8


@pytest.mark.parametrize("kind", SQP)
def test_on_the_reference_nothing_is_to_be_done(kind):
    solver, references = problem(motor_cart(), kind)
    x0 = references.over(0.3, np.array([np.pi / 2, 0.0, 0.0]), (0,)).x[0]
    made = references.over(0.3, x0, (0,))
    found = solver.solve(x0, made)
    # Holding u* of the middle of an interval is right to second order.
    np.testing.assert_allclose(found.u, made.u, atol=5e-3)
    assert found.stats.cost < 1e-6


def steep(start: float = 3.0) -> LagrangianSystem:
    """A stiffening spring, on which full Gauss–Newton steps from afar go wrong."""
    return LagrangianSystem.build(
        (Coordinate("x", "m", input="f"),),
        lambda q, v, p: 0.5 * v[0] ** 2 - 200.0 * ca.cosh(start * q[0]),
        lambda v, p: 0.1 * v[0] ** 2,
    )


@pytest.mark.parametrize("kind", SQP)
def test_line_search_reaches_what_ipopt_finds(kind):
    options = {"reference": REST, "inputs": {"f": Bounds(min=-200.0, max=200.0)}, "iterations": 300}
    one = solve(kind, steep(), [0.9, -2.0], **options)
    other = solve("ipopt", steep(), [0.9, -2.0], **options)
    assert one.status == SolveStatus.SOLVED
    np.testing.assert_allclose(one.u, other.u, atol=1e-4)


@pytest.mark.parametrize("kind", [*SQP, "ipopt"])
def test_iteration_limit_is_a_status_with_a_usable_plan(kind):
    found = solve(kind, motor_cart(), [0.3, 3.0, 0.0], iterations=2, **LIMITS)
    assert found.status == SolveStatus.LIMIT
    assert "2 iterations" in found.stats.message
    assert np.isfinite(found.u).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_measurement_that_is_not_finite_fails_as_a_status(kind):
    solver, references = problem(motor_cart(), kind)
    made = references.over(0.0, np.array([1.0, 0.0, 0.0]), (0,))
    found = solver.solve(np.array([1.0, np.nan, 0.0]), made)
    assert found.status == SolveStatus.FAILED
    assert "not finite" in found.stats.message


def edge() -> LagrangianSystem:
    """A system whose model ends at x = 1: there is no prediction beyond."""
    return LagrangianSystem.build(
        (Coordinate("x", "m", input="f"),),
        lambda q, v, p: 0.5 * v[0] ** 2 + ca.sqrt(1.0 - q[0]),
        lambda v, p: 0.1 * v[0] ** 2,
    )


@pytest.mark.parametrize("kind", KINDS)
def test_predictions_that_are_not_finite_fail_as_a_status(kind):
    found = solve(kind, edge(), [2.0, 0.0], reference=REST)
    assert found.status == SolveStatus.FAILED
    assert found.stats.message


@pytest.mark.parametrize("kind", SQP)
def test_a_reference_beyond_the_models_edge_is_approached_from_standing_still(kind):
    options = {"reference": constant("x", 2.0), "inputs": {"f": Bounds(min=-0.5, max=0.5)}}
    found = solve(kind, edge(), [0.0, 0.0], **options)
    assert found.status == SolveStatus.SOLVED
    np.testing.assert_allclose(found.u, 0.5)


@pytest.mark.parametrize("kind", ["rti/compiled", "rti/casadi"])
def test_a_plan_beyond_the_models_edge_is_given_up_for_the_reference(kind):
    solver, references = problem(edge(), kind, reference=REST)
    x0 = np.array([0.1, 0.0])
    made = references.over(0.0, x0, (0,))
    lost = Plan(np.full_like(made.x, 5.0), made.u)
    found = solver.solve(x0, made, lost)
    assert found.status == SolveStatus.SOLVED
    np.testing.assert_allclose(found.u, solver.solve(x0, made).u)


@pytest.mark.parametrize("kind", SQP)
def test_a_step_beyond_the_models_edge_is_shortened(kind):
    found = solve(kind, edge(), [0.9, 8.0], reference=REST, iterations=200)
    assert found.status in (SolveStatus.SOLVED, SolveStatus.LIMIT, SolveStatus.FAILED)
    assert np.isfinite(found.u).all()


class Never(QpSolver):
    """Solves nothing."""

    def solve(self, qp: StageQp) -> QpSolution:
        return QpSolution(np.zeros_like(qp.g), np.zeros_like(qp.r), np.zeros((0, 0)), False, 0, "never")


def test_a_quadratic_program_without_solution_fails_as_a_status():
    solver, references = problem(motor_cart(), "sqp/casadi")
    assert isinstance(solver, GaussNewton)
    solver.qp = Never()
    x0 = np.array([1.0, 0.0, 0.0])
    found = solver.solve(x0, references.over(0.0, x0, (0,)))
    assert found.status == SolveStatus.FAILED
    assert found.stats.message == "never did not solve the quadratic program"


def test_a_plan_that_is_not_finite_fails_as_a_status():
    class Wild(QpSolver):
        def solve(self, qp: StageQp) -> QpSolution:
            return QpSolution(np.full_like(qp.g, 1e300), qp.r, np.zeros((30, 0)), True, 0, "wild")

    solver, references = problem(motor_cart(), "rti/casadi")
    assert isinstance(solver, GaussNewton)
    solver.qp = Wild()
    x0 = np.array([1.0, 0.0, 0.0])
    made = references.over(0.0, x0, (0,))
    with np.errstate(all="ignore"):
        once = solver._from(x0, Plan(made.x, made.u), solver.ocp.targets(made), cold=False)
        found = solver.solve(x0, made, Plan(made.x, made.u))
    assert once.stats.message == "the plan is not finite"
    assert once.status == found.status == SolveStatus.FAILED


def test_without_ipopt_the_error_names_another_solver(monkeypatch):
    monkeypatch.setattr(ca, "has_nlpsol", lambda name: False)
    with pytest.raises(SolverError, match="take `solver: sqp`"):
        problem(motor_cart(), "ipopt")


def test_ipopt_that_raises_fails_as_a_status(monkeypatch):
    solver, references = problem(motor_cart(), "ipopt")

    def broken(**arguments):
        raise RuntimeError("casadi says:\nout of order")

    monkeypatch.setattr(solver, "_solver", broken)
    x0 = np.array([1.0, 0.0, 0.0])
    found = solver.solve(x0, references.over(0.0, x0, (0,)))
    assert found.status == SolveStatus.FAILED
    assert found.stats.message == "IPOPT: out of order"


@pytest.mark.parametrize("kind", SQP)
def test_substeps_refine_the_prediction(kind):
    coarse = solve(kind, motor_cart(), [1.0, 2.0, 1.0])
    fine = solve(kind, motor_cart(), [1.0, 2.0, 1.0], substeps=4)
    difference = np.abs(coarse.u - fine.u).max()
    assert 0.0 < difference < 1e-2


@pytest.mark.parametrize("kind", SQP)
def test_guess_and_references_are_left_as_they_were(kind):
    solver, references = problem(motor_cart(), kind, reference=CART)
    x0 = np.array([1.0, 0.0, 0.0])
    made = references.over(0.0, x0, (0,))
    guess = Plan(made.x.copy(), made.u.copy())
    solver.solve(x0, made, guess)
    np.testing.assert_array_equal(guess.x, made.x)
    np.testing.assert_array_equal(guess.u, made.u)

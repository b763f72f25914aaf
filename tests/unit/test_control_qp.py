"""Quadratic programs stage by stage: two solvers, one answer."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.control.qp import ConicQp, FallbackQp, QpSolution, QpSolver, StageQp, make_qp_solver

N, n, m, SOFT = 8, 3, 2, np.array([0, 2])


def program(seed: int, low: float = -0.5, bound: float = 1.0) -> StageQp:
    rng = np.random.default_rng(seed)
    return StageQp(
        A=np.eye(n) + 0.1 * rng.normal(size=(N, n, n)),
        B=0.3 * rng.normal(size=(N, n, m)),
        c=0.1 * rng.normal(size=(N, n)),
        dx0=rng.normal(size=n),
        H_x=np.diag(rng.uniform(0.5, 2.0, n)),
        H_end=5.0 * np.eye(n),
        H_u=np.diag(rng.uniform(0.1, 1.0, m)),
        g=rng.normal(size=(N + 1, n)),
        r=rng.normal(size=(N, m)),
        u_low=np.full((N, m), -bound),
        u_high=np.full((N, m), bound),
        low=np.full((N, len(SOFT)), low),
        high=np.full((N, len(SOFT)), 0.5),
        l1=np.full(len(SOFT), 100.0),
        l2=np.full(len(SOFT), 10.0),
    )


HPIPM, QRQP = ConicQp("hpipm", N, n, m, SOFT), ConicQp("qrqp", N, n, m, SOFT)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_interior_point_and_active_set_agree(seed):
    qp = program(seed)
    one, other = HPIPM.solve(qp), QRQP.solve(qp)
    assert one.solved
    if other.solved:  # qrqp gives up on some
        np.testing.assert_allclose(one.du, other.du, atol=1e-5)
        np.testing.assert_allclose(one.slack, other.slack, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_solution_obeys_dynamics_bounds_and_slack(seed):
    qp = program(seed)
    found = make_qp_solver(N, n, m, SOFT).solve(qp)
    following = np.einsum("kij,kj->ki", qp.A, found.dx[:-1]) + np.einsum("kij,kj->ki", qp.B, found.du) + qp.c
    np.testing.assert_allclose(found.dx[1:], following, atol=1e-6)
    np.testing.assert_array_equal(found.dx[0], qp.dx0)
    assert np.abs(found.du).max() <= 1.0
    beyond = np.maximum(np.abs(found.dx[1:, SOFT]) - 0.5, 0.0)
    np.testing.assert_allclose(found.slack, beyond, atol=1e-6)


def test_without_active_bounds_the_solution_is_stationary():
    qp = program(3, low=-np.inf, bound=np.inf)
    qp = StageQp(**(vars(qp) | {"high": np.full((N, len(SOFT)), np.inf)}))
    found = HPIPM.solve(qp)
    multiplier = qp.H_end @ found.dx[N] + qp.g[N]
    for k in reversed(range(N)):
        np.testing.assert_allclose(qp.H_u @ found.du[k] + qp.r[k] + qp.B[k].T @ multiplier, 0.0, atol=1e-7)
        multiplier = qp.H_x @ found.dx[k] + qp.g[k] + qp.A[k].T @ multiplier


def test_one_stage_is_enough():
    qp = program(0)
    short = {
        k: v[:1] for k, v in vars(qp).items() if k in ("A", "B", "c", "r", "u_low", "u_high", "low", "high")
    }
    found = make_qp_solver(1, n, m, SOFT).solve(StageQp(**(vars(qp) | short | {"g": qp.g[:2]})))
    assert found.solved
    assert found.dx.shape == (2, n)


def test_success_that_breaks_a_bound_is_none():
    # qrqp reports success on this one with inputs beyond their bounds.
    rng = np.random.default_rng(0)
    qp = StageQp(
        A=rng.normal(size=(4, 2, 2)),
        B=rng.normal(size=(4, 2, 1)),
        c=rng.normal(size=(4, 2)),
        dx0=rng.normal(size=2),
        H_x=np.eye(2) * 2,
        H_end=np.diag([5.0, 3.0]),
        H_u=np.eye(1),
        g=rng.normal(size=(5, 2)),
        r=rng.normal(size=(4, 1)),
        u_low=-np.ones((4, 1)),
        u_high=np.ones((4, 1)),
        low=-np.ones((4, 1)),
        high=np.ones((4, 1)),
        l1=np.array([100.0]),
        l2=np.array([10.0]),
    )
    soft = np.array([1])
    assert ConicQp("hpipm", 4, 2, 1, soft).solve(qp).solved
    assert not ConicQp("qrqp", 4, 2, 1, soft).solve(qp).solved


@pytest.mark.parametrize("solver", [HPIPM, QRQP], ids=["hpipm", "qrqp"])
def test_what_is_not_finite_is_not_solved(solver):
    qp = program(0)
    qp.A[2] = np.nan
    assert not solver.solve(qp).solved


class Never(QpSolver):
    """Solves nothing."""

    def solve(self, qp: StageQp) -> QpSolution:
        return QpSolution(np.zeros((N + 1, n)), np.zeros((N, m)), np.zeros((N, 2)), False, 0, "never")


def test_the_second_solver_is_asked_where_the_first_fails():
    assert FallbackQp(Never(), HPIPM).solve(program(1)).solver == "hpipm"
    assert FallbackQp(HPIPM, Never()).solve(program(1)).solver == "hpipm"


def test_without_hpipm_qrqp_takes_its_place(monkeypatch):
    monkeypatch.setattr(ca, "has_conic", lambda name: False)
    assert make_qp_solver(N, n, m, SOFT).solve(program(1)).solver == "qrqp"

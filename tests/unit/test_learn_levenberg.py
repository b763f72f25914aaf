"""Levenberg–Marquardt on problems with known answers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from exlinn_fmi.learn.levenberg import Normal, Triangle, levenberg_marquardt

Residual = Callable[[np.ndarray], np.ndarray]


def by_normal_equations(r: np.ndarray, j: np.ndarray) -> Normal:
    return Normal(float(r @ r), j.T @ r, j.T @ j)


def by_qr(r: np.ndarray, j: np.ndarray) -> Triangle:
    q, upper = np.linalg.qr(j) if np.isfinite(j).all() else (np.ones_like(j), j)
    return Triangle(float(r @ r), upper, q.T @ r)


SOLVERS = [by_normal_equations, by_qr]
Solver = Callable[[np.ndarray, np.ndarray], Normal | Triangle]


def minimise(
    residual: Residual,
    jacobian: Residual,
    start: list[float],
    solver: Solver = by_normal_equations,
    most: int = 500,
    floor: float = 0.0,
) -> list[float]:
    def linearise(theta: np.ndarray) -> Normal | Triangle:
        return solver(residual(theta), jacobian(theta))

    def value(theta: np.ndarray) -> float:
        return float(residual(theta) @ residual(theta))

    values = []
    for step in levenberg_marquardt(np.array(start), linearise, value, floor):
        values.append(step.value)
        if len(values) > most:
            break
    return values


def rosenbrock(x: np.ndarray) -> np.ndarray:
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def rosenbrock_jacobian(x: np.ndarray) -> np.ndarray:
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


@pytest.mark.parametrize("solver", SOLVERS)
def test_rosenbrocks_valley_is_followed_to_its_end(solver: Solver) -> None:
    assert minimise(rosenbrock, rosenbrock_jacobian, [-1.2, 1.0], solver)[-1] < 1e-25


@pytest.mark.parametrize("damping", [0.0, 1e-6, 1.0])
def test_both_solvers_take_the_same_step_and_promise_the_same(damping: float) -> None:
    random = np.random.default_rng(0)
    r, j = random.standard_normal(9), random.standard_normal((9, 4))
    one, other = (solver(r, j) for solver in SOLVERS)
    step = one.step(np.full(4, damping))
    assert other.step(np.full(4, damping)) == pytest.approx(step, rel=1e-9)
    assert other.fall(step) == pytest.approx(one.fall(step), rel=1e-9)
    assert other.sizes == pytest.approx(one.sizes, rel=1e-12)


def test_qr_finds_what_normal_equations_are_blind_to() -> None:
    columns = np.vander(np.linspace(0, 1, 40), 14)  # condition 1e10: squared, nothing is left
    truth = np.ones(14)
    by_squares, by_triangle = (solver(-columns @ truth, columns) for solver in SOLVERS)
    assert by_triangle.step(np.zeros(14)) == pytest.approx(truth, abs=1e-4)
    step = by_squares.step(np.zeros(14))
    assert step is None or np.abs(step - truth).max() > 1e-2


def test_a_floor_keeps_a_column_that_hardly_acts_from_long_steps() -> None:
    def residual(x: np.ndarray) -> np.ndarray:  # x₁ acts by its square, and begins next to nothing
        return np.array([x[0] - 1, x[0] + x[1] ** 2 - 1.0, 1e-3 * (x[1] - 1e-3)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.array([[1.0, 0.0], [1.0, 2 * x[1]], [0.0, 1e-3]])

    without, with_floor = (minimise(residual, jacobian, [0.0, 1e-3], floor=f) for f in (0.0, 1e-2))
    assert len(with_floor) <= len(without)
    assert with_floor[-1] < 1e-12


def test_the_objective_falls_with_every_step() -> None:
    values = minimise(rosenbrock, rosenbrock_jacobian, [-1.2, 1.0])
    assert (np.diff(values) < 0).all()


def test_a_direction_without_effect_does_no_harm() -> None:
    values = minimise(
        lambda x: np.array([x[0] + x[1] - 2, (x[0] + x[1]) ** 2 - 4]),
        lambda x: np.array([[1.0, 1.0], [2 * (x[0] + x[1])] * 2]),
        [5.0, -1.0],
    )
    assert values[-1] < 1e-25


def test_steps_to_where_the_objective_is_not_finite_are_refused() -> None:
    values = minimise(
        lambda x: np.array([np.log(x[0]) if x[0] > 0 else np.nan]), lambda x: np.array([[1 / x[0]]]), [8.0]
    )
    assert values[-1] == pytest.approx(0, abs=1e-20)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_matrix_that_is_not_finite_ends_the_descent_at_the_start(solver: Solver) -> None:
    values = minimise(lambda x: np.array([1.0]), lambda x: np.array([[np.inf]]), [1.0], solver)
    assert values == [1.0]

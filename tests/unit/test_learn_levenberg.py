"""Levenberg–Marquardt on problems with known answers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt

Residual = Callable[[np.ndarray], np.ndarray]


def minimise(residual: Residual, jacobian: Residual, start: list[float], most: int = 500) -> list[float]:
    def normal(theta: np.ndarray) -> Normal:
        r, j = residual(theta), jacobian(theta)
        return Normal(float(r @ r), j.T @ r, j.T @ j)

    def value(theta: np.ndarray) -> float:
        return float(residual(theta) @ residual(theta))

    values = []
    for step in levenberg_marquardt(np.array(start), normal, value):
        values.append(step.value)
        if len(values) > most:
            break
    return values


def rosenbrock(x: np.ndarray) -> np.ndarray:
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def rosenbrock_jacobian(x: np.ndarray) -> np.ndarray:
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


def test_rosenbrocks_valley_is_followed_to_its_end() -> None:
    assert minimise(rosenbrock, rosenbrock_jacobian, [-1.2, 1.0])[-1] < 1e-25


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


def test_a_matrix_that_is_not_finite_ends_the_descent_at_the_start() -> None:
    values = minimise(lambda x: np.array([1.0]), lambda x: np.array([[np.inf]]), [1.0])
    assert values == [1.0]

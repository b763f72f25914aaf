"""Levenberg–Marquardt for sums of squares, as an iterator: the caller watches, validates and stops.

Scaled damping (Moré), gain-ratio update of the damping (Nielsen). Directions that the data leave free
(gauges of a network) are held by the damping and by the L2 term.

References: Moré (1978), Lecture Notes in Mathematics 630; Nielsen (1999), report IMM-REP-1999-05, DTU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

Vector = Float[NDArray[np.float64], " P"]

FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-18
MOST_DAMPING = 1e10


class Normal(NamedTuple):
    """Objective ‖r(θ)‖² at a point, half its gradient Jᵀr, and JᵀJ."""

    value: float
    gradient: Float[NDArray[np.float64], " P"]
    matrix: Float[NDArray[np.float64], "P P"]


class Step(NamedTuple):
    """An accepted step: where it led and the objective there."""

    theta: Float[NDArray[np.float64], " P"]
    value: float


def levenberg_marquardt(
    theta: Vector, normal: Callable[[Vector], Normal], value: Callable[[Vector], float]
) -> Iterator[Step]:
    """Descend from `theta`; ends where no step makes the objective smaller.

    Args:
        theta: start.
        normal: objective, gradient and Gauss–Newton matrix at a point.
        value: the objective alone.

    Yields:
        The start, then every accepted step.
    """
    damping, growth = FIRST_DAMPING, 2.0
    now = value(theta)
    # A caller that has seen enough is spared the Jacobian, which costs many times a value.
    yield Step(theta, now)
    at = normal(theta)
    scale = np.diag(at.matrix).copy()
    while damping < MOST_DAMPING:
        scale = np.maximum(scale, np.diag(at.matrix))
        step = _solve(at, damping * np.maximum(scale, np.finfo(float).tiny))
        if step is None:
            damping, growth = damping * growth, 2 * growth
            continue
        new = value(theta + step)
        predicted = -2 * (step @ at.gradient) - step @ at.matrix @ step
        gain = (now - new) / predicted if predicted > 0 else -1.0
        if not new < now:  # also where it is not finite
            damping, growth = damping * growth, 2 * growth
            continue
        theta, now = theta + step, new
        damping = max(float(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)), LEAST_DAMPING)
        growth = 2.0
        yield Step(theta, now)
        at = normal(theta)


def _solve(at: Normal, damping: Vector) -> Vector | None:
    """The damped Gauss–Newton step, None where the matrix is not positive definite in floating point."""
    if not np.isfinite(at.matrix).all():
        return None
    # Equilibrate first: columns of networks differ by many orders of magnitude.
    size = 1 / np.sqrt(np.diag(at.matrix) + damping)
    matrix = at.matrix * size[:, None] * size
    matrix[np.diag_indices_from(matrix)] += damping * size**2
    try:
        step = -cho_solve(cho_factor(matrix), at.gradient * size) * size
    except LinAlgError:
        return None
    return np.asarray(step) if np.isfinite(step).all() else None

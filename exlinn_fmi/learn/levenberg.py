"""Levenberg–Marquardt for sums of squares, as an iterator: the caller watches, validates and stops.

Scaled damping (Moré), gain-ratio update of the damping (Nielsen). Directions that the data leave free
(gauges of a network) are held by the damping and by the L2 term.

References: Moré (1978), Lecture Notes in Mathematics 630; Nielsen (1999), report IMM-REP-1999-05, DTU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

Vector = Float[NDArray[np.float64], " P"]

FIRST_DAMPING = 1e-3
LEAST_DAMPING = 1e-30
MOST_DAMPING = 1e10


@runtime_checkable
class Linearised(Protocol):
    """Objective ‖r(θ)‖² with r linearised at a point."""

    @property
    def value(self) -> float:
        """The objective there."""

    @property
    def sizes(self) -> Vector:
        """Squares of the norms of J's columns."""

    def step(self, damping: Vector) -> Vector | None:
        """Minimiser of ‖r + Jp‖² + Σ damping p²; None where floating point gives none."""

    def fall(self, step: Vector) -> float:
        """By how much a step should make the objective smaller."""


class Normal(NamedTuple):
    """By the normal equations: cheap, blind to directions with singular values below 1e-8 of the largest.

    Args:
        value: ‖r‖².
        gradient: Jᵀr.
        matrix: JᵀJ.
    """

    value: float
    gradient: Float[NDArray[np.float64], " P"]
    matrix: Float[NDArray[np.float64], "P P"]

    @property
    def sizes(self) -> Vector:
        """Squares of the norms of J's columns."""
        return np.diag(self.matrix).copy()

    def step(self, damping: Vector) -> Vector | None:
        """Minimiser of ‖r + Jp‖² + Σ damping p²."""
        # Equilibrate first: columns of networks differ by many orders of magnitude.
        size = 1 / np.sqrt(self.sizes + damping)
        matrix = self.matrix * size[:, None] * size
        matrix[np.diag_indices_from(matrix)] += damping * size**2
        try:
            return _finite(-cho_solve(cho_factor(matrix), self.gradient * size) * size)
        except (LinAlgError, ValueError):  # the latter where entries are not finite
            return None

    def fall(self, step: Vector) -> float:
        """By how much a step should make the objective smaller."""
        return float(-2 * (step @ self.gradient) - step @ self.matrix @ step)


class Triangle(NamedTuple):
    """By QR of J: twice the work, and all the digits.

    Args:
        value: ‖r‖².
        factor: R with RᵀR = JᵀJ, upper triangular.
        right: b with Rᵀb = Jᵀr.
    """

    value: float
    factor: Float[NDArray[np.float64], "P P"]
    right: Float[NDArray[np.float64], " P"]

    @property
    def sizes(self) -> Vector:
        """Squares of the norms of J's columns."""
        return np.asarray(np.sum(self.factor**2, axis=0))

    def step(self, damping: Vector) -> Vector | None:
        """Minimiser of ‖r + Jp‖² + Σ damping p²."""
        count = len(self.right)
        matrix = np.zeros((2 * count, count + 1))
        matrix[:count, :count], matrix[:count, count] = self.factor, self.right
        matrix[count + np.arange(count), np.arange(count)] = np.sqrt(damping)
        r = triangle(matrix)
        try:
            return _finite(-solve_triangular(r[:count, :count], r[:count, count], check_finite=False))
        except LinAlgError:
            return None

    def fall(self, step: Vector) -> float:
        """By how much a step should make the objective smaller."""
        moved = self.factor @ step
        return float(-2 * (self.right @ moved) - moved @ moved)


class Step(NamedTuple):
    """An accepted step: where it led and the objective there."""

    theta: Float[NDArray[np.float64], " P"]
    value: float


def levenberg_marquardt(
    theta: Vector,
    linearise: Callable[[Vector], Linearised],
    value: Callable[[Vector], float],
    floor: float = 0.0,
    alike: int | None = None,
    damping: float = FIRST_DAMPING,
) -> Iterator[Step]:
    """Descend from `theta`; ends where no step makes the objective smaller.

    Args:
        theta: start.
        linearise: the problem linearised at a point.
        value: the objective alone.
        floor: columns of J are damped as if they had at least this share of the largest one's square. Where
            entries of θ have one unit, this keeps those that hardly act yet from steps so long that their own
            curvature undoes them.
        alike: so many entries, the first ones, have that unit; all if not given.
        damping: of the first step; little where the start is good.

    Yields:
        The start, then every accepted step.
    """
    growth = 2.0
    now = value(theta)
    # A caller that has seen enough is spared the Jacobian, which costs many times a value.
    yield Step(theta, now)
    at = linearise(theta)
    scale = at.sizes
    while damping < MOST_DAMPING and np.isfinite(at.sizes).all():
        scale = np.maximum(scale, at.sizes)
        lifted = np.maximum(scale, np.finfo(float).tiny)
        lifted[:alike] += floor * scale[:alike].max(initial=0.0)
        step = at.step(damping * lifted)
        if step is None:
            damping, growth = damping * growth, 2 * growth
            continue
        new, predicted = value(theta + step), at.fall(step)
        gain = (now - new) / predicted if predicted > 0 else -1.0
        if not new < now:  # also where it is not finite
            damping, growth = damping * growth, 2 * growth
            continue
        theta, now = theta + step, new
        damping = max(float(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3)), LEAST_DAMPING)
        growth = 2.0
        yield Step(theta, now)
        at = linearise(theta)


def _finite(step: Vector) -> Vector | None:
    return np.asarray(step) if np.isfinite(step).all() else None


def triangle(*rows: Float[NDArray[np.float64], "_ k"]) -> Float[NDArray[np.float64], "_ k"]:
    """R of the QR factorisation of arrays on top of each other; NaN where they are not finite."""
    matrix = np.concatenate(rows)
    if not np.isfinite(matrix).all():
        return np.full((matrix.shape[1], matrix.shape[1]), np.nan)
    return np.asarray(np.linalg.qr(matrix, mode="r"))

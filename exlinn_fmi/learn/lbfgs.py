"""L-BFGS where the Jacobian is too large: an iterator like `levenberg.py`, in memory in proportion to P.

The first guess of the inverse Hessian is diagonal, from the columns of the Jacobian, and made anew as the
descent goes on: weights of networks differ by orders of magnitude in what they do.

References: Nocedal & Wright (2006), Numerical Optimization, algorithms 7.4 (two loops) and 3.5 (line search).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.optimize import line_search

from exlinn_fmi.learn.levenberg import Step

Vector = Float[NDArray[np.float64], " P"]

MEMORY = 100
"""Steps that are remembered."""
ROUND = 20
"""After so many iterations the caller is told, …"""
RESCALE = 10
"""… and after so many times of that the diagonal is made anew."""
FLOOR = 1e-2
"""Columns of the Jacobian count as if they had at least this share of the largest one's square."""


class Pair(NamedTuple):
    """A step, and by how much it changed the gradient."""

    step: Vector
    change: Vector


def lbfgs(
    theta: Vector,
    objective: Callable[[Vector], tuple[float, Vector]],
    sizes: Callable[[Vector], Vector],
) -> Iterator[Step]:
    """Descend from `theta`; ends where no step makes the objective smaller.

    Args:
        theta: start.
        objective: what is made small, and its gradient.
        sizes: squares of the norms of the Jacobian's columns.

    Yields:
        The start, then every `ROUND` iterations, and the end.
    """
    at = _Remembered(objective)
    value, gradient = at(theta)
    yield Step(theta, value)
    pairs: deque[Pair] = deque(maxlen=MEMORY)
    number = 0
    while np.isfinite(value):
        if number % (ROUND * RESCALE) == 0:
            size = sizes(theta)
            diagonal = 1 / (size + FLOOR * size.max())
        step = direction(gradient, pairs, diagonal)
        with np.errstate(all="ignore"):  # the search tries what overflows
            length = line_search(at.value, at.gradient, theta, step, gradient, value, c2=0.9, maxiter=20)[0]
        if length is None:
            if not pairs:
                break
            pairs.clear()
            continue
        moved = theta + length * step
        new, slope = at(moved)
        if not new < value:
            break
        if (slope - gradient) @ (moved - theta) > 0:
            pairs.append(Pair(moved - theta, slope - gradient))
        theta, value, gradient = moved, new, slope
        number += 1
        if number % ROUND == 0:
            yield Step(theta, value)
    if number % ROUND:
        yield Step(theta, value)


def direction(gradient: Vector, pairs: deque[Pair], diagonal: Vector) -> Vector:
    """−H⁻¹ gradient by the two loops over the pairs, newest first, then oldest first."""
    rest, shares = gradient.copy(), []
    for step, change in reversed(pairs):
        shares.append((step @ rest) / (step @ change))
        rest -= shares[-1] * change
    rest *= diagonal
    if pairs:  # the diagonal's own size is no better known than by the last pair
        step, change = pairs[-1]
        rest *= (step @ change) / (change @ (diagonal * change))
    for (step, change), share in zip(pairs, reversed(shares), strict=True):
        rest += (share - (change @ rest) / (step @ change)) * step
    return -rest


class _Remembered:
    """An objective and its gradient as two functions; at the same point it is evaluated once."""

    def __init__(self, objective: Callable[[Vector], tuple[float, Vector]]) -> None:
        self._objective = objective
        self._last: tuple[Vector, tuple[float, Vector]] | None = None

    def __call__(self, theta: Vector) -> tuple[float, Vector]:
        if self._last is None or not np.array_equal(theta, self._last[0]):
            self._last = theta.copy(), self._objective(theta)
        return self._last[1]

    def value(self, theta: Vector) -> float:
        """The objective."""
        return self(theta)[0]

    def gradient(self, theta: Vector) -> Vector:
        """Its gradient."""
        return self(theta)[1]

"""Variable projection: families that are linear in all their parameters but a few, the shapes.

At given shapes the coefficients follow from linear least squares, so that only the shapes are searched for:
on a coarse grid about their start first, then by Levenberg–Marquardt, in the logarithm of their size.

References: Golub, Pereyra (1973), SIAM J. Numer. Anal. 10, 413; Kaufman (1975), BIT 15, 49.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.weak import CUT, Regression

Array = NDArray[np.float64]
Make = Callable[[Float[Array, " P"]], Regression]
"""From parameters (coefficients, shapes) to the regression there."""

GRID = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Shapes are looked for at these multiples of their start."""
JOINT = 2
"""So many shapes at most are looked for together, more one after the other."""
STEPS = 50
"""Most Levenberg–Marquardt iterations."""
ENOUGH = 1e-12
"""They end when the sum of squares falls by less than this share."""


def solve(
    make: Make, start: Float[Array, " P"], known: Float[Array, " P"] | None = None
) -> Float[Array, " P"]:
    """All parameters by least squares.

    Args:
        make: the regression at given parameters.
        start: where the shapes are looked for; its coefficients do not matter.
        known: parameters that are held, NaN where they are to be found.
    """
    held = np.full(len(start), np.nan) if known is None else known
    start = np.where(np.isnan(held), start, held)
    regression = make(start)
    terms = regression.terms
    free = terms + np.flatnonzero(np.isnan(held[terms:]))
    if not len(free):
        return np.concatenate([regression.solve(known=held[:terms]), start[terms:]])
    problem = _Projected(make, start, held, terms, free)
    best = _grid(problem, len(free))
    last = np.inf
    for number, step in enumerate(levenberg_marquardt(best, problem.normal, problem.value)):
        best, gained, last = step.theta, last - step.value, step.value
        if number >= STEPS or gained <= ENOUGH * last:
            break
    return problem.parameters(best)


def _grid(problem: _Projected, count: int) -> Float[Array, " S"]:
    """The best of a grid about the start, in logarithms."""
    best, at = np.inf, np.zeros(count)
    together = [range(count)] if count <= JOINT else [[k] for k in range(count)]
    for axes in together:
        centre = at.copy()
        for factors in product(np.log(GRID), repeat=len(axes)):
            tau = centre.copy()
            tau[list(axes)] = factors
            if (value := problem.value(tau)) < best:
                best, at = value, tau
    return at


@dataclass(frozen=True)
class _Projected:
    """The least sum of squares as a function of τ, free shapes being start · exp τ."""

    make: Make
    start: Float[Array, " P"]
    known: Float[Array, " P"]
    terms: int
    free: NDArray[np.intp]

    def _at(self, tau: Float[Array, " S"]) -> tuple[Array, Regression]:
        p = self.start.copy()
        p[self.free] *= np.exp(tau)
        regression = self.make(p)
        p[: self.terms] = regression.solve(known=self.known[: self.terms])
        return p, regression

    def parameters(self, tau: Float[Array, " S"]) -> Float[Array, " P"]:
        """Coefficients and shapes."""
        return self._at(tau)[0]

    def value(self, tau: Float[Array, " S"]) -> float:
        """The sum of squares, not finite where a shape makes no sense."""
        with np.errstate(all="ignore"):
            try:
                p, regression = self._at(tau)
            except np.linalg.LinAlgError:
                return float("inf")
            return float(np.sum(regression.residual(p) ** 2))

    def normal(self, tau: Float[Array, " S"]) -> Normal:
        """The same with gradient and matrix; Kaufman's, the coefficients' share being projected out."""
        p, _ = self._at(tau)
        regression = self.make(p)
        columns = regression.columns.reshape(regression.force.size, -1)
        linear = columns[:, : self.terms][:, np.isnan(self.known[: self.terms])]
        size = np.linalg.norm(linear, axis=0)
        linear = linear / np.where(size > 0, size, 1)
        slopes = columns[:, self.free] * p[self.free]
        slopes = slopes - linear @ np.linalg.lstsq(linear, slopes, rcond=CUT)[0]
        rest = regression.residual(p).ravel()
        return Normal(float(rest @ rest), slopes.T @ rest, slopes.T @ slopes)

"""The factor L of a mass matrix M = LLᵀ that is known at samples, L linear in given functions of position.

The Cholesky factor of a matrix that is quadratic in the features is not linear in them (√(j + m sin²α) is
not), but a factor with more columns can be: [√j, √m sin α]. It is found by Levenberg–Marquardt in some
milliseconds, since nothing but M is fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt

Array = NDArray[np.float64]

CUT = 1e-10
"""Singular values of the functions below this share of the largest are gauges."""
PRECISE = 1e-12
"""The same for bases that are to hold the last digits."""
SAMPLES = 400
"""About so many samples are looked at, …"""
STEPS = 60
"""… in at most so many iterations."""
SPREAD = 1e-2
"""Size of the columns of L that are drawn at random, relative to the others: columns of 0 would stay 0."""


def fit_factor(
    mass: Float[Array, "B m m"], basis: Float[Array, "B k"], columns: int, random: np.random.Generator
) -> Float[Array, "m c k"]:
    """Coefficients of each entry of L on the basis, so that LLᵀ is M as well as may be.

    Args:
        mass: M at the samples, positive definite.
        basis: the functions of position there.
        columns: number of columns c of L, m at least.
        random: draws the columns that the Cholesky factor has not.
    """
    rows = slice(None, None, -(-len(basis) // SAMPLES))
    mass, basis = mass[rows], basis[rows]
    m = mass.shape[1]
    cholesky = np.linalg.cholesky(mass).reshape(-1, m**2)
    factor = np.zeros((m, columns, basis.shape[1]))
    factor[:, :m] = np.linalg.lstsq(basis, cholesky, rcond=CUT)[0].T.reshape(m, m, -1)
    size = np.linalg.norm(factor, axis=(1, 2))
    factor[:, m:] = SPREAD * size[:, None, None] * random.standard_normal(factor[:, m:].shape)
    fit = _Fit(mass, basis, columns)
    for _, step in zip(
        range(STEPS), levenberg_marquardt(factor.ravel(), fit.normal, fit.value), strict=False
    ):
        best = step.theta
        if step.value < np.finfo(float).eps ** 2:
            break
    return best.reshape(factor.shape)


def fit_cholesky(
    mass: Float[Array, "B m m"],
    change: Float[Array, "B m m nz"],
    basis: Float[Array, "B k"],
    slopes: Float[Array, "B k nz"],
) -> Float[Array, "m m k"]:
    """Coefficients of each entry of M's Cholesky factor on a basis rich enough to hold it, with derivatives.

    Forces hold derivatives of M: a fit to M alone, however close, could waver between the samples.

    Args:
        mass: M at the samples, positive definite.
        change: ∂M/∂z.
        basis: the functions of position there.
        slopes: their derivatives with respect to z.

    References: Murray (2016), arXiv:1602.07527, eq. 8 (derivative of a Cholesky factor).
    """
    m = mass.shape[1]
    factor = np.linalg.cholesky(mass)
    inverse = np.linalg.inv(factor)[:, None]
    moved = inverse @ np.moveaxis(change, -1, 1) @ inverse.swapaxes(-1, -2)  # (B, nz, m, m)
    moved = factor[:, None] @ (np.tril(moved) - np.eye(m) * moved / 2)
    rows = np.concatenate([basis, *np.moveaxis(slopes, -1, 0)])
    right = np.concatenate([factor, *moved.swapaxes(0, 1)]).reshape(-1, m**2)
    size = np.linalg.norm(rows, axis=0)
    size[size == 0] = 1
    found = np.linalg.lstsq(rows / size, right, rcond=PRECISE)[0] / size[:, None]
    return np.asarray(found.T.reshape(m, m, -1))


@dataclass(frozen=True)
class _Fit:
    """Mean square of (LLᵀ − M)_ij / √(m_i m_j), j ≤ i, m the mean of M, over the coefficients of L."""

    mass: Float[Array, "B m m"]
    basis: Float[Array, "B k"]
    columns: int

    @cached_property
    def _unit(self) -> Float[Array, "m m"]:
        diagonal = np.diag(self.mass.mean(axis=0))
        unit: Array = np.sqrt(np.outer(diagonal, diagonal))
        return unit

    def _residual(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "B e"], Float[Array, "B m c"]]:
        m = self.mass.shape[1]
        factor = np.einsum("ick,bk->bic", theta.reshape(m, self.columns, -1), self.basis)
        gap = (factor @ factor.transpose(0, 2, 1) - self.mass) / self._unit
        lower: Array = gap[:, *np.tril_indices(m)]
        return lower, factor

    def value(self, theta: Float[Array, " P"]) -> float:
        """The objective alone."""
        with np.errstate(over="ignore", invalid="ignore"):  # a step too long is refused
            return float(np.mean(self._residual(theta)[0] ** 2))

    def normal(self, theta: Float[Array, " P"]) -> Normal:
        """The objective with gradient and Gauss–Newton matrix."""
        residual, factor = self._residual(theta)
        jacobian = np.zeros((*residual.shape, factor.shape[1], self.columns, self.basis.shape[1]))
        for entry, (i, j) in enumerate(zip(*np.tril_indices(factor.shape[1]), strict=True)):
            for one, other in ((i, j), (j, i)):
                slope = factor[:, other, :, None] * self.basis[:, None]
                jacobian[:, entry, one] += slope / self._unit[i, j]
        r, slopes = residual.ravel(), jacobian.reshape(residual.size, -1)
        return Normal(float(r @ r) / r.size, r @ slopes / r.size, slopes.T @ slopes / r.size)

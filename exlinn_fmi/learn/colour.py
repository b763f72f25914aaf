"""Noise that is correlated from row to row, and what it does to the covariance of parameters.

Least squares weighs rows as if their noise were white. Where it was filtered, or a sensor's own dynamics
shape it, the fit is still unbiased, but rows tell less than they seem to: the inverse of the Gauss–Newton
matrix H is too small. The covariance is H⁻¹ B H⁻¹ then, with B = Zᵀ R Z of the rows' influence Z on the
parameters and the autocovariance R of the noise. R is that of a vector autoregressive process fitted to the
residuals, its order by Schwarz's criterion; order 0 is white noise, for which B = H. Zᵀ R Z is summed over
frequencies, where R is block diagonal.

References: White (1982), Econometrica 50, 1 (H⁻¹ B H⁻¹); den Haan, Levin (1997), Handbook of Statistics 15,
    291 (autoregressive R); Lütkepohl (2005), New Introduction to Multiple Time Series Analysis, ch. 4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import NDArray

Array = NDArray[np.float64]

ORDERS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Orders that are tried, …"""
SPARE = 10
"""… as long as the longest series has so many rows for each coefficient."""
ROWS = 50_000
"""Most rows that the process is fitted to."""
FLOOR = 1e-5
"""White noise that is added, as a share of the variance: filters leave bands empty, no process does."""
CHUNK = 1 << 14
"""Rows that are transformed at once: correlation over longer times is not seen."""
FINE = 4096
"""Frequencies among which a peak is looked for."""


class Colour(NamedTuple):
    """A vector autoregressive process r_t = Σ A_k r_{t−k} + e_t.

    Args:
        coefficients: A_1 … A_K.
        innovation: covariance of e.
    """

    coefficients: Float[Array, "K n n"]
    innovation: Float[Array, "n n"]

    @property
    def order(self) -> int:
        """K, 0 for white noise."""
        return len(self.coefficients)

    def spectrum(
        self, frequencies: Float[Array, " F"]
    ) -> Complex[NDArray[np.complex128], "F n n"] | Float[Array, "F n n"]:
        """Spectral density Σ_l R_l e^(−iωl); that of white noise of variance 1 is 1.

        Args:
            frequencies: in cycles per row.
        """
        turns = np.exp(-2j * np.pi * np.outer(frequencies, 1 + np.arange(self.order)))
        transfer = np.linalg.inv(np.eye(len(self.innovation)) - np.tensordot(turns, self.coefficients, 1))
        return np.asarray(transfer @ self.innovation @ transfer.conj().transpose(0, 2, 1))

    @property
    def memory(self) -> float:
        """Rows over which the noise of the slowest channel stays alike: its spectrum's peak over its mean."""
        density = self.spectrum(np.linspace(0, 0.5, FINE)).real.diagonal(axis1=1, axis2=2)
        return float((density.max(axis=0) / density.mean(axis=0)).max())


def colour(series: Sequence[Array]) -> Colour:
    """Fit a process to residuals.

    Args:
        series: residuals (N, n) of each trajectory.
    """
    n = series[0].shape[1]
    before = np.cumsum([0, *map(len, series)])
    used = [part[: max(ROWS - first, 0)] for part, first in zip(series, before, strict=False)]
    most = max(map(len, used)) // (SPARE * n)
    deepest = max(order for order in ORDERS if order <= most)
    used = [part for part in used if len(part) > deepest]
    # The same rows are explained at every order, so that the criterion compares like with like.
    now = np.concatenate([part[deepest:] for part in used])
    past = np.concatenate([_past(part, deepest) for part in used])
    gram, cross, square = past.T @ past, past.T @ now, now.T @ now
    power = np.diag(square)
    floor = FLOOR * np.maximum(power, np.finfo(float).eps * (power.max() or 1.0))
    gram[np.diag_indices_from(gram)] += np.tile(floor, deepest)
    square[np.diag_indices_from(square)] += floor
    best, found = np.inf, Colour(np.zeros((0, n, n)), np.diag(np.diag(square) / len(now)))
    for order in (order for order in ORDERS if order <= deepest):
        size = order * n
        a = np.linalg.solve(gram[:size, :size], cross[:size])
        rest = (square - cross[:size].T @ a) / len(now)
        innovation = rest if order else np.diag(np.diag(rest))
        score = len(now) * np.linalg.slogdet(innovation)[1] + size * n * np.log(len(now))
        if score < best:
            best, found = score, Colour(a.T.reshape(n, order, n).transpose(1, 0, 2), innovation)
    return found


def _past(part: Float[Array, "N n"], order: int) -> Float[Array, "rows columns"]:
    """The rows before each row from `order` on, the last one first."""
    shifted = [part[order - k : len(part) - k] for k in range(1, order + 1)]
    return np.hstack([np.zeros((len(part) - order, 0)), *shifted])


def spread_of(noise: Colour, influence: Sequence[Array]) -> Float[Array, "P P"]:
    """Zᵀ R Z: how much the noise moves the gradient.

    Args:
        noise: of the rows.
        influence: Z (N, n, P) of each trajectory.
    """
    count = influence[0].shape[2]
    total = np.zeros((count, count))
    for part in influence:
        for first in range(0, len(part), CHUNK):
            z = part[first : first + CHUNK]
            points = 2 * len(z)
            f = np.fft.rfft(z, points, axis=0)
            shaped = noise.spectrum(np.arange(len(f)) / points) @ f
            weight = np.full(len(f), 2.0)
            weight[[0, -1]] = 1.0  # all others stand for their negative, too
            product = np.tensordot(f.conj() * weight[:, None, None], shaped, ((0, 1), (0, 1)))
            total += product.real / points
    return total

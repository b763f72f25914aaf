"""From a signal for some quantity to the trajectory of a coordinate, with derivatives that survive jumps.

**Derivatives.** The signal is sampled on a grid, and nine neighbouring samples carry a polynomial of
degree 8 that is differentiated exactly. Three sets of neighbours are in question at every point: those on
both sides, those up to it, and those from it on. The centred set serves unless another one is very much
smoother (as in essentially non-oscillatory interpolation), so that next to a jump or a kink only samples
from one side of it are used. Where no set is smooth (kinks all over: a coarse table), a parabola fitted
to the neighbourhood gives velocity and acceleration, and higher derivatives are 0; where not even a
parabola fits (jumps all over), all are 0 and the reference is a sequence of rests.

Reference: A. Harten, B. Engquist, S. Osher, S. Chakravarthy, Uniformly high order accurate essentially
non-oscillatory schemes III, J. Comput. Phys. 71 (1987).
"""

from __future__ import annotations

from fractions import Fraction
from math import acos, factorial, floor, pi

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.scenario.control import Linear, ScotchYoke

DEGREE = 8
REACH = DEGREE
"""Number of samples that are needed before and after the points where derivatives are wanted."""

BIAS = 100.0
"""How much smoother a one-sided set has to be before it is taken instead of the centred one."""

SMOOTH = 1e-3
"""Largest last difference, as a share of the range of the samples, of what counts as smooth."""

PARABOLIC = 0.1
"""Largest misfit, as a share of the range of the samples, of a parabola that is still believed."""


def branch_of(through: ScotchYoke | Linear | None, coordinate: float) -> int:
    """Which of the branches on which the kinematics can be inverted a coordinate lies on.

    Args:
        through: the kinematics.
        coordinate: measured coordinate.

    Returns:
        For a scotch yoke k with kπ ≤ α < (k+1)π; else 0.
    """
    return floor(coordinate / pi) if isinstance(through, ScotchYoke) else 0


def coordinate_of(
    through: ScotchYoke | Linear | None, quantity: Float[np.ndarray, " k"], branch: int
) -> Float[np.ndarray, " k"]:
    """The coordinate that makes the trajectory's quantity, on one branch and hence without a jump.

    Args:
        through: the kinematics.
        quantity: values y, shape (k,); what is out of reach is clipped to the stroke less its margin.
        branch: from `branch_of`.
    """
    if isinstance(through, ScotchYoke):
        # x = d cos α has one solution in each [kπ, (k+1)π]; cos(kπ + β) = ± cos β.
        reach = 1.0 - through.margin
        ratio = np.clip(quantity / through.crank, -reach, reach)
        # One by one: numpy's own arccos may differ in the last digit, which differentiation magnifies.
        angles = [acos(r) for r in (ratio if branch % 2 == 0 else -ratio).tolist()]
        return branch * pi + np.array(angles)
    if isinstance(through, Linear):
        line: NDArray[np.float64] = (quantity - through.offset) / through.gain
        return line
    return quantity


def derivatives(samples: Float[np.ndarray, " k"], spacing: float, orders: int) -> Float[np.ndarray, "o m"]:
    """Value and derivatives of a sampled signal, robust where it jumps (see the head of this file).

    Args:
        samples: values at equally spaced times, shape (m + 2·REACH,).
        spacing: distance of the samples [s].
        orders: highest derivative, at most 4.

    Returns:
        Shape (orders + 1, m): row p is the p-th derivative at each of the m inner samples.
    """
    windows = np.lib.stride_tricks.sliding_window_view(samples, DEGREE + 1)  # (m + 8, 9), first sample k − 8
    m = len(samples) - 2 * REACH
    centre, sides = REACH // 2, (0, REACH)
    value = samples[REACH : REACH + m]
    # The last difference does not depend on the origin. It is summed sample by sample: where it is rounding
    # and no more, other code chooses alike only if it rounds alike.
    last = np.abs(sum(windows[:, s] * KERNELS[centre][DEGREE, s] for s in range(DEGREE + 1)))
    choice = np.full(m, centre)
    best = last[centre : centre + m].copy()
    for offset in sides:
        rough = last[offset : offset + m]
        better = BIAS * rough < best
        choice[better], best[better] = offset, rough[better]
    # Less its own value, a sample's rounding is all that is left of a constant.
    chosen = windows[choice + np.arange(m)] - value[:, None]
    span = np.ptp(chosen, axis=1)
    floor_ = 1e-12 * (1.0 + np.abs(value))
    smooth = best <= SMOOTH * span + floor_

    result = np.zeros((orders + 1, m))
    result[0] = value
    kernels = np.array([KERNELS[REACH - offset] for offset in range(REACH + 1)])[:, 1 : orders + 1]
    # In a set that begins `offset` windows after the leftmost, the point itself is sample 8 − offset.
    weights, own = kernels[choice[smooth]], chosen[smooth]
    result[1:, smooth] = sum(weights[:, :, s].T * own[:, s] for s in range(DEGREE + 1))
    if not smooth.all():
        rough = ~smooth
        around = windows[centre : centre + m][rough]
        fit = around @ PARABOLA.T  # (k, 3): value, velocity, acceleration
        misfit = np.abs(fit @ _BASIS_OFPARABOLA.T - around).max(axis=1)
        fit[misfit > PARABOLIC * np.ptp(around, axis=1)] = 0.0
        kept = min(orders, 2)
        result[1 : kept + 1, rough] = fit.T[1 : kept + 1]
    return result / spacing ** np.arange(orders + 1.0)[:, None]


def integral(
    rate: Float[np.ndarray, " m"], slope: Float[np.ndarray, " m"], spacing: float
) -> Float[np.ndarray, " m"]:
    """Running integral from the first sample on, by the trapezoidal rule corrected with end slopes (order 4).

    Args:
        rate: integrand at equally spaced times.
        slope: its derivative there.
        spacing: distance of the samples [s].
    """
    pieces = spacing / 2 * (rate[:-1] + rate[1:]) + spacing**2 / 12 * (slope[:-1] - slope[1:])
    return np.concatenate([[0.0], np.cumsum(pieces)])


def _interpolation_kernel(position: int) -> NDArray[np.float64]:
    """Weights (p, sample) of the p-th derivative at sample `position` of the polynomial through nine samples.

    In exact arithmetic: rounded weights would not cancel a constant, which division by spacing^p amplifies.
    """
    points = [Fraction(s - position) for s in range(DEGREE + 1)]
    kernel = np.zeros((DEGREE + 1, DEGREE + 1))
    for i, own in enumerate(points):
        basis = [Fraction(1)]  # Lagrange polynomial of this sample, lowest power first
        for j, other in enumerate(points):
            if j != i:
                shifted, scaled = [Fraction(0), *basis], [*(-other * b for b in basis), Fraction(0)]
                basis = [(a + b) / (own - other) for a, b in zip(shifted, scaled, strict=True)]
        kernel[:, i] = [float(b * factorial(p)) for p, b in enumerate(basis)]
    return kernel


KERNELS = [_interpolation_kernel(position) for position in range(DEGREE + 1)]
"""For each sample of nine, the weights (p, sample) of the derivatives there."""
_BASIS_OFPARABOLA = np.array([[1.0, s, s**2 / 2] for s in range(-DEGREE // 2, DEGREE // 2 + 1)])
PARABOLA = np.linalg.pinv(_BASIS_OFPARABOLA)

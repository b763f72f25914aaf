"""Units in which an optimal control problem is well conditioned, whatever the units of the model.

A plate that moves by micrometres under kilovolts has a cost whose second derivatives span sixteen decades.
Where each state and each input is counted in what costs about one, they do not. All units are powers of two,
so that changing to them and back rounds nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from exlinn_fmi.control.qp import QpSolution, QpSolver, StageQp

SPREAD = 1e8
"""Ratio of the curvatures of two states up to which the model's own units do."""


def units(
    H_end: Float[np.ndarray, "n n"], H_u: Float[np.ndarray, "m m"], B: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"]]:
    """Units of states and inputs that cost about one; 1 throughout where that is nothing gained.

    Args:
        H_end: second derivative of the terminal cost.
        H_u: second derivative of the cost of the inputs.
        B: derivative of a state by the input before it.
    """
    curvature = np.diagonal(H_end)
    seen = curvature[np.isfinite(curvature) & (curvature > 0.0)]
    if not seen.size or seen.max() <= SPREAD * seen.min():
        return np.ones(len(H_end)), np.ones(len(H_u))
    with np.errstate(over="ignore", invalid="ignore"):  # such a curvature is not usable
        by_input = np.diagonal(H_u + B.T @ H_end @ B)
    return _power_of_two(curvature), _power_of_two(by_input)


def _power_of_two(curvature: Float[np.ndarray, " k"]) -> NDArray[np.float64]:
    """1/√curvature to a power of two; 1 where there is none."""
    usable = np.isfinite(curvature) & (curvature > 0.0)
    exponent = np.rint(-0.5 * np.log2(np.where(usable, curvature, 1.0)))
    unit: NDArray[np.float64] = np.exp2(exponent)
    return unit


class ScaledQp(QpSolver):
    """Solves quadratic programs in units in which they are well conditioned.

    Args:
        inner: the solver.
        soft: indices of the softened states, shape (s,).
    """

    def __init__(self, inner: QpSolver, soft: Int[np.ndarray, " s"]) -> None:
        self.inner, self._soft = inner, soft

    def solve(self, qp: StageQp) -> QpSolution:
        """Solve."""
        x, u = units(qp.H_end, qp.H_u, qp.B[-1])
        rated = qp.rate_low is not None and qp.rate_high is not None
        if rated:  # the last inputs, which stand among the states, are counted as the inputs are
            x[-len(u) :] = u
        s, column = x[self._soft], x[:, None]
        scaled = replace(
            qp,
            A=qp.A * x / column,
            B=qp.B * u / column,
            c=qp.c / x,
            dx0=qp.dx0 / x,
            H_x=qp.H_x * x * column,
            H_end=qp.H_end * x * column,
            H_u=qp.H_u * u * u[:, None],
            g=qp.g * x,
            r=qp.r * u,
            u_low=qp.u_low / u,
            u_high=qp.u_high / u,
            low=qp.low / s,
            high=qp.high / s,
            l1=qp.l1 * s,
            l2=qp.l2 * s**2,
            rate_low=qp.rate_low / u if rated else None,
            rate_high=qp.rate_high / u if rated else None,
        )
        found = self.inner.solve(scaled)
        return replace(found, dx=found.dx * x, du=found.du * u, slack=found.slack * s)

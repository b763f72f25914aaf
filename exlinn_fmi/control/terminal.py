"""The terminal set: where the linear feedback of the Riccati equation can take over within all bounds.

Within Ω = {e: eᵀPe ≤ α}, e = x − x*, the feedback u = u* + K e keeps every bound of the linearised system,
and eᵀPe falls by the stage cost: the plan that ends in Ω can be gone on with for ever.

References:
    D. Limon, T. Alamo, F. Salas, E. Camacho, On the stability of constrained MPC without terminal constraint,
    IEEE Trans. Automatic Control 51 (2006): the terminal cost times λ ≥ 1 takes the place of the constraint.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

FLAT = 1e-12
"""Share of its diagonal that is added to P: a bound along which P is singular then leaves no set."""

EVERYWHERE = 1e300
"""α where no bound limits the set."""


def terminal_level(
    A: Float[np.ndarray, "n n"],
    B: Float[np.ndarray, "n m"],
    R: Float[np.ndarray, "m m"],
    P: Float[np.ndarray, "n n"],
    u_room: Float[np.ndarray, " m"],
    soft: Int[np.ndarray, " s"],
    x_room: Float[np.ndarray, " s"],
) -> float:
    """The largest α for which Ω keeps the inputs of the linear feedback, and the states, within bounds.

    The largest aᵀe within Ω is √(α aᵀP⁻¹a): each bound |aᵀe| ≤ d allows α ≤ d² / aᵀP⁻¹a.

    Args:
        A: state matrix at the reference's end.
        B: input matrix there.
        R: weight of the inputs, positive definite.
        P: solution of the Riccati equation.
        u_room: distance of u* from the nearer of its bounds, shape (m,); ∞ where there is none.
        soft: indices of the states that are bounded, shape (s,).
        x_room: distance of x* from the nearer of their bounds, shape (s,).

    Returns:
        0 where a reference lies on a bound or P is not positive semidefinite, `EVERYWHERE` where no bound
        limits the set.
    """
    PB = P @ B
    K = np.linalg.solve(R + B.T @ PB, PB.T @ A)  # the sign does not matter here
    rows, room = np.vstack([K, np.eye(len(A))[soft]]), np.concatenate([u_room, x_room])
    curvature = np.diagonal(P)
    unit = 1.0 / np.sqrt(np.where(curvature > 0.0, curvature, 1.0))
    scaled = unit * P * unit[:, None] + FLAT * np.eye(len(A))
    try:
        spread = np.sum(np.linalg.solve(np.linalg.cholesky(scaled), (rows * unit).T) ** 2, axis=0)
    except np.linalg.LinAlgError:
        return 0.0
    limits = np.isfinite(room) & (spread > 0.0)
    return float(min(EVERYWHERE, (room[limits] ** 2 / spread[limits]).min(initial=np.inf)))

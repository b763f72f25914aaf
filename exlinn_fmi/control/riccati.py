"""The discrete algebraic Riccati equation, for terminal costs, without a library call that may raise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

ITERATIONS = 60


def solve_dare(
    A: Float[np.ndarray, "n n"],
    B: Float[np.ndarray, "n m"],
    Q: Float[np.ndarray, "n n"],
    R: Float[np.ndarray, "m m"],
) -> Float[np.ndarray, "n n"] | None:
    """The stabilising P = Q + AᵀPA − AᵀPB(R + BᵀPB)⁻¹BᵀPA, symmetric and positive semidefinite.

    Args:
        A: state matrix.
        B: input matrix.
        Q: weight of the states.
        R: weight of the inputs, positive definite.

    Returns:
        P, or None where the iteration does not converge (as for a mode that no input reaches).

    References:
        Structured doubling: E. Chu, H. Fan, W. Lin, C. Wang, Structure-preserving algorithms for periodic
        discrete-time algebraic Riccati equations, Int. J. Control 77 (2004). Quadratic convergence.
    """
    identity = np.eye(len(A))
    try:
        G = B @ np.linalg.solve(R, B.T)
        P = Q
        with np.errstate(all="ignore"):
            for _ in range(ITERATIONS):
                W = np.linalg.inv(identity + G @ P)
                AW = A @ W
                following = P + A.T @ P @ W @ A
                G = G + AW @ G @ A.T
                A = AW @ A
                change, P = np.abs(following - P).max(), (following + following.T) / 2
                G = (G + G.T) / 2
                if not np.isfinite(P).all():
                    return None
                if change <= 1e-13 * np.abs(P).max():
                    return P if np.linalg.eigvalsh(P)[0] >= -1e-9 * np.abs(P).max() else None
    except np.linalg.LinAlgError:
        pass
    return None

"""Smooth friction: functions for Rayleigh's D that behave at any velocity and under differentiation."""

from __future__ import annotations

import casadi as ca
import numpy as np

from exlinn_fmi.mechanics.euler_lagrange import Symbol


def log_cosh(x: Symbol) -> Symbol:
    """Log cosh x, without overflow: about x²/2 near 0 and |x| − log 2 far from it; its derivative is tanh x.

    D = F_c s · log cosh(v/s) is Coulomb friction of force F_c, smoothed over velocities of about s.
    """
    # |x| with a sign that AD takes for constant, so that the second derivative at 0 is 1 and not 0.
    size = x * (2 * (x >= 0) - 1)
    return size + ca.log1p(ca.exp(-2 * size)) - np.log(2)


def stribeck(x: Symbol) -> Symbol:
    """1 − exp(−x²/2): its derivative x exp(−x²/2) rises to a peak at x = 1 and is gone beyond x = 4.

    D = F s · stribeck(v/s) is what friction has at low speeds and loses at higher ones, beside Coulomb's. It
    dissipates at any speed, v ∂D/∂v ≥ 0, but is not convex: the force falls beyond the peak.
    """
    return 1 - ca.exp(-(x**2) / 2)

"""A system that is known, as a function of the physical parameters that are to be found in it."""

from __future__ import annotations

import casadi as ca

from exlinn_fmi.mechanics.coordinates import Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.monomials import MonomialBasis


def family(
    base: LagrangianSystem, basis: MonomialBasis, parameters: tuple[Parameter, ...]
) -> LagrangianSystem:
    """A known system, with 𝓛 + 𝓛ᵇ(p) − 𝓛ᵇ(p⁰) and D + Dᵇ(p) − Dᵇ(p⁰), b of a basis: at p⁰ it is what it was.

    So that a model that was learned, with networks or not, moves as it was learned, and still is a function
    of the physical parameters that are to be found.

    Args:
        base: the system; parameters of its own have the values that it states.
        basis: its parameters are those to be found.
        parameters: their names and values p⁰.
    """
    own, known = ca.DM(base.parameter_values), ca.DM([p.value for p in parameters])
    moved = basis.system()
    return LagrangianSystem.build(
        base.coordinates,
        lambda q, v, p: (
            base.lagrangian(q, v, own) + moved.lagrangian(q, v, p) - moved.lagrangian(q, v, known)
        ),
        lambda v, p: base.dissipation(v, own) + moved.dissipation(v, p) - moved.dissipation(v, known),
        parameters,
    )

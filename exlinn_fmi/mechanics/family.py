"""A system that is known, as a function of the physical parameters that are to be found in it."""

from __future__ import annotations

import casadi as ca

from exlinn_fmi.mechanics.coordinates import Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol
from exlinn_fmi.mechanics.monomials import MonomialBasis


def family(
    base: LagrangianSystem, basis: MonomialBasis, parameters: tuple[Parameter, ...]
) -> LagrangianSystem:
    """A known system, with 𝓛 + Σ (p_k − p⁰_k) φ_k and D + Σ (p_k − p⁰_k) ψ_k: at p⁰ it is what it was.

    So that a model that was learned, with networks or not, moves as it was learned, and still is a function
    of the physical parameters that are to be found.

    Args:
        base: the system; parameters of its own have the values that it states.
        basis: monomials φ and ψ, whose factors are the parameters.
        parameters: names and values p⁰.
    """
    count, own = len(basis.lagrangian), ca.DM(base.parameter_values)

    def moved(p: Symbol, terms: Symbol, first: int) -> Symbol:
        known = [parameter.value for parameter in parameters[first:]]
        return sum(((p[first + k] - known[k]) * terms[k] for k in range(terms.shape[0])), start=ca.SX(0))

    return LagrangianSystem.build(
        base.coordinates,
        lambda q, v, p: base.lagrangian(q, v, own) + moved(p, basis.expressions(q, v)[0], 0),
        lambda v, p: base.dissipation(v, own) + moved(p, basis.expressions(0 * v, v)[1], count),
        parameters,
    )

"""Monomials such as ``0.5*sin(alpha)^2*alpha_dot^2``: how a user names features and physical parameters.

Grammar: ``[number*]factor(*factor)*`` with factor = ``name`` | ``function(argument)``, each with optional
``^integer``; function = ``sin`` | ``cos`` | ``abs`` | ``logcosh`` | ``stribeck`` | ``T1`` … ``T9``
(Chebyshev), argument = ``[number*]name[±number]``. The same text serves as a feature of the paper's networks,
as a term of 𝓛 or D that a parameter multiplies, and as a product of parameters (``m_c*d^2``).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import compress
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol
from exlinn_fmi.mechanics.friction import log_cosh, stribeck

_DIGITS = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_NUMBER = re.compile(rf"[+-]?{_DIGITS}")
_FACTOR = re.compile(
    rf"(?:(?P<function>sin|cos|abs|logcosh|stribeck|T[1-9])\((?:(?P<scale>[+-]?{_DIGITS})\*)?(?P<argument>[A-Za-z_]\w*)"
    rf"(?P<shift>[+-]{_DIGITS})?\)|(?P<name>[A-Za-z_]\w*))(?:\^(?P<power>-?\d+))?"
)
_TIMES = re.compile(r"\*(?![^(]*\))")


@dataclass(frozen=True)
class Factor:
    """One factor of a monomial: function(scale·name + shift)^power; without a function, name^power."""

    name: str
    function: str = ""
    power: int = 1
    scale: float = 1.0
    shift: float = 0.0

    def base(self, value: Any) -> Any:
        """What is raised to the power, at a value of the name."""
        at = value if (self.scale, self.shift) == (1, 0) else self.scale * value + self.shift
        match self.function:
            case "":
                return value
            case "sin":
                return ca.sin(at)
            case "cos":
                return ca.cos(at)
            case "abs":
                return ca.fabs(at)
            case "logcosh":
                return log_cosh(at)
            case "stribeck":
                return stribeck(at)
        before, now = 1, at  # T_{k+1} = 2x T_k − T_{k−1}
        for _ in range(int(self.function[1:]) - 1):
            before, now = now, 2 * at * now - before
        return now


@dataclass(frozen=True)
class Monomial:
    """coefficient · Π factors."""

    coefficient: float
    factors: tuple[Factor, ...]

    def evaluate(self, values: Mapping[str, Any]) -> Any:
        """The monomial's value or expression.

        Args:
            values: number or CasADi symbol by name; every name of the monomial is there.
        """
        product: Any = self.coefficient
        for factor in self.factors:
            product = product * factor.base(values[factor.name]) ** factor.power
        return product


def parse_monomial(text: str, names: Collection[str]) -> Monomial:
    """Read a monomial.

    Args:
        text: e.g. ``0.5*sin(alpha)^2*alpha_dot^2``; blanks do not matter.
        names: the names that may occur.

    Raises:
        ModelError: the text does not follow the grammar, or a name is not among `names`.
    """
    parts = _TIMES.split("".join(text.split()))
    number = _NUMBER.fullmatch(parts[0])
    factors = []
    for part in parts[1:] if number else parts:
        match = _FACTOR.fullmatch(part)
        if match is None:
            raise ModelError(
                f"monomial {text!r}: {part or 'nothing'!r} is not a factor; expected [number*]factor*factor… "
                "with factor = name, sin(name), cos(name), abs(name), logcosh(name) or stribeck(name), each "
                "with an optional ^integer"
            )
        name = match["argument"] or match["name"]
        if name not in names:
            raise ModelError(f"monomial {text!r}: unknown name {name!r}; {_suggest(name, names)}")
        function, power = match["function"] or "", int(match["power"] or 1)
        factors.append(Factor(name, function, power, float(match["scale"] or 1), float(match["shift"] or 0)))
    if not factors:
        raise ModelError(f"monomial {text!r}: expected at least one name, found only a number")
    return Monomial(float(parts[0]) if number else 1.0, tuple(factors))


def parse_term(text: str, coordinates: tuple[Coordinate, ...], dissipation: bool = False) -> Monomial:
    """Read a term of 𝓛 or D.

    A cyclic position may stand alone, times a number: then its coefficient is a constant force on it.

    Args:
        text: the monomial.
        coordinates: the generalised coordinates, whose names may occur.
        dissipation: whether it is a term of D, where only velocities may.

    Raises:
        ModelError: the text does not follow the grammar, or a name may not occur.
    """
    velocities = [c.velocity for c in coordinates]
    if dissipation:
        return parse_monomial(text, velocities)
    parts = "".join(text.split()).split("*")
    alone = [c.name for c in coordinates if c.name == parts[-1] and not any(map(_FACTOR.match, parts[:-1]))]
    positions = [c.name for c in coordinates if c.topology != "cyclic"]
    return parse_monomial(text, [*positions, *alone, *velocities])


def _suggest(name: str, names: Collection[str]) -> str:
    """What the user may have meant."""
    near = difflib.get_close_matches(name, names, n=1)
    known = f"known names: {', '.join(sorted(names))}" if names else "no name is known here"
    return f"did you mean {near[0]!r}? ({known})" if near else known


@dataclass(frozen=True)
class MonomialBasis:
    """Functions φ_k(q, q̇) for 𝓛 and ψ_k(q̇) for D, given as monomials, with their Euler–Lagrange operators.

    Args:
        coordinates: the generalised coordinates.
        lagrangian: monomials φ in names of positions (cyclic ones excepted) and velocities.
        dissipation: monomials ψ in names of velocities.

    Raises:
        ModelError: a monomial cannot be read.
    """

    coordinates: tuple[Coordinate, ...]
    lagrangian: tuple[str, ...]
    dissipation: tuple[str, ...]

    def __post_init__(self) -> None:
        self._monomials()

    def _monomials(self) -> tuple[list[Monomial], list[Monomial]]:
        return (
            [parse_term(text, self.coordinates) for text in self.lagrangian],
            [parse_term(text, self.coordinates, dissipation=True) for text in self.dissipation],
        )

    def expressions(self, q: Symbol, v: Symbol) -> tuple[Symbol, Symbol]:
        """CasADi columns φ(q, v) and ψ(v)."""
        values = {c.name: q[i] for i, c in enumerate(self.coordinates)}
        values |= {c.velocity: v[i] for i, c in enumerate(self.coordinates)}
        phi, psi = ([m.evaluate(values) for m in monomials] for monomials in self._monomials())
        return ca.vertcat(ca.SX(0, 1), *phi), ca.vertcat(ca.SX(0, 1), *psi)

    def values(self) -> ca.Function:
        """(q, v) → all φ, then all ψ."""
        q, v = ca.SX.sym("q", len(self.coordinates)), ca.SX.sym("v", len(self.coordinates))
        return ca.Function("basis", [q, v], [ca.densify(ca.vertcat(*self.expressions(q, v)))])

    @property
    def size(self) -> int:
        """Number of terms K of 𝓛 and D together."""
        return len(self.lagrangian) + len(self.dissipation)

    @property
    def terms(self) -> tuple[str, ...]:
        """All terms in the order of the parameters."""
        return self.lagrangian + self.dissipation

    def only(self, chosen: NDArray[np.bool_]) -> MonomialBasis:
        """The basis of some of the terms.

        Args:
            chosen: which, in the order of `terms`.
        """
        count = len(self.lagrangian)
        return MonomialBasis(
            self.coordinates,
            tuple(compress(self.lagrangian, chosen[:count])),
            tuple(compress(self.dissipation, chosen[count:])),
        )

    def system(self) -> LagrangianSystem:
        """The family 𝓛 = Σ p_k φ_k, D = Σ p_k ψ_k, with parameters p in that order, 1 by default."""
        count = len(self.lagrangian)

        def weighted(p: Symbol, terms: Symbol, first: int) -> Symbol:
            return sum((p[first + k] * terms[k] for k in range(terms.shape[0])), start=ca.SX(0))

        return LagrangianSystem.build(
            self.coordinates,
            lambda q, v, p: weighted(p, self.expressions(q, v)[0], 0),
            lambda v, p: weighted(p, self.expressions(0 * v, v)[1], count),
            tuple(Parameter(f"p{k}", 1.0, "") for k in range(self.size)),
        )

    def regressor(self) -> ca.Function:
        """(q, v, a) → columns d/dt ∂φ_k/∂q̇ − ∂φ_k/∂q, then ∂ψ_k/∂q̇, shape (n, K): F = columns · p by (17)."""
        q, v, a = (ca.SX.sym(name, len(self.coordinates)) for name in "qva")
        p = ca.SX.sym("p", self.size)
        columns = ca.jacobian(self.system().inverse(q, v, a, p), p)
        return ca.Function("regressor", [q, v, a], [ca.densify(columns)])

    def momenta(self) -> ca.Function:
        """(q, v) → columns ∂φ_k/∂q̇, shape (n, K), 0 for D: F = d/dt(momenta · p) + rest · p."""
        return self._parts()[0]

    def rest(self) -> ca.Function:
        """(q, v) → columns −∂φ_k/∂q, then ∂ψ_k/∂q̇, shape (n, K): what needs no derivative in time."""
        return self._parts()[1]

    def _parts(self) -> tuple[ca.Function, ca.Function]:
        q, v = (ca.SX.sym(name, len(self.coordinates)) for name in "qv")
        phi, psi = self.expressions(q, v)
        momenta = ca.vertcat(ca.jacobian(phi, v), ca.SX.zeros(psi.shape[0], q.shape[0])).T
        rest = ca.vertcat(-ca.jacobian(phi, q), ca.jacobian(psi, v)).T
        return (
            ca.Function("momenta", [q, v], [ca.densify(momenta)]),
            ca.Function("rest", [q, v], [ca.densify(rest)]),
        )

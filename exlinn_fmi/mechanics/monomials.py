"""Monomials such as ``0.5*sin(alpha)^2*alpha_dot^2``: how a user names features and physical parameters.

Grammar: ``[number*]factor(*factor)*`` with factor = ``name`` | ``sin(name)`` | ``cos(name)``, each with an
optional ``^integer``. The same text serves as a feature of the paper's networks, as a term of 𝓛 or D that a
parameter multiplies, and as a product of parameters (``m_c*d^2``).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_FACTOR = re.compile(
    r"(?:(?P<function>sin|cos)\((?P<argument>[A-Za-z_]\w*)\)|(?P<name>[A-Za-z_]\w*))(?:\^(?P<power>-?\d+))?"
)


Function = Literal["", "sin", "cos"]
_FUNCTIONS: dict[str | None, Function] = {None: "", "sin": "sin", "cos": "cos"}


@dataclass(frozen=True)
class Factor:
    """One factor of a monomial: function(name)^power, the function being none, sin or cos."""

    name: str
    function: Function = ""
    power: int = 1


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
            base = values[factor.name]
            if factor.function:
                base = ca.sin(base) if factor.function == "sin" else ca.cos(base)
            product = product * base**factor.power
        return product


def parse_monomial(text: str, names: Collection[str]) -> Monomial:
    """Read a monomial.

    Args:
        text: e.g. ``0.5*sin(alpha)^2*alpha_dot^2``; blanks do not matter.
        names: the names that may occur.

    Raises:
        ModelError: the text does not follow the grammar, or a name is not among `names`.
    """
    parts = "".join(text.split()).split("*")
    number = _NUMBER.fullmatch(parts[0])
    factors = []
    for part in parts[1:] if number else parts:
        match = _FACTOR.fullmatch(part)
        if match is None:
            raise ModelError(
                f"monomial {text!r}: {part or 'nothing'!r} is not a factor; expected [number*]factor*factor… "
                "with factor = name, sin(name) or cos(name), each with an optional ^integer"
            )
        name = match["argument"] or match["name"]
        if name not in names:
            raise ModelError(f"monomial {text!r}: unknown name {name!r}; {_suggest(name, names)}")
        factors.append(Factor(name, _FUNCTIONS[match["function"]], int(match["power"] or 1)))
    if not factors:
        raise ModelError(f"monomial {text!r}: expected at least one name, found only a number")
    return Monomial(float(parts[0]) if number else 1.0, tuple(factors))


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
        velocities = [c.velocity for c in self.coordinates]
        names = [c.name for c in self.coordinates if c.topology != "cyclic"] + velocities
        return (
            [parse_monomial(text, names) for text in self.lagrangian],
            [parse_monomial(text, velocities) for text in self.dissipation],
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

    def regressor(self) -> ca.Function:
        """(q, v, a) → columns d/dt ∂φ_k/∂q̇ − ∂φ_k/∂q, then ∂ψ_k/∂q̇, shape (n, K): F = columns · p by (17)."""
        n, count = len(self.coordinates), len(self.lagrangian)
        parameters = tuple(Parameter(f"p{k}", 1.0, "") for k in range(count + len(self.dissipation)))
        q, v, a = (ca.SX.sym(name, n) for name in "qva")
        p = ca.SX.sym("p", len(parameters))
        phi, psi = self.expressions(q, v)
        system = LagrangianSystem(
            self.coordinates,
            ca.Function("L", [q, v, p], [sum((p[k] * phi[k] for k in range(count)), start=ca.SX(0))]),
            ca.Function(
                "D", [v, p], [sum((p[count + k] * psi[k] for k in range(psi.shape[0])), start=ca.SX(0))]
            ),
            parameters,
        )
        columns = ca.jacobian(system.inverse(q, v, a, p), p)
        return ca.Function("regressor", [q, v, a], [ca.densify(columns)])

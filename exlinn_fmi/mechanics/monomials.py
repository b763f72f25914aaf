"""Monomials such as ``0.5*sin(alpha)^2*alpha_dot^2``: how a user names features and physical parameters.

Grammar: ``[number*]factor(*factor)*`` with factor = ``name`` | ``function(argument)``, each with optional
``^integer``; argument = ``[number*]name[/shape][±number|±shape]``; function = ``sin`` | ``cos`` | ``abs`` |
``exp`` | ``logcosh`` | ``stribeck`` | ``lorentz``, 1/(1 + z²) | ``hyperbola``, 1/(1 + z) | ``T1`` … ``T9``
(Chebyshev). The same text serves as a feature of the paper's networks, as a term of 𝓛 or D that a parameter
multiplies, and as a product of parameters (``m_c*d^2``). A shape is a parameter inside a function, such as
the velocity s of ``s*logcosh(phi_dot/s)``: the term is not linear in it.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, compress
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
    rf"(?:(?P<function>sin|cos|abs|exp|logcosh|stribeck|lorentz|hyperbola|T[1-9])"
    rf"\((?:(?P<scale>[+-]?{_DIGITS})\*)?(?P<argument>[A-Za-z_]\w*)(?:/(?P<width>[A-Za-z_]\w*))?"
    rf"(?P<shift>[+-]{_DIGITS}|[+-][A-Za-z_]\w*)?\)|(?P<name>[A-Za-z_]\w*))(?:\^(?P<power>-?\d+))?"
)
_TIMES = re.compile(r"\*(?![^(]*\))")


@dataclass(frozen=True)
class Factor:
    """One factor: function(scale·name/width + shift)^power; without a function, name^power.

    Width and shift may be names of shapes; the shift then has a sign before it.
    """

    name: str
    function: str = ""
    power: int = 1
    scale: float = 1.0
    shift: float | str = 0.0
    width: str = ""

    @property
    def names(self) -> list[str]:
        """All names that occur."""
        shift = [self.shift[1:]] if isinstance(self.shift, str) else []
        return [self.name, *([self.width] if self.width else []), *shift]

    def argument(self, values: Mapping[str, Any]) -> Any:
        """What the function is taken of, at values of the names."""
        at = values[self.name]
        if self.scale != 1:
            at = self.scale * at
        if self.width:
            at = at / values[self.width]
        if isinstance(self.shift, str):
            return at + values[self.shift[1:]] * (1 if self.shift[0] == "+" else -1)
        return at + self.shift if self.shift else at

    def base(self, values: Mapping[str, Any]) -> Any:
        """What is raised to the power, at values of the names."""
        at = self.argument(values)
        match self.function:
            case "":
                return at
            case "sin":
                return ca.sin(at)
            case "cos":
                return ca.cos(at)
            case "abs":
                return ca.fabs(at)
            case "exp":
                return ca.exp(at)
            case "lorentz":
                return 1 / (1 + at**2)
            case "hyperbola":
                return 1 / (1 + at)
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
            product = product * factor.base(values) ** factor.power
        return product


def parse_monomial(text: str, names: Collection[str], shapes: Collection[str] = ()) -> Monomial:
    """Read a monomial.

    Args:
        text: e.g. ``0.5*sin(alpha)^2*alpha_dot^2``; blanks do not matter.
        names: the names that may occur.
        shapes: names that may occur as a factor, or inside a function as ``/shape`` or ``±shape``.

    Raises:
        ModelError: the text does not follow the grammar, or a name is not known.
    """
    parts = _TIMES.split("".join(text.split()))
    number = _NUMBER.fullmatch(parts[0])
    factors = []
    for part in parts[1:] if number else parts:
        match = _FACTOR.fullmatch(part)
        if match is None:
            raise ModelError(
                f"monomial {text!r}: {part or 'nothing'!r} is not a factor; expected [number*]factor*factor… "
                "with factor = name, sin(name), cos(name), abs(name), logcosh(name), … (docs/guide.md), each "
                "with an optional ^integer"
            )
        shift = match["shift"] or "0"
        factor = Factor(
            match["argument"] or match["name"],
            match["function"] or "",
            int(match["power"] or 1),
            float(match["scale"] or 1),
            float(shift) if _NUMBER.fullmatch(shift) else shift,
            match["width"] or "",
        )
        for name in factor.names[:1]:
            known = [*names, *(shapes if match["name"] else ())]
            if name not in known:
                raise ModelError(f"monomial {text!r}: unknown name {name!r}; {_suggest(name, known)}")
        for name in factor.names[1:]:
            if name not in shapes:
                raise ModelError(f"monomial {text!r}: {name!r} is no shape; {_suggest(name, shapes)}")
        factors.append(factor)
    if not factors:
        raise ModelError(f"monomial {text!r}: expected at least one name, found only a number")
    return Monomial(float(parts[0]) if number else 1.0, tuple(factors))


def parse_term(
    text: str,
    coordinates: tuple[Coordinate, ...],
    dissipation: bool = False,
    shapes: Collection[str] = (),
) -> Monomial:
    """Read a term of 𝓛 or D.

    A cyclic position may stand alone, times a number: then its coefficient is a constant force on it.

    Args:
        text: the monomial.
        coordinates: the generalised coordinates, whose names may occur.
        dissipation: whether it is a term of D, where only velocities may.
        shapes: names of parameters inside functions.

    Raises:
        ModelError: the text does not follow the grammar, or a name may not occur.
    """
    velocities = [c.velocity for c in coordinates]
    if dissipation:
        return parse_monomial(text, velocities, shapes)
    parts = "".join(text.split()).split("*")
    alone = [c.name for c in coordinates if c.name == parts[-1] and not any(map(_FACTOR.match, parts[:-1]))]
    positions = [c.name for c in coordinates if c.topology != "cyclic"]
    return parse_monomial(text, [*positions, *alone, *velocities], shapes)


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
        shapes: parameters inside functions, with the values that they have if not said otherwise.

    Raises:
        ModelError: a monomial cannot be read.
    """

    coordinates: tuple[Coordinate, ...]
    lagrangian: tuple[str, ...]
    dissipation: tuple[str, ...]
    shapes: tuple[Parameter, ...] = ()

    def __post_init__(self) -> None:
        self._monomials()

    def _monomials(self) -> tuple[list[Monomial], list[Monomial]]:
        shapes = [s.name for s in self.shapes]
        return (
            [parse_term(text, self.coordinates, False, shapes) for text in self.lagrangian],
            [parse_term(text, self.coordinates, True, shapes) for text in self.dissipation],
        )

    def expressions(self, q: Symbol, v: Symbol, p: Symbol | None = None) -> tuple[Symbol, Symbol]:
        """CasADi columns φ(q, v) and ψ(v), with the shapes in p if given."""
        values = {s.name: s.value if p is None else p[self.size + k] for k, s in enumerate(self.shapes)}
        values |= {c.name: q[i] for i, c in enumerate(self.coordinates)}
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

    @property
    def start(self) -> NDArray[np.float64]:
        """All parameters p: coefficients of the terms, here 1, then the shapes."""
        return np.array([1.0] * self.size + [s.value for s in self.shapes])

    @property
    def uses(self) -> NDArray[np.bool_]:
        """Which shapes each term holds, shape (terms, shapes)."""
        found = np.zeros((self.size, len(self.shapes)), dtype=bool)
        for k, monomial in enumerate(chain(*self._monomials())):
            names = {name for factor in monomial.factors for name in factor.names}
            found[k] = [s.name in names for s in self.shapes]
        return found

    def kept(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the parameters p belong to some of the terms.

        Args:
            chosen: which, in the order of `terms`.
        """
        return np.concatenate([chosen, self.uses[chosen].any(axis=0)])

    def at(self, p: NDArray[np.float64]) -> MonomialBasis:
        """The same basis with the shapes in p as their start."""
        values = p[self.size :].tolist()
        shapes = (replace(s, value=x) for s, x in zip(self.shapes, values, strict=True))
        return replace(self, shapes=tuple(shapes))

    def only(self, chosen: NDArray[np.bool_]) -> MonomialBasis:
        """The basis of some of the terms, and the shapes in them.

        Args:
            chosen: which, in the order of `terms`.
        """
        count = len(self.lagrangian)
        return MonomialBasis(
            self.coordinates,
            tuple(compress(self.lagrangian, chosen[:count])),
            tuple(compress(self.dissipation, chosen[count:])),
            tuple(compress(self.shapes, self.kept(chosen)[self.size :])),
        )

    def system(self) -> LagrangianSystem:
        """The family 𝓛 = Σ p_k φ_k, D = Σ p_k ψ_k; parameters: coefficients, 1 by default, and shapes."""
        count = len(self.lagrangian)

        def weighted(p: Symbol, terms: Symbol, first: int) -> Symbol:
            return sum((p[first + k] * terms[k] for k in range(terms.shape[0])), start=ca.SX(0))

        return LagrangianSystem.build(
            self.coordinates,
            lambda q, v, p: weighted(p, self.expressions(q, v, p)[0], 0),
            lambda v, p: weighted(p, self.expressions(0 * v, v, p)[1], count),
            (*(Parameter(f"p{k}", 1.0, "") for k in range(self.size)), *self.shapes),
        )

    @cached_property
    def regressor(self) -> ca.Function:
        """(q, v, a, p) → derivatives of the inverse model (17) by p, shape (n, parameters).

        For a coefficient that is d/dt ∂φ_k/∂q̇ − ∂φ_k/∂q, or ∂ψ_k/∂q̇, whatever the coefficients: without
        shapes F = columns · p.
        """
        q, v, a, p = self._symbols
        columns = ca.jacobian(self.system().inverse(q, v, a, p), p)
        return ca.Function("regressor", [q, v, a, p], [ca.densify(columns)])

    @cached_property
    def momenta(self) -> ca.Function:
        """(q, v, p) → derivatives of ∂𝓛/∂q̇ by p: F = d/dt(momenta · p) + rest · p without shapes."""
        q, v, _, p = self._symbols
        momentum = ca.gradient(self.system().lagrangian(q, v, p), v)
        return ca.Function("momenta", [q, v, p], [ca.densify(ca.jacobian(momentum, p))])

    @cached_property
    def rest(self) -> ca.Function:
        """(q, v, p) → derivatives of −∂𝓛/∂q + ∂D/∂q̇ by p: what needs no derivative in time."""
        (q, v, _, p), system = self._symbols, self.system()
        force = ca.gradient(system.dissipation(v, p), v) - ca.gradient(system.lagrangian(q, v, p), q)
        return ca.Function("rest", [q, v, p], [ca.densify(ca.jacobian(force, p))])

    @property
    def _symbols(self) -> tuple[Symbol, Symbol, Symbol, Symbol]:
        q, v, a = (ca.SX.sym(name, len(self.coordinates)) for name in "qva")
        return q, v, a, ca.SX.sym("p", self.size + len(self.shapes))

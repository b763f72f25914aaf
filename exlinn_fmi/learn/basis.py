"""A generic family 𝓛 = Σ p_k φ_k, D = Σ p_k ψ_k from kinds and topologies of the coordinates alone.

𝓛 = ½ q̇ᵀM(q)q̇ + (Kq + A(q))ᵀq̇ − V(q), M apart for mechanical and electrical coordinates; each entry is a
sum of functions of position: powers of sine and cosine on a circle (the span of the Fourier series to the
third harmonic), powers and rational functions of a shape on a line, their products for several. D has
viscous, Coulomb and quadratic friction for each velocity where not known otherwise. Terms that the equations
of motion cannot tell from earlier ones (gauges) are left out, the simpler ones standing first.
"""

from __future__ import annotations

import re
from itertools import combinations, combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.learned import angular
from exlinn_fmi.mechanics.monomials import Factor, MonomialBasis, parse_term
from exlinn_fmi.mechanics.structure import UNKNOWN, Friction, Structure

Array = NDArray[np.float64]

CIRCLE = (
    ("sin({0})", 1),
    ("cos({0})", 1),
    ("sin({0})^2", 2),
    ("sin({0})*cos({0})", 2),
    ("sin({0})^3", 3),
    ("sin({0})^2*cos({0})", 3),
)
"""Functions on a circle and their orders."""
POWERS = 6
"""Highest power on a line."""
RATIONAL = ("lorentz({x}/a_{x})", "hyperbola({x}/h_{x})")
"""Functions on a line beside its powers: inductances and capacitances mostly have such a form."""
DEGREES = (2, 3, 4, 6)
"""Degrees on lines of the families that are tried one after the other."""
RATIONAL_ORDER = 3
"""They count as of this order."""
POLE = 3.0
"""Hyperbolas are looked for with their pole so many times the reach of the data away."""
MARGIN = 1.1
"""A line is covered a little beyond the data."""
PRODUCTS = 3
"""Highest total order of products of functions of several coordinates."""
FRICTION: tuple[Friction, ...] = ("viscous", "coulomb", "quadratic")
"""Friction where none is named."""
COULOMB = 0.1
"""Coulomb friction changes its sign within this share of the rms velocity."""
DEPENDENT = 1e-9
"""A term is left out if no more than this share of it is new."""
PROBES = 40
"""Random points for each term that tell whether it is new."""


def generic_basis(data: Dataset, structure: Structure = UNKNOWN) -> MonomialBasis:
    """The family for the coordinates of a data set, which gives ranges and velocities.

    Args:
        data: what it is to explain.
        structure: what is known of the plant: terms that it cannot have are left out.
    """
    coordinates = data.coordinates
    lagrangian = [
        term
        for function, _ in position_functions(coordinates)
        for term in _terms_with(function, coordinates, structure)
    ]
    lagrangian += [c.name for i, c in enumerate(coordinates) if structure.has_offset(i)]
    kinds = [structure.friction_of(i, FRICTION) for i in range(len(coordinates))]
    dissipation = [
        _friction(kind, c.velocity)
        for kind in FRICTION_TERMS
        for c, known in zip(coordinates, kinds, strict=True)
        if kind in known
    ]
    basis = MonomialBasis(coordinates, tuple(lagrangian), tuple(dissipation), _shapes(data))
    return _independent(basis.only(np.ones(basis.size, dtype=bool)), data)


def _shapes(data: Dataset) -> tuple[Parameter, ...]:
    """Shapes that generic terms may hold: velocities of friction, lengths of rational functions."""
    shapes, samples = [], data.arrays
    for c, v, q in zip(data.coordinates, samples.v.T, samples.q.T, strict=True):
        rms, reach = float(np.sqrt(np.mean(v**2))), float(np.abs(q).max()) or 1.0
        shapes += [(f"s_{c.velocity}", COULOMB * rms), (f"w_{c.velocity}", COULOMB * rms)]
        shapes += [(f"a_{c.name}", reach), (f"h_{c.name}", POLE * reach)]
    return tuple(Parameter(name, value, "") for name, value in shapes)


def _terms_with(function: str, coordinates: tuple[Coordinate, ...], structure: Structure) -> list[str]:
    """Terms of 𝓛 with a function of position, the empty text being the constant."""
    seen = [i for i, c in enumerate(coordinates) if re.search(rf"\b{re.escape(c.name)}\b", function)]
    prefix, terms = f"{function}*" if function else "", []
    for i, j in combinations_with_replacement(range(len(coordinates)), 2):
        one, other = coordinates[i], coordinates[j]
        if one.kind == other.kind and structure.allows("M", coordinates, i, seen):
            same = f"0.5*{prefix}{one.velocity}^2"
            terms.append(same if i == j else f"{prefix}{one.velocity}*{other.velocity}")
    if function:
        terms += [
            f"{prefix}{c.velocity}"
            for i, c in enumerate(coordinates)
            if structure.allows("A", coordinates, i, seen)
        ]
        return terms + [f"-1*{function}"] * structure.allows("V", coordinates, 0, seen)
    return terms + [
        f"{q.name}*{coordinates[i].velocity}"
        for j, q in enumerate(coordinates)
        for i in reversed(range(len(coordinates)))
        if q.topology != "cyclic" and i != j and structure.allows("K", coordinates, i, [j])
    ]


FRICTION_TERMS: dict[Friction, str] = {
    "viscous": "0.5*{v}^2",
    "coulomb": "s_{v}*logcosh({v}/s_{v})",
    "quadratic": f"{1 / 3:.12g}*abs({{v}})^3",
    "stribeck": "w_{v}*stribeck({v}/w_{v})",
}
"""Terms of D; Coulomb's changes its sign within, and Stribeck's peaks at, a shape that is found."""


def _friction(kind: Friction, velocity: str) -> str:
    return FRICTION_TERMS[kind].format(v=velocity)


def position_functions(coordinates: tuple[Coordinate, ...]) -> list[tuple[str, int]]:
    """Functions of position as text, and their orders; the constant is the empty text of order 0.

    Args:
        coordinates: the generalised coordinates.
    """
    each = []
    for c in coordinates:
        if c.topology == "circle":
            factor = angular(c)
            argument = c.name if factor == 1 else f"{factor:.17g}*{c.name}"
            each.append([(text.format(argument), order) for text, order in CIRCLE])
        elif c.topology == "line":
            rational = [(text.format(x=c.name), RATIONAL_ORDER) for text in RATIONAL]
            each.append([(_power(c.name, k), k) for k in range(1, POWERS + 1)] + rational)
    found = [("", 0), *(entry for functions in each for entry in functions)]
    for count in range(2, len(each) + 1):
        for chosen in combinations(each, count):
            found += _products(chosen)
    return sorted(found, key=lambda entry: entry[1])


def _power(name: str, k: int) -> str:
    return name if k == 1 else f"{name}^{k}"


def families(basis: MonomialBasis) -> list[NDArray[np.bool_]]:
    """Generic terms in growing families: those of lines have few functions at first, and then more.

    Powers and rational functions that explain the same are all but dependent: no one can tell which of a rich
    family are the true ones. A poorer one that explains the data as well is the better place to look.

    Args:
        basis: of `generic_basis`.

    Returns:
        Masks on its terms; a single one where no coordinate is a line.
    """
    lines = {c.name for c in basis.coordinates if c.topology == "line"}
    shapes = tuple(shape.name for shape in basis.shapes)
    degree, rational = np.zeros(basis.size, dtype=int), np.full(basis.size, "", dtype="U9")
    for k, text in enumerate(basis.lagrangian):
        for f in parse_term(text, basis.coordinates, shapes=shapes).factors:
            if f.name in lines and f.function:
                rational[k] = f.function
            elif f.name in lines:
                degree[k] += f.power
    poor = [(rational == "") & (degree <= most) for most in DEGREES]
    rich = [(degree <= DEGREES[0]) & np.isin(rational, ["", name]) for name in ("lorentz", "hyperbola")]
    found = [*poor[:2], *rich, *poor[2:], np.ones(basis.size, dtype=bool)]
    return [mask for k, mask in enumerate(found) if not any((mask == other).all() for other in found[:k])]


def _products(factors: tuple[list[tuple[str, int]], ...]) -> list[tuple[str, int]]:
    """Products of one function of each list whose orders sum up to no more than `PRODUCTS`."""
    found = [("", 0)]
    for functions in factors:
        found = [
            (f"{text}*{more}" if text else more, order + extra)
            for text, order in found
            for more, extra in functions
            if order + extra <= PRODUCTS
        ]
    return found


def _independent(basis: MonomialBasis, data: Dataset) -> MonomialBasis:
    """The terms that the equations of motion tell from those before them."""
    random, (q, v, a, _) = np.random.default_rng(0), data.arrays
    shape = (PROBES * basis.size // v.shape[1] + 1, v.shape[1])
    middle, half = (q.max(axis=0) + q.min(axis=0)) / 2, (q.max(axis=0) - q.min(axis=0)) / 2
    drawn = [random.uniform(-1, 1, shape) for _ in range(3)]
    at = (
        middle + MARGIN * half * drawn[0],
        np.abs(v).max(axis=0) * drawn[1],
        np.abs(a).max(axis=0) * drawn[2],
    )
    columns = evaluate(basis.regressor, *at, basis.start).reshape(*shape, len(basis.start))
    columns = columns[:, :, : basis.size]
    power = columns * np.sqrt(np.mean(v**2, axis=0))[:, None]  # so that equations weigh alike
    flat = power.reshape(-1, basis.size)
    size = np.linalg.norm(flat, axis=0)
    # A total time derivative leaves nothing but rounding of the power that the term would have otherwise.
    rate = np.ones(basis.size)
    rate[: len(basis.lagrangian)] = np.exp(np.mean(np.log(np.std(a, axis=0) / np.std(v, axis=0))))
    seen = size > DEPENDENT * rate * np.linalg.norm(evaluate(basis.values(), *at[:2]), axis=0)
    scaled = np.where(seen, flat / np.where(seen, size, 1), 0)
    new = np.abs(np.diag(np.linalg.qr(scaled, mode="r"))) > DEPENDENT
    return basis.only(new)


# ── in words ─────────────────────────────────────────────────────────────────────────────────────────────


def entry(
    text: str, coordinates: tuple[Coordinate, ...], shapes: tuple[str, ...] = ()
) -> tuple[str, str, float]:
    """Where a term stands in 𝓛, its function of position there, and the factor of its coefficient.

    M_ij [α̇ twice], A_i [linear], V, F_i [a constant force]; so that ``0.5*sin(alpha)^2*alpha_dot^2`` is
    ("M_11", "sin(alpha)^2", 1).

    Args:
        text: a monomial.
        coordinates: the generalised coordinates, numbered from 1.
        shapes: names of parameters inside functions.
    """
    velocities = [c.velocity for c in coordinates]
    monomial = parse_term(text, coordinates, shapes=shapes)
    if text in (pushed := [c.name if c.topology != "line" else "" for c in coordinates]):
        return f"F_{pushed.index(text) + 1}", "", 1.0
    moved = [f for f in monomial.factors if f.name in velocities and not f.function]
    numbers = [velocities.index(f.name) + 1 for f in moved for _ in range(f.power)]
    others = [f for f in monomial.factors if f not in moved]
    function = "*".join(map(written, others))
    match numbers:
        case [i, j]:
            return f"M_{i}{j}", function, monomial.coefficient * (2 if i == j else 1)
        case [i]:
            return f"A_{i}", function, monomial.coefficient
        case []:
            return "V", function, -monomial.coefficient
    return "L", "*".join(map(written, monomial.factors)), monomial.coefficient


def written(factor: Factor) -> str:
    """A factor as text, as the grammar reads it."""
    argument = factor.name if factor.scale == 1 else f"{factor.scale:.12g}*{factor.name}"
    argument += f"/{factor.width}" if factor.width else ""
    if factor.shift:
        argument += factor.shift if isinstance(factor.shift, str) else f"{factor.shift:+.12g}"
    base = f"{factor.function}({argument})" if factor.function else argument
    return base if factor.power == 1 else f"{base}^{factor.power}"

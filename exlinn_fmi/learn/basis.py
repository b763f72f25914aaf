"""A generic family 𝓛 = Σ p_k φ_k, D = Σ p_k ψ_k from kinds and topologies of the coordinates alone.

𝓛 = ½ q̇ᵀM(q)q̇ + (Kq + A(q))ᵀq̇ − V(q), M apart for mechanical and electrical coordinates; each entry is a
sum of functions of position: powers of sine and cosine on a circle (the span of the Fourier series to the
third harmonic), Chebyshev's polynomials on a line, their products for several. D has viscous, Coulomb and
quadratic friction for each velocity. Terms that the equations of motion cannot tell from earlier ones
(gauges) are left out, the simpler ones standing first.
"""

from __future__ import annotations

import re
from itertools import combinations, combinations_with_replacement

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.mechanics.coordinates import Coordinate
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
CHEBYSHEV = 6
"""Highest degree on a line."""
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
    samples, coordinates = data.arrays, data.coordinates
    lagrangian = [
        term
        for function, _ in position_functions(coordinates, samples.q)
        for term in _terms_with(function, coordinates, structure)
    ]
    lagrangian += [c.name for i, c in enumerate(coordinates) if structure.has_offset(i)]
    dissipation = []
    for i, rms in enumerate(np.sqrt(np.mean(samples.v**2, axis=0)).tolist()):
        kinds = structure.friction_of(i, FRICTION)
        dissipation += [_friction(kind, coordinates[i].velocity, rms) for kind in kinds]
    dissipation.sort(key=lambda text: text not in [f"0.5*{c.velocity}^2" for c in coordinates])
    return _independent(MonomialBasis(coordinates, tuple(lagrangian), tuple(dissipation)), data)


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


def _friction(kind: Friction, velocity: str, rms: float) -> str:
    """A term of D; Coulomb's changes its sign, and Stribeck's peaks, at a share of the rms velocity."""
    width = COULOMB * rms
    return {
        "viscous": f"0.5*{velocity}^2",
        "coulomb": f"{width:.6g}*logcosh({1 / width:.6g}*{velocity})",
        "stribeck": f"{width:.6g}*stribeck({1 / width:.6g}*{velocity})",
        "quadratic": f"{1 / 3:.12g}*abs({velocity})^3",
    }[kind]


def position_functions(coordinates: tuple[Coordinate, ...], q: Float[Array, "N n"]) -> list[tuple[str, int]]:
    """Functions of position as text, and their orders; the constant is the empty text of order 0.

    Args:
        coordinates: the generalised coordinates.
        q: positions that the functions cover.
    """
    each = []
    for c, values in zip(coordinates, q.T, strict=True):
        if c.topology == "circle":
            factor = angular(c)
            argument = c.name if factor == 1 else f"{factor:.17g}*{c.name}"
            each.append([(text.format(argument), order) for text, order in CIRCLE])
        elif c.topology == "line":
            low, high = float(values.min()), float(values.max())
            reach = MARGIN * (high - low) / 2 or 1.0
            argument = f"{1 / reach:.6g}*{c.name}{-(high + low) / 2 / reach:+.6g}"
            each.append([(f"T{k}({argument})", k) for k in range(1, CHEBYSHEV + 1)])
    found = [("", 0), *(entry for functions in each for entry in functions)]
    for count in range(2, len(each) + 1):
        for chosen in combinations(each, count):
            found += _products(chosen)
    return sorted(found, key=lambda entry: entry[1])


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
    at = [random.uniform(-1, 1, shape) for _ in range(3)]
    columns = evaluate(
        basis.regressor(),
        middle + MARGIN * half * at[0],
        np.abs(v).max(axis=0) * at[1],
        np.abs(a).max(axis=0) * at[2],
        basis.start,
    ).reshape(*shape, basis.size)
    power = columns * np.sqrt(np.mean(v**2, axis=0))[:, None]  # so that equations weigh alike
    flat = power.reshape(-1, basis.size)
    size = np.linalg.norm(flat, axis=0)
    seen = size > DEPENDENT * size.max()  # else a total time derivative, of which rounding is left
    scaled = np.where(seen, flat / np.where(seen, size, 1), 0)
    new = np.abs(np.diag(np.linalg.qr(scaled, mode="r"))) > DEPENDENT
    return basis.only(new)


# ── in words ─────────────────────────────────────────────────────────────────────────────────────────────


def entry(text: str, coordinates: tuple[Coordinate, ...]) -> tuple[str, str, float]:
    """Where a term stands in 𝓛, its function of position there, and the factor of its coefficient.

    M_ij [α̇ twice], A_i [linear], V, F_i [a constant force]; so that ``0.5*sin(alpha)^2*alpha_dot^2`` is
    ("M_11", "sin(alpha)^2", 1).

    Args:
        text: a monomial.
        coordinates: the generalised coordinates, numbered from 1.
    """
    velocities = [c.velocity for c in coordinates]
    monomial = parse_term(text, coordinates)
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
    argument = factor.name
    if (factor.scale, factor.shift) != (1, 0):
        argument = f"{factor.scale:.12g}*{factor.name}" + (f"{factor.shift:+.12g}" if factor.shift else "")
    base = f"{factor.function}({argument})" if factor.function else argument
    return base if factor.power == 1 else f"{base}^{factor.power}"

"""A start for the structured form by linear least squares, and where the smallest mass ε is set.

With the functions of position on a low-order basis ([1, z, zz] for M, the networks' direct path for A and
V) and viscous D the residual is linear in all unknowns: one solve gives M, coupling, potentials and
friction at once. A row without input is homogeneous, so that noise or too poor a basis can shrink it until
M is not positive definite; then the start is a plain diagonal M instead. Such rows weigh no more than their
power: a larger weight would shrink them further.

With the hidden units as they were drawn the same solve gives starts for functions of position that are no
short polynomials (`hidden_starts`): coefficients on functions that are fixed are found to the last digits
where a descent from silent units takes hundreds of iterations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.optimize import nnls

from exlinn_fmi.learn.assembly import Assembly, product_basis
from exlinn_fmi.learn.factor import fit_cholesky, fit_factor
from exlinn_fmi.learn.levenberg import triangle
from exlinn_fmi.learn.networks import coupling_columns
from exlinn_fmi.learn.objective import Rows
from exlinn_fmi.mechanics.layout import Layout, Mask

Array = NDArray[np.float64]
Basis = tuple[Array, Array]
"""Functions of position at the samples (B, k), and their derivatives with respect to z (B, k, nz)."""

SAMPLES = 4000
"""About as many samples does the solve look at."""
CUT = 1e-10
"""Singular values below this share of the largest are gauges."""
CUTS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
"""The same for starts that are judged by validation."""
OVERLAP = 0.25
"""Slope of a hidden unit on a line times the distance to the next, …"""
LEAST_SLOPE = 1.0
"""… and least slope: flatter ones would all be straight."""
SHARE = 0.1
"""ε as a share of the smallest mass in the solution."""
LEAST = 1e-2
"""Blocks of M closer to singular than this are not believed, nor friction below this share of the forces."""
PLAIN = 0.3
"""Mass and friction where the solution is of no use, as a share of the forces in its equation."""
NONE = 1e-6
"""Masses below this share of the forces in their equation are taken for none."""
FRICTION = ("viscous", "friction", "quadratic")
"""Weights of friction, in the order in which it is solved for."""
SILENT = 1e-9
"""Friction that a solve does without begins with this share of the forces: from 0 it could not grow."""
COLUMNS = 1000
"""Of the hidden units as many take part in a linear start as make so many columns."""
JOIN = 0.02
"""First weight of friction units, relative to the viscous one: small, so that they join without a jolt."""


class Start(NamedTuple):
    """First weights by name, and ε for each coordinate."""

    weights: dict[str, Array]
    epsilon: tuple[float, ...]


class _Family(NamedTuple):
    """At samples: functions of position for M, those for A and V, and each velocity's friction (B, n, f)."""

    mass: Basis
    others: Basis
    friction: Array


class _Solution(NamedTuple):
    """Coefficients of A and V by term, K, offsets, friction, M and ∂M/∂z at the samples, sizes of forces.

    Friction of each velocity: viscous, then that of its units and quadratic drag.
    """

    functions: dict[tuple[str, int, int], Array]
    coupling: Array
    offset: Array
    friction: Float[Array, "n f"]
    mass: Float[Array, "B n n"]
    change: Float[Array, "B n n nz"]
    forces: Float[Array, " n"]


def linear_start(rows: Rows, seed: int) -> Start:
    """Weights to start from, hidden units silent.

    Args:
        rows: what is to be explained.
        seed: of all that is drawn.
    """
    layout, rows = rows.networks.spec.layout, rows.thin(SAMPLES)
    part = rows.samples(SAMPLES)
    pairs = list(combinations_with_replacement(range(part.z.shape[1]), 2))
    masks = [layout.term_mask(t, pairs if t[0] == "M" else layout.products) for t in layout.terms]

    def family(at: Assembly) -> _Family:
        friction = at.velocity[:, :, None] * layout.free["dissipation.viscous"][:, None]
        return _Family(product_basis(at.z, pairs), (at.basis, at.slopes), friction)

    found = next(_solve(rows, family, masks, (CUT,)))
    random = np.random.default_rng(seed)
    weights = {name: np.zeros(shape) for name, shape in layout.shapes.items()}
    epsilon = np.zeros(len(found.forces))
    output = weights["lagrangian.output"]
    for block, columns in zip(layout.blocks, layout.columns, strict=True):
        mass, _, epsilon[block] = _mass_block(found, block)
        used = np.flatnonzero(layout.term_mask(("L", block[0], 0), layout.products))
        factor = fit_factor(mass, part.basis[:, used], columns, random)
        for k, i in enumerate(block):
            output[layout.rows[i], used] = factor[k]
    believed = found.friction > LEAST * found.forces[:, None]
    friction = np.where(believed, found.friction, PLAIN * LEAST * found.forces[:, None])
    _fill(layout, weights, found)
    weights["dissipation.viscous"][:] = np.sqrt(friction[:, 0])
    weights["dissipation.friction"][:] = JOIN * np.sqrt(friction)
    weights["dissipation.quadratic"][:] = JOIN * np.sqrt(friction[:, 0])
    smooth = layout.friction - layout.bumps
    weights["dissipation.width"][:, :smooth] = np.log(np.geomspace(0.1, 1.0, smooth))
    weights["dissipation.width"][:, smooth:] = np.log(0.1)
    _draw_units(layout, weights, random)
    return Start(weights, tuple(epsilon.tolist()))


def hidden_starts(rows: Rows, weights: dict[str, Array]) -> Iterator[dict[str, Array]]:
    """Weights to start from with hidden units that take part from the first: better, or far too rich.

    The more singular values a solve keeps, the closer it is to clean data and the further off on others.

    Args:
        rows: what is to be explained, of networks with their smallest masses ε.
        weights: whose hidden units are taken as they are.
    """
    networks, rows = rows.networks, rows.thin(SAMPLES)
    layout = networks.spec.layout
    free, basis = layout.free, networks.basis(weights, rows.samples(SAMPLES))
    free["lagrangian.output"][:, COLUMNS // len(layout.terms) :] = False
    used = dict(zip(layout.outputs, free["lagrangian.output"], strict=True))
    masks = [used[("L", i, 0) if kind == "M" else (kind, i, j)] for kind, i, j in layout.terms]
    kinds = [
        free[f"dissipation.{kind}"].reshape(len(weights["dissipation.viscous"]), -1) for kind in FRICTION
    ]
    friction = np.concatenate(kinds, axis=1)

    def family(at: Assembly) -> _Family:
        functions = networks.basis(weights, at)
        return _Family(functions, functions, networks.friction(weights, at) * friction)

    epsilon = np.array(networks.spec.epsilon)
    for found in _solve(rows, family, masks, CUTS):
        now = {name: array.copy() for name, array in weights.items()}
        output = now["lagrangian.output"]
        output[:] = 0
        for block in layout.blocks:
            mass, change, least = _mass_block(found, block)
            room = mass + np.diag(least - epsilon[block])  # M − ε, with the ε that the model has
            if not np.linalg.eigvalsh(room).min() > 0:
                break
            part = np.flatnonzero(used["L", block[0], 0])
            factor = fit_cholesky(room, change, basis[0][:, part], basis[1][:, part])
            for k, i in enumerate(block):
                output[layout.rows[i]][: len(block), part] = factor[k]
        else:
            _fill(layout, now, found)
            strength = np.sqrt(np.maximum(found.friction, SILENT * found.forces[:, None]))
            now["dissipation.viscous"][:], now["dissipation.quadratic"][:] = strength[:, [0, -1]].T
            now["dissipation.friction"][:] = strength[:, 1:-1]
            yield now


def _draw_units(layout: Layout, weights: dict[str, Array], random: np.random.Generator) -> None:
    """Hidden units whose transitions lie in the range of their inputs, [-1, 1].

    On a line they stand in equal distances, so wide that they overlap well: then sums of them hold a smooth
    function to many digits with coefficients of its own size.
    """
    slope, bias = weights["lagrangian.hidden.weight"], weights["lagrangian.hidden.bias"]
    slope[:] = 1.5 * random.standard_normal(slope.shape) * layout.free["lagrangian.hidden.weight"]
    bias[:] = -(slope * random.uniform(-1, 1, slope.shape)).sum(axis=1)
    for seen in set(layout.sight):
        units = np.flatnonzero([sight == seen for sight in layout.sight])
        inputs = [k for k, owner in enumerate(layout.owners) if owner in seen]
        if len(inputs) == 1 and len(units) > 1:
            steep = max(OVERLAP * (len(units) - 1) / 2, LEAST_SLOPE)
            slope[units, inputs], bias[units] = steep, -steep * np.linspace(-1, 1, len(units))


def _fill(layout: Layout, weights: dict[str, Array], found: _Solution) -> None:
    """Put A, V, K and offsets into the weights."""
    for row, term in enumerate(layout.outputs):
        if term in found.functions:
            weights["lagrangian.output"][row, : len(found.functions[term])] = found.functions[term]
    weights["lagrangian.coupling"][:] = found.coupling
    weights["lagrangian.offset"][:] = found.offset


def _solve(
    rows: Rows, family: Callable[[Assembly], _Family], masks: Sequence[Mask], cuts: Sequence[float]
) -> Iterator[_Solution]:
    """Weighted linear least squares for everything at once, for each cut of the singular values.

    Friction, which must not be negative, is solved for on what the others leave open.

    Args:
        rows: what is to be explained.
        family: functions that take part, at samples.
        masks: for each term which of its functions may take part.
        cuts: singular values below this share of the largest are left out.
    """
    layout, target = rows.networks.spec.layout, rows.target
    # The first function of A and V, a constant, has no effect.
    masks = [
        mask if term[0] == "M" else mask & (np.arange(len(mask)) > 0)
        for term, mask in zip(layout.terms, masks, strict=True)
    ]
    columns = _columns(rows, family, masks)
    places = np.cumsum([column.shape[2] for column in columns])[:-1]
    size = np.sqrt(np.mean(target**2, axis=0))
    weight = 1 / np.where(size > 0, size, 1)
    matrix = (np.concatenate(columns, axis=2) * weight[:, None]).reshape(target.size, -1)
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1
    count = int(places[-1])
    few = np.zeros((max(len(size) + 1 - len(matrix), 0), len(size) + 1))  # fewer equations than unknowns
    r = triangle(np.column_stack([matrix / size, (target * weight).ravel()]), few)
    left, singular, right = np.linalg.svd(r[:count, :count])
    n, part = target.shape[1], rows.samples(SAMPLES)
    values, slopes = family(part).mass
    for cut in cuts:
        strong = singular > cut * singular.max()
        kept, lost = left[:, strong], left[:, ~strong]
        rest = np.concatenate([lost.T @ r[:count, count:], r[count:, count:]])
        solution = np.empty(len(size))
        solution[count:] = nnls(rest[:, :-1], rest[:, -1])[0]
        goal = kept.T @ (r[:count, -1] - r[:count, count:-1] @ solution[count:])
        solution[:count] = right[strong].T @ (goal / singular[strong])
        parts = np.split(solution / size, places)
        mass, change = np.zeros((len(part), n, n)), np.zeros((len(part), n, n, part.z.shape[1]))
        for (kind, i, j), mask, x in zip(layout.terms, masks, parts, strict=False):
            if kind == "M":
                mass[:, i, j] = mass[:, j, i] = values @ (mask * x)
                change[:, i, j] = change[:, j, i] = np.einsum("bhz,h->bz", slopes, mask * x)
        shares = [target, *(c @ x for c, x in zip(columns, parts, strict=True))]
        forces = np.max([np.sqrt(np.mean(share**2, axis=0)) for share in shares], axis=0)
        forces = np.maximum(forces, np.finfo(float).eps * forces.max())
        functions = {term: x for term, x in zip(layout.terms, parts, strict=False) if term[0] != "M"}
        coupling, offset, friction_found = parts[-3:]
        yield _Solution(functions, coupling, offset, friction_found.reshape(n, -1), mass, change, forces)


def _columns(
    rows: Rows, family: Callable[[Assembly], _Family], masks: Sequence[Mask]
) -> list[Float[Array, "N n _"]]:
    """What each coefficient contributes: one array for each term of 𝓛, then for K, offsets and friction."""
    layout, sizes = rows.networks.spec.layout, list[int]()
    free, n = layout.free, rows.target.shape[1]

    def make(at: Assembly) -> Array:
        mass, others, friction = family(at)
        columns = []
        for t, (term, mask) in enumerate(zip(layout.terms, masks, strict=True)):
            values, slopes = mass if term[0] == "M" else others
            column = at.value[:, :, t, None] * (values * mask)[:, None]
            columns.append(column + np.einsum("bnz,bhz->bnh", at.gradient[:, :, t], slopes * mask[:, None]))
        columns.append(coupling_columns(layout, at.velocity) * free["lagrangian.coupling"])
        columns.append(-np.eye(n) * at.push[:, :, None] * free["lagrangian.offset"])
        columns.append((friction[:, :, None] * np.eye(n)[:, :, None]).reshape(len(at), n, -1))
        sizes[:] = [column.shape[2] for column in columns]
        return np.concatenate(columns, axis=2)

    whole = rows.gather(make)
    return np.split(whole, np.cumsum(sizes)[:-1], axis=2)


def _mass_block(
    found: _Solution, block: list[int]
) -> tuple[Float[Array, "B m m"], Float[Array, "B m m nz"], Float[Array, " m"]]:
    """A block of M less ε, its derivatives, and ε.

    The block is drawn towards its mean as far as it is not positive definite everywhere; if not even the mean
    is, a plain diagonal takes its place.
    """
    mass, change = found.mass[:, block][:, :, block], found.change[:, block][:, :, block]
    forces = found.forces[block]
    if not _believed(mass.mean(axis=0), forces):
        mass, change = np.broadcast_to(np.diag(PLAIN * forces), mass.shape), np.zeros_like(change)
    mean = mass.mean(axis=0)
    diagonal = np.diag(mean)
    unit = np.sqrt(np.outer(diagonal, diagonal))
    smallest, least = (float(np.linalg.eigvalsh(matrix / unit).min()) for matrix in (mean, mass))
    share = 1.0 if least > smallest / 2 else smallest / (2 * (smallest - least))
    epsilon = SHARE * max(least, smallest / 2) * diagonal
    return mean + share * (mass - mean) - np.diag(epsilon), share * change, epsilon


def _believed(mean: Float[Array, "m m"], forces: Float[Array, " m"]) -> bool:
    """Whether the mean of a block of M is a mass matrix, and not nearly singular."""
    diagonal = np.diag(mean)
    if not (diagonal > NONE * forces).all():
        return False
    return float(np.linalg.eigvalsh(mean / np.sqrt(np.outer(diagonal, diagonal))).min()) > LEAST

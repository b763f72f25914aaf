"""A start for the structured form by linear least squares, and where the smallest mass ε is set.

With the functions of position on a low-order basis ([1, z, zz] for M, the networks' direct path for A and
V) and viscous D the residual is linear in all unknowns: one solve gives M, coupling, potentials and
friction at once. A row without input is homogeneous, so that noise or too poor a basis can shrink it until
M is not positive definite; then the start is a plain diagonal M instead. Such rows weigh no more than their
power: a larger weight would shrink them further.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.learn.assembly import Assembly, product_basis
from exlinn_fmi.learn.factor import fit_factor
from exlinn_fmi.learn.networks import coupling_columns
from exlinn_fmi.mechanics.layout import Layout

Array = NDArray[np.float64]

SAMPLES = 4000
"""About as many samples does the solve look at."""
CUT = 1e-10
"""Singular values below this share of the largest are gauges."""
SHARE = 0.1
"""ε as a share of the smallest mass in the solution."""
LEAST = 1e-2
"""Blocks of M closer to singular than this are not believed, nor friction below this share of the forces."""
PLAIN = 0.3
"""Mass and friction where the solution is of no use, as a share of the forces in its equation."""
NONE = 1e-6
"""Masses below this share of the forces in their equation are taken for none."""
JOIN = 0.02
"""First weight of friction units, relative to the viscous one: small, so that they join without a jolt."""


class Start(NamedTuple):
    """First weights by name, and ε for each coordinate."""

    weights: dict[str, Array]
    epsilon: tuple[float, ...]


class _Solution(NamedTuple):
    """Coefficients of A and V by term, K, offsets, viscous friction, M at the samples, sizes of forces."""

    functions: dict[tuple[str, int, int], Array]
    coupling: Array
    offset: Array
    viscous: Array
    mass: Float[Array, "B n n"]
    forces: Float[Array, " n"]


def linear_start(layout: Layout, data: Assembly, seed: int) -> Start:
    """Weights to start from.

    Args:
        layout: of the networks.
        data: coefficients of the inverse model.
        seed: of all that is drawn.
    """
    part = data.part(slice(None, None, -(-len(data) // SAMPLES)))
    found = _solve(layout, part)
    random = np.random.default_rng(seed)
    weights = {name: np.zeros(shape) for name, shape in layout.shapes.items()}
    epsilon = np.zeros(len(found.forces))
    output = weights["lagrangian.output"]
    for block, columns in zip(layout.blocks, layout.columns, strict=True):
        mass, epsilon[block] = _mass_block(found.mass[:, block][:, :, block], found.forces[block])
        used = np.flatnonzero(layout.term_mask(("L", block[0], 0), layout.products))
        factor = fit_factor(mass, part.basis[:, used], columns, random)
        for k, i in enumerate(block):
            output[layout.rows[i], used] = factor[k]
    for row, term in enumerate(layout.outputs):
        if term in found.functions:
            output[row, 1 : 1 + len(found.functions[term])] = found.functions[term]
    weights["lagrangian.coupling"][:] = found.coupling
    weights["lagrangian.offset"][:] = found.offset
    viscous = np.where(found.viscous > LEAST * found.forces, found.viscous, PLAIN * LEAST * found.forces)
    weights["dissipation.viscous"][:] = np.sqrt(viscous)
    weights["dissipation.friction"][:] = JOIN * np.sqrt(viscous)[:, None]
    smooth = layout.friction - layout.bumps
    weights["dissipation.width"][:, :smooth] = np.log(np.geomspace(0.1, 1.0, smooth))
    weights["dissipation.width"][:, smooth:] = np.log(0.1)
    weights["dissipation.quadratic"][:] = JOIN * np.sqrt(viscous)
    # Each unit's transition lies somewhere in the range of its inputs, which is [-1, 1].
    slope = weights["lagrangian.hidden.weight"]
    slope[:] = 1.5 * random.standard_normal(slope.shape)
    weights["lagrangian.hidden.bias"][:] = -(slope * random.uniform(-1, 1, slope.shape)).sum(axis=1)
    return Start(weights, tuple(epsilon.tolist()))


def _solve(layout: Layout, part: Assembly) -> _Solution:
    """Weighted linear least squares for everything at once."""
    n, free = part.velocity.shape[1], layout.free
    pairs = list(combinations_with_replacement(range(part.z.shape[1]), 2))
    bases, columns = [], []
    for t, term in enumerate(layout.terms):
        if term[0] == "M":
            used = layout.term_mask(term, pairs)
            basis, slopes = product_basis(part.z, pairs)
        else:  # constants have no effect there
            used = layout.term_mask(term, layout.products)[1:]
            basis, slopes = part.basis[:, 1:], part.slopes[:, 1:]
        basis, slopes = basis * used, slopes * used[:, None]
        column = part.value[:, :, t, None] * basis[:, None]
        columns.append(column + np.einsum("bnz,bhz->bnh", part.gradient[:, :, t], slopes))
        bases.append(basis)
    columns += [
        coupling_columns(layout, part.velocity) * free["lagrangian.coupling"],
        -np.broadcast_to(np.eye(n), (len(part), n, n)) * free["lagrangian.offset"],
        part.velocity[:, :, None] * np.eye(n) * free["dissipation.viscous"],
    ]
    size = np.sqrt(np.mean(part.target**2, axis=0))
    weight = 1 / np.where(size > 0, size, 1)
    matrix = (np.concatenate(columns, axis=2) * weight[:, None]).reshape(part.target.size, -1)
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1
    solution = np.linalg.lstsq(matrix / size, (part.target * weight).ravel(), rcond=CUT)[0] / size
    parts = np.split(solution, np.cumsum([c.shape[2] for c in columns])[:-1])
    mass = np.zeros((len(part), n, n))
    for (kind, i, j), basis, coefficients in zip(layout.terms, bases, parts, strict=False):
        if kind == "M":
            mass[:, i, j] = mass[:, j, i] = basis @ coefficients
    shares = [part.target, *(c @ x for c, x in zip(columns, parts, strict=True))]
    forces = np.max([np.sqrt(np.mean(share**2, axis=0)) for share in shares], axis=0)
    forces = np.maximum(forces, np.finfo(float).eps * forces.max())
    functions = {term: x for term, x in zip(layout.terms, parts, strict=False) if term[0] != "M"}
    coupling, offset, viscous = parts[-3:]
    return _Solution(functions, coupling, offset, viscous, mass, forces)


def _mass_block(
    mass: Float[Array, "B m m"], forces: Float[Array, " m"]
) -> tuple[Float[Array, "B m m"], Float[Array, " m"]]:
    """A block of M less ε, and ε.

    The block is drawn towards its mean as far as it is not positive definite everywhere; if not even the mean
    is, a plain diagonal takes its place.
    """
    if not _believed(mass.mean(axis=0), forces):
        mass = np.broadcast_to(np.diag(PLAIN * forces), mass.shape)
    mean = mass.mean(axis=0)
    diagonal = np.diag(mean)
    unit = np.sqrt(np.outer(diagonal, diagonal))
    smallest, least = (float(np.linalg.eigvalsh(matrix / unit).min()) for matrix in (mean, mass))
    share = 1.0 if least > smallest / 2 else smallest / (2 * (smallest - least))
    epsilon = SHARE * max(least, smallest / 2) * diagonal
    return mean + share * (mass - mean) - np.diag(epsilon), epsilon


def _believed(mean: Float[Array, "m m"], forces: Float[Array, " m"]) -> bool:
    """Whether the mean of a block of M is a mass matrix, and not nearly singular."""
    diagonal = np.diag(mean)
    if not (diagonal > NONE * forces).all():
        return False
    return float(np.linalg.eigvalsh(mean / np.sqrt(np.outer(diagonal, diagonal))).min()) > LEAST

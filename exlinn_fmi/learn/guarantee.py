"""Whether bounded inputs keep a model bounded for ever, which structure may promise and data may not.

The stored energy E obeys dE/dt = q̇ᵀF − q̇ᵀ∂D/∂q̇. With M ≻ 0, friction that grows at least like b‖q̇‖² and a
potential that is bounded below, E falls wherever the motion is fast: it stays below what the inputs can
feed. Networks of the structured form have all that by construction, sums of terms may or may not; here it is
looked at far beyond the data.
"""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.learned import angular

Array = NDArray[np.float64]

FAR = (1.0, 1.5, 3.0, 10.0, 100.0, 1000.0)
"""Positions on a line are looked at up to so many times their range in the data."""
TURN = 48
"""Positions on a circle."""
MOST = 20_000
"""More combinations of positions than that are drawn at random."""
FAST = (1e6, 1e9)
"""Speeds, relative to those in the data, between which friction must grow like viscous friction."""
DIRECTIONS = 200
"""Directions of motion that friction is looked at in."""
SLACK = 1e-9
"""Rounding that is forgiven."""
NONE = np.zeros(0)

KEPT = "bounded inputs keep it bounded: M is positive definite, V bounded below, and all motion has friction"


def doubts(system: LagrangianSystem, data: Dataset) -> list[str]:
    """Why bounded inputs might not keep a model bounded; none where they do.

    Args:
        system: the learned model.
        data: where it was learned, which gives ranges.
    """
    speed = np.sqrt(np.mean(data.arrays.v**2, axis=0))
    speed = np.where(speed > 0, speed, 1.0)
    q, reach = _positions(system, data)
    energy = evaluate(system.energy, q, np.zeros_like(q), NONE)[:, 0]
    ends = [energy[reach == far].min() for far in FAR[1:] if (reach == far).any()]
    slack = SLACK * np.ptp(energy)
    falls = any(b < a - slack for a, b in pairwise(ends))
    rises = all(b > a + slack for a, b in pairwise(ends))  # so that no motion gets far out
    found = _inertia(system, q, reach, speed, rises) + _friction(system, speed)
    return found + ["V falls without bound along a line"] * falls


def told(system: LagrangianSystem, data: Dataset) -> str:
    """The same in words for the report card."""
    found = doubts(system, data)
    return f"not guaranteed to stay bounded: {'; '.join(found)}" if found else KEPT


def _positions(system: LagrangianSystem, data: Dataset) -> tuple[Float[Array, "B n"], Float[Array, " B"]]:
    """Positions to look at, and how far out each is: the largest of its factors among `FAR`."""
    axes: list[list[tuple[float, float]]] = []
    for c, values in zip(system.coordinates, data.arrays.q.T, strict=True):
        middle, half = (values.max() + values.min()) / 2, (values.max() - values.min()) / 2 or 1.0
        if c.topology == "cyclic":
            axes.append([(0.0, 1.0)])
        elif c.topology == "circle":
            turn = 2 * np.pi / angular(c)
            axes.append([(turn * k / TURN, 1.0) for k in range(TURN)])
        else:
            inside = [(middle + half * s, 1.0) for s in np.linspace(-1, 1, 21)]
            axes.append(inside + [(middle + sign * half * far, far) for far in FAR for sign in (-1, 1)])
    random = np.random.default_rng(0)
    if np.prod([len(axis) for axis in axes]) <= MOST:
        drawn = list(product(*axes))
    else:
        picks = [random.integers(len(axis), size=MOST) for axis in axes]
        drawn = [
            tuple(axis[k] for axis, k in zip(axes, pick, strict=True)) for pick in zip(*picks, strict=True)
        ]
    table = np.array(drawn, dtype=float)  # (B, n, 2)
    return table[:, :, 0], table[:, :, 1].max(axis=1)


def _masses(
    system: LagrangianSystem, q: Float[Array, "B n"], v: Float[Array, "B n"]
) -> Float[Array, "B n n"]:
    return evaluate(system.mass_matrix, q, v, NONE).reshape(-1, system.n, system.n)


def _inertia(
    system: LagrangianSystem,
    q: Float[Array, "B n"],
    reach: Float[Array, " B"],
    speed: Float[Array, " n"],
    confined: bool,
) -> list[str]:
    mass = _masses(system, q, np.zeros_like(q))
    size = np.sqrt(np.abs(np.diagonal(mass[reach == 1], axis1=1, axis2=2)).mean(axis=0))
    size = np.where(size > 0, size, 1.0)
    least = np.linalg.eigvalsh(mass / np.outer(size, size))[:, 0]
    found = []
    if (least <= SLACK).any():
        worst = q[int(np.argmin(least))]
        names = zip(system.coordinates, worst.tolist(), strict=True)
        place = ", ".join(f"{c.name} = {x:.3g}" for c, x in names if c.topology != "cyclic")
        found.append(f"M is not positive definite at {place or 'rest'}")
    moved = _masses(system, q, np.broadcast_to(speed, q.shape))
    if np.abs(moved - mass).max() > SLACK * np.abs(mass).max():
        found.append("M depends on velocities")
    largest = np.linalg.eigvalsh(mass / np.outer(size, size))[:, -1]
    ends = [largest[reach == far].max() for far in FAR[-2:] if (reach == far).any()]
    if ends and not confined and ends[1] > 1.5 * ends[0]:
        found.append("M grows without bound along a line")
    return found


def _friction(system: LagrangianSystem, speed: Float[Array, " n"]) -> list[str]:
    drawn = np.random.default_rng(0).standard_normal((DIRECTIONS, system.n))
    unit = np.vstack([np.eye(system.n), drawn / np.linalg.norm(drawn, axis=1)[:, None]])
    factors = [*np.geomspace(1e-3, 1e3, 25), *FAST]
    v = np.concatenate([unit * speed * factor for factor in factors])
    none = np.zeros((len(system.input_names), len(v))), np.zeros((0, len(v)))
    loss = system.power.map(len(v))(v.T, *none)[1].full().reshape(len(factors), len(unit)).T
    found = []
    if (loss[:, :-2] < -SLACK * np.abs(loss[:, :-2]).max()).any():
        found.append("friction pushes at some speeds")
    for k, c in enumerate(system.coordinates):
        slow, fast = loss[k, -2] / FAST[0] ** 2, loss[k, -1] / FAST[1] ** 2
        if not fast > 0.5 * slow > 0:
            found.append(f"{c.velocity} has no viscous friction")
    return found

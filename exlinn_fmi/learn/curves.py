"""Curves that a learned model holds: inertias and inductances M(q), potential V(q), 1/C(x), friction f(q̇).

All of them are linear in the forces of the inverse model (17) at chosen points: M_ij(q) is what an
acceleration of 1 along j adds to F_i at rest, the potential is the integral of the static force, friction is
the odd part of the force over velocity. So their uncertainty follows from the covariance of the parameters:
that of the fit for sums of terms, for networks from the Gauss–Newton matrix and the residuals in training.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from exlinn_fmi.data.dataset import Dataset, Samples
from exlinn_fmi.learn.assembly import inverse_assembly
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Inverse, Rows
from exlinn_fmi.learn.tested import Weak
from exlinn_fmi.learn.train import TrainedModel
from exlinn_fmi.learn.trajectory import Information
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import evaluate

Array = NDArray[np.float64]

POINTS = 81
"""Points on a curve."""
SAMPLES = 2000
"""Rows of the training data that the covariance of networks is taken from."""
CONFIDENCE = 1.96
"""Standard deviations on either side of a 95 % band."""
CONSTANT = 1e-6
"""Curves that vary by less than this share of their size are not drawn."""
INERTIA = {"m/s": "kg", "rad/s": "kg.m2", "A": "H"}
"""Units of a diagonal entry of M by that of the velocity."""
COLUMNS = ["curve", "unit", "variable", "variable_unit", "at", "value", "low", "high"]


class Curve(NamedTuple):
    """A curve with its derivatives by the parameters, K of them (none where no covariance is known)."""

    name: str
    unit: str
    variable: str
    variable_unit: str
    at: Float[Array, " N"]
    value: Float[Array, " N"]
    slopes: Float[Array, "N K"]


@dataclass(frozen=True)
class _Forces:
    """The inverse model, its derivatives by the parameters, and their covariance."""

    force: Callable[[Array, Array, Array], Float[Array, "N n"]]
    slopes: Callable[[Array, Array, Array], Float[Array, "N n K"]]
    covariance: Float[Array, "K K"]

    def pair(self, q: Array, v: Array, a: Array) -> tuple[Float[Array, "N n"], Float[Array, "N n K"]]:
        return self.force(q, v, a), self.slopes(q, v, a)


def curves(model: TrainedModel, data: Dataset) -> pd.DataFrame:
    """All curves that are not constant.

    Args:
        model: the learned model.
        data: what it was fitted to, which gives the range of each curve.

    Returns:
        Columns `COLUMNS`; low and high bound the 95 % band, NaN where no covariance is known.
    """
    forces, tables = _forces(model, data), []
    for curve in (*_position_curves(forces, data), *_friction_curves(forces, data)):
        std = np.sqrt(np.maximum(np.einsum("nk,kl,nl->n", curve.slopes, forces.covariance, curve.slopes), 0))
        std = std if forces.covariance.size else np.full(len(curve.at), np.nan)
        table = pd.DataFrame({"at": curve.at, "value": curve.value})
        names = ("curve", "unit", "variable", "variable_unit")
        table = table.assign(**dict(zip(names, curve[:4], strict=True)))
        table["low"], table["high"] = curve.value - CONFIDENCE * std, curve.value + CONFIDENCE * std
        tables.append(table[COLUMNS])
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=COLUMNS)


# ── the inverse model and its parameters ─────────────────────────────────────────────────────────────────


def _forces(model: TrainedModel, data: Dataset) -> _Forces:
    system, spec = model.system, model.spec

    def force(q: Array, v: Array, a: Array) -> Array:
        return evaluate(system.inverse, q, v, a, np.zeros(0))

    if spec.form == "terms":
        basis = spec.basis
        p = np.concatenate([model.weights[n] for n in ("lagrangian.terms", "dissipation.terms", "shapes")])
        kept = np.array(model.provenance["covariance"]["of"], dtype=int)

        def columns(q: Array, v: Array, a: Array) -> Array:
            return evaluate(basis.regressor, q, v, a, p).reshape(*v.shape, len(p))[:, :, kept]

        covariance = np.array(model.provenance["covariance"]["matrix"], dtype=float)
        return _Forces(force, columns, covariance.reshape(len(kept), len(kept)))
    if spec.form != "structured" or spec.scales is None:
        return _Forces(force, lambda q, v, a: np.zeros((*v.shape, 0)), np.zeros((0, 0)))
    networks, unit = StructuredNetworks(spec), spec.scales.force
    theta = networks.pack(dict(model.weights))

    def jacobian(q: Array, v: Array, a: Array) -> Array:
        samples = Samples(*(np.broadcast_to(x, v.shape) for x in (q, v, a, np.zeros(v.shape))))
        return networks.jacobian(theta, inverse_assembly(spec, samples))[1] * unit[:, None]

    rows: Rows
    if model.provenance.get("objective", "").startswith("weak"):
        rows = Weak.all(networks, data)
        share = rows.windows.overlap  # windows that share their samples tell the same
    else:
        rows = Inverse(networks, inverse_assembly(spec, data.arrays)).thin(SAMPLES)
        share = len(rows.target) / len(data)
    residual, slopes = rows.jacobian(theta)
    variance = np.maximum(np.mean(residual**2, axis=0), np.finfo(float).tiny)
    weighted = (slopes / np.sqrt(variance)[:, None]).reshape(-1, slopes.shape[2])
    return _Forces(force, jacobian, Information(weighted.T @ weighted / share).covariance)


# ── the curves ───────────────────────────────────────────────────────────────────────────────────────────


def _position_curves(forces: _Forces, data: Dataset) -> Iterator[Curve]:
    """M, V and 1/C along each position, the others in the middle of their data."""
    coordinates, q = data.coordinates, data.arrays.q
    n, middle = q.shape[1], np.median(q, axis=0)
    for k, c in enumerate(coordinates):
        if c.topology == "cyclic":
            continue
        at = np.linspace(q[:, k].min(), q[:, k].max(), POINTS)
        where = np.tile(middle, (POINTS, 1))
        where[:, k] = at
        rest = np.zeros((POINTS, n))
        still, still_slopes = forces.pair(where, rest, rest)
        made = []
        for j in range(n):
            moved, slopes = forces.pair(where, rest, np.tile(np.eye(n)[j], (POINTS, 1)))
            for i in range(j + 1):
                unit = INERTIA.get(coordinates[i].velocity_unit, "") if i == j else ""
                entry = moved[:, i] - still[:, i], slopes[:, i] - still_slopes[:, i]
                made.append((f"M_{i + 1}{j + 1}", unit, *entry))
        potential = cumulative_trapezoid(still[:, k], at, initial=0)
        made.append(("V", "J", potential, cumulative_trapezoid(still_slopes[:, k], at, axis=0, initial=0)))
        made += _elastance(forces, data, where, k)
        for name, unit, value, slopes in made:
            if np.ptp(value) > CONSTANT * np.abs(value).max():
                yield Curve(name, unit, c.name, c.unit, at, value, slopes)


def _elastance(
    forces: _Forces, data: Dataset, where: Float[Array, "N n"], along: int
) -> Iterator[tuple[str, str, Array, Array]]:
    """1/C = ∂²V/∂Q² of each charge that is stored, along another coordinate."""
    for k, c in enumerate(data.coordinates):
        if c.kind == "electrical" and c.topology == "line" and k != along:
            charge = float(np.abs(data.arrays.q[:, k]).max()) or 1.0
            rest, sides = np.zeros_like(where), []
            for sign in (-1, 1):
                moved = where.copy()
                moved[:, k] = sign * charge
                sides.append(forces.pair(moved, rest, rest))
            value, slopes = ((b - a)[:, k] / (2 * charge) for a, b in zip(*sides, strict=True))
            yield f"1/C_{c.name}", "1/F", value, slopes


def _friction_curves(forces: _Forces, data: Dataset) -> Iterator[Curve]:
    """The odd part of the force over each velocity, up to the fastest in the data."""
    q, v = data.arrays.q, data.arrays.v
    where = np.tile(np.median(q, axis=0), (POINTS, 1))
    rest = np.zeros_like(where)
    for k, c in enumerate(data.coordinates):
        at = np.linspace(-1, 1, POINTS) * np.abs(v[:, k]).max()
        moved = rest.copy()
        moved[:, k] = at
        (one, one_slopes), (other, other_slopes) = (forces.pair(where, s * moved, rest) for s in (1, -1))
        value, slopes = (one - other)[:, k] / 2, (one_slopes - other_slopes)[:, k] / 2
        if np.ptp(value) > 0:
            name = f"friction_{c.velocity}"
            yield Curve(name, _force_unit(c), c.velocity, c.velocity_unit, at, value, slopes)


def _force_unit(c: Coordinate) -> str:
    """Unit of the generalised force on a coordinate."""
    return c.input_unit or {"m": "N", "rad": "N.m", "C": "V"}.get(c.unit, "")

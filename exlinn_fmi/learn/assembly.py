"""What data contribute to the Euler–Lagrange equations of a structured model.

With 𝓛 = Σ_t f_t(z(q)) μ_t(q̇), monomials μ of the velocities and network inputs z, (11) reads

    d/dt ∂𝓛/∂q̇_k − ∂𝓛/∂q_k = Σ_t  f_t (∂²μ_t q̈)_k + (∂f_t/∂z · ż) ∂μ_t/∂q̇_k − μ_t ∂f_t/∂z · ∂z/∂q_k,

linear in the values f_t and derivatives ∂f_t/∂z. The coefficients depend on data alone and are computed once;
whatever represents the functions (networks, a basis for linear least squares) is applied to them. All
quantities are dimensionless (`Scales`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Samples
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.learned import FAITHFUL, ModelSpec, Scales, angular

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Assembly:
    """Coefficients at B samples: r = value · f + gradient · ∂f/∂z + (K − Kᵀ)q̇ + ∂D/∂q̇ − push · F₀ − target.

    Args:
        z: network inputs (B, nz).
        basis: the direct path of the networks [1, z, products] (B, nd), and
        slopes: its derivatives with respect to z (B, nd, nz).
        velocity: q̇ (B, n).
        value: of each function f_t in each equation (B, n, T).
        gradient: of each derivative ∂f_t/∂z_j in each equation (B, n, T, nz).
        push: of the constant force F₀ in each equation (B, n).
        target: F (B, n).
    """

    z: Float[Array, "B nz"]
    basis: Float[Array, "B nd"]
    slopes: Float[Array, "B nd nz"]
    velocity: Float[Array, "B n"]
    value: Float[Array, "B n T"]
    gradient: Float[Array, "B n T nz"]
    push: Float[Array, "B n"]
    target: Float[Array, "B n"]

    def __len__(self) -> int:
        return len(self.target)

    def part(self, samples: slice) -> Assembly:
        """Some of the samples."""
        return Assembly(**{f.name: getattr(self, f.name)[samples] for f in fields(self)})

    def inertia(self) -> Assembly:
        """Coefficients of the inertial forces M q̈ alone."""
        others = ("velocity", "gradient", "push", "target")
        none = {name: np.zeros_like(getattr(self, name)) for name in others}
        return replace(self, **none)

    def chunks(self, size: int) -> Iterator[Assembly]:
        """Parts of at most `size` samples, so that a Jacobian fits into the cache."""
        return (self.part(slice(start, start + size)) for start in range(0, len(self), size))


def data_scales(samples: Samples, coordinates: tuple[Coordinate, ...]) -> Scales:
    """Units in which velocities, accelerations and powers are of size 1, whatever units the user has.

    Time is that of change, rms(q̇)/rms(q̈) in the geometric mean; each position's unit makes its velocity's
    rms 1; energy makes the largest input power 1.

    Args:
        samples: with velocities and accelerations that are not all 0, and at least one force.
        coordinates: the generalised coordinates.
    """
    velocity, acceleration, force = (
        np.sqrt(np.mean(x**2, axis=0)) for x in (samples.v, samples.a, samples.F)
    )
    time = float(np.exp(np.mean(np.log(velocity / acceleration))))
    low, high = samples.q.min(axis=0), samples.q.max(axis=0)
    line = np.array([c.topology == "line" for c in coordinates])
    return Scales(
        time=time,
        energy=float(np.max(force * velocity)) * time,
        position=tuple((velocity * time).tolist()),
        centre=tuple(np.where(line, (high + low) / 2, 0.0).tolist()),
        reach=tuple(np.where(line, (high - low) / 2, 1.0).tolist()),
    )


def inverse_assembly(spec: ModelSpec, samples: Samples) -> Assembly:
    """Coefficients of the inverse model (17), the paper's residual: one row for each sample and equation.

    Args:
        spec: a structured model.
        samples: the data, in the user's units.
    """
    assert spec.scales is not None
    position, speed = np.array(spec.scales.position), spec.scales.velocity
    w, a = samples.v / speed, samples.a * spec.scales.time / speed
    z, rate = topology_features(spec, samples.q)
    owners = spec.layout.owners
    slope = rate * position[owners]  # ∂z/∂q̂
    (rows, n), count, nz = w.shape, len(spec.layout.terms), len(owners)
    value, gradient = np.zeros((rows, n, count)), np.zeros((rows, n, count, nz))
    rate = slope * w[:, owners]  # ż
    for t, term in enumerate(spec.layout.terms):
        monomial, first, second = _velocity_monomial(term, w, a)
        value[:, :, t] = second
        gradient[:, :, t] = first[:, :, None] * rate[:, None]
        for j, k in enumerate(owners):
            gradient[:, k, t, j] -= monomial * slope[:, j]
    basis, slopes = product_basis(z, spec.layout.products)
    return Assembly(z, basis, slopes, w, value, gradient, np.ones_like(w), samples.F / spec.scales.force)


def weak_assembly(spec: ModelSpec, samples: Samples) -> Assembly:
    """Coefficients of the momenta M q̇ at B samples, then those of all that is left of (11) but d/dt (M q̇).

    Args:
        spec: a structured model.
        samples: the data; accelerations and forces are not looked at.
    """
    assert spec.scales is not None
    speeds = samples._replace(a=samples.v / spec.scales.time, F=np.zeros_like(samples.F))
    whole = inverse_assembly(spec, speeds)
    momenta = whole.inertia()
    owners = list(spec.layout.owners)
    rate = topology_features(spec, samples.q)[1] * np.array(spec.scales.position)[owners]
    rate = rate * whole.velocity[:, owners]  # ż
    change = momenta.value[..., None] * rate[:, None, None]  # Ṁ q̇ is part of d/dt (M q̇)
    rest = replace(whole, value=np.zeros_like(whole.value), gradient=whole.gradient - change)
    parts = {f.name: (getattr(momenta, f.name), getattr(rest, f.name)) for f in fields(Assembly)}
    return Assembly(**{name: np.concatenate(pair) for name, pair in parts.items()})


def product_basis(
    z: Float[Array, "B nz"], products: Sequence[tuple[int, ...]]
) -> tuple[Float[Array, "B H"], Float[Array, "B H nz"]]:
    """[1, z, products of features] and their derivatives with respect to z."""
    rows, nz = z.shape
    basis = np.ones((rows, 1 + nz + len(products)))
    slopes = np.zeros((*basis.shape, nz))
    basis[:, 1 : 1 + nz] = z
    slopes[:, 1 : 1 + nz] = np.eye(nz)
    for k, product in enumerate(products, start=1 + nz):
        basis[:, k] = z[:, product].prod(axis=1)
        for place, i in enumerate(product):
            slopes[:, k, i] += z[:, product[:place] + product[place + 1 :]].prod(axis=1)
    return basis, slopes


def product_curvature(
    z: Float[Array, "B nz"], products: Sequence[tuple[int, ...]]
) -> Float[Array, "B H nz nz"]:
    """Second derivatives of [1, z, products of features] with respect to z."""
    rows, nz = z.shape
    curvature = np.zeros((rows, 1 + nz + len(products), nz, nz))
    for k, product in enumerate(products, start=1 + nz):
        for a, i in enumerate(product):
            for b, j in enumerate(product):
                if a != b:
                    rest = [f for place, f in enumerate(product) if place not in (a, b)]
                    curvature[:, k, i, j] += z[:, rest].prod(axis=1)
    return curvature


def topology_curvature(
    spec: ModelSpec, q: Float[Array, "B n"]
) -> tuple[Float[Array, "B nz"], Float[Array, "B nz"]]:
    """First and second derivative of each network input with respect to its own coordinate."""
    assert spec.scales is not None
    z, slope = topology_features(spec, q)
    bend = np.empty_like(z)
    for k, i in enumerate(spec.layout.owners):
        if spec.coordinates[i].topology == "circle":
            bend[:, k] = -(angular(spec.coordinates[i]) ** 2) * z[:, k]
        else:
            place = (q[:, i] - spec.scales.centre[i]) / spec.scales.reach[i]
            tanh = np.sign(place) * np.tanh(np.maximum(np.abs(place) - FAITHFUL, 0))
            bend[:, k] = -2 * tanh * slope[:, k] / spec.scales.reach[i]
    return slope, bend


def _velocity_monomial(
    term: tuple[str, int, int], w: Array, a: Array
) -> tuple[Float[Array, " B"], Float[Array, "B n"], Float[Array, "B n"]]:
    """μ, ∂μ/∂q̇ and ∂²μ/∂q̇² q̈ of a term of 𝓛."""
    kind, i, j = term
    first, second = np.zeros_like(w), np.zeros_like(w)
    if kind == "V":
        return -np.ones(len(w)), first, second
    if kind == "A":
        first[:, i] = 1
        return w[:, i], first, second
    if i == j:
        first[:, i], second[:, i] = w[:, i], a[:, i]
        return w[:, i] ** 2 / 2, first, second
    first[:, i], first[:, j] = w[:, j], w[:, i]
    second[:, i], second[:, j] = a[:, j], a[:, i]
    return w[:, i] * w[:, j], first, second


def topology_features(
    spec: ModelSpec, q: Float[Array, "B n"]
) -> tuple[Float[Array, "B nz"], Float[Array, "B nz"]]:
    """Network inputs z(q) and the derivative of each with respect to its own coordinate."""
    assert spec.scales is not None
    z, slope = (np.empty((len(q), len(spec.layout.owners))) for _ in range(2))
    k = 0
    for i in spec.layout.positions:
        if spec.coordinates[i].topology == "circle":
            factor = angular(spec.coordinates[i])
            z[:, k], z[:, k + 1] = np.sin(factor * q[:, i]), np.cos(factor * q[:, i])
            slope[:, k], slope[:, k + 1] = factor * z[:, k + 1], -factor * z[:, k]
            k += 2
        else:
            place = (q[:, i] - spec.scales.centre[i]) / spec.scales.reach[i]
            beyond = np.maximum(np.abs(place) - FAITHFUL, 0)  # `mechanics.learned.saturate`
            z[:, k] = place - np.sign(place) * (beyond - np.tanh(beyond))
            slope[:, k] = (1 - np.tanh(beyond) ** 2) / spec.scales.reach[i]
            k += 1
    return z, slope

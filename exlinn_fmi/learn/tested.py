"""The equations of motion of structured networks against test functions: rows of `Objective` without q̈.

With the momenta p = M q̇ and all that is left of (11), r, a row is ∫ (φ r − φ̇ p − φ F) dt over its window
(`windows`): sums over samples, linear in what the networks make there. What needs no second derivative, as
d/dt A(q), stays in r, so that a total time derivative in 𝓛 has no effect to the last digit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset, Samples
from exlinn_fmi.learn.adjoint import Adjoint, Upstream
from exlinn_fmi.learn.assembly import Assembly, weak_assembly
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Rows
from exlinn_fmi.learn.windows import Windows, windows

Array = NDArray[np.float64]

MOST = 5000
"""Windows that are looked at."""
BESIDE = 24
"""So many fit into the longest trajectory: weights ask for more equations than a few terms do."""
BEYOND = 3.0
"""Changes of velocities whose square exceeds that of noise so many times tell of accelerations."""


class _Piece(NamedTuple):
    """Some samples, which of the windows they belong to, and how much they add to each: −φ̇ to p, φ to r."""

    samples: Assembly
    windows: slice
    weights: Float[Array, "C B"]


@dataclass(frozen=True)
class Weak(Rows):
    """The equations in windows.

    Args:
        networks: what is trained.
        data: trajectories; accelerations are not looked at.
        windows: of these data.
    """

    networks: StructuredNetworks
    data: Dataset
    windows: Windows

    @classmethod
    def all(cls, networks: StructuredNetworks, data: Dataset) -> Weak:
        """All windows of the data, or `MOST`.

        Raises:
            DataError: no trajectory is long enough for a single window.
        """
        return cls(networks, data, windows(data, BESIDE)).thin(MOST)

    def of(self, networks: StructuredNetworks) -> Weak:
        """The same for other weights θ of the model."""
        return Weak(networks, self.data, self.windows)

    @cached_property
    def target(self) -> Float[Array, "N n"]:
        """Forces."""
        assert self.networks.spec.scales is not None
        force = self.data.recorded_forces / self.networks.spec.scales.force
        target = np.zeros((len(self.windows), force.shape[1]))
        for piece in self.windows.pieces():
            target[piece.windows] += piece.held @ force[piece.rows]
        return target

    @cached_property
    def _pieces(self) -> tuple[_Piece, ...]:
        spec, pieces = self.networks.spec, []
        assert spec.scales is not None
        for rows, some, phi, slope, _ in self.windows.pieces():
            samples = weak_assembly(spec, Samples(*(x[rows] for x in self.data.arrays)))
            pieces.append(_Piece(samples, some, np.hstack([-spec.scales.time * slope, phi])))
        return tuple(pieces)

    def thin(self, most: int) -> Weak:
        """At most so many windows, evenly."""
        return Weak(self.networks, self.data, self.windows.thin(most))

    def samples(self, most: int) -> Assembly:
        """Samples that are in a window."""
        every = -(-sum(len(piece.samples) // 2 for piece in self._pieces) // most)
        parts = [piece.samples.part(slice(len(piece.samples) // 2, None, every)) for piece in self._pieces]
        names = [f.name for f in fields(Assembly)]
        return Assembly(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def gather(self, make: Callable[[Assembly], Float[Array, "B n k"]]) -> Float[Array, "N n k"]:
        """Sums over the samples of each window."""
        return self._sum(make, self._pieces)

    def _sum(self, make: Callable[[Assembly], Array], pieces: tuple[_Piece, ...]) -> Array:
        total: Array | None = None
        for samples, some, weights in pieces:
            part = np.tensordot(weights, make(samples), axes=1)
            total = np.zeros((len(self.windows), *part.shape[1:])) if total is None else total
            total[some] += part
        assert total is not None
        return total

    @cached_property
    def _momenta(self) -> tuple[_Piece, ...]:
        """The pieces with the momenta alone."""
        halves = (slice(len(piece.samples) // 2) for piece in self._pieces)
        return tuple(
            _Piece(piece.samples.part(half), piece.windows, piece.weights[:, half])
            for piece, half in zip(self._pieces, halves, strict=True)
        )

    def chunks(self) -> Iterator[Weak]:
        """All: a window is a sum over many samples, and there are few of them."""
        yield self

    def adjoints(self) -> Iterator[_Adjoint]:
        """One for all."""
        yield _Adjoint(self)

    def residual(self, theta: Float[Array, " P"]) -> Float[Array, "N n"]:
        """Equations less forces."""
        return self._sum(lambda at: self.networks.residual(theta, at), self._pieces) - self.target

    def inertia(self, theta: Float[Array, " P"]) -> Float[Array, "N n"]:
        """d/dt (M q̇)."""
        return self._sum(lambda at: self.networks.residual(theta, at), self._momenta)

    def jacobian(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "N n"], Float[Array, "N n P"]]:
        """The residual and its derivatives."""
        value, slopes = self._linearised(theta, self._pieces)
        return value - self.target, slopes

    def inertia_jacobian(
        self, theta: Float[Array, " P"]
    ) -> tuple[Float[Array, "N n"], Float[Array, "N n P"]]:
        """d/dt (M q̇) and its derivatives."""
        return self._linearised(theta, self._momenta)

    def _linearised(self, theta: Float[Array, " P"], pieces: tuple[_Piece, ...]) -> tuple[Array, Array]:
        def make(samples: Assembly) -> Array:
            value, slopes = self.networks.jacobian(theta, samples)
            return np.concatenate([value[..., None], slopes], axis=2)

        both = self._sum(make, pieces)
        return both[..., 0], both[..., 1:]


@dataclass(frozen=True)
class _Adjoint:
    """`adjoint.Adjoint` for windows: derivatives go back through their sums to the samples."""

    rows: Weak

    @cached_property
    def _parts(self) -> list[tuple[Adjoint, _Piece]]:
        return [(Adjoint(self.rows.networks, piece.samples), piece) for piece in self.rows._pieces]

    def forces(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
        """The residual and the inertial forces in it."""
        residual, inertia = -self.rows.target, np.zeros_like(self.rows.target)
        for one, piece in self._parts:
            r, x = one.forces(theta)
            residual[piece.windows] += piece.weights @ r
            inertia[piece.windows] += piece.weights @ x
        return residual, inertia

    def gradient(self, theta: Float[Array, " P"], upstream: Upstream) -> Float[Array, " P"]:
        """Derivatives by θ of what `upstream` has the derivatives of by residual and inertial forces."""
        by_residual, by_inertia = upstream(*self.forces(theta))
        total = np.zeros_like(theta)
        for one, piece in self._parts:
            back = [piece.weights.T @ by[piece.windows] for by in (by_residual, by_inertia)]
            total += one.gradient(theta, partial(_given, back[0], back[1]))
        return total


def _given(by_residual: Array, by_inertia: Array, *_: Array) -> tuple[Array, Array]:
    """`Upstream` of derivatives that are known already."""
    return by_residual, by_inertia


def usual_accelerations(data: Dataset) -> Float[Array, "N n"]:
    """Root mean square of each acceleration, from differences of velocities that exceed their noise."""
    names = [c.velocity for c in data.coordinates]
    time, v = data.frame["time"].to_numpy(dtype=float), data.frame[names].to_numpy(dtype=float)
    trajectory, noise = data.frame["trajectory"].to_numpy(), data.noise[-len(names) :]
    longest = int(data.frame.groupby("trajectory").size().max()) - 1
    usual, unknown, apart = np.zeros(len(names)), np.ones(len(names), dtype=bool), 1
    while unknown.any():
        same = trajectory[apart:] == trajectory[:-apart]
        steps = (time[apart:] - time[:-apart])[same, None]
        change = (v[apart:] - v[:-apart])[same]
        seen = (np.mean(change**2, axis=0) > BEYOND * 2 * noise**2) | (2 * apart > longest)
        rate = np.sqrt(np.mean((change / steps) ** 2, axis=0))
        usual, unknown = np.where(unknown & seen, rate, usual), unknown & ~seen
        apart *= 2
    return np.broadcast_to(usual, v.shape)

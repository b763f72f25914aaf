"""What the structured networks make small: the share of the forces that stays unexplained.

In the mean over the equations of motion:

    ‖r_i‖² / ‖F_i‖²              where an input acts,
    ‖r_i‖² / (‖x_i‖² + ‖y_i‖²)   where none does, r_i = x_i + y_i with the inertial forces x_i = (M q̈)_i.

An equation without input is homogeneous: against a fixed scale a model could shrink it until nothing is left
to explain; against its own size it cannot. Both are free of units. The objective is the loss + λ‖θ‖².

Rows are samples of the inverse model (17), or the equations against test functions (`tested.Weak`). Their
Jacobian is reduced to a triangle chunk by chunk (QR of what was there and what comes), so that no sum of
squares loses half of the digits and no large array is kept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.learn.adjoint import Adjoint, Upstream
from exlinn_fmi.learn.assembly import Assembly
from exlinn_fmi.learn.levenberg import Triangle, triangle
from exlinn_fmi.learn.networks import StructuredNetworks

Array = NDArray[np.float64]

CHUNK = 1024
"""Samples whose Jacobian is made at once, …"""
ENTRIES = 1_000_000
"""… fewer where so many entries of each equation's Jacobian do not hold them."""
SLICE = 512
"""Samples whose gradient is made at once: they fit into the cache."""


@runtime_checkable
class Reverse(Protocol):
    """Derivatives of what is made of rows, without a Jacobian, as `Adjoint` gives them."""

    def forces(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "N n"], Float[Array, "N n"]]:
        """The residual and the inertial forces in it."""

    def gradient(self, theta: Float[Array, " P"], upstream: Upstream) -> Float[Array, " P"]:
        """Derivatives by θ of what `upstream` has the derivatives of by residual and inertial forces."""


class Rows(ABC):
    """Rows of the equations of motion for θ; N rows of n equations, dimensionless."""

    networks: StructuredNetworks

    @property
    @abstractmethod
    def target(self) -> Float[Array, "N n"]:
        """Forces."""

    @abstractmethod
    def of(self, networks: StructuredNetworks) -> Rows:
        """The same for other weights θ of the model."""

    @abstractmethod
    def thin(self, most: int) -> Rows:
        """About as many of the rows, evenly."""

    @abstractmethod
    def samples(self, most: int) -> Assembly:
        """About as many of the samples that the rows are made of, evenly."""

    @abstractmethod
    def gather(self, make: Callable[[Assembly], Float[Array, "B n k"]]) -> Float[Array, "N n k"]:
        """Rows of what is made at samples, linear in their coefficients; forces left out."""

    @abstractmethod
    def chunks(self) -> Iterator[Rows]:
        """Parts whose Jacobian is small."""

    @abstractmethod
    def adjoints(self) -> Iterator[Reverse]:
        """Parts whose gradient is made at once."""

    @abstractmethod
    def residual(self, theta: Float[Array, " P"]) -> Float[Array, "N n"]:
        """Equations less forces."""

    @abstractmethod
    def inertia(self, theta: Float[Array, " P"]) -> Float[Array, "N n"]:
        """The part of the residual that is due to inertia."""

    @abstractmethod
    def jacobian(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "N n"], Float[Array, "N n P"]]:
        """The residual and its derivatives."""

    @abstractmethod
    def inertia_jacobian(
        self, theta: Float[Array, " P"]
    ) -> tuple[Float[Array, "N n"], Float[Array, "N n P"]]:
        """The inertial part and its derivatives."""


@dataclass(frozen=True)
class Inverse(Rows):
    """The inverse model (17) at samples.

    Args:
        networks: what is trained.
        data: from `inverse_assembly`.
    """

    networks: StructuredNetworks
    data: Assembly

    @property
    def target(self) -> Float[Array, "N n"]:
        """Forces."""
        return self.data.target

    def of(self, networks: StructuredNetworks) -> Inverse:
        """The same for other weights θ of the model."""
        return Inverse(networks, self.data)

    def thin(self, most: int) -> Inverse:
        """Every k-th sample."""
        return Inverse(self.networks, self.samples(most))

    def samples(self, most: int) -> Assembly:
        """The same."""
        return self.data.part(slice(None, None, -(-len(self.data) // most)))

    def gather(self, make: Callable[[Assembly], Float[Array, "N n k"]]) -> Float[Array, "N n k"]:
        """Each sample is a row."""
        return make(self.data)

    def chunks(self) -> Iterator[Inverse]:
        """Parts of `CHUNK` samples, or fewer."""
        size = min(CHUNK, ENTRIES // self.networks.size + 1)
        return (Inverse(self.networks, chunk) for chunk in self.data.chunks(size))

    def adjoints(self) -> Iterator[Adjoint]:
        """Parts of `SLICE` samples."""
        return (Adjoint(self.networks, part) for part in self.data.chunks(SLICE))

    def residual(self, theta: Float[Array, " P"]) -> Float[Array, "N n"]:
        """Equations less forces."""
        return self.networks.residual(theta, self.data)

    def inertia(self, theta: Float[Array, " P"]) -> Float[Array, "N n"]:
        """Inertial forces M q̈."""
        return self.networks.residual(theta, self.data.inertia())

    def jacobian(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "N n"], Float[Array, "N n P"]]:
        """The residual and its derivatives."""
        return self.networks.jacobian(theta, self.data)

    def inertia_jacobian(
        self, theta: Float[Array, " P"]
    ) -> tuple[Float[Array, "N n"], Float[Array, "N n P"]]:
        """Inertial forces and their derivatives."""
        return self.networks.jacobian(theta, self.data.inertia())


def loss(rows: Rows, theta: Float[Array, " P"]) -> float:
    """Share of the forces that stays unexplained, in the mean over the equations."""
    scale = np.sum(rows.target**2, axis=0)
    driven = scale > 0
    square = np.zeros(len(scale))
    with np.errstate(all="ignore"):  # a step too long is refused, whatever it overflows
        for chunk in rows.chunks():
            r = chunk.residual(theta)
            square += np.sum(r**2, axis=0)
            if not driven.all():
                scale += _own(r, chunk.inertia(theta), driven)
        return float(np.mean(square / scale))


def _own(r: Float[Array, "N n"], x: Float[Array, "N n"], driven: Bool[NDArray[np.bool_], " n"]) -> Array:
    """‖x‖² + ‖y‖² of the equations that no input acts in, r = x + y; 0 of the others."""
    return np.asarray(np.where(driven, 0, np.sum(x**2 + (r - x) ** 2, axis=0)))


@dataclass(frozen=True)
class Objective:
    """The loss + λ‖θ‖².

    Args:
        rows: what is to be explained.
        regularisation: λ.
    """

    rows: Rows
    regularisation: float

    def value(self, theta: Float[Array, " P"]) -> float:
        """The objective."""
        return loss(self.rows, theta) + self.regularisation * float(theta @ theta)

    @cached_property
    def _adjoints(self) -> list[Reverse]:
        return list(self.rows.adjoints())

    def gradient(self, theta: Float[Array, " P"]) -> tuple[float, Float[Array, " P"]]:
        """The objective and its gradient, without a Jacobian."""
        target = np.sum(self.rows.target**2, axis=0)
        driven, n, squares = target > 0, len(target), np.zeros(len(target))
        scale, fall = target.copy(), np.zeros(n)

        def upstream(r: Array, x: Array) -> tuple[Array, Array]:
            """Of Σ r²/(n·scale), where no input acts with scale = Σ x² + (r − x)²."""
            squares[:] += np.sum(r**2, axis=0)
            return 2 / n * (r / scale - fall * (r - x)), -2 / n * fall * (2 * x - r)

        with np.errstate(all="ignore"):  # a step too long is refused, whatever it overflows
            if not driven.all():
                for one in self._adjoints:
                    r, x = one.forces(theta)
                    scale += _own(r, x, driven)
                    fall += np.sum(r**2, axis=0)
                fall = np.where(driven, 0, fall / scale**2)
            gradient = sum(one.gradient(theta, upstream) for one in self._adjoints)
            value = float(np.mean(squares / scale)) + self.regularisation * float(theta @ theta)
            return value, np.asarray(gradient + 2 * self.regularisation * theta)

    def sizes(self, theta: Float[Array, " P"]) -> Float[Array, " P"]:
        """Squares of the norms of the Jacobian's columns, equations weighed as in the objective."""
        scale = np.sum(self.rows.target**2, axis=0)
        driven, squares = scale > 0, np.zeros((len(scale), len(theta)))
        for chunk in self.rows.chunks():
            r, j = chunk.jacobian(theta)
            squares += np.einsum("bnp,bnp->np", j, j)
            if not driven.all():
                scale += _own(r, chunk.inertia(theta), driven)
        return np.asarray(np.mean(squares / scale[:, None], axis=0))

    def linearise(self, theta: Float[Array, " P"]) -> Triangle:
        """Of r_i/√scale_i, whose Jacobian is (J − r gᵀ)/√scale with g the relative growth of √scale."""
        count = len(theta)
        scale = np.sum(self.rows.target**2, axis=0)
        driven, n = scale > 0, len(scale)
        factors, growth = np.zeros((n, count + 1, count + 1)), np.zeros((n, count))
        for chunk in self.rows.chunks():
            r, j = chunk.jacobian(theta)
            for i in range(n):
                factors[i] = triangle(factors[i], np.column_stack([j[:, i], r[:, i]]))
            if not driven.all():
                x, jx = chunk.inertia_jacobian(theta)
                scale += _own(r, x, driven)
                for i in np.flatnonzero(~driven).tolist():
                    growth[i] += x[:, i] @ jx[:, i] + (r - x)[:, i] @ (j - jx)[:, i]
        for factor, size, g in zip(factors, scale, growth, strict=True):
            factor[:, :count] -= np.outer(factor[:, count], g / size)
            factor /= np.sqrt(n * size)
        decay = np.sqrt(self.regularisation) * np.column_stack([np.eye(count), theta])
        r = triangle(decay, factors.reshape(-1, count + 1))
        return Triangle(float(r[:, count] @ r[:, count]), r[:count, :count], r[:count, count])

"""What the structured networks make small: the share of the forces that stays unexplained.

In the mean over the equations of motion:

    ‖r_i‖² / ‖F_i‖²              where an input acts,
    ‖r_i‖² / (‖x_i‖² + ‖y_i‖²)   where none does, r_i = x_i + y_i with the inertial forces x_i = (M q̈)_i.

An equation without input is homogeneous: against a fixed scale a model could shrink it until nothing is left
to explain; against its own size it cannot. Both are free of units. The objective is the loss + λ‖θ‖².

Rows are samples of the inverse model (17). Their Jacobian is reduced to a triangle chunk by chunk (QR of what
was there and what comes), so that no sum of squares loses half of the digits and no large array is kept.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.learn.assembly import Assembly
from exlinn_fmi.learn.levenberg import Triangle, triangle
from exlinn_fmi.learn.networks import StructuredNetworks

Array = NDArray[np.float64]

CHUNK = 1024
"""Samples whose Jacobian is made at once."""


class Rows(ABC):
    """Rows of the equations of motion for θ; N rows of n equations, dimensionless."""

    @property
    @abstractmethod
    def target(self) -> Float[Array, "N n"]:
        """Forces."""

    @abstractmethod
    def chunks(self) -> Iterator[Rows]:
        """Parts whose Jacobian is small."""

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

    def chunks(self) -> Iterator[Inverse]:
        """Parts of `CHUNK` samples."""
        return (Inverse(self.networks, chunk) for chunk in self.data.chunks(CHUNK))

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
                x = chunk.inertia(theta)
                scale += np.where(driven, 0, np.sum(x**2 + (r - x) ** 2, axis=0))
        return float(np.mean(square / scale))


@dataclass(frozen=True)
class Objective:
    """The loss + λ‖θ‖² as a function of some of the weights, the others being 0.

    Args:
        rows: what is to be explained.
        regularisation: λ.
        chosen: which of the free weights.
    """

    rows: Rows
    regularisation: float
    chosen: Bool[NDArray[np.bool_], " P"]

    def full(self, part: Float[Array, " p"]) -> Float[Array, " P"]:
        """All free weights."""
        theta = np.zeros(len(self.chosen))
        theta[self.chosen] = part
        return theta

    def value(self, part: Float[Array, " p"]) -> float:
        """The objective."""
        return loss(self.rows, self.full(part)) + self.regularisation * float(part @ part)

    def linearise(self, part: Float[Array, " p"]) -> Triangle:
        """Of r_i/√scale_i, whose Jacobian is (J − r gᵀ)/√scale with g the relative growth of √scale."""
        theta, count = self.full(part), len(part)
        scale = np.sum(self.rows.target**2, axis=0)
        driven, n = scale > 0, len(scale)
        factors, growth = np.zeros((n, count + 1, count + 1)), np.zeros((n, count))
        for chunk in self.rows.chunks():
            r, j = chunk.jacobian(theta)
            j = j[:, :, self.chosen]
            for i in range(n):
                factors[i] = triangle(factors[i], np.column_stack([j[:, i], r[:, i]]))
            if not driven.all():
                x, jx = chunk.inertia_jacobian(theta)
                jx = jx[:, :, self.chosen]
                for i in np.flatnonzero(~driven).tolist():
                    rest = r[:, i] - x[:, i]
                    scale[i] += x[:, i] @ x[:, i] + rest @ rest
                    growth[i] += x[:, i] @ jx[:, i] + rest @ (j - jx)[:, i]
        for factor, size, g in zip(factors, scale, growth, strict=True):
            factor[:, :count] -= np.outer(factor[:, count], g / size)
            factor /= np.sqrt(n * size)
        decay = np.sqrt(self.regularisation) * np.column_stack([np.eye(count), part])
        r = triangle(decay, factors.reshape(-1, count + 1))
        return Triangle(float(r[:, count] @ r[:, count]), r[:count, :count], r[:count, count])

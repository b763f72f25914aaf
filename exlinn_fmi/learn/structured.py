"""Training of the structured form: a linear start, then Levenberg–Marquardt on the inverse-model residual.

The loss is the share of the forces that stays unexplained, in the mean over the equations of motion:

    ‖r_i‖² / ‖F_i‖²              where an input acts,
    ‖r_i‖² / (‖x_i‖² + ‖y_i‖²)   where none does, r_i = x_i + y_i with the inertial forces x_i = (M q̈)_i.

An equation without input is homogeneous: against a fixed scale a model could shrink it until nothing is left
to explain; against its own size it cannot. Both are free of units. The objective is the loss + λ‖θ‖².

Three stages: the direct path alone, which suffices for mechanisms whose Lagrangian is trigonometric or a low
polynomial in the positions; then, if the target is not met, with the hidden units; both on every k-th sample,
since sampled motion repeats itself. The last stage takes all samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.assembly import Assembly, data_scales, inverse_assembly
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.start import Start, linear_start
from exlinn_fmi.mechanics.learned import ModelSpec
from exlinn_fmi.mechanics.structure import UNKNOWN, Structure
from exlinn_fmi.scenario.learning import Structured

Array = NDArray[np.float64]

CHUNK = 512
"""Samples whose Jacobian is made at once."""
COARSE = 4000
"""About as many samples do the first stages look at."""
PATIENCE = {"direct": (10, 0.5), "hidden": (30, 0.95), "all": (10, 0.9)}
"""A stage ends when that many iterations left more than that share of the loss."""


class _Sums:
    """Sums over the samples, for each equation, that make up loss, gradient and Gauss–Newton matrix.

    Args:
        data: all samples.
        size: number of weights.
    """

    def __init__(self, data: Assembly, size: int) -> None:
        n = data.target.shape[1]
        self.scale = np.sum(data.target**2, axis=0)  # ‖F‖², or ‖x‖² + ‖y‖² as it is summed up
        self.driven: Bool[NDArray[np.bool_], " n"] = self.scale > 0
        self.square = np.zeros(n)  # ‖r‖²
        self.gradient = np.zeros((n, size))  # Jᵀr
        self.growth = np.zeros((n, size))  # half the gradient of the scale
        self.matrix = np.zeros((n, size, size))  # JᵀJ

    def add_residual(self, r: Float[Array, "B n"], x: Float[Array, "B n"] | None) -> None:
        """Add residuals, and inertial forces where there are equations without input."""
        self.square += np.sum(r**2, axis=0)
        if x is not None:
            self.scale += np.where(self.driven, 0, np.sum(x**2 + (r - x) ** 2, axis=0))

    def add_jacobian(self, r: Float[Array, "B n"], j: Float[Array, "B n P"]) -> None:
        """Add to gradients and matrices."""
        for i in range(len(self.square)):
            self.gradient[i] += r[:, i] @ j[:, i]
            self.matrix[i] += j[:, i].T @ j[:, i]

    def add_growth(
        self,
        r: Float[Array, "B n"],
        j: Float[Array, "B n P"],
        x: Float[Array, "B n"],
        jx: Float[Array, "B n P"],
    ) -> None:
        """Add to the derivatives of the scales."""
        for i in np.flatnonzero(~self.driven):
            self.growth[i] += x[:, i] @ jx[:, i] + (r - x)[:, i] @ (j - jx)[:, i]

    @property
    def loss(self) -> float:
        """Mean over the equations of the share that is not explained."""
        return float(np.mean(self.square / self.scale))

    def normal(self) -> Normal:
        """Of r_i/√scale_i, whose Jacobian is (J − r gᵀ)/√scale with g the relative growth of √scale."""
        n = len(self.square)
        gradient, matrix = np.zeros(self.gradient.shape[1]), np.zeros(self.matrix.shape[1:])
        for s, size, c, d, m in zip(
            self.square, self.scale, self.gradient, self.growth, self.matrix, strict=True
        ):
            g = d / size
            gradient += (c - s * g) / (n * size)
            cross = np.outer(c, g)
            matrix += (m - cross - cross.T + s * np.outer(g, g)) / (n * size)
        return Normal(self.loss, gradient, matrix)


def loss(networks: StructuredNetworks, theta: Float[Array, " P"], data: Assembly) -> float:
    """Share of the forces in the data that stays unexplained, in the mean over the equations."""
    sums = _Sums(data, 0)
    with np.errstate(all="ignore"):  # a step too long is refused, whatever it overflows
        for chunk in data.chunks(CHUNK):
            x = None if sums.driven.all() else networks.residual(theta, chunk.inertia())
            sums.add_residual(networks.residual(theta, chunk), x)
        return sums.loss


@dataclass(frozen=True)
class _Objective:
    """The loss + λ‖θ‖² as a function of some of the weights, the others being 0."""

    networks: StructuredNetworks
    data: Assembly
    regularisation: float
    chosen: NDArray[np.bool_]

    def full(self, part: Float[Array, " p"]) -> Float[Array, " P"]:
        """All free weights."""
        theta = np.zeros(len(self.chosen))
        theta[self.chosen] = part
        return theta

    def value(self, part: Float[Array, " p"]) -> float:
        """The objective."""
        return loss(self.networks, self.full(part), self.data) + self.regularisation * float(part @ part)

    def normal(self, part: Float[Array, " p"]) -> Normal:
        """Objective, gradient and Gauss–Newton matrix."""
        theta, sums = self.full(part), _Sums(self.data, len(part))
        for chunk in self.data.chunks(CHUNK):
            r, j = self.networks.jacobian(theta, chunk)
            j = j[:, :, self.chosen]
            sums.add_jacobian(r, j)
            x = None
            if not sums.driven.all():
                x, jx = self.networks.jacobian(theta, chunk.inertia())
                sums.add_growth(r, j, x, jx[:, :, self.chosen])
            sums.add_residual(r, x)
        at = sums.normal()
        return Normal(
            at.value + self.regularisation * float(part @ part),
            at.gradient + self.regularisation * part,
            at.matrix + self.regularisation * np.eye(len(part)),
        )


def structured_spec(
    train: Dataset, options: Structured, seed: int, structure: Structure = UNKNOWN
) -> tuple[ModelSpec, Start]:
    """The model to train and its first weights.

    Args:
        train: data that excite all coordinates.
        options: the learner's settings.
        seed: of what is drawn.
        structure: what is known of the plant.
    """
    scales = data_scales(train.arrays, train.coordinates)
    n = len(train.coordinates)
    spec = ModelSpec(
        "structured", train.coordinates, options.hidden, scales, epsilon=(0.0,) * n, structure=structure
    )
    start = linear_start(spec.layout, inverse_assembly(spec, train.arrays), seed)
    return replace(spec, epsilon=start.epsilon), start


def iterate_structured(
    spec: ModelSpec, start: Start, train: Dataset, validation: Dataset, options: Structured
) -> Iterator[Iterate]:
    """Train; ends when the target is met or nothing more is gained.

    Args:
        spec: from `structured_spec`.
        start: from there too.
        train: data to fit.
        validation: data to watch.
        options: the learner's settings.

    Yields:
        The start of each stage and every iteration.
    """
    networks = StructuredNetworks(spec)
    data, held = (inverse_assembly(spec, dataset.arrays) for dataset in (train, validation))
    coarse = data.part(slice(None, None, -(-len(data) // COARSE)))
    theta, chosen, met = networks.pack(start.weights), networks.pack_mask(spec.layout.direct), False
    for stage, (patience, share) in PATIENCE.items():
        if stage == "hidden" and met:
            continue
        if stage == "hidden":
            chosen = np.ones_like(chosen)
        # Units that do not take part yet are silent; each starts from where it was drawn when it joins.
        objective = _Objective(networks, data if stage == "all" else coarse, options.regularisation, chosen)
        losses: list[float] = []
        for step in levenberg_marquardt(theta[chosen], objective.normal, objective.value):
            now = objective.full(step.theta)
            losses.append(step.value - options.regularisation * float(step.theta @ step.theta))
            yield Iterate(networks.unpack(now), losses[-1], loss(networks, now, held), stage)
            met = losses[-1] <= options.target
            if met or (len(losses) > patience and losses[-1] > share * losses[-1 - patience]):
                break
        theta[chosen] = step.theta

"""Training of the structured form: a linear start, then Levenberg–Marquardt on the inverse-model residual.

The objective is the mean square of F̂ − F (17) over samples and equations, in the units of `Scales`, + λ‖θ‖².
First the direct path is fitted, which suffices for mechanisms whose Lagrangian is trigonometric or
quadratic in the positions; hidden units join only if the target is not met.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.assembly import Assembly, data_scales, inverse_assembly
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.start import Start, linear_start
from exlinn_fmi.mechanics.learned import ModelSpec
from exlinn_fmi.scenario.schema import Structured

Array = NDArray[np.float64]

CHUNK = 512
"""Samples whose Jacobian is made at once."""
STAGES = {"direct": (10, 0.5), "full": (30, 0.98)}
"""A stage ends when that many iterations left more than that share of the loss."""


@dataclass(frozen=True)
class _Objective:
    """Mean square residual + λ‖θ‖² as a function of some of the weights, the others being fixed."""

    networks: StructuredNetworks
    data: Assembly
    regularisation: float
    fixed: Float[Array, " P"]
    chosen: NDArray[np.bool_]

    def full(self, part: Float[Array, " p"]) -> Float[Array, " P"]:
        """All free weights."""
        theta = self.fixed.copy()
        theta[self.chosen] = part
        return theta

    def loss(self, part: Float[Array, " p"]) -> float:
        """Mean square residual alone."""
        return mean_square(self.networks, self.full(part), self.data)

    def value(self, part: Float[Array, " p"]) -> float:
        return self.loss(part) + self.regularisation * float(part @ part)

    def normal(self, part: Float[Array, " p"]) -> Normal:
        """Value, gradient and Gauss–Newton matrix, summed chunk by chunk."""
        theta, size = self.full(part), len(part)
        square, gradient, matrix = 0.0, np.zeros(size), np.zeros((size, size))
        for chunk in self.data.chunks(CHUNK):
            residual, jacobian = self.networks.jacobian(theta, chunk)
            r, j = residual.ravel(), jacobian[:, :, self.chosen].reshape(-1, size)
            square += float(r @ r)
            gradient += r @ j
            matrix += j.T @ j
        count = self.data.target.size
        return Normal(
            square / count + self.regularisation * float(part @ part),
            gradient / count + self.regularisation * part,
            matrix / count + self.regularisation * np.eye(size),
        )


def mean_square(networks: StructuredNetworks, theta: Float[Array, " P"], data: Assembly) -> float:
    """Mean square of the residual, dimensionless."""
    with np.errstate(over="ignore", invalid="ignore"):  # a step too long is refused, whatever it overflows
        return (
            sum(float(np.sum(networks.residual(theta, c) ** 2)) for c in data.chunks(CHUNK))
            / data.target.size
        )


def structured_spec(train: Dataset, options: Structured, seed: int) -> tuple[ModelSpec, Start]:
    """The model to train and its first weights.

    Args:
        train: data that excite all coordinates.
        options: the learner's settings.
        seed: of what is drawn.
    """
    scales = data_scales(train.arrays, train.coordinates)
    n = len(train.coordinates)
    spec = ModelSpec("structured", train.coordinates, options.hidden, scales, epsilon=(0.0,) * n)
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
    data, held = (inverse_assembly(spec, d.arrays, 1 / start.forces) for d in (train, validation))
    theta, direct = networks.pack(start.weights), networks.pack_mask(spec.layout.direct)
    for (stage, (patience, share)), chosen in zip(
        STAGES.items(), (direct, np.ones_like(direct)), strict=True
    ):
        # Units that do not take part yet are silent; each starts from where it was drawn when it joins.
        objective = _Objective(networks, data, options.regularisation, np.zeros_like(theta), chosen)
        losses: list[float] = []
        for step in levenberg_marquardt(theta[chosen], objective.normal, objective.value):
            now = objective.full(step.theta)
            losses.append(step.value - options.regularisation * float(step.theta @ step.theta))
            yield Iterate(networks.unpack(now), losses[-1], mean_square(networks, now, held), stage)
            if losses[-1] <= options.target:
                return
            if len(losses) > patience and losses[-1] > share * losses[-1 - patience]:
                break
        theta[chosen] = step.theta

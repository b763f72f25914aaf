"""Training of the structured form: a linear start, then Levenberg–Marquardt on the inverse-model residual.

Three stages: the direct path alone, which suffices for mechanisms whose Lagrangian is trigonometric or a low
polynomial in the positions; then, if the target is not met, with the hidden units, from silent ones or from a
linear start of their own, whichever is better; both on every k-th sample, since sampled
motion repeats itself. The last stage takes all samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.assembly import data_scales, inverse_assembly
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.levenberg import levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Inverse, Objective, loss
from exlinn_fmi.learn.start import Start, hidden_starts, linear_start
from exlinn_fmi.mechanics.learned import ModelSpec
from exlinn_fmi.mechanics.structure import UNKNOWN, Structure
from exlinn_fmi.scenario.learning import Structured

Array = NDArray[np.float64]

COARSE = 4000
"""About as many samples do the first stages look at."""
PATIENCE = {"direct": (10, 0.5), "hidden": (20, 0.8), "all": (3, 0.5)}
"""A stage ends when that many iterations left more than that share of the loss."""
FLOOR = 1e-2
"""Weights are damped as if each had at least this share of the largest effect."""


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
    data, held = (Inverse(networks, inverse_assembly(spec, part.arrays)) for part in (train, validation))
    coarse = Inverse(networks, data.data.part(slice(None, None, -(-len(data.data) // COARSE))))
    theta, chosen, met = networks.pack(start.weights), networks.pack_mask(spec.layout.direct), False
    for stage, (patience, share) in PATIENCE.items():
        if stage == "hidden" and met:
            continue
        if stage == "hidden":
            chosen = np.ones_like(chosen)
            theta = _best_start(theta, coarse, held)
        # Units that do not take part yet are silent; each starts from where it was drawn when it joins.
        objective = Objective(data if stage == "all" else coarse, options.regularisation, chosen)
        losses: list[float] = []
        descent = levenberg_marquardt(theta[chosen], objective.linearise, objective.value, FLOOR)
        for step in descent:
            now = objective.full(step.theta)
            losses.append(step.value - options.regularisation * float(step.theta @ step.theta))
            yield Iterate(networks.unpack(now), losses[-1], loss(held, now), stage)
            met = losses[-1] <= options.target
            if met or (len(losses) > patience and losses[-1] > share * losses[-1 - patience]):
                break
        theta[chosen] = step.theta


def _best_start(theta: Float[Array, " P"], data: Inverse, held: Inverse) -> Float[Array, " P"]:
    """The weights as they are, hidden units silent, or those of a linear start, ranked as `Iterate` does."""
    networks = data.networks
    starts = map(networks.pack, hidden_starts(networks, networks.unpack(theta), data.data))
    return min((theta, *starts), key=lambda start: loss(data, start) * loss(held, start))

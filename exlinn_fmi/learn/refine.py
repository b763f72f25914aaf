"""Networks refined by maximum likelihood on trajectories, where noise makes the inverse model a poor judge.

First the direct path alone, then, if that leaves more than noise, the hidden units with it: under noise the
fewer weights that explain the data predict best. A weak prior holds weights that the data say nothing of.
What is kept is best by Schwarz's criterion (BIC) on training and validation data; to the latter only the
states that segments begin in are fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.trajectory import Segments, Shooting, cut
from exlinn_fmi.mechanics.coordinates import input_names, state_names

Array = NDArray[np.float64]

ROWS = 10_000
"""About as many rows does the fit look at."""
PRIOR = 1.0
"""Weight of the square of each dimensionless weight."""
SWEEPS = ((20, 1e-3), (20, 1e-4))
"""Most iterations, and the least gain of one, with noise as estimated and then as the residuals show it."""
EXPLAINED = 1.05
"""Residuals of no more than so many times the noise leave nothing to explain."""
FLOOR = 1e-2
"""Weights are damped as if each had at least this share of the largest effect."""
DAMPING = 1e-7
"""The inverse model gives a good start."""
JOINED = 1e-12
"""The same for states alone: gaps between segments, hard to open, would else slow them down."""
RELEVANT = 1e-6
"""Each state counts as if it had at least this noise, as a share of its standard deviation."""
SETTLED = 1e-3
"""States of the validation data are fitted until an iteration gains less than this share."""


class Candidate(NamedTuple):
    """What to begin with.

    Args:
        name: of the stage.
        theta: weights.
        chosen: those that are fitted; the others stay as they are.
    """

    name: str
    theta: Float[Array, " P"]
    chosen: Bool[NDArray[np.bool_], " P"]


def refine(
    networks: StructuredNetworks,
    candidates: tuple[Candidate, ...],
    train: Dataset,
    validation: Dataset,
    notes: Mapping[str, Any],
) -> Iterator[Iterate]:
    """Fit to trajectories; yields after each iteration, losses in squares of the noise for each value.

    Args:
        networks: what is trained.
        candidates: simple ones first; the next is tried where the one before leaves something to explain.
        train: data to fit.
        validation: data to judge by.
        notes: for the model's provenance.
    """
    segments = _segments(train)
    held = replace(_segments(validation), sigma=segments.sigma)
    count, held_count = (s.total * s.measured.shape[2] for s in (segments, held))
    for name, theta, chosen in candidates:
        part = StructuredNetworks(networks.spec, chosen, theta)
        used = part.size + np.count_nonzero(theta[~chosen])
        judge = _Judge(part, held)
        now, states, p = segments, None, theta[chosen]
        for most, least in SWEEPS:
            shooting = Shooting(part, now, PRIOR)
            value = np.inf
            first = shooting.start(p, states)
            descent = levenberg_marquardt(first, shooting.normal, shooting.value, FLOOR, part.size, DAMPING)
            for number, step in enumerate(descent):
                p, states = shooting.split(step.theta)
                fitted, judged = Shooting(part, segments).value(step.theta), judge.value(p)
                score = fitted + judged + used * np.log(count + held_count)
                shares = fitted / count, judged / held_count
                yield Iterate(part.unpack(p), *shares, name, True, 1, notes, score)
                if number >= most or value - step.value < least * step.value:
                    break
                value = step.value
            now = replace(now, sigma=shooting.noise(step.theta))
        if fitted <= EXPLAINED**2 * count:
            break


def _segments(data: Dataset) -> Segments:
    """Trajectories cut into segments, not too many rows and none without noise."""
    names = state_names(data.coordinates)
    every = max(len(data) // ROWS, 1)
    segments = cut(data, names, input_names(data.coordinates), every)
    size = data.frame[names].std().to_numpy(dtype=float)
    return replace(segments, sigma=np.maximum(segments.sigma, RELEVANT * size))


@dataclass
class _Judge:
    """How well weights predict data whose first states are fitted to them."""

    networks: StructuredNetworks
    data: Segments
    states: Float[Array, "B nx"] | None = None

    def value(self, p: Float[Array, " P"]) -> float:
        """Sum of squares of what is left over its noise."""
        shooting = Shooting(self.networks, self.data)
        count = len(p)

        def linearise(states: Float[Array, " S"]) -> Normal:
            at = shooting.normal(np.concatenate([p, states]))
            return Normal(at.value, at.gradient[count:], at.matrix[count:, count:])

        def square(states: Float[Array, " S"]) -> float:
            return shooting.value(np.concatenate([p, states]))

        before = np.inf
        first = shooting.start(p, self.states)[count:]
        for step in levenberg_marquardt(first, linearise, square, damping=JOINED):
            if not before - step.value > SETTLED * step.value:
                break
            before = step.value
        if np.isfinite(step.value):
            self.states = shooting.split(np.concatenate([p, step.theta]))[1]
        return step.value

"""Networks refined by maximum likelihood on trajectories, where noise makes the inverse model a poor judge.

First the direct path alone, then, if that leaves more than noise, the hidden units with it: under noise the
fewer weights that explain the data predict best. A weak prior holds weights that the data say nothing of.
What is kept predicts the validation data best, the states that segments begin in being fitted too.
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

ROWS = 20_000
"""About as many rows does the fit look at."""
PRIOR, NEVER = 1.0, 1e12
"""Weight of the square of a dimensionless weight that is fitted, and of one that stays 0."""
SWEEPS = ((20, 1e-4), (10, 1e-4))
"""Most iterations, and the least gain of one, with noise as estimated and then as the residuals show it."""
EXPLAINED = 1.05
"""Residuals of no more than so many times the noise leave nothing to explain."""
FLOOR = 1e-2
"""Weights are damped as if each had at least this share of the largest effect."""
RELEVANT = 1e-6
"""Each state counts as if it had at least this noise, as a share of its standard deviation."""
SETTLED = 1e-3
"""States of the validation data are fitted until an iteration gains less than this share."""


class Candidate(NamedTuple):
    """What to begin with.

    Args:
        name: of the stage.
        theta: weights.
        chosen: those that are fitted; the others stay 0.
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
    judge = _Judge(networks, replace(_segments(validation), sigma=segments.sigma))
    for name, theta, chosen in candidates:
        now, states, p = segments, None, np.where(chosen, theta, 0.0)
        for most, least in SWEEPS:
            shooting = Shooting(networks, now, np.where(chosen, PRIOR, NEVER))
            value = np.inf
            first = shooting.start(p, states)
            descent = levenberg_marquardt(first, shooting.normal, shooting.value, FLOOR, networks.size)
            for number, step in enumerate(descent):
                p, states = shooting.split(step.theta)
                share, score = step.value / (now.total * now.measured.shape[2]), judge.score(p)
                yield Iterate(networks.unpack(p), share, score, name, True, 1, notes, score)
                if number >= most or value - step.value < least * step.value:
                    break
                value = step.value
            now = replace(now, sigma=shooting.noise(step.theta))
        if (now.sigma <= EXPLAINED * segments.sigma).all():
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

    def score(self, p: Float[Array, " P"]) -> float:
        """Mean square of what is left over its noise."""
        shooting = Shooting(self.networks, self.data)
        count = len(p)

        def linearise(states: Float[Array, " S"]) -> Normal:
            at = shooting.normal(np.concatenate([p, states]))
            return Normal(at.value, at.gradient[count:], at.matrix[count:, count:])

        def value(states: Float[Array, " S"]) -> float:
            return shooting.value(np.concatenate([p, states]))

        before = np.inf
        for step in levenberg_marquardt(shooting.start(p, self.states)[count:], linearise, value):
            if not before - step.value > SETTLED * step.value:
                break
            before = step.value
        if np.isfinite(step.value):
            self.states = shooting.split(np.concatenate([p, step.theta]))[1]
        return step.value / float(self.data.total * self.data.measured.shape[2])

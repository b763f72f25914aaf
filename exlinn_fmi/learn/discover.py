"""Which physical terms the data need: from a generic family, prune what does not earn its keep, and refit.

Backward elimination by the extended Bayesian information criterion: a term stays if leaving it out costs more
than log N + 2 log P in twice the log-likelihood, N being the samples and P the candidates. What it would
cost follows from the Gauss–Newton matrix for all the others refitted; after each round the rest is refitted
to the trajectories themselves.

References: Schwarz (1978), Ann. Stat. 6, 461; Chen, Chen (2008), Biometrika 95, 759 (extended BIC, γ = 1).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import TrainingError
from exlinn_fmi.learn.projection import solve
from exlinn_fmi.learn.trajectory import Fit, Information, Segments, Shooting, cut, maximum_likelihood
from exlinn_fmi.learn.weak import inverse_regression, weak_regression
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.monomials import MonomialBasis, parse_term

Array = NDArray[np.float64]

RIDGES = (0.0, 1e-8, 1e-6, 1e-4, 1e-2)
"""Ridges of the linear solves among which the start is chosen."""
ORDERS = (0, 2)
"""Orders of the smaller families that starts are solved for, too."""
ROUNDS = 5
"""Most rounds of pruning and refitting."""
COARSE = 2000
"""About as many rows does the whole family look at until it is near its optimum, …"""
CLOSE = 4
"""… and that many iterations it then takes on all of them."""
RELEVANT = 1e-6
"""Terms are judged as if each state had at least this noise, as a share of its standard deviation."""
LEAST_MASS = 1e-3
"""Smallest eigenvalue of M at the data, as a share of its mean diagonal, that a start may have."""


@dataclass(frozen=True)
class Discovery:
    """The terms that are left at a stage of the work.

    Args:
        stage: what was done last.
        chosen: which of the generic family's terms stay.
        fit: the fit of those.
    """

    stage: str
    chosen: Bool[NDArray[np.bool_], " P"]
    fit: Fit

    @property
    def p(self) -> Float[Array, " P"]:
        """Coefficients of the whole family; exactly 0 where a term was pruned."""
        return spread(self.fit.p, self.chosen)


def spread(p: Float[Array, " K"], chosen: Bool[NDArray[np.bool_], " P"]) -> Float[Array, " P"]:
    """Coefficients of some terms among those of all."""
    full = np.zeros(len(chosen))
    full[chosen] = p
    return full


def least_mass(basis: MonomialBasis, p: Float[Array, " P"], data: Dataset) -> float:
    """Smallest eigenvalue of M at the data, M scaled by its mean diagonal; negative where one of that is."""
    q, v, _, _ = data.arrays
    rows = np.linspace(0, len(data) - 1, min(len(data), 500)).astype(int)
    n = v.shape[1]
    mass = evaluate(basis.system().mass_matrix, q[rows], v[rows], p).reshape(-1, n, n)
    mean = np.diag(mass.mean(axis=0))
    if not (mean > 0).all():
        return -1.0
    return float(np.linalg.eigvalsh(mass / np.sqrt(np.outer(mean, mean))).min())


def start(
    basis: MonomialBasis, data: Dataset, segments: Segments, known: Float[Array, " P"] | None = None
) -> Float[Array, " P"]:
    """Parameters to start from: of several linear solves with M ≻ 0, the one that predicts best.

    An equation without input is homogeneous, so that noise shrinks it: with many terms and much noise M is
    not positive definite, and a ridge or fewer terms are the better start.

    Args:
        basis: the family.
        data: trajectories.
        segments: the same, cut.
        known: parameters that are held, NaN where they are to be found.

    Raises:
        TrainingError: none of them predicts anything.
    """
    orders = np.array([_order(text, basis) for text in basis.terms])
    shooting = Shooting(basis.system(), segments)
    best, least = np.zeros(len(basis.start)), float("inf")
    held = np.full(len(best), np.nan) if known is None else known
    for kind in (weak_regression, inverse_regression):
        at = solve(partial(kind, basis, data), basis.start, held)
        regression = kind(basis, data, at)
        for highest in (*ORDERS, int(orders.max())):
            chosen = orders <= highest
            for ridge in RIDGES if highest == orders.max() else RIDGES[:1]:
                # Terms that do not take part are known to be 0.
                out = np.where(chosen, held[: basis.size], 0.0)
                p = np.concatenate([regression.solve(ridge, out), at[basis.size :]])
                if least_mass(basis, p, data) > LEAST_MASS and (error := shooting.misprediction(p)) < least:
                    best, least = p, error
    if not np.isfinite(least):
        raise TrainingError(
            "no combination of these terms has a positive definite mass matrix and predicts the data at all; "
            "give terms that fit the plant, more or richer data, or choose the preset 'structured'"
        )
    return best


def _order(text: str, basis: MonomialBasis) -> int:
    """How elaborate a term is: powers of functions of position; friction beyond viscous counts as 1."""
    velocities = [c.velocity for c in basis.coordinates]
    return sum(
        1 if f.name in velocities else f.power * int(f.function[1:] if f.function[0] == "T" else 1)
        for f in parse_term(text, basis.coordinates).factors
        if f.function
    )


def prune(fit: Fit, samples: float, candidates: int) -> Bool[NDArray[np.bool_], " K"]:
    """Terms that stay, by backward elimination on the quadratic model of the likelihood.

    Args:
        fit: where the quadratic model holds.
        samples: number of residuals N.
        candidates: number of terms P of the generic family.
    """
    price = np.log(samples) + 2 * np.log(candidates)
    stays = np.ones(len(fit.p), dtype=bool)
    gradient = fit.information.matrix @ fit.p
    while stays.sum() > 1:
        left = np.flatnonzero(stays)
        # With the others refitted, p moves to where the gradient along all that stay vanishes again.
        covariance = Information(fit.information.matrix[np.ix_(left, left)]).covariance
        p = covariance @ gradient[left]
        cost = p**2 / np.maximum(np.diag(covariance), np.finfo(float).tiny)
        if cost.min() > price:
            break
        stays[left[np.argmin(cost)]] = False
    return stays


def discover(basis: MonomialBasis, data: Dataset) -> Iterator[Discovery]:
    """Find the terms that trajectories need; yields after the first fit, each pruning and the last fit.

    Args:
        basis: the generic family.
        data: trajectories.
    """
    system = basis.system()
    names, size = system.state_names, data.frame[system.state_names].std().to_numpy()
    segments = cut(data, names, system.input_names)
    coarse = cut(data, names, system.input_names, max(len(data) // COARSE, 1))
    coarse, judged = (replace(s, sigma=np.maximum(s.sigma, RELEVANT * size)) for s in (coarse, segments))
    chosen = np.ones(basis.size, dtype=bool)
    fit = maximum_likelihood(system, coarse, start(basis, data, coarse), passes=1)
    fit = maximum_likelihood(system, judged, fit.p, iterations=CLOSE, passes=1)
    yield Discovery("all terms", chosen, fit)
    for _ in range(ROUNDS):
        stays = prune(fit, judged.total * len(names), basis.size)
        if stays.all():
            break
        chosen = chosen.copy()
        chosen[np.flatnonzero(chosen)[~stays]] = False
        system = basis.only(chosen).system()
        fit = maximum_likelihood(system, judged, fit.p[stays], fit.states, passes=1)
        yield Discovery("pruned", chosen, fit)
    yield Discovery("likelihood", chosen, maximum_likelihood(system, segments, fit.p, fit.states))

"""Which physical terms the data need: from a generic family, prune what does not earn its keep, and refit.

Backward elimination by the extended Bayesian information criterion: a term stays if leaving it out costs more
than log N + 2 log P in twice the log-likelihood, N being the samples and P the candidates. What it would
cost follows from the Gauss–Newton matrix for all the others refitted; after each round the rest is refitted
to the trajectories themselves.

References: Schwarz (1978), Ann. Stat. 6, 461; Chen, Chen (2008), Biometrika 95, 759 (extended BIC, γ = 1).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from exlinn_fmi.mechanics.coordinates import input_names, state_names
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
        basis: the generic family, with the shapes as they are known by now.
        chosen: which of its terms stay.
        fit: the fit of those; it has their parameters, and its information is on those that are not held.
        known: all parameters of the family that are held, NaN for the others.
    """

    stage: str
    basis: MonomialBasis
    chosen: Bool[NDArray[np.bool_], " T"]
    fit: Fit
    known: Float[Array, " P"]

    @property
    def p(self) -> Float[Array, " P"]:
        """Parameters of the whole family; coefficients are exactly 0 where a term was pruned."""
        kept = self.basis.kept(self.chosen)
        return np.where(kept, spread(self.fit.p, kept), np.where(self._is_shape, self.basis.start, 0))

    @property
    def free(self) -> Bool[NDArray[np.bool_], " P"]:
        """Parameters that were found: those that the covariance is of."""
        return self.basis.kept(self.chosen) & np.isnan(self.known)

    @property
    def deviations(self) -> Float[Array, " P"]:
        """Standard deviations of the parameters; 0 where pruned or held."""
        return spread(np.sqrt(np.maximum(np.diag(self.fit.information.covariance), 0)), self.free)

    @property
    def _is_shape(self) -> Bool[NDArray[np.bool_], " P"]:
        return np.arange(len(self.basis.start)) >= self.basis.size


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
                given = held[: basis.size]
                out = np.where(chosen | ~np.isnan(given), given, 0.0)
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
    shapes = [shape.name for shape in basis.shapes]
    order = 0
    for f in parse_term(text, basis.coordinates, shapes=shapes).factors:
        if f.name in velocities:
            order += bool(f.function)
        elif f.name not in shapes and (f.function or f.power > 1):  # q alone may be a mere coupling
            order += f.power * int(f.function[1:] if f.function[:1] == "T" else 1)
    return order


def prune(
    fit: Fit,
    samples: float,
    candidates: int,
    basis: MonomialBasis | None = None,
    known: Float[Array, " P"] | None = None,
) -> Bool[NDArray[np.bool_], " T"]:
    """Terms that stay, by backward elimination on the quadratic model of the likelihood.

    Args:
        fit: where the quadratic model holds.
        samples: number of residuals N.
        candidates: number of terms P of the generic family.
        basis: the terms of the fit, if some of them have shapes.
        known: parameters that are held, NaN for the others; their terms stay.
    """
    price = np.log(samples) + 2 * np.log(candidates)
    free = np.flatnonzero(np.ones(len(fit.p), bool) if known is None else np.isnan(known))
    terms = len(fit.p) if basis is None else basis.size
    stays = np.ones(terms, dtype=bool)
    is_term = free < terms
    # A shape moves the model by its column, of which as much as nothing is there at the optimum.
    gradient = fit.information.matrix @ np.where(is_term, fit.p[free], 0)
    while True:
        kept = stays if basis is None else basis.kept(stays)
        left = np.flatnonzero(kept[free])
        if np.count_nonzero(is_term[left]) <= 1:
            break
        # With the others refitted, p moves to where the gradient along all that stay vanishes again.
        covariance = Information(fit.information.matrix[np.ix_(left, left)]).covariance
        p = covariance @ gradient[left]
        cost = np.where(is_term[left], p**2 / np.maximum(np.diag(covariance), np.finfo(float).tiny), np.inf)
        if cost.min() > price:
            break
        stays[free[left[np.argmin(cost)]]] = False
    return stays


def negative_friction(
    basis: MonomialBasis, p: Float[Array, " P"], data: Dataset
) -> Bool[NDArray[np.bool_], " T"]:
    """Terms of D that give power to the motion, which no friction does.

    Args:
        basis: the terms.
        p: their parameters.
        data: where they act.
    """
    _, v, _, _ = data.arrays
    columns = evaluate(basis.rest, np.zeros_like(v), v, p).reshape(*v.shape, len(p))
    power = np.einsum("bn,bnk->k", v, columns)[: basis.size] * p[: basis.size]
    gives: NDArray[np.bool_] = (power < 0) & (np.arange(basis.size) >= len(basis.lagrangian))
    return gives


def eliminate(
    basis: MonomialBasis,
    data: Dataset,
    known: Float[Array, " P"],
    fit: Callable[[MonomialBasis, Float[Array, " P"], Fit | None], Fit],
    samples: float,
    first: Bool[NDArray[np.bool_], " T"],
) -> Iterator[Discovery]:
    """Prune and refit, until every term is worth its price; yields after each fit.

    Shapes are held where they start until pruning has come to an end, and are found then: most terms that
    hold one are not needed, and nothing is to be found of those.

    Args:
        basis: the generic family.
        data: what it is fitted to.
        known: parameters that are held, NaN for the others.
        fit: of a family with some parameters held, from its start or from an earlier fit of them.
        samples: number of residuals.
        first: terms that are looked at.
    """
    chosen, held = first, known.copy()
    held[basis.size :] = np.where(np.isnan(known), basis.start, known)[basis.size :]
    last = fit(basis.only(chosen), held[basis.kept(chosen)], None)
    yield Discovery("all terms", basis, chosen, last, held)
    for _ in range(ROUNDS):
        part, kept = basis.only(chosen), basis.kept(chosen)
        stays = prune(last, samples, basis.size, part, held[kept])
        negative = negative_friction(part, last.p, data) & np.isnan(held[kept][: part.size])
        stays &= ~negative
        if stays.all():
            if not (np.isnan(known[kept]) & ~np.isnan(held[kept])).any():
                break
            held = known
        chosen = chosen.copy()
        chosen[np.flatnonzero(chosen)[~stays]] = False
        last = last._replace(p=last.p[part.kept(stays)])
        last = fit(basis.only(chosen), held[basis.kept(chosen)], last)
        basis = basis.at(spread_over(last.p, basis, chosen))
        yield Discovery("pruned", basis, chosen, last, held)


def spread_over(
    p: Float[Array, " K"], basis: MonomialBasis, chosen: Bool[NDArray[np.bool_], " T"]
) -> Float[Array, " P"]:
    """Parameters of some terms among all; shapes that do not take part as they start."""
    kept = basis.kept(chosen)
    return np.where(kept, spread(p, kept), basis.start)


def discover(
    basis: MonomialBasis,
    first: Bool[NDArray[np.bool_], " T"] | None,
    data: Dataset,
    known: Float[Array, " P"] | None = None,
) -> Iterator[Discovery]:
    """Find the terms that trajectories need; yields after the first fit, each pruning and the last fit.

    Args:
        basis: the generic family.
        first: terms that are looked at; all of them if None.
        data: trajectories.
        known: parameters that are held, NaN for the others.
    """
    names, inputs = state_names(basis.coordinates), input_names(basis.coordinates)
    size = data.frame[names].std().to_numpy()
    segments = cut(data, names, inputs)
    coarse = cut(data, names, inputs, max(len(data) // COARSE, 1))
    coarse, judged = (replace(s, sigma=np.maximum(s.sigma, RELEVANT * size)) for s in (coarse, segments))

    def fit(part: MonomialBasis, held: Float[Array, " P"], last: Fit | None) -> Fit:
        free = np.isnan(held)
        system = part.system().bound(held)
        if last is None:
            first = start(part, data, coarse, held)
            found = maximum_likelihood(system, coarse, first[free], passes=1)
            found = maximum_likelihood(system, judged, found.p, iterations=CLOSE, passes=1)
        else:
            found = maximum_likelihood(system, judged, last.p[free], last.states, passes=1)
        return found._replace(p=np.where(free, spread(found.p, free), held))

    held = np.full(len(basis.start), np.nan) if known is None else known
    first = np.ones(basis.size, dtype=bool) if first is None else first
    for found in eliminate(basis, data, held, fit, judged.total * len(names), first):
        yield found
    part, held = found.basis.only(found.chosen), found.known[found.basis.kept(found.chosen)]
    free, last = np.isnan(held), found.fit
    final = maximum_likelihood(part.system().bound(held), segments, last.p[free], last.states)
    final = final._replace(p=np.where(free, spread(final.p, free), held))
    basis = found.basis.at(spread_over(final.p, found.basis, found.chosen))
    yield replace(found, stage="likelihood", basis=basis, fit=final)

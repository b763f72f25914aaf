"""The learner `terms`: a short sum of physical terms, found by the objective that the data call for.

``inverse`` and ``weak`` are linear least squares; ``trajectory`` is maximum likelihood by multiple shooting
(`discover`). All prune the generic terms by the same criterion, and all give each coefficient its standard
deviation, which goes into the model's provenance.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.basis import entry, families, generic_basis
from exlinn_fmi.learn.discover import COARSE, ROUNDS, Discovery, discover, eliminate, least_mass, spread_over
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.noise import CLEAN, relative_noise
from exlinn_fmi.learn.projection import Make, solve
from exlinn_fmi.learn.trajectory import Fit, Information, Shooting, cut
from exlinn_fmi.learn.weak import Regression, inverse_regression, weak_regression
from exlinn_fmi.learn.windows import OVERLAP
from exlinn_fmi.mechanics.coordinates import Parameter, state_names
from exlinn_fmi.mechanics.learned import ModelSpec
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.mechanics.structure import UNKNOWN, Structure
from exlinn_fmi.scenario.learning import Objective, Terms

Array = NDArray[np.float64]

Masks = Sequence[NDArray[np.bool_]]

GENERIC = Terms(preset="terms")
BEYOND = 3.0
"""Residuals of so many times the noise tell that the terms found are not the whole truth, …"""
SHORT = 1e-3
"""… and so does this share of the forces where data are clean."""
NO_FORMULA = (
    "no short sum of these terms is true here; take the preset 'structured' or give terms of your own"
)
STAGES = ROUNDS + 2
"""Most iterates that the learner gives."""
CONSISTENT = 1e-8
"""Accelerations that leave no more than this share of the forces unexplained were measured, or as good as."""
RESOLVED = 1e-4
"""If not, and the weak form leaves less than this share, the terms are right and accelerations are not."""
LEAST_MISFIT = 1e-6
"""Terms are judged as if forces had at least this noise, as a share of their size."""
EXPLAINED = 1.1
"""A family that leaves no more than so many times that explains all there is to explain."""


def terms_spec(train: Dataset, options: Terms, structure: Structure = UNKNOWN) -> ModelSpec:
    """The model to train: the user's candidates, or generic ones that what is known of the plant leaves."""
    if options.lagrangian:
        shapes = tuple(Parameter(name, value, "") for name, value in options.shapes.items())
        texts = tuple(options.lagrangian), tuple(options.dissipation)
        basis = MonomialBasis(train.coordinates, *texts, shapes)
    else:
        basis = generic_basis(train, structure)
    return ModelSpec(
        "terms",
        train.coordinates,
        0,
        lagrangian_features=basis.lagrangian,
        dissipation_features=basis.dissipation,
        structure=structure,
        inside=tuple((shape.name, shape.value) for shape in basis.shapes),
    )


def choose(
    objective: Objective, basis: MonomialBasis, data: Dataset, known: Float[Array, " P"] | None = None
) -> tuple[Objective, str]:
    """What to make small, and why.

    Args:
        objective: what the user chose; ``auto`` leaves it to the data.
        basis: a family that can explain the data.
        data: what it is fitted to.
        known: parameters that are held, NaN for the others.
    """
    if objective != "auto":
        return objective, f"{objective}: as the scenario says"
    noise = relative_noise(data)
    worst = max(noise, key=lambda name: noise[name])
    if noise[worst] > CLEAN:
        return (
            "trajectory",
            f"trajectory: {worst} has {100 * noise[worst]:.2g} % noise, the most of all states",
        )
    misfit = unexplained(inverse_regression, basis, data, known)
    # Where not even the weak form fits it is the terms that fall short: no objective mends that.
    if misfit > CONSISTENT and unexplained(weak_regression, basis, data, known) < RESOLVED:
        return "trajectory", _doubt(misfit)
    return "inverse", "inverse: the states are clean and the accelerations do not contradict them"


def _doubt(misfit: float) -> str:
    return f"trajectory: states are clean, but {100 * misfit:.2g} % of forces do not fit the accelerations"


def unexplained(
    kind: Callable[..., Regression],
    basis: MonomialBasis,
    data: Dataset,
    known: Float[Array, " P"] | None,
) -> float:
    """What the best of a family leaves unexplained, as a share of the forces.

    Args:
        kind: `inverse_regression` or `weak_regression`.
        basis: the family.
        data: what it is fitted to.
        known: parameters that are held, NaN for the others.
    """
    p = solve(partial(kind, basis, data), basis.start, known)
    return kind(basis, data, p).misfit(p)


def iterate_terms(
    spec: ModelSpec,
    train: Dataset,
    validation: Dataset,
    objective: Objective,
    options: Terms = GENERIC,
) -> Iterator[Iterate]:
    """Train; yields after each stage of the work.

    Args:
        spec: from `terms_spec`.
        train: data to fit.
        validation: data to watch.
        objective: what to make small.
        options: the learner's settings: candidates of the user are all looked at together.
    """
    basis = spec.basis
    names = [*basis.terms, *(shape.name for shape in basis.shapes)]
    held = np.array([options.known.get(name, np.nan) for name in names], dtype=float)
    masks = [np.ones(basis.size, dtype=bool)] if options.lagrangian else families(basis)
    found, why = _stages(basis, masks, train, objective, held)
    judge = prediction_error if why.startswith("trajectory") else force_misfit
    for step, now in enumerate(found):
        p, count = now.p, len(basis.lagrangian)
        yield Iterate(
            {
                "lagrangian.terms": p[:count],
                "dissipation.terms": p[count : basis.size],
                "shapes": p[basis.size :],
            },
            judge(basis, p, train),
            judge(basis, p, validation),
            now.stage,
            least_mass(basis, p, train) > 0,
            step,
            _notes(basis, now, why, train),
        )


def _stages(
    basis: MonomialBasis, masks: Masks, data: Dataset, objective: Objective, held: Float[Array, " P"]
) -> tuple[Iterable[Discovery], str]:
    """What is done one after the other, and why.

    Clean data are fitted by least squares. What this leaves tells whether the accelerations are as clean as
    the states; if not, the weak form tells all but a few terms apart, and those are fitted to trajectories.
    """
    if objective != "auto" or max(relative_noise(data).values()) > CLEAN:
        chosen, why = choose(objective, basis, data)
        if chosen != "trajectory":
            return _least_squares(basis, masks, data, chosen, held), why
        return discover(*narrow(basis, masks, data, "weak", held), data, held), why
    stages = list(_least_squares(basis, masks, data, "inverse", held))
    misfit = np.sqrt(force_misfit(stages[-1].basis, stages[-1].p, data))
    if misfit > CONSISTENT:
        *_, weak = _least_squares(basis, masks, data, "weak", held)
        if weak_regression(weak.basis, data, weak.p).misfit(weak.p) < RESOLVED:
            return discover(weak.basis, weak.chosen, data, held), _doubt(misfit)
    return stages, "inverse: the states are clean and the accelerations do not contradict them"


def narrow(
    basis: MonomialBasis, masks: Masks, data: Dataset, objective: Objective, known: Float[Array, " P"]
) -> tuple[MonomialBasis, NDArray[np.bool_]]:
    """The family of terms that explains the data best for its size, by the same criterion as single terms.

    Args:
        basis: all terms.
        masks: families of them that are tried, the richest last.
        data: what they are to explain.
        objective: ``inverse`` or ``weak``.
        known: parameters that are held, NaN for the others.

    Returns:
        The basis with the shapes of that family's rational functions as they were found, and the family.
    """
    if len(masks) == 1:
        return basis, masks[0]
    if objective == "inverse":
        every = -(-len(data) // COARSE)
        data = Dataset(data.frame[::every], data.coordinates)
    best, found, family = np.inf, basis, masks[-1]
    lengths = np.array([s.name.startswith(("a_", "h_")) for s in basis.shapes], dtype=bool)
    for mask in masks[:-1]:
        part, kept = basis.only(mask), basis.kept(mask)
        make, windows = regress(part, data, objective)
        held = known[kept]
        friction = np.append(np.zeros(part.size, dtype=bool), ~lengths[kept[basis.size :]])
        held = np.where(friction & np.isnan(held), part.start, held)  # it is found when terms are few
        p = solve(make, part.start, held)
        regression = make(p)
        samples = regression.force.size / windows
        misfit = np.hypot(regression.misfit(p), LEAST_MISFIT)
        score = 2 * samples * np.log(misfit) + part.size * (np.log(samples) + 2 * np.log(basis.size))
        if score < best:
            best, found, family = score, basis.at(spread_over(p, basis, mask)), mask
        if misfit < EXPLAINED * LEAST_MISFIT:
            break  # more terms cannot do better
    return found, family


def _least_squares(
    basis: MonomialBasis,
    masks: Masks,
    data: Dataset,
    objective: Objective,
    known: Float[Array, " P"],
) -> Iterator[Discovery]:
    """Least squares on a family of terms, and on those that pruning leaves."""
    basis, first = narrow(basis, masks, data, objective, known)

    def fit(part: MonomialBasis, held: Float[Array, " P"], last: Fit | None) -> Fit:
        make, windows = regress(part, data, objective)
        return linear_fit(make, part.start, windows, LEAST_MISFIT, held)

    make, windows = regress(basis, data, objective)
    samples = make(basis.start).force.size / windows
    for found in eliminate(basis, data, known, fit, samples, first):
        yield found
    part, held = found.basis.only(found.chosen), found.known[found.basis.kept(found.chosen)]
    make, windows = regress(part, data, objective)
    yield replace(found, stage="least squares", fit=linear_fit(make, part.start, windows, 0.0, held))


def regress(basis: MonomialBasis, data: Dataset, objective: Objective) -> tuple[Make, int]:
    """The problem of ``inverse`` or ``weak``, and how many rows share samples, and so count as one."""
    if objective == "weak":
        return partial(weak_regression, basis, data), OVERLAP
    return partial(inverse_regression, basis, data), 1


def linear_fit(
    make: Make,
    start: Float[Array, " P"],
    windows: int,
    least: float = 0.0,
    known: Float[Array, " P"] | None = None,
) -> Fit:
    """Least squares with covariance from its residuals.

    Args:
        make: the problem at given shapes.
        start: where shapes are looked for.
        windows: how many of its rows count as one.
        least: smallest noise of the forces, as a share of their size.
        known: parameters that are held, NaN where they are to be found.

    Returns:
        All parameters; the information is on those that were to be found.
    """
    p = solve(make, start, known)
    regression = make(p)
    free = np.ones(len(p), dtype=bool) if known is None else np.isnan(known)
    flat = regression.columns.reshape(-1, len(p))[:, free]
    force = np.sqrt(np.mean(regression.force**2))
    sigma = max(regression.misfit(p), least, np.finfo(float).eps) * force
    value = float(np.sum(regression.residual(p) ** 2) / sigma**2)
    return Fit(p, np.zeros((0, 0)), value, Information(flat.T @ flat / (windows * sigma**2)), np.zeros(0))


def force_misfit(basis: MonomialBasis, p: Float[Array, " P"], data: Dataset) -> float:
    """Square of the share of the forces that the inverse model (17) leaves unexplained."""
    return inverse_regression(basis, data, p).misfit(p) ** 2


def prediction_error(basis: MonomialBasis, p: Float[Array, " P"], data: Dataset) -> float:
    """Mean square error of states predicted over a segment, relative to their variance.

    Args:
        basis: the family.
        p: its coefficients.
        data: trajectories; the segments start as measured.
    """
    chosen = p[: basis.size] != 0
    system = basis.only(chosen).system()
    size = data.frame[system.state_names].std().to_numpy()
    segments = replace(cut(data, system.state_names, system.input_names), sigma=np.where(size > 0, size, 1))
    return Shooting(system, segments).misprediction(p[basis.kept(chosen)]) / (segments.total * len(size))


def _notes(basis: MonomialBasis, found: Discovery, why: str, data: Dataset) -> dict[str, Any]:
    """Provenance: the objective and its reason, noise, and the terms with their deviations."""
    if found.fit.sigma.size:  # of states, as the residuals of trajectories show it
        excess = float((found.fit.sigma / np.maximum(data.noise, CLEAN * _size(data))).max())
        why += f"; {found.fit.information}"
        if excess > BEYOND and not found.fit.is_noise:
            why += f"; they leave residuals of {excess:.3g} times the noise: {NO_FORMULA}"
    elif (misfit := np.sqrt(force_misfit(found.basis, found.p, data))) > SHORT:
        why += f"; they leave {100 * misfit:.2g} % of the forces unexplained: {NO_FORMULA}"
    covariance = {
        "of": np.flatnonzero(found.free).tolist(),
        "matrix": found.fit.information.covariance.tolist(),
    }
    return {
        "objective": why,
        "noise": relative_noise(data),
        "deviations": found.deviations.tolist(),
        "covariance": covariance,
    }


def _size(data: Dataset) -> Float[Array, " nx"]:
    """Standard deviation of each state."""
    return np.asarray(data.frame[state_names(data.coordinates)].to_numpy(dtype=float).std(axis=0))


def term_table(spec: ModelSpec, p: Float[Array, " P"], deviations: Float[Array, " P"]) -> pd.DataFrame:
    """The terms found: where they stand, their function, coefficient, deviation and 95 % interval.

    Args:
        spec: of the form ``terms``.
        p: coefficients of 𝓛's terms, then of D's, then shapes.
        deviations: their standard deviations.
    """
    rows: list[tuple[Any, ...]] = []
    basis = spec.basis
    texts = (*basis.terms, *(shape.name for shape in basis.shapes))
    values = {name: f"{x:.6g}" for (name, _), x in zip(spec.inside, p[basis.size :], strict=True)}
    names = "|".join(map(re.escape, values)) or "$^"
    for k in np.flatnonzero((p != 0) & basis.kept(p[: basis.size] != 0)):
        if k < len(spec.lagrangian_features):
            place, function, factor = entry(texts[k], spec.coordinates, tuple(values))
        else:
            place, function, factor = ("D" if k < basis.size else "shape"), texts[k], 1.0
        if place != "shape":
            function = re.sub(rf"\b({names})\b", lambda match: values[match[0]], function)
        value, std = factor * p[k], abs(factor) * deviations[k]
        rows.append((place, function or "1", value, std, value - 1.96 * std, value + 1.96 * std, texts[k]))
    return pd.DataFrame(rows, columns=["entry", "function", "coefficient", "std", "low", "high", "term"])


def formula(table: pd.DataFrame) -> str:
    """The terms in one line: M_11 = 0.1 + 0.04 sin(alpha)^2; A_2 = 1 alpha; D = …."""
    parts = []
    for place, rows in table[table["entry"] != "shape"].groupby("entry", sort=False):
        terms = [
            f"{c:.6g}" if f == "1" else f"{c:.6g}*{f}"
            for c, f in zip(rows["coefficient"], rows["function"], strict=True)
        ]
        parts.append(f"{place} = {' + '.join(terms).replace('+ -', '- ')}")
    return "; ".join(parts)

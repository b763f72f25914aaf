"""Physical parameters straight from the data, with the uncertainty that noise leaves.

The user's monomials are the family 𝓛 = Σ p_k φ_k, D = Σ p_k ψ_k itself, fitted by the objective that the data
call for; deviations come from the Gauss–Newton matrix and the residuals. What the data cannot tell apart is
said by name and has no number. Where the monomials do not explain the data down to their noise, there is no
estimate: then parameters are read off the learned model (`identify`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import TrainingError
from exlinn_fmi.learn.discover import spread, start
from exlinn_fmi.learn.identify import Identified, Unknowns, parameter_table
from exlinn_fmi.learn.noise import CLEAN
from exlinn_fmi.learn.terms import choose, linear_fit, regress, unexplained
from exlinn_fmi.learn.trajectory import Fit, cut, maximum_likelihood
from exlinn_fmi.learn.weak import inverse_regression
from exlinn_fmi.scenario.learning import Identify, Objective

Array = NDArray[np.float64]

EXPLAINED = 1.5
"""Residuals that exceed the estimated noise by no more than this factor are explained."""
FILTERED = 1e-3
"""States look clean to the eye for white noise; a larger share of forces that do not fit tells of another."""
CONFIDENCE = 1.96
"""Standard deviations on either side of a 95 % interval."""


class Estimate(NamedTuple):
    """Parameters from the data, or why there are none.

    Args:
        identified: the table with columns std, low and high; None where there is no estimate.
        note: what was done and why, and what the data cannot tell apart; empty where data are clean.
    """

    identified: Identified | None
    note: str


def estimate(data: Dataset, options: Identify, truth: Mapping[str, float], objective: Objective) -> Estimate:
    """Fit the user's family to the data.

    Args:
        data: trajectories.
        options: parameters and their monomials.
        truth: parameters of the plant as far as they are known.
        objective: what to make small.

    Raises:
        ModelError: a monomial cannot be read.
    """
    unknowns = Unknowns.of(data.coordinates, options)
    basis, known = unknowns.basis, unknowns.known
    chosen, why = choose(objective, basis, data, known)
    if objective == "auto" and chosen == "inverse":
        share = unexplained(inverse_regression, basis, data, known)
        if share < FILTERED:
            return Estimate(None, "")
        chosen = "trajectory"
        why = (
            f"trajectory: states look clean, but {100 * share:.2g} % of forces do not fit the accelerations, "
            "as when noise was filtered"
        )
    if chosen == "trajectory":
        system, free = basis.system().bound(known), np.isnan(known)
        segments = cut(data, system.state_names, system.input_names)
        try:
            found = start(basis, data, segments, known)
            fit = maximum_likelihood(system, segments, found[free])
            fit = fit._replace(p=np.where(free, spread(fit.p, free), known))
        except (TrainingError, np.linalg.LinAlgError):
            return Estimate(None, "read off the learned model: the monomials alone predict nothing")
        size = data.frame[system.state_names].std().to_numpy()
        excess = float((fit.sigma / np.maximum(segments.sigma, CLEAN * size)).max())
        # The estimate takes the noise for white: what was filtered is more, but forgets itself soon.
        if not (excess <= EXPLAINED or fit.is_noise):
            reason = f"the monomials leave residuals of {excess:.3g} times the noise"
            return Estimate(None, f"read off the learned model: {reason}")
        misfit = float((fit.sigma / size).max())
        why += f"; {fit.information}"
        regression = inverse_regression(basis, data, fit.p)
    else:
        make, windows = regress(basis, data, chosen)
        fit = linear_fit(make, basis.start, windows, known=known)
        regression = make(fit.p)
        misfit = regression.misfit(fit.p)
    lost, doubts = unknowns.lost(fit.information, regression)
    told = "".join(f"; not identifiable: {doubt}" for doubt in doubts)
    held = ", ".join(f"{n} = {x:g}" for n, x in zip(unknowns.names, known, strict=True) if np.isfinite(x))
    told += f"; held: {held}" if held else ""
    return Estimate(Identified(_table(unknowns, fit, lost, truth), misfit), why + told)


def _table(unknowns: Unknowns, fit: Fit, lost: NDArray[np.bool_], truth: Mapping[str, float]) -> pd.DataFrame:
    """Parameters beside their true values, with deviations and 95 % intervals."""
    values = np.where(lost, np.nan, fit.p)
    deviation = np.sqrt(np.maximum(np.diag(fit.information.covariance), 0))
    std = np.where(lost, np.nan, spread(deviation, np.isnan(unknowns.known)))
    table = parameter_table(unknowns.names, values, truth)
    return table.assign(std=std, low=values - CONFIDENCE * std, high=values + CONFIDENCE * std)

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
from exlinn_fmi.learn.discover import start
from exlinn_fmi.learn.identify import PART, Identified, parameter_table
from exlinn_fmi.learn.noise import CLEAN
from exlinn_fmi.learn.terms import choose, linear_fit, regress
from exlinn_fmi.learn.trajectory import Fit, cut, maximum_likelihood
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.scenario.learning import Identify, Objective

Array = NDArray[np.float64]

EXPLAINED = 1.5
"""Residuals that exceed the estimated noise by no more than this factor are explained."""
CONFIDENCE = 1.96
"""Standard deviations on either side of a 95 % interval."""


class Estimate(NamedTuple):
    """Parameters from the data, or why there are none.

    Args:
        identified: the table with columns std, low and high; None where there is no estimate.
        note: what was done and why, and what the data cannot tell apart.
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
    names = [*options.lagrangian, *options.dissipation]
    basis = MonomialBasis(
        data.coordinates, tuple(options.lagrangian.values()), tuple(options.dissipation.values())
    )
    chosen, why = choose(objective, basis, data)
    if chosen == "trajectory":
        system = basis.system()
        segments = cut(data, system.state_names, system.input_names)
        try:
            fit = maximum_likelihood(system, segments, start(basis, data, segments))
        except TrainingError:
            return Estimate(None, "read off the learned model: the monomials alone predict nothing")
        size = data.frame[system.state_names].std().to_numpy()
        excess = float((fit.sigma / np.maximum(segments.sigma, CLEAN * size)).max())
        if not excess <= EXPLAINED:
            reason = f"the monomials leave residuals of {excess:.3g} times the noise"
            return Estimate(None, f"read off the learned model: {reason}")
        misfit = float((fit.sigma / size).max())
    else:
        regression, windows = regress(basis, data, chosen)
        fit = linear_fit(regression, windows)
        misfit = regression.misfit(fit.p)
    unknown = np.abs(fit.information.unknown) > PART
    lost = np.asarray(unknown.any(axis=0))
    groups = [" and ".join(np.array(names)[row]) for row in unknown]
    doubt = "".join(f"; not identifiable apart from these data: {group}" for group in groups)
    return Estimate(Identified(_table(names, fit, lost, truth), misfit), why + doubt)


def _table(names: list[str], fit: Fit, lost: NDArray[np.bool_], truth: Mapping[str, float]) -> pd.DataFrame:
    """Parameters beside their true values, with deviations and 95 % intervals."""
    values = np.where(lost, np.nan, fit.p)
    std = np.where(lost, np.nan, np.sqrt(np.maximum(np.diag(fit.information.covariance), 0)))
    table = parameter_table(names, values, truth)
    return table.assign(std=std, low=values - CONFIDENCE * std, high=values + CONFIDENCE * std)

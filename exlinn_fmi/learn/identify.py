"""Physical parameters, read off a learned model.

The user says which monomial each parameter multiplies: 𝓛 = Σ p_k φ_k(q, q̇), D = Σ p_k ψ_k(q̇). Then the
inverse model (17) is linear in p, and p is the least-squares fit to the learned inverse model at positions
and velocities from the data under accelerations drawn independently of them: so M, coupling and dissipation
are all seen, and an equation that no input acts on is no longer homogeneous.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.monomials import MonomialBasis, parse_monomial
from exlinn_fmi.scenario.learning import Identify

SAMPLES = 2000
SINGULAR = 1e-8
"""Singular values below this share of the largest tell that parameters cannot be told apart."""
PART = 1e-4
"""A parameter that takes part in a singular direction with more than this is not identifiable."""

Array = NDArray[np.float64]


class Identified(NamedTuple):
    """Parameters and how well their monomials explain the model.

    Args:
        parameters: columns name, identified, true, rel_error; NaN where not identifiable or not known.
        misfit: rms of what the monomials leave unexplained over the rms of the learned forces.
    """

    parameters: pd.DataFrame
    misfit: float


def identify(
    system: LagrangianSystem, data: Dataset, options: Identify, truth: Mapping[str, float], seed: int = 0
) -> Identified:
    """Read the parameters off a learned model.

    Args:
        system: the learned model.
        data: where it was learned.
        options: parameters and their monomials.
        truth: parameters of the plant as far as they are known.
        seed: of the accelerations that are drawn.

    Raises:
        ModelError: a monomial cannot be read.
    """
    names = [*options.lagrangian, *options.dissipation]
    if not names:
        return Identified(parameter_table([], np.empty(0), truth), float("nan"))
    basis = MonomialBasis(
        system.coordinates, tuple(options.lagrangian.values()), tuple(options.dissipation.values())
    )
    samples = data.arrays
    random = np.random.default_rng(seed)
    rows = np.linspace(0, len(data) - 1, min(len(data), SAMPLES)).astype(int)
    q, v = samples.q[rows], samples.v[rows]
    a = np.abs(samples.a).max(axis=0) * random.uniform(-1, 1, v.shape)
    force = evaluate(system.inverse, q, v, a, np.zeros(0))
    weight = 1 / np.maximum(np.sqrt(np.mean(force**2, axis=0)), np.finfo(float).tiny)
    matrix = evaluate(basis.regressor(), q, v, a).reshape(*v.shape, len(names)) * weight[:, None]
    values, misfit = _solve(matrix.reshape(-1, len(names)), (force * weight).ravel())
    return Identified(parameter_table(names, values, truth), misfit)


def _solve(matrix: Float[Array, "N K"], right: Float[Array, " N"]) -> tuple[Float[Array, " K"], float]:
    """Least squares with NaN for what is not determined, and the relative misfit."""
    size = np.linalg.norm(matrix, axis=0)
    seen = size > 0
    left, singular, directions = np.linalg.svd(matrix[:, seen] / size[seen], full_matrices=False)
    strong = singular > SINGULAR * singular.max(initial=0.0)
    solution = directions[strong].T @ ((left[:, strong].T @ right) / singular[strong])
    lost: Bool[NDArray[np.bool_], " k"] = (np.abs(directions[~strong]) > PART).any(axis=0)
    values = np.full(len(size), np.nan)
    values[seen] = np.where(lost, np.nan, solution / size[seen])
    rest = right - (matrix[:, seen] / size[seen]) @ solution
    return values, float(np.linalg.norm(rest) / np.linalg.norm(right))


def parameter_table(names: list[str], values: Float[Array, " K"], truth: Mapping[str, float]) -> pd.DataFrame:
    """The parameters beside their true values."""
    true = np.array([true_value(name, truth) for name in names], dtype=float)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(values - true) / np.abs(true)
    return pd.DataFrame({"name": names, "identified": values, "true": true, "rel_error": error})


def true_value(name: str, truth: Mapping[str, float]) -> float:
    """Value of a parameter or of a product of parameters (``m_c*d^2``), NaN where not all are known."""
    try:
        return float(parse_monomial(name, truth).evaluate(truth))
    except ModelError:
        return float("nan")

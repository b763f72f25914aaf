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
from exlinn_fmi.learn.terms import linear_fit
from exlinn_fmi.learn.trajectory import Information
from exlinn_fmi.learn.weak import Regression
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.monomials import MonomialBasis, parse_monomial
from exlinn_fmi.scenario.learning import Identify

SAMPLES = 2000
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


class Unknowns(NamedTuple):
    """What the user wants to know: the family, and which of its parameters are known already.

    Args:
        basis: monomials and shapes.
        names: of all parameters.
        known: values of those that are held, NaN for the others.
    """

    basis: MonomialBasis
    names: list[str]
    known: Float[Array, " P"]

    @classmethod
    def of(cls, coordinates: tuple[Coordinate, ...], options: Identify) -> Unknowns:
        """From the `identify` section.

        Raises:
            ModelError: a monomial cannot be read.
        """
        basis = MonomialBasis(
            coordinates,
            tuple(options.lagrangian.values()),
            tuple(options.dissipation.values()),
            tuple(Parameter(name, value, "") for name, value in options.shapes.items()),
        )
        known = [options.known.get(name, np.nan) for name in options.names]
        return cls(basis, options.names, np.array(known, dtype=float))

    def lost(
        self, information: Information, regression: Regression
    ) -> tuple[Bool[NDArray[np.bool_], " P"], list[str]]:
        """Parameters that the data do not tell, and in words what cannot be told.

        Args:
            information: what the data tell of the parameters that are not held.
            regression: the equations of motion at the parameters found.
        """
        names, free = np.array(self.names), np.flatnonzero(np.isnan(self.known))
        lost, told = np.zeros(len(names), dtype=bool), []
        for part in self._without_force(regression):
            lost[part] = True
            told.append(
                f"the common scale of {' and '.join(names[part])}: no input acts on what they move, and no "
                "coupling ties it to one"
            )
        for row in np.abs(information.unknown) > PART:
            part = free[row]
            if not lost[part].all():
                single = "not seen in these data" if len(part) == 1 else "only a combination is seen"
                told.append(f"{' and '.join(names[part])}: {single}")
            lost[part] = True
        return lost, told

    def _without_force(self, regression: Regression) -> list[NDArray[np.intp]]:
        """Sets of parameters in equations without any force: whatever their scale, they explain nothing.

        Parameters that occur in one equation belong together, and so do equations that share a parameter.
        """
        linear = regression.columns[:, :, : regression.terms]
        size = np.sqrt(np.sum(linear**2, axis=0))  # (n, T)
        occurs = size > np.finfo(float).eps * size.max(initial=0.0)
        driven = np.any(regression.force != 0, axis=0)
        sets, left = [], set(range(len(occurs)))
        while left:
            equations, grown = {left.pop()}, True
            while grown:
                terms = occurs[sorted(equations)].any(axis=0)
                more = set(np.flatnonzero(occurs[:, terms].any(axis=1)).tolist())
                grown, equations = not more <= equations, equations | more
            left -= equations
            held = terms & ~np.isnan(self.known[: regression.terms])
            if not driven[sorted(equations)].any() and not held.any() and terms.any():
                sets.append(np.flatnonzero(terms))
        return sets


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
    if not options.names:
        return Identified(parameter_table([], np.empty(0), truth), float("nan"))
    unknowns = Unknowns.of(system.coordinates, options)
    basis = unknowns.basis
    samples = data.arrays
    random = np.random.default_rng(seed)
    rows = np.linspace(0, len(data) - 1, min(len(data), SAMPLES)).astype(int)
    q, v = samples.q[rows], samples.v[rows]
    a = np.abs(samples.a).max(axis=0) * random.uniform(-1, 1, v.shape)
    force = evaluate(system.inverse, q, v, a, np.zeros(0))
    weight = 1 / np.maximum(np.sqrt(np.mean(force**2, axis=0)), np.finfo(float).tiny)
    driven = np.any(samples.F != 0, axis=0)

    def make(p: Float[Array, " P"]) -> Regression:
        columns = evaluate(basis.regressor, q, v, a, p).reshape(*v.shape, len(p))
        return Regression(columns * weight[:, None], force * weight, basis.size)

    fit = linear_fit(make, basis.start, 1, known=unknowns.known)
    at = make(fit.p)
    # The learned model has forces everywhere; what scale they have is known only where an input acts.
    lost, _ = unknowns.lost(fit.information, at._replace(force=at.force * driven))
    table = parameter_table(unknowns.names, np.where(lost, np.nan, fit.p), truth)
    return Identified(table, at.misfit(fit.p))


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

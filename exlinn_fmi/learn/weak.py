"""Equations of motion as linear least squares for the coefficients of terms: (17) at samples, or weakly.

Against test functions (`windows`) no derivative of the data is needed and noise is averaged. That needs no
start, which makes it the start for everything else.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.windows import windows
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.monomials import MonomialBasis

Array = NDArray[np.float64]

CUT = 1e-12
"""Singular values below this share of the largest are not determined."""


class Regression(NamedTuple):
    """F = columns · p for each row and equation, forces relative to their scale.

    Args:
        columns: derivatives of the forces by the parameters: by the coefficients, in which the forces are
            linear, then by the shapes.
        force: generalised forces.
        terms: number of coefficients.
    """

    columns: Float[Array, "R n P"]
    force: Float[Array, "R n"]
    terms: int

    def solve(self, ridge: float = 0.0, known: Float[Array, " T"] | None = None) -> Float[Array, " T"]:
        """Coefficients by least squares with columns scaled to one.

        Args:
            ridge: weight of ‖p‖² in that scale.
            known: coefficients that are held, NaN where they are to be found.

        Raises:
            LinAlgError: the equations are not finite.
        """
        p = np.full(self.terms, np.nan) if known is None else known.copy()
        free = np.isnan(p)
        p[free] = 0
        columns, right = self.columns[:, :, : self.terms][:, :, free], self.residual(p)
        size = np.linalg.norm(columns, axis=(0, 1))
        size[size == 0] = 1
        matrix, right = (columns / size).reshape(right.size, len(size)), -right.ravel()
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            raise np.linalg.LinAlgError("their coefficients are not finite")
        if ridge:
            matrix = np.vstack([matrix, np.sqrt(ridge) * np.eye(len(size))])
            right = np.concatenate([right, np.zeros(len(size))])
        p[free] = np.linalg.lstsq(matrix, right, rcond=CUT)[0] / size
        return p

    def only(self, chosen: NDArray[np.bool_]) -> Regression:
        """The regression of some of the parameters.

        Args:
            chosen: which, shapes included.
        """
        return Regression(self.columns[:, :, chosen], self.force, int(chosen[: self.terms].sum()))

    def residual(self, p: Float[Array, " P"]) -> Float[Array, "R n"]:
        """Forces of the model less those in the data; shapes in p are those of the columns."""
        return np.asarray(self.columns[:, :, : self.terms] @ p[: self.terms] - self.force)

    def misfit(self, p: Float[Array, " P"]) -> float:
        """What is left unexplained, as a share of the forces."""
        return float(np.linalg.norm(self.residual(p)) / np.linalg.norm(self.force))


def inverse_regression(
    basis: MonomialBasis, data: Dataset, p: Float[Array, " P"] | None = None
) -> Regression:
    """The inverse model (17) at the samples, accelerations as they stand in the data.

    Args:
        basis: the family.
        data: the samples.
        p: where its columns are taken, if it has shapes; at its start if not given.
    """
    q, v, a, force = data.arrays
    scale, p = force_scale(data), basis.start if p is None else p
    columns = evaluate(basis.regressor, q, v, a, p).reshape(*v.shape, len(p))
    return Regression(columns / scale[:, None], force / scale, basis.size)


def weak_regression(basis: MonomialBasis, data: Dataset, p: Float[Array, " P"] | None = None) -> Regression:
    """The equations against test functions, in windows that overlap.

    Args:
        basis: the family.
        data: trajectories.
        p: where its columns are taken, if it has shapes; at its start if not given.
    """
    scale, at = force_scale(data), basis.start if p is None else p
    q, v, _, _ = data.arrays
    force, tested = data.recorded_forces, windows(data)
    columns, forces = np.zeros((len(tested), v.shape[1], len(at))), np.zeros((len(tested), v.shape[1]))
    for rows, some, phi, slope, held in tested.pieces():
        shape = (len(rows), v.shape[1], len(at))
        m = evaluate(basis.momenta, q[rows], v[rows], at).reshape(shape)
        r = evaluate(basis.rest, q[rows], v[rows], at).reshape(shape)
        columns[some] += np.tensordot(phi, r, axes=1) - np.tensordot(slope, m, axes=1)
        forces[some] += held @ force[rows]
    return Regression(columns / scale[:, None], forces / scale, basis.size)


def force_scale(data: Dataset) -> Float[Array, " n"]:
    """Units of the generalised forces: in each equation the force that has the power of the inputs."""
    _, v, _, force = data.arrays
    speed = np.sqrt(np.mean(v**2, axis=0))
    speed = np.where(speed > 0, speed, speed.max() or 1.0)
    power = np.sqrt(np.mean(force**2, axis=0)) * speed
    return np.asarray(power.max() / speed)

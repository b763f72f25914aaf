"""Maximum likelihood on trajectories: multiple shooting of a family that is linear in its parameters.

Each trajectory is cut into segments; unknown are the parameters p and the first state of every segment. The
residuals are the measured less the predicted states over their noise σ, and the gaps between segments over a
thousandth of σ: so the trajectory is continuous, and still the problem is one sum of squares without
constraints, well conditioned for unstable systems too. Levenberg–Marquardt solves it with sensitivities
through RK4; with residual-based σ its Gauss–Newton matrix gives the covariance of p.

References: Bock (1983), Recent advances in parameter identification for ODE (multiple shooting);
    Ljung (1999), System Identification, ch. 9 (covariance of prediction-error estimates).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.linalg import block_diag

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import DataError, TrainingError
from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.motion import NetworkMotion
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.noise import FLOOR, noise_levels
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.sensitivity import Motion, Propagator

Array = NDArray[np.float64]

SEGMENTS = 50
"""Segments of the longest trajectory, …"""
SHORTEST, LONGEST = 10, 400
"""… which have so many steps at least and at most."""
BREAK = 20.0
"""A step of more than so many usual ones is no step but a gap."""
GAP = 1e-3
"""Gaps between segments are weighed as if they had this share of the noise."""
BLOCK = 32
"""Rows whose sensitivities are kept at once."""
GAIN = 1e-6
"""Iterations that gain less than this share end the fit."""


@dataclass(frozen=True)
class Segments:
    """Recorded trajectories cut into B segments of K steps, K + 1 rows.

    Args:
        measured: states at the rows.
        inputs: held from each row to the next.
        counted: 1 where a row counts, 0 where it is another segment's first or padding.
        follows: for each segment the one that continues it, −1 where none does.
        steps: from row to row [s].
        sigma: noise of each state.
    """

    measured: Float[Array, "B rows nx"]
    inputs: Float[Array, "B K m"]
    counted: Float[Array, "B rows"]
    follows: Int[NDArray[np.intp], " B"]
    steps: Float[Array, "B K"]
    sigma: Float[Array, " nx"]

    @property
    def total(self) -> float:
        """Rows that count."""
        return float(self.counted.sum())


def cut(data: Dataset, states: list[str], inputs: list[str], every: int = 1) -> Segments:
    """Cut a data set into segments.

    Args:
        data: trajectories; steps may differ.
        states: names of the states x.
        inputs: names of the inputs u.
        every: take every so many rows, under the mean of the inputs between them.

    Raises:
        DataError: a step is so long that nothing is known of what went on in it.
    """
    frames = [part for _, part in data.frame.groupby("trajectory", sort=False) if len(part) > every]
    steps = np.concatenate([np.diff(part["time"].to_numpy(dtype=float)) for part in frames])
    usual = float(np.median(steps))
    if steps.max() > BREAK * usual:
        raise DataError(
            f"data set: a step of {steps.max():.6g} s where {usual:.6g} s are usual; to fit to trajectories "
            "give what comes after the gap a trajectory of its own, or choose the objective 'inverse'"
        )
    k = int(np.clip(max(map(len, frames)) // (SEGMENTS * every), SHORTEST, LONGEST))
    measured, held, counted, follows, lengths = [], [], [], [], []
    for part in frames:
        x = part[states].to_numpy(dtype=float)[::every]
        time = part["time"].to_numpy(dtype=float)
        begins = np.arange(0, len(part), every)
        length = np.append(np.diff(time), usual)  # the last row's input acts on nothing that was measured
        step = np.add.reduceat(length, begins)
        u = (
            np.add.reduceat(part[inputs].to_numpy(dtype=float) * length[:, None], begins, axis=0)
            / step[:, None]
        )
        for first in range(0, len(x) - 1, k):
            rows = np.arange(first, first + k + 1)
            at = np.minimum(rows, len(x) - 1)
            last = first + k >= len(x) - 1
            measured.append(x[at])
            held.append(u[at[:-1]])
            lengths.append(step[at[:-1]])
            counted.append((rows < len(x)) & (last | (rows < first + k)))
            follows.append(-1 if last else len(measured))
    return Segments(
        np.array(measured),
        np.array(held).reshape(len(held), k, len(inputs)),
        np.array(counted, dtype=float),
        np.array(follows),
        np.array(lengths),
        noise_levels(data),
    )


SINGULAR = 1e-12
"""Eigenvalues of the scaled information below this share of the largest tell directions that are not seen."""


@dataclass(frozen=True)
class Information:
    """What the data tell of p: the Gauss–Newton matrix, the segments' states eliminated."""

    matrix: Float[Array, "P P"]

    @cached_property
    def _scaled(self) -> tuple[Array, Array, Array]:
        size = np.sqrt(np.maximum(np.diag(self.matrix), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(self.matrix / np.outer(size, size))
        return values, vectors, size

    @property
    def covariance(self) -> Float[Array, "P P"]:
        """Of p, within the directions that the data tell of."""
        values, vectors, size = self._scaled
        kept = values > SINGULAR * values.max()
        inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
        with np.errstate(over="ignore"):  # what the data say nothing of has no finite variance
            return np.asarray(inverse / size[:, None] / size)

    @property
    def unknown(self) -> Float[Array, "D P"]:
        """Directions in p that the data say nothing about, each parameter in its natural scale."""
        values, vectors, _ = self._scaled
        return np.asarray(vectors[:, values <= SINGULAR * values.max()].T)

    def only(self, chosen: NDArray[np.bool_]) -> Information:
        """Where the other parameters are known."""
        return Information(self.matrix[np.ix_(chosen, chosen)])


class Fit(NamedTuple):
    """A family fitted to trajectories.

    Args:
        p: parameters.
        states: first state of each segment.
        value: sum of squared residuals over their σ.
        information: what the data tell of p.
        sigma: noise of each state as the residuals show it.
    """

    p: Float[Array, " P"]
    states: Float[Array, "B nx"]
    value: float
    information: Information
    sigma: Float[Array, " nx"]


@dataclass(frozen=True)
class Shooting:
    """The sum of squares as a function of θ = (p, first states of the segments).

    Args:
        system: a family with parameters p, or networks with weights p.
        data: trajectories, cut into segments.
        prior: weight of the square of each parameter: what is known of weights before any data.
    """

    system: LagrangianSystem | StructuredNetworks
    data: Segments
    prior: float | Float[Array, " P"] = 0.0

    @cached_property
    def _motion(self) -> Motion:
        if isinstance(self.system, StructuredNetworks):
            return NetworkMotion(self.system, self.data.steps)
        return Propagator(self.system, self.data.steps)

    def start(self, p: Float[Array, " P"], states: Float[Array, "B nx"] | None = None) -> Float[Array, " T"]:
        """θ for parameters p, segments starting as measured if not said otherwise."""
        return np.concatenate([p, (self.data.measured[:, 0] if states is None else states).ravel()])

    def split(self, theta: Float[Array, " T"]) -> tuple[Float[Array, " P"], Float[Array, "B nx"]]:
        """Parameters and first states that θ holds."""
        count = self._motion.size
        return theta[:count], theta[count:].reshape(len(self.data.measured), -1)

    def predict(self, theta: Float[Array, " T"]) -> Float[Array, "B rows nx"]:
        """States at the rows."""
        p, states = self.split(theta)
        return self._motion.run(states, self.data.inputs, p)

    def residuals(self, x: Float[Array, "B rows nx"]) -> Float[Array, "B rows nx"]:
        """Predicted less measured over σ; 0 where rows do not count."""
        return np.asarray((x - self.data.measured) / self.data.sigma * self.data.counted[..., None])

    def _gaps(self, x: Float[Array, "B rows nx"], states: Float[Array, "B nx"]) -> Float[Array, "B nx"]:
        follows = self.data.follows
        gaps = (x[:, -1] - states[follows]) / (GAP * self.data.sigma)
        return np.where(follows[:, None] >= 0, gaps, 0)

    def value(self, theta: Float[Array, " T"]) -> float:
        """The sum of squares; not finite where the model diverges."""
        with np.errstate(all="ignore"):
            x = self.predict(theta)
            p, states = self.split(theta)
            gaps = self._gaps(x, states)
            return float(np.sum(self.residuals(x) ** 2) + np.sum(gaps**2) + np.sum(self.prior * p**2))

    def misprediction(self, p: Float[Array, " P"]) -> float:
        """Sum of squares of predictions from the segments' first states as measured."""
        with np.errstate(all="ignore"):
            return float(np.sum(self.residuals(self.predict(self.start(p))) ** 2))

    def normal(self, theta: Float[Array, " T"]) -> Normal:
        """The sum of squares, half its gradient and its Gauss–Newton matrix."""
        data, (p, states) = self.data, self.split(theta)
        count, r, nx = len(states), len(p), states.shape[1]
        x = self.predict(theta)
        rest, gaps = self.residuals(x), self._gaps(x, states)
        # Each segment's own part is of its first state; what p alone has is summed up at once.
        local, slope = np.zeros((count, nx, nx + r)), np.zeros((count, nx))
        matrix, gradient = np.zeros((theta.size, theta.size)), np.zeros(theta.size)

        def add(where: Int[NDArray[np.intp], " b"] | slice, j: Array, rest: Array) -> None:
            own, common = j[..., :nx], j[..., nx:].reshape(-1, r)
            local[where] += own.transpose(0, 2, 1) @ j
            slope[where] += np.einsum("bxp,bx->bp", own, rest)
            matrix[:r, :r] += common.T @ common
            gradient[:r] += rest.ravel() @ common

        part: list[Array] = []
        for k, s in enumerate(self._motion.sensitivities(x, data.inputs, p)):
            part.append(s / data.sigma[:, None] * data.counted[:, k, None, None])
            if len(part) == BLOCK or k == len(data.inputs[0]):
                rows = rest[:, k + 1 - len(part) : k + 1].reshape(count, -1)
                add(slice(None), np.concatenate(part, axis=1), rows)
                part = []
        joined = np.flatnonzero(data.follows >= 0)
        j = s[joined] / (GAP * data.sigma[:, None])
        add(joined, j, gaps[joined])
        matrix[r:, :r] = local[:, :, nx:].reshape(count * nx, r)
        matrix[r:, r:], gradient[r:] = block_diag(*local[:, :, :nx]), slope.ravel()
        other = 1 / (GAP * data.sigma)
        for b, jb in zip(joined, j, strict=True):
            this, after = (slice(r + nx * i, r + nx * (i + 1)) for i in (b, data.follows[b]))
            matrix[after, this] -= other[:, None] * jb[:, :nx]
            matrix[this, after] -= (other[:, None] * jb[:, :nx]).T
            matrix[after, :r] -= other[:, None] * jb[:, nx:]
            matrix[after, after] += np.diag(other**2)
            gradient[after] -= other * gaps[b]
        matrix[:r, r:] = matrix[r:, :r].T
        matrix[range(r), range(r)] += self.prior
        gradient[:r] += self.prior * p
        return Normal(float(np.sum(rest**2) + np.sum(gaps**2) + np.sum(self.prior * p**2)), gradient, matrix)

    def information(self, theta: Float[Array, " T"]) -> Information:
        """What the data tell of p at θ."""
        matrix, r = self.normal(theta).matrix, self._motion.size
        try:
            if not np.isfinite(matrix).all():
                raise np.linalg.LinAlgError
            cross = np.linalg.solve(matrix[r:, r:], matrix[r:, :r])
        except np.linalg.LinAlgError as error:
            raise TrainingError(
                "the fitted model says nothing of the measured states: its sensitivities vanish; check units "
                "and columns of the data, or choose the objective 'inverse'"
            ) from error
        return Information(matrix[:r, :r] - matrix[:r, r:] @ cross)

    def noise(self, theta: Float[Array, " T"]) -> Float[Array, " nx"]:
        """Noise of each state as the residuals show it, less what the fit has taken of them."""
        rest = self.residuals(self.predict(theta))
        # Segments are joined, so that only a trajectory's first state is free.
        free = self._motion.size / rest.shape[2] + float(np.sum(self.data.follows < 0))
        share = np.sqrt(np.sum(rest**2, axis=(0, 1)) / max(self.data.total - free, 1))
        size = np.abs(self.data.measured).max(axis=(0, 1))
        return np.asarray(np.maximum(self.data.sigma * share, FLOOR * np.where(size > 0, size, 1)))


def maximum_likelihood(
    system: LagrangianSystem,
    data: Segments,
    p: Float[Array, " P"],
    states: Float[Array, "B nx"] | None = None,
    iterations: int = 30,
    passes: int = 2,
) -> Fit:
    """Fit a family to trajectories, with the noise that was estimated, then with that of the residuals.

    Args:
        system: the family.
        data: trajectories, cut into segments.
        p: start.
        states: where segments start; as measured if not given.
        iterations: most Levenberg–Marquardt iterations each time.
        passes: how often; 1 keeps to the noise that was estimated.
    """
    for _ in range(passes):
        shooting = Shooting(system, data)
        theta, value = shooting.start(p, states), float("inf")
        for number, step in enumerate(levenberg_marquardt(theta, shooting.normal, shooting.value)):
            gained = value - step.value
            theta, value = step.theta, step.value
            p, states = shooting.split(theta)
            if number >= iterations or gained < GAIN * value:
                break
        data = replace(data, sigma=shooting.noise(theta))
    shooting = Shooting(system, data)
    information, value = shooting.information(theta), shooting.value(theta)
    return Fit(p, shooting.split(theta)[1], value, information, data.sigma)

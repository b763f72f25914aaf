"""Maximum likelihood on trajectories: multiple shooting of a family that is linear in its parameters.

Each trajectory is cut into segments; unknown are the parameters p and the first state of every segment. The
residuals are the measured less the predicted states over their noise σ, and the gaps between segments over a
thousandth of σ: so the trajectory is continuous, and still the problem is one sum of squares without
constraints, well conditioned for unstable systems too. Levenberg–Marquardt solves it with sensitivities
through RK4; with residual-based σ its Gauss–Newton matrix gives the covariance of p, and the correlation of
the residuals widens it where noise is not white (`colour`).

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
from exlinn_fmi.data.derivatives import LEAST_NOISE
from exlinn_fmi.errors import DataError, TrainingError
from exlinn_fmi.learn.colour import colour, spread_of
from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.motion import NetworkMotion
from exlinn_fmi.learn.networks import StructuredNetworks
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
        data.noise,
    )


SINGULAR = 1e-12
"""Eigenvalues of the scaled information below this share of the largest tell directions that are not seen."""


@dataclass(frozen=True)
class Information:
    """What the data tell of p.

    Args:
        matrix: the Gauss–Newton matrix, the segments' states eliminated.
        spread: covariance of the gradient where noise is not white; else it is that matrix, too.
    """

    matrix: Float[Array, "P P"]
    spread: Float[Array, "P P"] | None = None

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
        if self.spread is not None:
            inverse = inverse @ (self.spread / size[:, None] / size) @ inverse
        with np.errstate(over="ignore"):  # what the data say nothing of has no finite variance
            return np.asarray(inverse / size[:, None] / size)

    @property
    def widening(self) -> float:
        """By how much correlated noise widens the intervals, in the geometric mean."""
        white, found = np.diag(Information(self.matrix).covariance), np.diag(self.covariance)
        told = (white > 0) & np.isfinite(white)
        return float(np.exp(np.mean(np.log(found[told] / white[told])) / 2)) if told.any() else 1.0

    def __str__(self) -> str:
        if self.spread is None:
            return "the noise is white"
        return (
            "the noise is correlated from row to row, so that intervals are "
            f"{self.widening:.2g} times as wide as under white noise"
        )

    @property
    def unknown(self) -> Float[Array, "D P"]:
        """Directions in p that the data say nothing about, each parameter in its natural scale."""
        values, vectors, _ = self._scaled
        return np.asarray(vectors[:, values <= SINGULAR * values.max()].T)

    def only(self, chosen: NDArray[np.bool_]) -> Information:
        """Where the other parameters are known."""
        block = np.ix_(chosen, chosen)
        return Information(self.matrix[block], None if self.spread is None else self.spread[block])


class Fit(NamedTuple):
    """A family fitted to trajectories.

    Args:
        p: parameters.
        states: first state of each segment.
        value: sum of squared residuals over their σ.
        information: what the data tell of p.
        sigma: noise of each state as the residuals show it.
        memory: rows over which that noise stays alike, 1 where it is white.
        pace: rows that the motion takes to change by its standard deviation, that of the fastest state.
    """

    p: Float[Array, " P"]
    states: Float[Array, "B nx"]
    value: float
    information: Information
    sigma: Float[Array, " nx"]
    memory: float = 1.0
    pace: float = np.inf

    @property
    def is_noise(self) -> bool:
        """Whether the residuals may be noise: what a model does not explain changes no faster than motion."""
        return self.memory < self.pace


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
        """What the data tell of p at θ, were the noise white."""
        return self._eliminated(theta)[0]

    def _eliminated(self, theta: Float[Array, " T"]) -> tuple[Information, Float[Array, "S P"]]:
        """What the data tell of p, and by how much the segments' states move with p."""
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
        return Information(matrix[:r, :r] - matrix[:r, r:] @ cross), np.asarray(cross, dtype=float)

    def correlated(self, theta: Float[Array, " T"]) -> tuple[Information, float]:
        """What the data tell of p at θ with noise as the residuals show it, and its memory in rows."""
        white, cross = self._eliminated(theta)
        p, x = self.split(theta)[0], self.predict(theta)
        (count, rows, nx), r = x.shape, len(p)
        noise = colour(self._series(self.residuals(x)))
        if not noise.order:
            return white, 1.0
        moved = cross.reshape(count, nx, r)
        influence = np.empty((count, rows, nx, r))
        for k, s in enumerate(self._motion.sensitivities(x, self.data.inputs, p)):
            influence[:, k] = (s[:, :, nx:] - s[:, :, :nx] @ moved) / self.data.sigma[:, None]
        return replace(white, spread=spread_of(noise, self._series(influence))), noise.memory

    def _series(self, values: Float[Array, "B rows ..."]) -> list[Array]:
        """What belongs to the rows that count, in the order of time, for each trajectory apart."""
        ends = np.flatnonzero(self.data.follows < 0)[:-1] + 1
        counted = np.split(self.data.counted > 0, ends)
        return [part[rows] for part, rows in zip(np.split(values, ends), counted, strict=True)]

    def pace(self, theta: Float[Array, " T"]) -> float:
        """Rows that the motion takes to change by its standard deviation, that of the fastest state."""
        series = self._series(self.predict(theta))
        speed = np.sqrt(np.mean(np.concatenate([np.diff(part, axis=0) for part in series]) ** 2, axis=0))
        return float(np.min(np.concatenate(series).std(axis=0) / np.maximum(speed, np.finfo(float).tiny)))

    def noise(self, theta: Float[Array, " T"]) -> Float[Array, " nx"]:
        """Noise of each state as the residuals show it, less what the fit has taken of them."""
        rest = self.residuals(self.predict(theta))
        # Segments are joined, so that only a trajectory's first state is free.
        free = self._motion.size / rest.shape[2] + float(np.sum(self.data.follows < 0))
        share = np.sqrt(np.sum(rest**2, axis=(0, 1)) / max(self.data.total - free, 1))
        size = np.abs(self.data.measured).max(axis=(0, 1))
        return np.asarray(np.maximum(self.data.sigma * share, LEAST_NOISE * np.where(size > 0, size, 1)))


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
        passes: how often; 1 keeps to the noise that was estimated, and takes it for white.
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
    information, memory = shooting.correlated(theta) if passes > 1 else (shooting.information(theta), 1.0)
    states, value = shooting.split(theta)[1], shooting.value(theta)
    return Fit(p, states, value, information, data.sigma, memory, shooting.pace(theta))

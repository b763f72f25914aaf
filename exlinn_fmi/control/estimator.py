"""Where the system is, and what pushes it: states and disturbances from what is measured.

A disturbance is a constant generalised force d on some coordinates that the model does not know of: a load
torque, a voltage drop, an error of the model. It is estimated with the state, z = (x, d), as a random walk,
and references and plan are made under it: what is measured then follows its reference without offset
(G. Pannocchia, J. Rawlings, Disturbance models for offset-free model-predictive control, AIChE J. 49, 2003).

- `none`: states are as measured; where one is not a number, the model's prediction stands in.
- `ekf`: extended Kalman filter, with the gain updated at each sample or that of the steady state.
- `mhe`: moving horizon estimation over a window, by Gauss–Newton: the iterated Kalman smoother (B. Bell,
  The iterated Kalman smoother as a Gauss–Newton method, SIAM J. Optim. 4, 1994), arrival cost by the filter.

A measurement that is not a number counts as not made.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.riccati import solve_dare
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import TURN


@dataclass(frozen=True)
class Noise:
    """What is not known, as standard deviations.

    Args:
        measured: whether a state is measured, shape (n,).
        measurement: noise of each state's measurement, shape (n,).
        process: what changes each state beside the model, by the square root of a second, shape (n,).
        force: unknown force on each coordinate, new in each sample, shape (coordinates,).
        disturbed: coordinates on which a disturbance acts, indices (d,).
        walk: change of each disturbance by the square root of a second, shape (d,).
        first: of the states that are not measured, and of the disturbances, at the beginning, shape (n + d,).
    """

    measured: NDArray[np.bool_]
    measurement: NDArray[np.float64]
    process: NDArray[np.float64]
    force: NDArray[np.float64]
    disturbed: NDArray[np.intp]
    walk: NDArray[np.float64]
    first: NDArray[np.float64]


@dataclass(frozen=True)
class Sample:
    """What a window remembers of one sampling time.

    Args:
        mean: z that was believed, where the next linearisation is made, shape (n + d,).
        y: measurements, shape (n,); NaN where none was made.
        u: input that was held from then on, shape (m,).
    """

    mean: NDArray[np.float64]
    y: NDArray[np.float64]
    u: NDArray[np.float64]


@dataclass(frozen=True)
class Belief:
    """What is held of z = (x, d) at one sampling time.

    Args:
        mean: shape (n + d,).
        covariance: shape (n + d, n + d).
        y: measurements at that time, shape (n,), NaN where none was made.
        window: the samples before, oldest first (moving horizon).
        arrival: mean and covariance at the oldest of them before its measurement (moving horizon).
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    y: NDArray[np.float64]
    window: tuple[Sample, ...] = ()
    arrival: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @property
    def finite(self) -> bool:
        """Whether it is one."""
        return bool(np.isfinite(self.mean).all() and np.isfinite(self.covariance).all())


class Estimator(ABC):
    """Keeps a belief: predicts it over a sample, corrects it by measurements.

    Args:
        system: the prediction model.
        noise: what is not known.
        step: sampling time [s].
        substeps: RK4 steps in a sample.
        points: number of points that are linearised at once.
    """

    def __init__(
        self, system: LagrangianSystem, noise: Noise, step: float, substeps: int, points: int = 1
    ) -> None:
        self.system, self.noise, self.step = system, noise, step
        self.n, self.d = len(system.state_names), len(noise.disturbed)
        self._one = Batch(sensitivities(system, substeps), 1)
        self._all = Batch(sensitivities(system, substeps), points) if points > 1 else self._one
        self.turn = _turns(system)
        self._p = system.parameter_values

    def state(self, belief: Belief) -> Float[np.ndarray, " n"]:
        """The estimated state x̂ (n,)."""
        return belief.mean[: self.n]

    def force(self, mean: Float[np.ndarray, " z"]) -> Float[np.ndarray, " c"]:
        """The estimated force on each coordinate that a mean (n + d,) of z holds."""
        force = np.zeros(self.system.n)
        force[self.noise.disturbed] = mean[self.n :]
        return force

    def begin(self, y: Float[np.ndarray, " n"], start: Float[np.ndarray, " n"]) -> Belief:
        """The first belief: measurements where there are any, else where the state starts.

        Args:
            y: measurements (n,), NaN where none was made.
            start: a guess of the state (n,).
        """
        seen = np.isfinite(y) & self.noise.measured
        deviation = self.noise.first.copy()
        deviation[: self.n][seen] = self.noise.measurement[seen]
        mean = np.concatenate([np.where(seen, y, start), np.zeros(self.d)])
        return Belief(mean, np.diag(deviation**2), np.where(seen, y, np.nan))

    @abstractmethod
    def update(self, belief: Belief, y: Float[np.ndarray, " n"]) -> Belief:
        """A belief corrected by measurements (n,) of the same time."""

    @abstractmethod
    def predict(self, belief: Belief, u: Float[np.ndarray, " m"]) -> Belief:
        """The belief one sample later, with the input u (m,) held."""

    # ── what filters are made of ─────────────────────────────────────────────────────────────────────────

    def innovation(
        self, mean: Float[np.ndarray, " z"], y: Float[np.ndarray, " n"]
    ) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, " s"]]:
        """Which states were measured, and measured less expected; angles by the shorter way round."""
        seen = np.flatnonzero(np.isfinite(y) & self.noise.measured)
        difference, turn = y[seen] - mean[seen], self.turn[seen]
        with np.errstate(invalid="ignore"):
            turns = np.where(np.isfinite(turn), np.rint(difference / turn) * turn, 0.0)
        return seen, difference - np.nan_to_num(turns)

    def corrected(
        self, mean: Float[np.ndarray, " z"], P: Float[np.ndarray, "z z"], y: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " z"], Float[np.ndarray, "z z"]]:
        """Mean and covariance after a measurement, in Joseph's form, which keeps the covariance positive."""
        seen, difference = self.innovation(mean, y)
        if not len(seen):
            return mean, P
        R = np.diag(self.noise.measurement[seen] ** 2)
        try:
            K = np.linalg.solve(P[np.ix_(seen, seen)] + R, P[seen]).T
        except np.linalg.LinAlgError:  # P has grown until R is lost in rounding: nothing is known any more
            return np.full_like(mean, np.nan), P
        rest = np.eye(len(mean))
        rest[:, seen] -= K
        return mean + K @ difference, rest @ P @ rest.T + K @ R @ K.T

    def linearised(
        self, means: Float[np.ndarray, "k z"], u: Float[np.ndarray, "k m"]
    ) -> tuple[Float[np.ndarray, "k z"], Float[np.ndarray, "k z z"], Float[np.ndarray, "k z z"]]:
        """What becomes of z in a sample, its derivative by z, and the covariance of what the sample adds."""
        batch = self._one if len(means) == 1 else self._all
        count, n, d = len(means), self.n, self.d
        rows = np.pad(means, ((0, batch.count - count), (0, 0)), mode="edge")
        inputs = np.pad(u, ((0, batch.count - count), (0, 0)), mode="edge")
        forces = np.array([self.force(mean) for mean in rows])
        x, A, G = batch(rows[:, :n], inputs, np.hstack([np.tile(self._p, (len(rows), 1)), forces]), self.step)
        following = np.hstack([x[:count, :, 0], means[:, n:]])
        F = np.tile(np.eye(n + d), (count, 1, 1))
        F[:, :n, :n], F[:, :n, n:] = A[:count], G[:count][:, :, self.noise.disturbed]
        Q = np.zeros((count, n + d, n + d))
        pushed = G[:count] * self.noise.force
        Q[:, :n, :n] = pushed @ pushed.transpose(0, 2, 1) + np.diag(self.noise.process**2 * self.step)
        Q[:, n:, n:] = np.diag(self.noise.walk**2 * self.step)
        return following, F, Q


class Direct(Estimator):
    """States are as measured; the model stands in where one is not."""

    def update(self, belief: Belief, y: Float[np.ndarray, " n"]) -> Belief:
        """Measured where it is a number, else as predicted."""
        return replace(belief, mean=np.where(np.isfinite(y), y, belief.mean), y=y)

    def predict(self, belief: Belief, u: Float[np.ndarray, " m"]) -> Belief:
        """As the model says."""
        force = np.concatenate([self._p, np.zeros(self.system.n)])
        return replace(belief, mean=self._one(belief.mean, u, force, self.step)[0][0, :, 0].copy())


class ExtendedKalman(Estimator):
    """The extended Kalman filter.

    Args:
        system: the prediction model.
        noise: what is not known.
        step: sampling time [s].
        substeps: RK4 steps in a sample.
        steady: (x, u) where the gain of the steady state is taken; it is updated at each sample if not given.
    """

    def __init__(
        self,
        system: LagrangianSystem,
        noise: Noise,
        step: float,
        substeps: int,
        steady: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
    ) -> None:
        super().__init__(system, noise, step, substeps)
        self.fixed = None if steady is None else self._steady(*steady)
        self.settled = steady is None or self.fixed is not None
        """Whether the filter is as asked for: False where no steady state was found."""

    def update(self, belief: Belief, y: Float[np.ndarray, " n"]) -> Belief:
        """Corrected by the gain."""
        P = belief.covariance if self.fixed is None else self.fixed
        mean, covariance = self.corrected(belief.mean, P, y)
        return replace(belief, mean=mean, covariance=covariance, y=y)

    def predict(self, belief: Belief, u: Float[np.ndarray, " m"]) -> Belief:
        """As the model says, less certain by what it does not know."""
        mean, F, Q = self.linearised(belief.mean[None], u[None])
        return replace(belief, mean=mean[0], covariance=F[0] @ belief.covariance @ F[0].T + Q[0])

    def _steady(
        self, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, "z z"] | None:
        """Covariance before a measurement in the steady state at (x, u), None where there is none."""
        _, F, Q = self.linearised(np.concatenate([x, np.zeros(self.d)])[None], u[None])
        seen = np.flatnonzero(self.noise.measured)
        C, R = np.eye(self.n + self.d)[seen], np.diag(self.noise.measurement[seen] ** 2)
        return solve_dare(F[0].T, C.T, Q[0], R)


class MovingHorizon(Estimator):
    """Moving horizon estimation: the likeliest trajectory over the last samples.

    Args:
        system: the prediction model.
        noise: what is not known.
        step: sampling time [s].
        substeps: RK4 steps in a sample.
        window: number of samples before the present one.
        iterations: Gauss–Newton steps at each sample.
    """

    def __init__(
        self,
        system: LagrangianSystem,
        noise: Noise,
        step: float,
        substeps: int,
        window: int,
        iterations: int,
    ) -> None:
        super().__init__(system, noise, step, substeps, window)
        self.window, self.iterations = window, iterations

    def begin(self, y: Float[np.ndarray, " n"], start: Float[np.ndarray, " n"]) -> Belief:
        """The first belief is the arrival cost."""
        first = super().begin(y, start)
        return replace(first, y=np.full(self.n, np.nan), arrival=(first.mean, first.covariance))

    def predict(self, belief: Belief, u: Float[np.ndarray, " m"]) -> Belief:
        """As the model says; a sample that leaves the window moves the arrival cost on."""
        mean, F, Q = self.linearised(belief.mean[None], u[None])
        window = (*belief.window, Sample(belief.mean, belief.y, u))
        arrival = belief.arrival
        assert arrival is not None
        if len(window) > self.window:
            oldest, window = window[0], window[1:]
            prior, P = self.corrected(*arrival, oldest.y)
            following, slope, added = self.linearised(oldest.mean[None], oldest.u[None])
            arrival = (
                following[0] + slope[0] @ (prior - oldest.mean),
                slope[0] @ P @ slope[0].T + added[0],
            )
        covariance = F[0] @ belief.covariance @ F[0].T + Q[0]
        return Belief(mean[0], covariance, np.full(self.n, np.nan), window, arrival)

    def update(self, belief: Belief, y: Float[np.ndarray, " n"]) -> Belief:
        """The likeliest trajectory that ends with these measurements."""
        window = belief.window
        assert belief.arrival is not None
        if not window:
            mean, covariance = self.corrected(*belief.arrival, y)
            return replace(belief, mean=mean, covariance=covariance, y=y)
        u = np.array([sample.u for sample in window])
        points = np.array([sample.mean for sample in window])
        mean, covariance = belief.mean, belief.covariance
        try:
            with np.errstate(all="ignore"):
                for _ in range(self.iterations):
                    points, mean, covariance = self._pass(points, window, u, belief.arrival, y)
        except np.linalg.LinAlgError:  # the linearisation led to where nothing is finite
            mean = np.full_like(mean, np.nan)
        window = tuple(replace(s, mean=point) for s, point in zip(window, points, strict=True))
        return replace(belief, mean=mean, covariance=covariance, y=y, window=window)

    def _pass(
        self,
        points: Float[np.ndarray, "k z"],
        window: tuple[Sample, ...],
        u: Float[np.ndarray, "k m"],
        arrival: tuple[NDArray[np.float64], NDArray[np.float64]],
        y: Float[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, "k z"], Float[np.ndarray, " z"], Float[np.ndarray, "z z"]]:
        """One Gauss–Newton step: filter forwards along the linearisation at `points`, smooth backwards."""
        following, F, Q = self.linearised(points, u)
        mean, P = arrival
        filtered, predicted = [], []
        for k, sample in enumerate(window):
            mean, P = self.corrected(mean, P, sample.y)
            filtered.append((mean, P))
            mean, P = following[k] + F[k] @ (mean - points[k]), F[k] @ P @ F[k].T + Q[k]
            predicted.append((mean, P))
        mean, P = self.corrected(mean, P, y)
        smoothed, later = np.empty_like(points), mean
        for k in reversed(range(len(window))):
            gain = np.linalg.lstsq(predicted[k][1], F[k] @ filtered[k][1], rcond=None)[0].T
            later = filtered[k][0] + gain @ (later - predicted[k][0])
            smoothed[k] = later
        return smoothed, mean, P


def unobservable(estimator: Estimator, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " m"]) -> list[str]:
    """States and disturbed coordinates that the measurements do not tell of, linearised at (x, u).

    Args:
        estimator: with the scales in its `noise`.
        x: a state (n,).
        u: an input (m,).
    """
    size, n = estimator.noise.first, estimator.n
    F = estimator.linearised(np.concatenate([x, np.zeros(estimator.d)])[None], u[None])[1][0]
    F = F * size / size[:, None]  # each in its own size
    seen = np.eye(len(size))[np.flatnonzero(estimator.noise.measured)]
    rows = [seen]
    for _ in range(len(size) - 1):
        rows.append(rows[-1] @ F)
    _, singular, directions = np.linalg.svd(np.vstack(rows))
    hidden = directions[singular <= 1e-9 * singular[0]]
    names = [*estimator.system.state_names]
    names += [f"the disturbance of {estimator.system.coordinates[c].name}" for c in estimator.noise.disturbed]
    seen_at: Bool[np.ndarray, " z"] = (np.abs(hidden) > 1e-3).any(axis=0)
    return [
        name for k, name in enumerate(names) if seen_at[k] and not (k < n and estimator.noise.measured[k])
    ]


def _turns(system: LagrangianSystem) -> NDArray[np.float64]:
    """A full turn for the states that are angles, NaN for the others."""
    turns = {c.name: TURN.get(c.unit, 2 * np.pi) for c in system.coordinates if c.topology == "circle"}
    return np.array([turns.get(name, np.nan) for name in system.state_names])


def sensitivities(system: LagrangianSystem, substeps: int) -> ca.Function:
    """One sample and its derivatives: (x, u, (p, f), h) → (x⁺, ∂x⁺/∂x, ∂x⁺/∂f), f the coordinates' forces."""
    loaded = system.loaded()
    step = loaded.rk4(substeps)
    x, u = ca.SX.sym("x", len(system.state_names)), ca.SX.sym("u", len(system.input_names))
    p, h = ca.SX.sym("p", len(loaded.parameters)), ca.SX.sym("h")
    following = step(x, u, p, h)
    by_force = ca.jacobian(following, p)[:, len(system.parameters) :]
    results = [following, ca.jacobian(following, x), by_force]
    return ca.Function("sample", [x, u, p, h], ca.cse([ca.densify(r) for r in results]))

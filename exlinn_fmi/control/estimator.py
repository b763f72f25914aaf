"""Where the system is, and what pushes it: states and disturbances from what is measured.

A disturbance is a constant generalised force d on some coordinates that the model does not know of: a load
torque, a voltage drop, an error of the model. It is estimated with the state, z = (x, d), as a random walk,
and references and plan are made under it: what is measured then follows its reference without offset
(G. Pannocchia, J. Rawlings, Disturbance models for offset-free model-predictive control, AIChE J. 49, 2003).

- `none`: states are as measured; where one is not a number, the model's prediction stands in.
- `ekf`: extended Kalman filter, with the gain updated at each sample or that of the steady state.
- `mhe`: moving horizon estimation over a window, see moving_horizon.py.

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
from exlinn_fmi.mechanics.coordinates import full_turn
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem

QUIET = np.errstate(over="ignore", invalid="ignore")
"""What leaves the finite is told by the belief (`Belief.finite`), not by warnings."""


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
class Window:
    """What is remembered of the last samples, oldest first.

    Args:
        points: z that was believed, where the next linearisation is made, shape (k, n + d).
        y: measurements, shape (k, n); NaN where none was made.
        u: inputs that were held from then on, shape (k, m).
        arrival: mean (n + d,) and covariance (n + d, n + d) at the oldest, before its measurement.
    """

    points: NDArray[np.float64]
    y: NDArray[np.float64]
    u: NDArray[np.float64]
    arrival: tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class Belief:
    """What is held of z = (x, d) at one sampling time.

    Args:
        mean: shape (n + d,).
        covariance: shape (n + d, n + d).
        y: measurements at that time, shape (n,), NaN where none was made.
        window: the samples before (moving horizon).
    """

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    y: NDArray[np.float64]
    window: Window | None = None

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

    @QUIET
    def innovation(
        self, mean: Float[np.ndarray, " z"], y: Float[np.ndarray, " n"]
    ) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, " s"]]:
        """Which states were measured, and measured less expected; angles by the shorter way round."""
        seen = np.flatnonzero(np.isfinite(y) & self.noise.measured)
        difference, turn = y[seen] - mean[seen], self.turn[seen]
        turns = np.where(np.isfinite(turn), np.rint(difference / turn) * turn, 0.0)
        return seen, difference - np.nan_to_num(turns)

    @QUIET
    def corrected(
        self, mean: Float[np.ndarray, " z"], P: Float[np.ndarray, "z z"], y: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " z"], Float[np.ndarray, "z z"]]:
        """Mean and covariance after a measurement, in Joseph's form, which keeps the covariance positive."""
        try:
            return self.correction(mean, P, y)[:2]
        except np.linalg.LinAlgError:  # P has grown until R is lost in rounding: nothing is known any more
            return np.full_like(mean, np.nan), P

    def correction(
        self, mean: Float[np.ndarray, " z"], P: Float[np.ndarray, "z z"], y: Float[np.ndarray, " n"]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp], NDArray[np.float64]]:
        """The same, which states were measured (s,), and the innovation over its covariance beside the gain.

        The last is shape (s, 1 + z): S⁻¹ (y − ŷ), S⁻¹ C P.

        Raises:
            LinAlgError: that covariance is singular.
        """
        seen, difference = self.innovation(mean, y)
        R = np.diag(self.noise.measurement[seen] ** 2)
        weighed = np.linalg.solve(P[np.ix_(seen, seen)] + R, np.column_stack([difference, P[seen]]))
        if not len(seen):
            return mean, P, seen, weighed
        K = weighed[:, 1:].T
        rest = np.eye(len(mean))
        rest[:, seen] -= K
        return mean + K @ difference, rest @ P @ rest.T + K @ R @ K.T, seen, weighed

    @QUIET
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

    @QUIET
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
    turns = {c.name: full_turn(c.unit) for c in system.coordinates if c.topology == "circle"}
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

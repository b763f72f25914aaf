"""Moving horizon estimation: the likeliest trajectory over the last samples, by Gauss–Newton.

That is the iterated Kalman smoother (B. Bell, The iterated Kalman smoother as a Gauss–Newton method, SIAM J.
Optim. 4, 1994), with the filter's belief as arrival cost. It smooths as Bryson and Frazier do: what later
measurements say goes back as an adjoint, and no covariance is inverted that may be singular (G. Bierman,
Fixed interval smoothing with discrete measurements, Int. J. Control 18, 1973).

Compiled (compiled_window.py) a sample costs a twentieth; without a compiler it is computed here, with the
same answers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.estimator import QUIET, Belief, Estimator, Noise, Window
from exlinn_fmi.errors import ExlinnError
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem

Moments = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Mean (n + d,) and covariance (n + d, n + d) of z."""


class Passes(ABC):
    """What moving horizon estimation computes with."""

    @abstractmethod
    def carried(
        self,
        moments: Moments,
        y: Float[np.ndarray, " n"],
        point: Float[np.ndarray, " z"],
        u: Float[np.ndarray, " m"],
    ) -> Moments:
        """Moments corrected by measurements, then a sample later, linearised at a point."""

    @abstractmethod
    def smoothed(
        self, window: Window, y: Float[np.ndarray, " n"], iterations: int
    ) -> tuple[Float[np.ndarray, "k z"], Moments]:
        """The likeliest points of a window that ends with measurements y, and the moments at its end."""


class PlainPasses(Passes):
    """The passes by numpy.

    Args:
        estimator: whose samples and measurements they are.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator

    def carried(
        self,
        moments: Moments,
        y: Float[np.ndarray, " n"],
        point: Float[np.ndarray, " z"],
        u: Float[np.ndarray, " m"],
    ) -> Moments:
        """As `Passes.carried`."""
        mean, P = self._estimator.corrected(*moments, y)
        following, F, Q = self._estimator.linearised(point[None], u[None])
        return following[0] + F[0] @ (mean - point), F[0] @ P @ F[0].T + Q[0]

    def smoothed(
        self, window: Window, y: Float[np.ndarray, " n"], iterations: int
    ) -> tuple[Float[np.ndarray, "k z"], Moments]:
        """As `Passes.smoothed`."""
        points, measured = window.points, np.vstack([window.y, y])
        moments = window.arrival
        for _ in range(iterations):
            points, moments = self._pass(points, window, measured)
        return points, moments

    def _pass(
        self, points: Float[np.ndarray, "k z"], window: Window, y: Float[np.ndarray, "k1 n"]
    ) -> tuple[Float[np.ndarray, "k z"], Moments]:
        """One Gauss–Newton step: filter forwards along the linearisation at `points`, smooth backwards."""
        estimator, last = self._estimator, len(points)
        following, F, Q = estimator.linearised(points, window.u)
        mean, P = window.arrival
        filtered: list[Moments] = []
        weighed = []
        for k in range(last + 1):
            mean, P, seen, told = estimator.correction(mean, P, y[k])
            filtered.append((mean, P))
            weighed.append((seen, told))
            if k < last:
                mean, P = following[k] + F[k] @ (mean - points[k]), F[k] @ P @ F[k].T + Q[k]
        smoothed, adjoint = np.empty_like(points), np.zeros(len(mean))
        for k in reversed(range(last)):
            seen, told = weighed[k + 1]
            adjoint[seen] -= told[:, 0] + told[:, 1:] @ adjoint
            adjoint = F[k].T @ adjoint
            smoothed[k] = filtered[k][0] - filtered[k][1] @ adjoint
        return smoothed, filtered[last]


class MovingHorizon(Estimator):
    """Moving horizon estimation.

    Args:
        system: the prediction model.
        noise: what is not known.
        step: sampling time [s].
        substeps: RK4 steps in a sample.
        window: number of samples before the present one.
        iterations: Gauss–Newton steps at each sample.
        backend: what computes them; `auto`: compiled where that can be had.

    Raises:
        ExlinnError: it was to be compiled, and cannot be.
    """

    def __init__(
        self,
        system: LagrangianSystem,
        noise: Noise,
        step: float,
        substeps: int,
        window: int,
        iterations: int,
        backend: Literal["auto", "compiled", "casadi"] = "auto",
    ) -> None:
        super().__init__(system, noise, step, substeps, window)
        self.window, self.iterations = window, iterations
        self.passes: Passes = PlainPasses(self)
        if backend == "casadi":
            return
        from exlinn_fmi.control.compiled_window import CompiledPasses

        try:
            self.passes = CompiledPasses(self, substeps, window)
        except ExlinnError:
            if backend == "compiled":
                raise

    def begin(self, y: Float[np.ndarray, " n"], start: Float[np.ndarray, " n"]) -> Belief:
        """The first belief is the arrival cost."""
        first = super().begin(y, start)
        n, m, z = self.n, len(self.system.input_names), self.n + self.d
        empty = Window(np.empty((0, z)), np.empty((0, n)), np.empty((0, m)), (first.mean, first.covariance))
        return replace(first, y=np.full(n, np.nan), window=empty)

    @QUIET
    def predict(self, belief: Belief, u: Float[np.ndarray, " m"]) -> Belief:
        """As the model says; a sample that leaves the window moves the arrival cost on."""
        window, none = belief.window, np.full(self.n, np.nan)
        assert window is not None
        points = np.vstack([window.points, belief.mean])
        y, inputs, arrival = np.vstack([window.y, belief.y]), np.vstack([window.u, u]), window.arrival
        mean, covariance = self.passes.carried((belief.mean, belief.covariance), none, belief.mean, u)
        if len(points) > self.window:
            arrival = self.passes.carried(arrival, y[0], points[0], inputs[0])
            points, y, inputs = points[1:], y[1:], inputs[1:]
        return Belief(mean, covariance, none, Window(points, y, inputs, arrival))

    @QUIET
    def update(self, belief: Belief, y: Float[np.ndarray, " n"]) -> Belief:
        """The likeliest trajectory that ends with these measurements."""
        window = belief.window
        assert window is not None
        if not len(window.points):
            mean, covariance = self.corrected(*window.arrival, y)
            return replace(belief, mean=mean, covariance=covariance, y=y)
        try:
            points, (mean, covariance) = self.passes.smoothed(window, y, self.iterations)
        except np.linalg.LinAlgError:  # the linearisation led to where nothing is finite
            return replace(belief, mean=np.full_like(belief.mean, np.nan), y=y)
        return replace(belief, mean=mean, covariance=covariance, y=y, window=replace(window, points=points))

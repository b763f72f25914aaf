"""The optimal control problem (13), (14): model, cost, bounds and horizon, and its linearisation at a plan.

Over N intervals with states x_0 … x_N and held inputs u_0 … u_{N−1}:

    minimise   Σ_{k<N} ‖x_k − x*_k‖²_Q + ‖u_k − u*_k‖²_R  +  ‖x_N − x*_N‖²_P  +  penalty of the state bounds
    subject to x_{k+1} = RK4 of (16), x_0 measured, u within its bounds.

The paper's (14a) sums the inputs up to k = N, one more than there are. `cost: paper` is (13) as
written, u* = 0; `cost: tracking` takes the u* that the model needs to follow x*.

**What Q weighs.** One number for `weights.states` weighs the referenced state alone: it is what the user
asked to follow, and weight on the others' references, right as these are, slows the approach to it (with
the same weight on angle and speed the closed loop settles in a second instead of a tenth). Weights by
name are taken as they are, against the reference states x* that the model needs to follow the reference.

**State bounds** are softened: a violation s of a bound costs l₁ s + l₂ s²/2, l₁ large enough that a bound
that can be kept is kept exactly, at the nodes. They are moved inwards by `back_off`, the room for model error
and for what happens between two nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.riccati import solve_dare
from exlinn_fmi.control.terminal import terminal_level
from exlinn_fmi.errors import ModelError, nearest
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.scenario.control import Nmpc
from exlinn_fmi.scenario.spec import Bounds

HORIZON, KEEN, EASY = 30, 10.0, 1e-3
"""Intervals, weight of the referenced states and of the inputs: the paper's, where nothing else tells."""

PENALTY = 1e3
"""l₁ of a state bound over the largest weight times the bound's range."""

FALLBACK_TERMINAL = 10.0
"""The terminal cost is this multiple of Q where the Riccati equation has no solution."""


@dataclass(frozen=True)
class Targets:
    """What a solve aims at.

    Args:
        x: reference states x*, shape (N + 1, n), within the state bounds.
        u: reference inputs, shape (N, m): u* within the input bounds, or 0.
        P: terminal weight, shape (n, n).
        riccati: whether P / weight solves the Riccati equation.
        force: constant generalised force on each coordinate besides the inputs, shape (coordinates,).
        applied: the input applied last, shape (m,), None where there is none or where rates are not bounded.
        weight: λ, what P was multiplied by so that plans end in the terminal set.
        level: α of the terminal set for P / weight; 0 where there is none.
    """

    x: NDArray[np.float64]
    u: NDArray[np.float64]
    P: NDArray[np.float64]
    riccati: bool
    force: NDArray[np.float64]
    applied: NDArray[np.float64] | None = None
    weight: float = 1.0
    level: float = 0.0


@dataclass(frozen=True)
class Linearisation:
    """x_{k+1} ≈ next_k + A_k (x_k − x̄_k) + B_k (u_k − ū_k) at the plan (x̄, ū), for k = 0 … N−1.

    Args:
        next: shape (N, n).
        A: shape (N, n, n).
        B: shape (N, n, m).
    """

    next: NDArray[np.float64]
    A: NDArray[np.float64]
    B: NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """Bounds, −∞ or ∞ where there is none.

    Args:
        u_min: inputs, shape (m,).
        u_max: inputs, shape (m,).
        u_step: largest change of the inputs from one interval to the next, shape (m,).
        soft: indices of the states that are bounded, shape (s,).
        x_min: their bounds less the back-off, shape (s,).
        x_max: their bounds less the back-off, shape (s,).
        span: size that a violation is related to, shape (s,).
        back_off: the back-off over `span`.
    """

    u_min: NDArray[np.float64]
    u_max: NDArray[np.float64]
    u_step: NDArray[np.float64]
    soft: NDArray[np.intp]
    x_min: NDArray[np.float64]
    x_max: NDArray[np.float64]
    span: NDArray[np.float64]
    back_off: float

    @property
    def rated(self) -> bool:
        """Whether any input's rate is bounded."""
        return bool(np.isfinite(self.u_step).any())


class Ocp:
    """The optimal control problem of one controller.

    Args:
        system: the prediction model.
        options: horizon, cost, weights and bounds.
        step: length of an interval [s].
        referenced: indices of the referenced states.

    Raises:
        ModelError: names in `options` that the model does not have, bounds that exclude each other, or a
            terminal set that nothing is known of.
    """

    def __init__(
        self,
        system: LagrangianSystem,
        options: Nmpc,
        step: float,
        referenced: Sequence[int],
    ) -> None:
        self.system, self.step, self.horizon = system, step, options.horizon or HORIZON
        self.n, self.m = len(system.state_names), len(system.input_names)
        if not self.m:
            raise ModelError("the model has no input that the controller could move")
        self.paper = options.cost == "paper"
        weights, chosen = options.weights, np.isin(np.arange(self.n), referenced).astype(float)
        q = KEEN if weights.states is None else weights.states
        r = EASY if weights.inputs is None else weights.inputs
        self.Q = np.diag(_numbers("weights.states", q, system.state_names, chosen))
        self.R = np.diag(_numbers("weights.inputs", r, system.input_names, np.ones(self.m)))
        self.terminal = weights.terminal
        self.set_weight = 0.0 if options.terminal_set is None else options.terminal_set.weight
        """λ, what the terminal cost is multiplied by so that plans end in the terminal set; 0: no set."""
        if self.set_weight and (self.paper or self.terminal != "dare"):
            raise ModelError("terminal_set: needs `cost: tracking` and `weights.terminal: dare`")
        self.limits = _limits(options, system, step)
        largest = max(self.Q.max(), self.R.max())
        self.l1 = PENALTY * largest * self.limits.span
        self.l2 = PENALTY * largest * np.ones_like(self.limits.span)
        self.substeps, loaded = options.substeps or 1, system.loaded()
        self.sensitivities = rk4_sensitivities(loaded, self.substeps)
        """One interval and its derivatives: (x, u, p, h) → (x⁺, ∂x⁺/∂x, ∂x⁺/∂u)."""
        self._linearise = Batch(self.sensitivities, self.horizon)
        self._linearise_one = Batch(self.sensitivities, 1)
        self.discrete = loaded.rk4(self.substeps)
        """One interval of the prediction: (x, u, p, h) → x⁺, with `parameters(force)` as p."""
        self._predict = Batch(self.discrete, self.horizon)

    def parameters(self, force: Float[np.ndarray, " c"]) -> Float[np.ndarray, " p"]:
        """Parameters of the prediction: the model's own, then the force on each coordinate."""
        return np.concatenate([self.system.parameter_values, force])

    def predict(
        self,
        x: Float[np.ndarray, "nodes n"],
        u: Float[np.ndarray, "intervals m"],
        force: Float[np.ndarray, " c"],
    ) -> Float[np.ndarray, "intervals n"]:
        """Where each interval ends that begins at x_k with input u_k, shape (N, n)."""
        return self._predict(x[:-1], u, self.parameters(force), self.step)[0][:, :, 0].copy()

    def linearise(
        self,
        x: Float[np.ndarray, "nodes n"],
        u: Float[np.ndarray, "intervals m"],
        force: Float[np.ndarray, " c"],
    ) -> Linearisation:
        """The linearisation of all intervals at a plan."""
        following, A, B = self._linearise(x[:-1], u, self.parameters(force), self.step)
        return Linearisation(following[:, :, 0].copy(), A.copy(), B.copy())

    def linearise_at(
        self, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " m"], force: Float[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n m"]]:
        """A and B of one interval at a state (n,) and input (m,)."""
        _, A, B = self._linearise_one(x, u, self.parameters(force), self.step)
        return A[0].copy(), B[0].copy()

    def first_bounds(
        self, applied: Float[np.ndarray, " m"] | None
    ) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Bounds of the first input: what its rate allows after the last one, but never beyond its own.

        Args:
            applied: the last input, shape (m,); None where none has been applied.
        """
        lim = self.limits
        if applied is None:
            return lim.u_min, lim.u_max
        return (
            np.clip(applied - lim.u_step, lim.u_min, lim.u_max),
            np.clip(applied + lim.u_step, lim.u_min, lim.u_max),
        )

    def targets(self, references: References) -> Targets:
        """What to aim at: the references within bounds, and the terminal cost at the horizon's end.

        A reference beyond a bound would pull against it with a force that grows without limit; within it, the
        bound's penalty stays exact.
        """
        x, lim, factor, level = references.x.copy(), self.limits, 1.0, 0.0
        x[:, lim.soft] = np.clip(x[:, lim.soft], lim.x_min, lim.x_max)
        u = np.clip(references.u, lim.u_min, lim.u_max)
        P: NDArray[np.float64] | None = None
        if self.terminal == "dare":
            A, B = self.linearise_at(x[-1], u[-1], references.force)
            # An input without weight would leave R singular.
            R = self.R + np.diag(np.where(np.diagonal(self.R) > 0.0, 0.0, 1e-12 * max(1.0, self.Q.max())))
            P = solve_dare(A, B, self.Q, R)
            if P is not None and self.set_weight:
                u_room = np.minimum(lim.u_max - u[-1], u[-1] - lim.u_min)
                x_room = np.minimum(lim.x_max - x[-1, lim.soft], x[-1, lim.soft] - lim.x_min)
                level = terminal_level(A, B, R, P, u_room, lim.soft, x_room)
                factor = self.set_weight
        multiple = FALLBACK_TERMINAL if self.terminal == "dare" else self.terminal
        target = np.zeros_like(u) if self.paper else u
        end = multiple * self.Q if P is None else factor * P
        return Targets(x, target, end, P is not None, references.force, weight=factor, level=level)

    def cost(
        self, x: Float[np.ndarray, "nodes n"], u: Float[np.ndarray, "intervals m"], targets: Targets
    ) -> float:
        """Cost J (13) of a plan, without the penalty of the state bounds."""
        return self.weigh(x - targets.x, u - targets.u, targets.P)

    def weigh(
        self,
        x: Float[np.ndarray, "nodes n"],
        u: Float[np.ndarray, "intervals m"],
        P: Float[np.ndarray, "n n"],
    ) -> float:
        """Σ ‖x_k‖²_Q + ‖u_k‖²_R + ‖x_N‖²_P: the quadratic form of the cost."""
        stages = np.sum((x[:-1] @ self.Q) * x[:-1]) + np.sum((u @ self.R) * u)
        return float(stages + x[-1] @ P @ x[-1])

    def shift(
        self,
        x: Float[np.ndarray, "nodes n"],
        u: Float[np.ndarray, "intervals m"],
        force: Float[np.ndarray, " c"],
    ) -> tuple[Float[np.ndarray, "nodes n"], Float[np.ndarray, "intervals m"]]:
        """A plan (x, u) moved on by one interval: the last input is held, and the model says where to."""
        end = self._linearise_one(x[-1], u[-1], self.parameters(force), self.step)[0][0, :, 0]
        last = end if np.isfinite(end).all() else x[-1]
        return np.vstack([x[1:], last]), np.vstack([u[1:], u[-1:]])

    def violations(self, x: Float[np.ndarray, "nodes n"]) -> Float[np.ndarray, "intervals s"]:
        """How far x_1 … x_N are beyond their softened bounds, shape (N, s)."""
        lim = self.limits
        bounded = x[1:, lim.soft]
        beyond: NDArray[np.float64] = np.maximum(np.maximum(lim.x_min - bounded, bounded - lim.x_max), 0.0)
        return beyond

    def penalty(self, x: Float[np.ndarray, "nodes n"]) -> float:
        """Penalty of the state bounds."""
        s = self.violations(x)
        return float(np.sum(s @ self.l1) + np.sum(s**2 @ self.l2) / 2)

    def slack(self, x: Float[np.ndarray, "nodes n"]) -> float:
        """Largest violation of a bound as the user gave it (without back-off), over the bound's range."""
        beyond = self.violations(x) / self.limits.span - self.limits.back_off
        return float(max(0.0, beyond.max(initial=0.0)))


def rk4_sensitivities(system: LagrangianSystem, substeps: int) -> ca.Function:
    """One interval and its derivatives: (x, u, p, h) → (x⁺, ∂x⁺/∂x, ∂x⁺/∂u), by the chain rule through RK4.

    Args:
        system: the model.
        substeps: number of RK4 steps in the interval.
    """
    n, m = len(system.state_names), len(system.input_names)
    x0, u, h = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("h")
    p = ca.SX.sym("p", len(system.parameters))
    rate = system.derivative(x0, u, p)
    # Differentiating once and chaining is a third cheaper than differentiating all four stages.
    derivatives = ca.cse([rate, ca.jacobian(rate, x0), ca.jacobian(rate, u)])
    point = ca.Function("point", [x0, u, p], derivatives)
    dt, x = h / substeps, x0
    S = ca.horzcat(ca.SX.eye(n), ca.SX(n, m))  # ∂x/∂(x0, u)
    for _ in range(substeps):
        slopes: list[tuple[ca.SX, ca.SX]] = []
        for fraction in (0.0, 0.5, 0.5, 1.0):
            k, K = slopes[-1] if slopes else (ca.SX(n, 1), ca.SX(n, n + m))
            f, fx, fu = point(x + fraction * dt * k, u, p)
            slopes.append((f, fx @ (S + fraction * dt * K) + ca.horzcat(ca.SX(n, n), fu)))
        (k1, K1), (k2, K2), (k3, K3), (k4, K4) = slopes
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        S = S + dt / 6 * (K1 + 2 * K2 + 2 * K3 + K4)
    results = [ca.densify(x), ca.densify(S[:, :n]), ca.densify(S[:, n:])]
    return ca.Function("rk4_sensitivities", [x0, u, p, h], ca.cse(results))


def _numbers(
    key: str, given: float | Mapping[str, float], names: list[str], shape: NDArray[np.float64]
) -> NDArray[np.float64]:
    """One number per name: a number times `shape`, or those that are named and else 0."""
    if not isinstance(given, Mapping):
        return given * shape
    check_names(key, given, names, key.rpartition(".")[2])
    return np.array([given.get(name, 0.0) for name in names])


def check_names(key: str, given: Iterable[str], names: list[str], kind: str) -> None:
    """Refuse names that the model does not have.

    Args:
        key: where they stand.
        given: the names.
        names: those that the model has.
        kind: what these are, e.g. ``states``.

    Raises:
        ModelError: with the valid names.
    """
    for name in given:
        if name not in names:
            raise ModelError(f"{key}: the model has no {name!r}; {nearest(name, names, kind)}")


def _limits(options: Nmpc, system: LagrangianSystem, step: float) -> Limits:
    """Bounds as arrays."""
    u_min, u_max = _bounds("inputs", options.inputs, system.input_names)
    check_names("rates", options.rates, system.input_names, "inputs")
    u_step = step * np.array([options.rates.get(name, np.inf) for name in system.input_names])
    x_min, x_max = _bounds("states", options.states, system.state_names)
    soft: Int[np.ndarray, " s"] = np.flatnonzero(np.isfinite(x_min) | np.isfinite(x_max))
    low, high = x_min[soft], x_max[soft]
    both = np.isfinite(low) & np.isfinite(high)
    one = np.abs(np.where(np.isfinite(high), high, low))
    with np.errstate(invalid="ignore"):
        span = np.where(both, (high - low) / 2, one)
    span[span == 0.0] = 1.0
    room = options.back_off * span
    return Limits(u_min, u_max, u_step, soft, low + room, high - room, span, options.back_off)


def _bounds(
    key: str, given: Mapping[str, Bounds], names: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    check_names(key, given, names, key)
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for name, bounds in given.items():
        k = names.index(name)
        low[k] = -np.inf if bounds.min is None else bounds.min
        high[k] = np.inf if bounds.max is None else bounds.max
        if low[k] > high[k]:
            raise ModelError(f"{key}.{name}: min {low[k]:g} is above max {high[k]:g}; exchange them")
    return low, high

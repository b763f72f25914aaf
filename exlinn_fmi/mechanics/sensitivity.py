"""States and their sensitivities along many trajectories at once: what fitting to trajectories needs.

One RK4 step and its derivatives are CasADi functions; they are evaluated for all samples in one call and
chained in numpy for all segments together, so that no Python loop runs over samples × segments.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol

Array = NDArray[np.float64]


class Motion(ABC):
    """States along B segments of K steps each through recorded inputs, as they depend on r parameters p."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of parameters."""

    @abstractmethod
    def run(
        self, start: Float[Array, "B nx"], inputs: Float[Array, "B K m"], p: Float[Array, " r"]
    ) -> Float[Array, "B rows nx"]:
        """States at all rows; not finite from where a segment diverges.

        Args:
            start: first state of each segment.
            inputs: held from each row to the next.
            p: parameters.
        """

    @abstractmethod
    def sensitivities(
        self, states: Float[Array, "B rows nx"], inputs: Float[Array, "B K m"], p: Float[Array, " r"]
    ) -> Iterator[Float[Array, "B nx columns"]]:
        """Derivatives of the states by the segment's first state and by p, at each row from the first on.

        Args:
            states: what `run` gave.
            inputs: held from each row to the next.
            p: parameters.
        """


@dataclass(frozen=True)
class Propagator(Motion):
    """RK4 through recorded inputs, held from row to row.

    Args:
        system: with nx states, m inputs and r parameters.
        step: from row to row [s], one for all or (B, K).
    """

    system: LagrangianSystem
    step: float | Float[Array, "B K"]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.system.parameters)

    @cached_property
    def _advance(self) -> ca.Function:
        x, u, p = self._symbols
        h = ca.SX.sym("h")
        return ca.Function("advance", [x, u, p, h], [self.system.rk4()(x, u, p, h)])

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        s = self.system
        sizes = {"x": len(s.state_names), "u": len(s.input_names), "p": len(s.parameters)}
        x, u, p = (ca.SX.sym(name, size) for name, size in sizes.items())
        return x, u, p

    @cached_property
    def _derivatives(self) -> ca.Function:
        """(x, u, p, h) → ∂x⁺/∂x, ∂x⁺/∂p of one step, by the chain rule through its four stages."""
        x, u, p = self._symbols
        h = ca.SX.sym("h")
        rate = self.system.derivative
        slope = ca.Function(
            "slope",
            [x, u, p],
            [rate(x, u, p), ca.jacobian(rate(x, u, p), x), ca.jacobian(rate(x, u, p), p)],
        )
        n = x.shape[0]
        k: Symbol = ca.SX.zeros(n)
        kx: Symbol = ca.SX.zeros(n, n)
        kp: Symbol = ca.SX.zeros(n, p.shape[0])
        sum_x: Symbol = 0
        sum_p: Symbol = 0
        for part, weight in zip((0, 1 / 2, 1 / 2, 1), (1, 2, 2, 1), strict=True):
            k, fx, fp = slope(x + part * h * k, u, p)
            kp = fp + part * h * ca.mtimes(fx, kp)
            kx = ca.mtimes(fx, ca.SX.eye(n) + part * h * kx)
            sum_x, sum_p = sum_x + weight * kx, sum_p + weight * kp
        results = [ca.densify(ca.SX.eye(n) + h / 6 * sum_x), ca.densify(h / 6 * sum_p)]
        return ca.Function("derivatives", [x, u, p, h], results)

    def run(
        self, start: Float[Array, "B nx"], inputs: Float[Array, "B K m"], p: Float[Array, " r"]
    ) -> Float[Array, "B rows nx"]:
        """States at all rows; not finite from where a segment diverges."""
        count, steps, _ = inputs.shape
        h = np.broadcast_to(self.step, (count, steps))
        states = np.empty((count, steps + 1, start.shape[1]))
        states[:, 0] = start
        advance = self._advance.map(count)
        for k in range(steps):
            states[:, k + 1] = advance(states[:, k].T, inputs[:, k].T, p[:, None], h[None, :, k]).full().T
        return states

    def sensitivities(
        self, states: Float[Array, "B rows nx"], inputs: Float[Array, "B K m"], p: Float[Array, " r"]
    ) -> Iterator[Float[Array, "B nx columns"]]:
        """Derivatives of the states by the segment's first state and by p, at each row from the first on."""
        count, steps, _ = inputs.shape
        nx, r = states.shape[2], len(p)
        by_x, by_p = self._all_derivatives(states[:, :-1], inputs, p)
        s = np.concatenate([np.broadcast_to(np.eye(nx), (count, nx, nx)), np.zeros((count, nx, r))], axis=2)
        yield s
        for k in range(steps):
            s = by_x[:, k] @ s
            s[:, :, nx:] += by_p[:, k]
            yield s

    def _all_derivatives(
        self, states: Float[Array, "B K nx"], inputs: Float[Array, "B K m"], p: Float[Array, " r"]
    ) -> tuple[Float[Array, "B K nx nx"], Float[Array, "B K nx r"]]:
        """∂x⁺/∂x and ∂x⁺/∂p of the step from each row."""
        count, steps, nx = states.shape
        rows = count * steps
        h = np.broadcast_to(self.step, (count, steps)).ravel()
        found = self._derivatives.map(rows)(
            states.reshape(rows, nx).T, inputs.reshape(rows, inputs.shape[2]).T, p[:, None], h[None]
        )
        by_x, by_p = (
            d.full().reshape(nx, rows, -1).transpose(1, 0, 2).reshape(count, steps, nx, -1) for d in found
        )
        return by_x, by_p

"""Algebraic loops: values that depend on themselves without delay, solved at each communication point.

The graph tears each loop at a connection. The torn values x go once around the loop and come back as G(x); a
solution is x = G(x). A pass around the loops sets and gets the components that are part of one, and no
others; those that depend on them follow once a solution is found.

References: Anderson, "Iterative procedures for nonlinear integral equations", 1965; Irons and Tuck, "A
version of the Aitken accelerator for computer iteration", 1969.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from exlinn_fmi.components.base import Indices, Values
from exlinn_fmi.errors import ComponentError, LoopError

if TYPE_CHECKING:
    from exlinn_fmi.cosim.exchange import Exchange
    from exlinn_fmi.cosim.plan import Plan

SOLVERS = ("newton", "anderson", "aitken", "fixed-point")
DEPTH = 5
"""Residuals that Anderson's method remembers."""


@dataclass(frozen=True)
class LoopOptions:
    """How algebraic loops are solved.

    Args:
        solver: one of `SOLVERS`.
        tolerance: greatest residual |G(x) − x| relative to 1 + |x|.
        iterations: passes around the loops at most, those for derivatives by differences left out.
    """

    solver: str = "newton"
    tolerance: float = 1e-9
    iterations: int = 50


class Loops:
    """The algebraic loops of a plan.

    Args:
        plan: laid out; `hold_to` are the places of torn values, `hold_from` those of what they become.
        torn: the output port behind each torn value.
        options: how to solve.

    Attributes:
        passes: around the loops, so far.
        worst: greatest residual that was accepted, relative to 1 + |x|.
    """

    def __init__(self, plan: Plan, torn: Sequence[tuple[int, int]], options: LoopOptions) -> None:
        self._plan, self._options, self._torn = plan, options, torn
        self._loops = [[plan.graph.port(path) for path in loop] for loop in plan.graph.loops]
        ports = {port for loop in self._loops for port in loop}
        self._visits = [(every, x) for every, x in plan.visits if ports & set(_ports(x))]
        self._followers = list(self._find_followers())
        self._real = np.array([plan.graph.variable(port).type == "Real" for port in torn])
        self._inverse: Values | None = None
        self._by_derivatives = all(
            plan.components[x.component].gives_directional_derivatives
            for _, x in self._visits
            if x.outputs is not None
        )
        self.passes, self.worst = 0, 0.0

    def _find_followers(self) -> Iterator[tuple[int, Exchange]]:
        """Visits out of the loops that take values of components in them, directly or not."""
        changed = {x.component for _, x in self._visits}
        inside = [x for _, x in self._visits]
        places = {p for x in inside for p in self._plan.places(x.taken)}
        for every, x in self._plan.visits:
            if not any(x is y for y in inside) and (
                x.component in changed or places & set(x.sources.tolist())
            ):
                changed.add(x.component)
                places |= set(self._plan.places(x.taken))
                yield every, x

    def close(self, k: int, t: float) -> None:
        """Find values that fit all around, after a first pass with those of the communication point before.

        Args:
            k: number of the tick.
            t: its time [s].

        Raises:
            LoopError: there are none, or they were not found.
            RunError: a component failed.
        """
        signals, to, back = self._plan.signals, self._plan.hold_to, self._plan.hold_from
        visits = [x for every, x in self._visits if not k % every]
        update = getattr(self, f"_{self._options.solver.replace('-', '_')}")(visits, t)
        for iteration in range(self._options.iterations + 1):
            x = signals[to]
            residual = signals[back] - x
            size = np.abs(residual) / (1 + np.abs(x))
            if (size <= self._options.tolerance).all():
                self.passes += iteration
                self.worst = max(self.worst, float(size.max(initial=0.0)))
                for every, visit in self._followers if iteration else ():
                    if not k % every:
                        self._plan.exchange(visit, signals, t)
                return
            if iteration < self._options.iterations:
                self._around(update(x, residual), visits, t)
        self._fail(size, t, f"the residual is {size.max():.3g} after {iteration} passes")

    def save(self) -> dict[str, Any]:
        """What it remembers from one communication point to the next, in plain values."""
        return {"inverse": self._inverse, "passes": self.passes, "worst": self.worst}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Remember what `save` gave."""
        self._inverse, self.passes, self.worst = state["inverse"], state["passes"], state["worst"]

    def _around(self, x: Values, visits: Sequence[Exchange], t: float) -> None:
        """One pass with torn values x; what they become is in the signals then.

        Raises:
            LoopError: x, or what comes of it, is not finite.
        """
        signals = self._plan.signals
        if not np.isfinite(x).all():
            self._fail(~np.isfinite(x), t, "the values grow without bound")
        signals[self._plan.hold_to] = x
        try:
            for visit in visits:
                self._plan.exchange(visit, signals, t)
        except ComponentError as error:
            if error.variable is None:
                raise
            self._fail(np.abs(x), t, str(error), error)

    def _fail(self, size: Values, t: float, what: str, cause: Exception | None = None) -> None:
        """Stop, naming the loop that fits worst.

        Raises:
            LoopError: always.
        """
        port = self._torn[int(np.argmax(size))]
        loop = next(loop for loop in self._loops if port in loop)
        names = " — ".join(map(self._plan.graph.path, loop))
        raise LoopError(
            f"algebraic loop {names} at t = {t:.9g} s: no solution found by {self._options.solver}: {what}, "
            f"expected at most {self._options.tolerance:g}; try another simulate.loops.solver, give start "
            "values nearer to a solution, or break the loop with `loops: delay`"
        ) from cause

    # ── solvers: each gives a function from values and residual to new values ────────────────────────────

    def _fixed_point(self, visits: Sequence[Exchange], t: float) -> Callable[[Values, Values], Values]:
        """Fixed point: x ← G(x)."""
        return lambda x, residual: x + residual

    def _aitken(self, visits: Sequence[Exchange], t: float) -> Callable[[Values, Values], Values]:
        """Aitken: x ← x + ω (G(x) − x) with ω from the last two residuals."""
        last: list[Any] = [1.0, None]

        def update(x: Values, residual: Values) -> Values:
            if last[1] is not None:
                change = residual - last[1]
                square = float(change @ change)
                last[0] = -last[0] * float(last[1] @ change) / square if square > 0 else 1.0
            last[1] = residual
            new: Values = x + last[0] * residual
            return new

        return update

    def _anderson(self, visits: Sequence[Exchange], t: float) -> Callable[[Values, Values], Values]:
        """Anderson: the combination of the last values whose residuals cancel best."""
        xs, residuals = list[Values](), list[Values]()

        def update(x: Values, residual: Values) -> Values:
            xs.append(x)
            residuals.append(residual)
            del xs[: -DEPTH - 1], residuals[: -DEPTH - 1]
            new: Values = x + residual
            if len(xs) > 1:
                of_x, of_residual = np.diff(xs, axis=0).T, np.diff(residuals, axis=0).T
                weights = np.linalg.lstsq(of_residual, residual, rcond=None)[0]
                new = new - (of_x + of_residual) @ weights
            return new

        return update

    def _newton(self, visits: Sequence[Exchange], t: float) -> Callable[[Values, Values], Values]:
        """Newton: x ← x + (1 − ∂G/∂x)⁻¹ (G(x) − x); a derivative serves while residuals shrink fast."""
        before = [np.inf]

        def update(x: Values, residual: Values) -> Values:
            size = float(np.abs(residual).max())
            if self._inverse is None or size > 0.1 * before[0]:
                matrix = np.eye(len(x)) - self._jacobian(x, x + residual, visits, t)
                try:
                    self._inverse = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
                except np.linalg.LinAlgError:
                    self._fail(np.abs(residual), t, "the derivative around the loop is 1")
            before[0] = size
            assert self._inverse is not None
            new: Values = x + self._inverse @ residual
            return new

        return update

    # ── derivatives ──────────────────────────────────────────────────────────────────────────────────────

    def _jacobian(self, x: Values, g: Values, visits: Sequence[Exchange], t: float) -> Values:
        """∂G/∂x; values that are no real numbers count as constant."""
        if self._by_derivatives:
            matrix = self._along_directions(visits)
        else:
            matrix = np.zeros((len(x), len(x)))
            for j in np.flatnonzero(self._real):
                moved = x.copy()
                moved[j] += np.sqrt(np.finfo(float).eps) * (1 + abs(x[j]))
                self._around(moved, visits, t)
                matrix[:, j] = (self._plan.signals[self._plan.hold_from] - g) / (moved[j] - x[j])
        return np.where(np.outer(self._real, self._real), matrix, 0.0)

    def _along_directions(self, visits: Sequence[Exchange]) -> Values:
        """∂G/∂x from the components' directional derivatives, carried around the loops."""
        plan = self._plan
        tangent = np.zeros((len(plan.hold_to), len(plan.signals)))
        tangent[np.arange(len(plan.hold_to)), plan.hold_to] = 1.0
        given: dict[int, list[tuple[Indices, Indices]]] = {}
        for x in visits:
            so_far = given.setdefault(x.component, [])
            if x.inputs is not None:
                so_far.append((x.inputs, x.sources))
            if x.outputs is None or not so_far:
                continue
            inputs, sources = (np.concatenate(part) for part in zip(*so_far, strict=True))
            place = list(plan.places(x.taken))
            component = plan.components[x.component]
            for direction in tangent:
                seed = direction[sources]
                if seed.any():
                    direction[place] = component.directional_derivative(x.outputs, inputs, seed)
        return tangent[:, plan.hold_from].T


def _ports(x: Exchange) -> set[tuple[int, int]]:
    """Ports that an exchange sets and gets."""
    return {(x.component, int(k)) for part in (x.inputs, x.outputs) if part is not None for k in part}

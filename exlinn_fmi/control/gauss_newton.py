"""Gauss–Newton steps by CasADi and its QP solvers: `rti` and `sqp` for machines without a C compiler."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Limits, Linearisation, Ocp, Targets
from exlinn_fmi.control.qp import QpSolution, StageQp, make_qp_solver
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.scaling import ScaledQp, units
from exlinn_fmi.control.solver import PlainSolver, Plan, Solution, SolveStatus, Stats, failed

SHORTEST = 2.0**-10
"""Shortest step that the line search tries."""


class GaussNewton(PlainSolver):
    """Sequential quadratic programming with the Gauss–Newton Hessian, which is that of the cost.

    Args:
        ocp: the problem.
        iterations: most iterations in a solve.
        tolerance: KKT tolerance.
        real_time: one full step in a solve that has a plan to start from.
    """

    def __init__(self, ocp: Ocp, iterations: int, tolerance: float, real_time: bool) -> None:
        super().__init__(ocp, iterations, tolerance)
        self.real_time = real_time
        lim = ocp.limits
        inner = make_qp_solver(ocp.horizon, ocp.n + ocp.m * lim.rated, ocp.m, lim.soft, lim.rated)
        self.qp = ScaledQp(inner, lim.soft)
        """Solver of the quadratic programs."""

    def prepare(
        self, references: References, guess: Plan, applied: Float[np.ndarray, " m"] | None = None
    ) -> None:
        """Linearise at the guess and lay out the quadratic program of a real-time iteration."""
        super().prepare(references, guess, applied)
        self._prepared: tuple[Plan, Linearisation, Targets] | None = None
        if not self.real_time:
            return
        targets, lim = self._targets(references, applied), self.ocp.limits
        plan = Plan(guess.x, np.clip(guess.u, lim.u_min, lim.u_max))
        at = self.ocp.linearise(plan.x, plan.u, targets.force)
        if all(np.isfinite(a).all() for a in (at.next, at.A, at.B)):
            self._prepared = plan, at, targets

    def feedback(self, x0: Float[np.ndarray, " n"]) -> Solution:
        """One step of the quadratic program that was prepared; where that is not to be had, a whole solve."""
        if self.real_time and self._prepared is not None and np.isfinite(x0).all():
            plan, at, targets = self._prepared
            step = self._step(plan, at, targets, x0 - plan.x[0])
            if step.solved:
                stats = Stats(1, self._residual(plan, at, step, targets), qp=step.solver)
                found = self._whole_step(plan, step, targets, stats)
                if found.status != SolveStatus.FAILED:
                    return found
        return super().feedback(x0)

    def _solve(self, plan: Plan, targets: Targets, cold: bool) -> Solution:
        once = self.real_time and not cold
        weight, stats = 0.0, Stats()
        for iteration in range(1, self.iterations + 1):
            at = self.ocp.linearise(plan.x, plan.u, targets.force)
            if not all(np.isfinite(a).all() for a in (at.next, at.A, at.B)):
                return failed(plan, Stats(iteration, message="the model's predictions are not finite"))
            step = self._step(plan, at, targets, np.zeros(self.ocp.n))
            if not step.solved:
                message = f"{step.solver} did not solve the quadratic program"
                return failed(plan, Stats(iteration, qp=step.solver, message=message))
            stats = Stats(iteration, self._residual(plan, at, step, targets), qp=step.solver)
            if once or stats.kkt <= self.tolerance:
                return self._whole_step(plan, step, targets, stats)
            plan, weight = self._search(plan, at, step, targets, weight)
        message = (
            f"KKT residual {stats.kkt:.2g} after {self.iterations} iterations (tolerance {self.tolerance:g})"
        )
        limit = Stats(stats.iterations, stats.kkt, qp=stats.qp, message=message)
        return self._solution(plan, targets, SolveStatus.LIMIT, limit)

    def _whole_step(self, plan: Plan, step: QpSolution, targets: Targets, stats: Stats) -> Solution:
        # ū + (bound − ū) is the bound up to rounding only.
        u = np.clip(plan.u + step.du, self.ocp.limits.u_min, self.ocp.limits.u_max)
        return self._solution(Plan(plan.x + step.dx, u), targets, SolveStatus.SOLVED, stats)

    def _step(
        self, plan: Plan, at: Linearisation, targets: Targets, dx0: Float[np.ndarray, " n"]
    ) -> QpSolution:
        """The solution of the quadratic program at a plan, for a state that is off its first one by dx0."""
        qp = self.stage_qp(plan, at, targets, dx0)
        step = self.qp.solve(_with_rates(qp, plan.u, self.ocp.limits) if self.ocp.limits.rated else qp)
        return replace(step, dx=step.dx[:, : self.ocp.n])

    def stage_qp(
        self, plan: Plan, at: Linearisation, targets: Targets, dx0: Float[np.ndarray, " n"]
    ) -> StageQp:
        """The quadratic program at a plan, for a state off its first by dx0; without bounds on rates."""
        ocp, lim = self.ocp, self.ocp.limits
        first_low, first_high = ocp.first_bounds(targets.applied)
        e = plan.x - targets.x
        g = 2.0 * e @ ocp.Q
        g[-1] = 2.0 * targets.P @ e[-1]
        bounded = plan.x[1:, lim.soft]
        return StageQp(
            A=at.A,
            B=at.B,
            c=at.next - plan.x[1:],
            dx0=dx0,
            H_x=2.0 * ocp.Q,
            H_end=2.0 * targets.P,
            H_u=2.0 * ocp.R,
            g=g,
            r=2.0 * (plan.u - targets.u) @ ocp.R,
            u_low=np.vstack([first_low, np.tile(lim.u_min, (ocp.horizon - 1, 1))]) - plan.u,
            u_high=np.vstack([first_high, np.tile(lim.u_max, (ocp.horizon - 1, 1))]) - plan.u,
            low=lim.x_min - bounded,
            high=lim.x_max - bounded,
            l1=ocp.l1,
            l2=ocp.l2,
        )

    def _residual(self, plan: Plan, at: Linearisation, step: QpSolution, targets: Targets) -> float:
        """KKT residual at a plan, with the multipliers of its quadratic program.

        These make gradient + Hessian · step + constraints' part vanish, so Hessian · step is what the
        gradient of the Lagrangian is off by; and the gaps of the dynamics. Each in units that cost about one.
        """
        ocp = self.ocp
        x, u = units(2.0 * targets.P, 2.0 * ocp.R, at.B[-1])
        soft = x[ocp.limits.soft]
        slack = step.slack - ocp.violations(plan.x)
        parts = (
            2.0 * step.dx[1:-1] @ ocp.Q * x,
            2.0 * targets.P @ step.dx[-1] * x,
            2.0 * step.du @ ocp.R * u,
            slack * ocp.l2 * soft,
            (at.next - plan.x[1:]) / x,
        )
        return float(max(np.abs(part).max(initial=0.0) for part in parts))

    def _search(
        self, plan: Plan, at: Linearisation, step: QpSolution, targets: Targets, weight: float
    ) -> tuple[Plan, float]:
        """The next plan, and the weight of the gaps in the merit function, which only grows."""
        ocp = self.ocp
        gap = float(np.abs(at.next - plan.x[1:]).sum())
        now = ocp.cost(plan.x, plan.u, targets) + ocp.penalty(plan.x)
        full = ocp.cost(plan.x + step.dx, plan.u + step.du, targets) + ocp.penalty(plan.x + step.dx)
        if gap > 0.0:
            weight = max(weight, 2.0 * (full - now) / gap)
        # The cost is quadratic: its change less its curvature is its slope.
        slope = full - now - ocp.weigh(step.dx, step.du, targets.P) - weight * gap
        rounding = 1e-12 * (1.0 + abs(now) + weight * gap)
        length = 1.0
        while True:
            trial = Plan(plan.x + length * step.dx, plan.u + length * step.du)
            gaps = ocp.predict(trial.x, trial.u, targets.force) - trial.x[1:]
            merit = ocp.cost(trial.x, trial.u, targets) + ocp.penalty(trial.x) + weight * np.abs(gaps).sum()
            enough = merit <= now + weight * gap + 1e-4 * length * slope + rounding
            # The shortest step is taken whatever it brings: standing still would end the iteration.
            if enough or length <= SHORTEST:
                return trial, weight
            length /= 2.0


def _with_rates(qp: StageQp, u: Float[np.ndarray, "intervals m"], limits: Limits) -> StageQp:
    """The same program with the inputs of the stage before as further states, and bounds on their change."""
    _, n, m = qp.B.shape

    def longer(a: NDArray[np.float64], *axes: int) -> NDArray[np.float64]:
        return np.pad(a, [(0, m if axis in axes else 0) for axis in range(a.ndim)])

    B = longer(qp.B, 1)
    B[:, n:] = np.eye(m)
    moved = np.diff(u, axis=0)
    return replace(
        qp,
        A=longer(qp.A, 1, 2),
        B=B,
        c=longer(qp.c, 1),
        dx0=longer(qp.dx0, 0),
        H_x=longer(qp.H_x, 0, 1),
        H_end=longer(qp.H_end, 0, 1),
        g=longer(qp.g, 1),
        rate_low=-limits.u_step - moved,
        rate_high=limits.u_step - moved,
    )

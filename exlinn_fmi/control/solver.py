"""What solves the optimal control problem: one interface, three words in the scenario.

- `rti`: one Gauss–Newton step (real-time iteration: M. Diehl et al., J. Process Control 12, 2002). A start
  without a plan is iterated to convergence, since there is nothing yet to improve on.
- `sqp`: Gauss–Newton steps until the KKT residual is below the tolerance, made globally convergent by a line
  search on an ℓ₁ merit function (J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., §18.3).
- `ipopt`: interior point with exact second derivatives.

A solve that goes wrong is a `Solution` that says so.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Linearisation, Ocp, Targets
from exlinn_fmi.control.qp import QpSolution, StageQp, make_qp_solver
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.scaling import ScaledQp, units
from exlinn_fmi.errors import SolverError

SHORTEST = 2.0**-10
"""Shortest step that the line search tries."""


class SolveStatus(IntEnum):
    """Outcome of a solve."""

    SOLVED = 0
    LIMIT = 1
    FAILED = 2


@dataclass(frozen=True)
class Plan:
    """States (N + 1, n) and inputs (N, m) over the horizon."""

    x: NDArray[np.float64]
    u: NDArray[np.float64]


@dataclass(frozen=True)
class Stats:
    """How a solve went.

    Args:
        iterations: linearisations, or interior-point iterations.
        kkt: largest residual of the optimality conditions, at the last linearisation.
        cost: J (13) of the plan.
        slack: largest violation of a state bound in the plan, over the bound's range.
        qp: which QP solver was used last, "" for none.
        message: what went wrong, "" if nothing did.
    """

    iterations: int = 0
    kkt: float = 0.0
    cost: float = 0.0
    slack: float = 0.0
    qp: str = ""
    message: str = ""


@dataclass(frozen=True)
class Solution:
    """A plan with its status and targets; where that is FAILED the plan is not to be used."""

    x: NDArray[np.float64]
    u: NDArray[np.float64]
    status: SolveStatus
    stats: Stats
    targets: Targets | None = None


class Solver(ABC):
    """Solves one optimal control problem again and again.

    Args:
        ocp: the problem.
        iterations: most iterations in a solve.
        tolerance: KKT tolerance.
    """

    def __init__(self, ocp: Ocp, iterations: int, tolerance: float) -> None:
        self.ocp, self.iterations, self.tolerance = ocp, iterations, tolerance

    def solve(
        self, x0: Float[np.ndarray, " n"], references: References, guess: Plan | None = None
    ) -> Solution:
        """Solve from a measured state.

        Args:
            x0: measured state, shape (n,).
            references: what to follow.
            guess: plan to start from, usually the last one shifted; where there is none or it leads nowhere,
                the reference is what is started from, then standing still.
        """
        targets = self.ocp.targets(references)
        # Plan and reference may lead where the model predicts nothing: then try from where we are.
        stay = Plan(np.tile(x0, (self.ocp.horizon + 1, 1)), np.zeros_like(targets.u))
        starts = [] if guess is None else [guess]
        for start in (*starts, Plan(targets.x, targets.u), stay):
            solution = self._from(x0, start, targets, cold=start is not guess)
            if solution.status != SolveStatus.FAILED:
                break
        return solution

    def _from(self, x0: Float[np.ndarray, " n"], guess: Plan, targets: Targets, cold: bool) -> Solution:
        """Solve from a plan that need be neither finite nor within bounds."""
        x, u = guess.x.copy(), np.clip(guess.u, self.ocp.limits.u_min, self.ocp.limits.u_max)
        x[0] = x0
        if not all(np.isfinite(a).all() for a in (x, u, targets.x, targets.u, targets.P)):
            message = "the measured state, the reference or the guess is not finite"
            return failed(Plan(x, u), Stats(message=message))
        return self._solve(Plan(x, u), targets, cold)

    @abstractmethod
    def _solve(self, plan: Plan, targets: Targets, cold: bool) -> Solution:
        """Solve from a finite plan whose first state is the measured one."""

    def _solution(self, plan: Plan, targets: Targets, status: SolveStatus, stats: Stats) -> Solution:
        """A solution with cost and slack of its plan, FAILED if they are not finite."""
        cost, slack = self.ocp.cost(plan.x, plan.u, targets), self.ocp.slack(plan.x)
        if not (np.isfinite(cost) and np.isfinite(slack) and np.isfinite(plan.u).all()):
            return failed(plan, Stats(stats.iterations, message="the plan is not finite", qp=stats.qp))
        full = Stats(stats.iterations, stats.kkt, cost, slack, stats.qp, stats.message)
        return Solution(plan.x, plan.u, status, full, targets)


def failed(plan: Plan, stats: Stats) -> Solution:
    """A solution that is none."""
    return Solution(plan.x, plan.u, SolveStatus.FAILED, stats)


class GaussNewton(Solver):
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
        self.qp = ScaledQp(make_qp_solver(ocp.horizon, ocp.n, ocp.m, ocp.limits.soft), ocp.limits.soft)
        """Solver of the quadratic programs."""

    def _solve(self, plan: Plan, targets: Targets, cold: bool) -> Solution:
        once = self.real_time and not cold
        weight, stats = 0.0, Stats()
        for iteration in range(1, self.iterations + 1):
            at = self.ocp.linearise(plan.x, plan.u, targets.force)
            if not all(np.isfinite(a).all() for a in (at.next, at.A, at.B)):
                return failed(plan, Stats(iteration, message="the model's predictions are not finite"))
            step = self.qp.solve(self._stage_qp(plan, at, targets))
            if not step.solved:
                message = f"{step.solver} did not solve the quadratic program"
                return failed(plan, Stats(iteration, qp=step.solver, message=message))
            stats = Stats(iteration, self._residual(plan, at, step, targets), qp=step.solver)
            if once or stats.kkt <= self.tolerance:
                # ū + (bound − ū) is the bound up to rounding only.
                u = np.clip(plan.u + step.du, self.ocp.limits.u_min, self.ocp.limits.u_max)
                return self._solution(Plan(plan.x + step.dx, u), targets, SolveStatus.SOLVED, stats)
            plan, weight = self._search(plan, at, step, targets, weight)
        message = (
            f"KKT residual {stats.kkt:.2g} after {self.iterations} iterations (tolerance {self.tolerance:g})"
        )
        limit = Stats(stats.iterations, stats.kkt, qp=stats.qp, message=message)
        return self._solution(plan, targets, SolveStatus.LIMIT, limit)

    def _stage_qp(self, plan: Plan, at: Linearisation, targets: Targets) -> StageQp:
        """The quadratic program at a plan whose first state is the measured one."""
        ocp, lim = self.ocp, self.ocp.limits
        e = plan.x - targets.x
        g = 2.0 * e @ ocp.Q
        g[-1] = 2.0 * targets.P @ e[-1]
        bounded = plan.x[1:, lim.soft]
        return StageQp(
            A=at.A,
            B=at.B,
            c=at.next - plan.x[1:],
            dx0=np.zeros(ocp.n),
            H_x=2.0 * ocp.Q,
            H_end=2.0 * targets.P,
            H_u=2.0 * ocp.R,
            g=g,
            r=2.0 * (plan.u - targets.u) @ ocp.R,
            u_low=lim.u_min - plan.u,
            u_high=lim.u_max - plan.u,
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
            2.0 * step.dx[:-1] @ ocp.Q * x,
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


class Ipopt(Solver):
    """IPOPT on the same problem, with exact second derivatives.

    Args:
        ocp: the problem.
        iterations: most iterations in a solve.
        tolerance: KKT tolerance.

    Raises:
        SolverError: this CasADi has no IPOPT.
    """

    def __init__(self, ocp: Ocp, iterations: int, tolerance: float) -> None:
        super().__init__(ocp, iterations, tolerance)
        if not ca.has_nlpsol("ipopt"):
            raise SolverError("solver: this CasADi comes without IPOPT; take `solver: sqp`")
        N, n, m, lim = ocp.horizon, ocp.n, ocp.m, ocp.limits
        s = len(lim.soft)
        self._split = np.cumsum([n * N, m * N])
        X, U, S = ca.MX.sym("x", n, N), ca.MX.sym("u", m, N), ca.MX.sym("s", s, N)
        x0, X_ref, U_ref = ca.MX.sym("x0", n), ca.MX.sym("x_ref", n, N + 1), ca.MX.sym("u_ref", m, N)
        P, force = ca.MX.sym("P", n, n), ca.MX.sym("force", ocp.system.n)
        p = ca.vertcat(ca.DM(ocp.system.parameter_values), force)
        before = ca.horzcat(x0, X[:, :-1])
        following = ocp.discrete.map(N)(before, U, ca.repmat(p, 1, N), ocp.step)
        e, d = before - X_ref[:, :-1], U - U_ref
        end = X[:, -1] - X_ref[:, -1]
        cost = ca.sum2(ca.sum1(e * ca.mtimes(ocp.Q, e))) + ca.sum2(ca.sum1(d * ca.mtimes(ocp.R, d)))
        cost += ca.dot(end, P @ end) + ca.dot(ca.repmat(ocp.l1, 1, N), S) + ca.dot(ocp.l2, ca.sum2(S**2)) / 2
        bounded = X[lim.soft.tolist(), :]
        constraints = [following - X, bounded - S, bounded + S]
        self._solver = ca.nlpsol(
            "ocp",
            "ipopt",
            {
                "x": ca.vertcat(*(ca.vec(a) for a in (X, U, S))),
                "p": ca.vertcat(*(ca.vec(a) for a in (x0, X_ref, U_ref, P, force))),
                "f": cost,
                "g": ca.vertcat(*(ca.vec(a) for a in constraints)),
            },
            {
                "error_on_fail": False,
                "print_time": False,
                "show_eval_warnings": False,
                "calc_lam_p": False,
                "ipopt": {
                    "print_level": 0,
                    "sb": "yes",
                    "max_iter": iterations,
                    # Its barrier keeps off bounds that are hardly active, by the root of what is asked for.
                    "tol": max(1e-4 * tolerance, 1e-12),
                    "nlp_scaling_method": "none",
                    "bound_relax_factor": 0.0,
                    "acceptable_iter": 0,
                },
            },
        )
        free, none, gap = np.full(n * N, np.inf), np.full(s * N, np.inf), np.zeros(n * N)
        self._bounds = {
            "lbx": np.concatenate([-free, np.tile(lim.u_min, N), np.zeros(s * N)]),
            "ubx": np.concatenate([free, np.tile(lim.u_max, N), none]),
            "lbg": np.concatenate([gap, -none, np.tile(lim.x_min, N)]),
            "ubg": np.concatenate([gap, np.tile(lim.x_max, N), none]),
        }

    def _solve(self, plan: Plan, targets: Targets, cold: bool) -> Solution:
        violations = self.ocp.violations(plan.x)
        start = np.concatenate([plan.x[1:].ravel(), plan.u.ravel(), violations.ravel()])
        p = np.concatenate(
            [plan.x[0], targets.x.ravel(), targets.u.ravel(), targets.P.ravel(), targets.force]
        )
        try:
            result = self._solver(x0=start, p=p, **self._bounds)
        except RuntimeError as error:  # CasADi's only way to report a callback that went wrong
            return failed(plan, Stats(message=f"IPOPT: {str(error).splitlines()[-1]}"))
        stats = self._solver.stats()
        word, iterations = str(stats["return_status"]), int(stats["iter_count"])
        x, u, _ = np.split(result["x"].full().ravel(), self._split)
        found = Plan(np.vstack([plan.x[0], x.reshape(-1, self.ocp.n)]), u.reshape(-1, self.ocp.m))
        history = stats.get("iterations", {})
        kkt = max((history[key][-1] for key in ("inf_pr", "inf_du") if history.get(key)), default=np.inf)
        stuck = word == "Search_Direction_Becomes_Too_Small"  # at the limit of its arithmetic
        if word == "Solve_Succeeded" or (stuck and kkt <= self.tolerance):
            status, message = SolveStatus.SOLVED, ""
        elif word == "Maximum_Iterations_Exceeded":
            status, message = SolveStatus.LIMIT, f"IPOPT stopped after {iterations} iterations"
        else:
            return failed(plan, Stats(iterations, message=f"IPOPT: {word}"))
        return self._solution(found, targets, status, Stats(iterations, float(kkt), message=message))


def make_solver(ocp: Ocp, kind: Literal["rti", "sqp", "ipopt"], iterations: int, tolerance: float) -> Solver:
    """The solver of that name.

    Args:
        ocp: the problem.
        kind: as in the scenario.
        iterations: most iterations in a solve.
        tolerance: KKT tolerance.

    Raises:
        SolverError: this CasADi has no such solver.
    """
    if kind == "ipopt":
        return Ipopt(ocp, iterations, tolerance)
    return GaussNewton(ocp, iterations, tolerance, real_time=kind == "rti")

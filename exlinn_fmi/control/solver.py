"""What solves the optimal control problem: one interface, three words in the scenario.

- `rti`: one Gauss–Newton step (real-time iteration: M. Diehl et al., J. Process Control 12, 2002). A start
  without a plan is iterated to convergence, since there is nothing yet to improve on.
- `sqp`: Gauss–Newton steps until the KKT residual is below the tolerance, made globally convergent by a line
  search on an ℓ₁ merit function (J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., §18.3).
- `ipopt`: interior point with exact second derivatives.

A solve comes in one piece (`solve`) or in two: `prepare`, all that can be done before the measurement is
there, and `feedback` with it. What goes wrong is a `Solution` that says so. `rti` and `sqp` come twice, with
the same answers: compiled (control/realtime.py), and here by CasADi, for machines without a C compiler.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Limits, Linearisation, Ocp, Targets
from exlinn_fmi.control.qp import QpSolution, StageQp, make_qp_solver
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.scaling import ScaledQp, units
from exlinn_fmi.errors import ExlinnError, SolverError

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

    Attributes:
        backend: what computes it, ``compiled`` or ``casadi``.
        reason: why it is not the compiled one, "" where that was asked for.
    """

    backend = "casadi"

    def __init__(self, ocp: Ocp, iterations: int, tolerance: float) -> None:
        self.ocp, self.iterations, self.tolerance = ocp, iterations, tolerance
        self.reason = ""

    def prepare(
        self, references: References, guess: Plan, applied: Float[np.ndarray, " m"] | None = None
    ) -> None:
        """Do what can be done before the measurement is there.

        Args:
            references: what to follow.
            guess: plan to start from; it begins where the measurement is expected.
            applied: the input that is applied until then, shape (m,).
        """
        self._waiting = references, guess, applied

    def feedback(self, x0: Float[np.ndarray, " n"]) -> Solution:
        """Solve what was prepared, from a measured state (n,)."""
        return self.solve(x0, *self._waiting)

    @abstractmethod
    def solve(
        self,
        x0: Float[np.ndarray, " n"],
        references: References,
        guess: Plan | None = None,
        applied: Float[np.ndarray, " m"] | None = None,
    ) -> Solution:
        """Solve from a measured state.

        Args:
            x0: measured state, shape (n,).
            references: what to follow.
            guess: plan to start from, usually the last one shifted; where there is none or it leads nowhere,
                the reference is what is started from, then standing still.
            applied: the input applied last, shape (m,), which bounds on the rate start from.
        """


class PlainSolver(Solver):
    """A solver by CasADi, which is started from one plan after the other until it leads somewhere."""

    def solve(
        self,
        x0: Float[np.ndarray, " n"],
        references: References,
        guess: Plan | None = None,
        applied: Float[np.ndarray, " m"] | None = None,
    ) -> Solution:
        """Solve from a measured state; as `Solver.solve`."""
        targets = self._targets(references, applied)
        # Plan and reference may lead where the model predicts nothing: then try from where we are.
        stay = Plan(np.tile(x0, (self.ocp.horizon + 1, 1)), np.zeros_like(targets.u))
        if guess is not None:
            solution = self._from(x0, guess, targets, cold=False)
            if solution.status != SolveStatus.FAILED:
                return solution
        found = []
        for start in (Plan(targets.x, targets.u), stay):
            found.append(self._from(x0, start, targets, cold=True))
            if found[-1].status == SolveStatus.SOLVED:
                return found[-1]
        return found[0] if found[1].status == SolveStatus.FAILED else found[1]

    def _targets(self, references: References, applied: Float[np.ndarray, " m"] | None) -> Targets:
        targets = self.ocp.targets(references)
        return replace(targets, applied=applied) if self.ocp.limits.rated else targets

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
        """Linearise at the guess and lay out the quadratic program."""
        super().prepare(references, guess, applied)
        self._prepared: tuple[Plan, Linearisation, Targets] | None = None
        targets, lim = self._targets(references, applied), self.ocp.limits
        plan = Plan(guess.x, np.clip(guess.u, lim.u_min, lim.u_max))
        at = self.ocp.linearise(plan.x, plan.u, targets.force)
        if all(np.isfinite(a).all() for a in (at.next, at.A, at.B)):
            self._prepared = plan, at, targets

    def feedback(self, x0: Float[np.ndarray, " n"]) -> Solution:
        """One step of the quadratic program that was prepared; where that is not to be had, a whole solve."""
        if self._prepared is not None and np.isfinite(x0).all():
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
        qp = self._stage_qp(plan, at, targets, dx0)
        step = self.qp.solve(_with_rates(qp, plan.u, self.ocp.limits) if self.ocp.limits.rated else qp)
        return replace(step, dx=step.dx[:, : self.ocp.n])

    def _stage_qp(
        self, plan: Plan, at: Linearisation, targets: Targets, dx0: Float[np.ndarray, " n"]
    ) -> StageQp:
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


class Ipopt(PlainSolver):
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
        constraints = [following - X, bounded - S, bounded + S, U[:, 1:] - U[:, :-1]]
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
        rate = np.tile(lim.u_step, N - 1)
        self._bounds = {
            "lbx": np.concatenate([-free, np.tile(lim.u_min, N), np.zeros(s * N)]),
            "ubx": np.concatenate([free, np.tile(lim.u_max, N), none]),
            "lbg": np.concatenate([gap, -none, np.tile(lim.x_min, N), -rate]),
            "ubg": np.concatenate([gap, np.tile(lim.x_max, N), none, rate]),
        }

    def _solve(self, plan: Plan, targets: Targets, cold: bool) -> Solution:
        violations = self.ocp.violations(plan.x)
        start = np.concatenate([plan.x[1:].ravel(), plan.u.ravel(), violations.ravel()])
        p = np.concatenate(
            [plan.x[0], targets.x.ravel(), targets.u.ravel(), targets.P.ravel(), targets.force]
        )
        first = slice(self._split[0], self._split[0] + self.ocp.m)
        self._bounds["lbx"][first], self._bounds["ubx"][first] = self.ocp.first_bounds(targets.applied)
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


def make_solver(
    ocp: Ocp,
    kind: Literal["rti", "sqp", "ipopt"],
    iterations: int,
    tolerance: float,
    backend: Literal["auto", "compiled", "casadi"] = "auto",
) -> Solver:
    """The solver of that name.

    Args:
        ocp: the problem.
        kind: as in the scenario.
        iterations: most iterations in a solve.
        tolerance: KKT tolerance.
        backend: what computes `rti` and `sqp`, as in the scenario.

    Raises:
        SolverError: this CasADi has no such solver, or the compiled one was asked for and cannot be made.
    """
    if kind == "ipopt":
        if backend == "compiled":
            raise SolverError(
                "solver: `ipopt` is never compiled; take `rti` or `sqp`, or leave out `backend`"
            )
        return Ipopt(ocp, iterations, tolerance)
    plain = GaussNewton(ocp, iterations, tolerance, real_time=kind == "rti")
    if backend == "casadi":
        return plain
    from exlinn_fmi.control.realtime import CompiledGaussNewton

    try:
        return CompiledGaussNewton(plain)
    except ExlinnError as error:
        if backend == "compiled":
            raise SolverError(f"backend: the compiled solver cannot be made: {error}") from error
        plain.reason = str(error)
        return plain

"""The optimal control problem by IPOPT, with exact second derivatives."""

from __future__ import annotations

import casadi as ca
import numpy as np

from exlinn_fmi.control.ocp import Ocp, Targets
from exlinn_fmi.control.solver import PlainSolver, Plan, Solution, SolveStatus, Stats, failed
from exlinn_fmi.errors import SolverError


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

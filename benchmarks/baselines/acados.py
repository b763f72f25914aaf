"""The same optimal control problem in acados with HPIPM: for machines that have it.

It is used where ACADOS_SOURCE_DIR says that acados is installed, with its Python package `acados_template`.
It runs in a process of its own: its HPIPM and the one that comes with CasADi have the same file names, and
whichever is found first would serve both.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from baselines.cart import problem
from exlinn_fmi.control.ocp import Ocp, Targets
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.solver import Plan

READY = (0, 5)
"""What a real-time iteration may say of itself: solved, and ready for its feedback phase."""


class Acados:
    """An acados solver of a problem: discrete dynamics, linear least squares, Gauss–Newton, softened bounds.

    Args:
        ocp: the problem.
        method: real-time iteration, or iterated to convergence with the tolerances 1e-9.
        tuned: set as it is fastest on this problem (partially condensed to 5 blocks, HPIPM's mode
            `SPEED_ABS`, generated code compiled for this processor), else by default.
    """

    def __init__(self, ocp: Ocp, method: Literal["SQP_RTI", "SQP"], tuned: bool = True) -> None:
        import acados_template

        self._ocp, self._tuned = ocp, tuned
        with tempfile.TemporaryDirectory(prefix="exlinn-acados-") as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it has not been tried with this CasADi
            made = self._problem(acados_template, method)
            made.code_gen_options.code_export_directory = str(Path(folder) / "code")
            self._solver: Any = acados_template.AcadosOcpSolver(made, verbose=False)

    def _problem(self, library: Any, method: str) -> Any:
        import casadi as ca

        ocp, lim = self._ocp, self._ocp.limits
        n, m, s = ocp.n, ocp.m, len(lim.soft)
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
        made = library.AcadosOcp()
        made.model.name, made.model.x, made.model.u = f"plant_{method.lower()}_{self._tuned:d}", x, u
        made.model.disc_dyn_expr = ocp.discrete(x, u, ocp.parameters(np.zeros(ocp.system.n)), ocp.step)
        made.cost.cost_type = made.cost.cost_type_e = "LINEAR_LS"
        # Its cost is ½ ‖y − y*‖²_W, and what is softened costs z s + ½ Z s²: the latter is ours.
        made.cost.W, made.cost.W_e = 2.0 * scipy.linalg.block_diag(ocp.Q, ocp.R), 2.0 * ocp.Q
        made.cost.Vx, made.cost.Vu = np.eye(n + m, n), np.eye(n + m, m, -n)
        made.cost.Vx_e, made.cost.yref, made.cost.yref_e = np.eye(n), np.zeros(n + m), np.zeros(n)
        box = made.constraints
        box.x0 = np.zeros(n)
        box.idxbu, box.lbu, box.ubu = np.arange(m), lim.u_min, lim.u_max
        for end in ("", "_e"):
            setattr(box, f"idxbx{end}", lim.soft)
            setattr(box, f"lbx{end}", lim.x_min)
            setattr(box, f"ubx{end}", lim.x_max)
            setattr(box, f"idxsbx{end}", np.arange(s))
            for side in ("l", "u"):
                setattr(made.cost, f"z{side}{end}", ocp.l1)
                setattr(made.cost, f"Z{side}{end}", ocp.l2)
        options = made.solver_options
        options.N_horizon, options.tf = ocp.horizon, ocp.horizon * ocp.step
        options.cost_scaling = np.ones(ocp.horizon + 1)  # a sum over the intervals, no integral
        options.integrator_type, options.hessian_approx = "DISCRETE", "GAUSS_NEWTON"
        options.nlp_solver_type, options.qp_solver = method, "PARTIAL_CONDENSING_HPIPM"
        if method == "SQP":
            options.tol, options.nlp_solver_max_iter, options.qp_solver_iter_max = 1e-9, 200, 200
            options.globalization = "MERIT_BACKTRACKING"
            options.qp_solver_t0_init = 0  # with its default HPIPM gives up on 7 % of the random problems
        elif self._tuned:
            options.hpipm_mode, options.qp_solver_cond_N = "SPEED_ABS", max(1, ocp.horizon // 6)
            made.code_gen_options.ext_fun_compile_flags = "-O3 -march=native -fno-math-errno"
        return made

    def _aim(self, aim: References) -> None:
        """Put references and terminal weight."""
        solver, targets, N = self._solver, self._ocp.targets(aim), self._ocp.horizon
        for k in range(N):
            solver.set(k, "yref", np.concatenate([targets.x[k], targets.u[k]]))
        solver.set(N, "yref", targets.x[N])
        solver.cost_set(N, "W", 2.0 * targets.P)

    def _start(self, plan: Plan) -> None:
        """Put a plan to start from."""
        for name, rows in (("x", plan.x), ("u", plan.u)):
            for k, row in enumerate(rows):
                self._solver.set(k, name, row)

    def _plan(self) -> Plan:
        solver, N = self._solver, self._ocp.horizon
        x, u = ([solver.get(k, name) for k in range(count)] for name, count in (("x", N + 1), ("u", N)))
        return Plan(np.array(x), np.array(u))

    def times(
        self, states: NDArray[np.float64], aims: list[References]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """CPU seconds of each tick but the first, and of its feedback phase; from the last plan, shifted."""
        solver, spent = self._solver, []
        plan = Plan(aims[0].x, aims[0].u)
        for x, aim in zip(states, aims, strict=True):
            self._aim(aim)
            self._start(plan)
            phases = []
            for phase in (1, 2):
                solver.options_set("rti_phase", phase)
                if phase == 2:
                    solver.set(0, "lbx", x)
                    solver.set(0, "ubx", x)
                began = time.thread_time_ns()
                status = solver.solve()
                phases.append((time.thread_time_ns() - began) * 1e-9)
                if status not in READY:
                    raise RuntimeError(f"acados: status {status}")
            spent.append((sum(phases), phases[1]))
            found = self._plan()
            plan = Plan(*self._ocp.shift(found.x, found.u, aim.force))
        step, feedback = np.array(spent[1:]).T
        return step, feedback

    def converged(self, x0: NDArray[np.float64], aim: References, targets: Targets) -> Plan | None:
        """The solution from the targets, under the bounds and weights that the problem has by now."""
        ocp, solver, lim = self._ocp, self._solver, self._ocp.limits
        for k in range(ocp.horizon):
            solver.cost_set(k, "W", 2.0 * scipy.linalg.block_diag(ocp.Q, ocp.R))
            solver.set(k, "lbu", lim.u_min)
            solver.set(k, "ubu", lim.u_max)
            solver.set(k + 1, "lbx", lim.x_min)
            solver.set(k + 1, "ubx", lim.x_max)
        self._aim(aim)
        solver.reset()
        self._start(Plan(targets.x, targets.u))
        solver.set(0, "lbx", x0)
        solver.set(0, "ubx", x0)
        return self._plan() if solver.solve() == 0 else None


@lru_cache
def _solver(method: Literal["SQP_RTI", "SQP"], tuned: bool) -> Acados:
    return Acados(problem.__wrapped__().ocp, method, tuned)


def _times(
    tuned: bool, states: NDArray[np.float64], aims: list[References]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return _solver("SQP_RTI", tuned).times(states, aims)


def _converged(
    drawn: dict[str, NDArray[np.float64]], x0: NDArray[np.float64], aim: References, targets: Targets
) -> Plan | None:
    made = _solver("SQP", True)
    ocp = made._ocp
    for name, value in drawn.items():
        getattr(ocp if name == "R" else ocp.limits, name)[:] = value
    return made.converged(x0, aim, targets)


class SeparateAcados:
    """acados on the cart's problem, in a process of its own.

    Raises:
        RuntimeError: its libraries are in this process's search path too.
    """

    def __init__(self) -> None:
        folder = str(Path(os.environ["ACADOS_SOURCE_DIR"]) / "lib")
        before = os.environ.get("LD_LIBRARY_PATH", "")
        if folder in before.split(":"):
            raise RuntimeError(
                "LD_LIBRARY_PATH: take acados out (ACADOS_SOURCE_DIR does), else CasADi uses its HPIPM"
            )
        self._pool = ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
        os.environ["LD_LIBRARY_PATH"] = folder
        self._pool.submit(os.getpid).result()  # by now it is started
        os.environ["LD_LIBRARY_PATH"] = before

    def times(
        self, tuned: bool, states: NDArray[np.float64], aims: list[References]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """As `Acados.times`, of the problem as it is."""
        return self._pool.submit(_times, tuned, states, aims).result()

    def converged(self, ocp: Ocp, x0: NDArray[np.float64], aim: References, targets: Targets) -> Plan | None:
        """As `Acados.converged`, under the bounds and weights of `ocp`."""
        drawn = {name: getattr(ocp.limits, name) for name in ("u_min", "u_max", "x_min", "x_max")} | {
            "R": ocp.R
        }
        return self._pool.submit(_converged, drawn, x0, aim, targets).result()

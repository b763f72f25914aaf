"""The same optimal control problem in acados with HPIPM, in real-time iteration: for machines that have it.

It is used where ACADOS_SOURCE_DIR says that acados is installed, with its Python package `acados_template`.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.reference import References


class Acados:
    """An acados solver of a problem: discrete dynamics, linear least squares, Gauss–Newton, softened bounds.

    The terminal weight is that of the first reference.

    Args:
        ocp: the problem.
    """

    def __init__(self, ocp: Ocp) -> None:
        self._ocp = ocp
        self._folder = tempfile.TemporaryDirectory(prefix="exlinn-acados-")

    def _solver(self, aim: References) -> object:
        import casadi as ca
        from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

        ocp, lim = self._ocp, self._ocp.limits
        n, m = ocp.n, ocp.m
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
        model = AcadosModel()
        model.name, model.x, model.u = "cart", x, u
        model.disc_dyn_expr = ocp.discrete(x, u, ocp.parameters(np.zeros(ocp.system.n)), ocp.step)
        made = AcadosOcp()
        made.model = model
        made.solver_options.N_horizon = ocp.horizon
        made.solver_options.tf = ocp.horizon * ocp.step
        made.cost.cost_type, made.cost.cost_type_e = "LINEAR_LS", "LINEAR_LS"
        # acados integrates the stage cost: over the interval it is to be what the problem sums.
        made.cost.W = 2.0 * scipy.linalg.block_diag(ocp.Q, ocp.R) / ocp.step
        made.cost.W_e = 2.0 * ocp.targets(aim).P
        made.cost.Vx, made.cost.Vu = np.eye(n + m, n), np.vstack([np.zeros((n, m)), np.eye(m)])
        made.cost.Vx_e = np.eye(n)
        made.cost.yref, made.cost.yref_e = np.zeros(n + m), np.zeros(n)
        made.constraints.x0 = aim.x[0]
        made.constraints.idxbu, made.constraints.lbu, made.constraints.ubu = (
            np.arange(m),
            lim.u_min,
            lim.u_max,
        )
        count = len(lim.soft)
        for end in ("", "_e"):
            setattr(made.constraints, f"idxbx{end}", np.array(lim.soft))
            setattr(made.constraints, f"lbx{end}", lim.x_min)
            setattr(made.constraints, f"ubx{end}", lim.x_max)
            setattr(made.constraints, f"idxsbx{end}", np.arange(count))
            for side in ("l", "u"):
                setattr(made.cost, f"z{side}{end}", ocp.l1)
                setattr(made.cost, f"Z{side}{end}", ocp.l2)
        made.solver_options.integrator_type = "DISCRETE"
        made.solver_options.nlp_solver_type = "SQP_RTI"
        made.solver_options.hessian_approx = "GAUSS_NEWTON"
        made.solver_options.qp_solver = "PARTIAL_CONDENSING_HPIPM"
        made.code_export_directory = str(Path(self._folder.name) / "code")
        return AcadosOcpSolver(made, json_file=str(Path(self._folder.name) / "cart.json"), verbose=False)

    def times(self, states: NDArray[np.float64], aims: list[References]) -> NDArray[np.float64]:
        """CPU seconds of each tick but the first, from the last plan shifted by one."""
        solver, N, spent = self._solver(aims[0]), self._ocp.horizon, []
        for k in range(N):
            solver.set(k, "x", aims[0].x[k])
            solver.set(k, "u", aims[0].u[k])
        solver.set(N, "x", aims[0].x[N])
        for x, aim in zip(states, aims, strict=True):
            for k in range(N):
                solver.set(k, "yref", np.concatenate([aim.x[k], aim.u[k]]))
            solver.set(N, "yref", aim.x[N])
            for k in range(N - 1):
                solver.set(k, "u", solver.get(k + 1, "u"))
                solver.set(k, "x", solver.get(k + 1, "x"))
            solver.set(0, "lbx", x)
            solver.set(0, "ubx", x)
            began = time.thread_time()
            status = solver.solve()
            spent.append(time.thread_time() - began)
            if status not in (0, 5):  # 5: ready, as after a real-time iteration
                raise RuntimeError(f"acados: status {status}")
        return np.array(spent[1:])

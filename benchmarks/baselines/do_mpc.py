"""The same optimal control problem in do-mpc (the real library), as its documentation has it written."""

from __future__ import annotations

import time
import warnings
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.reference import References


class DoMpc:
    """A do-mpc controller of a problem: discrete model, time-varying references, softened state bounds.

    The terminal weight is that of the first reference: do-mpc's is fixed.

    Args:
        ocp: the problem.
    """

    def __init__(self, ocp: Ocp) -> None:
        self._ocp = ocp

    def controller(self, aim: References) -> Any:
        """The library's controller, ready but for its first guess."""
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore"
            )  # of optional parts that are not installed, and CasADi's of its future
            import do_mpc

            return self._controller(aim, do_mpc)

    def _controller(self, aim: References, library: Any) -> Any:
        ocp = self._ocp
        n, m, lim = ocp.n, ocp.m, ocp.limits
        model = library.model.Model("discrete", "SX")
        x, u = model.set_variable("_x", "x", (n, 1)), model.set_variable("_u", "u", (m, 1))
        x_ref = model.set_variable("_tvp", "x_ref", (n, 1))
        u_ref = model.set_variable("_tvp", "u_ref", (m, 1))
        model.set_rhs("x", ocp.discrete(x, u, ocp.parameters(np.zeros(ocp.system.n)), ocp.step))
        model.setup()
        mpc = library.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step = ocp.horizon, ocp.step
        mpc.settings.store_full_solution = False
        mpc.settings.supress_ipopt_output()
        P, e, d = ocp.targets(aim).P, x - x_ref, u - u_ref
        mpc.set_objective(
            mterm=ca.dot(e, ca.DM(P) @ e), lterm=ca.dot(e, ca.DM(ocp.Q) @ e) + ca.dot(d, ca.DM(ocp.R) @ d)
        )
        mpc.set_rterm(u=0.0)
        mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = lim.u_min, lim.u_max
        for b, k in enumerate(lim.soft):
            for sign, bound in ((1.0, lim.x_max[b]), (-1.0, -lim.x_min[b])):
                mpc.set_nl_cons(
                    f"bound_{b}_{sign:g}",
                    sign * x[int(k)],
                    ub=bound,
                    soft_constraint=True,
                    penalty_term_cons=1e3,
                )
        template = mpc.get_tvp_template()

        self._aim = aim

        def references(_: float) -> object:
            for k in range(ocp.horizon + 1):
                template["_tvp", k, "x_ref"] = self._aim.x[k]
                template["_tvp", k, "u_ref"] = self._aim.u[min(k, ocp.horizon - 1)]
            return template

        mpc.set_tvp_fun(references)
        mpc.setup()
        return mpc

    def times(self, states: NDArray[np.float64], aims: list[References]) -> NDArray[np.float64]:
        """CPU seconds of each tick but the first, warm-started as the library does."""
        mpc = self.controller(aims[0])
        mpc.x0 = states[0]
        mpc.set_initial_guess()
        spent = []
        for x, aim in zip(states, aims, strict=True):
            self._aim = aim
            began = time.thread_time()
            mpc.make_step(x.reshape(-1, 1))
            spent.append(time.thread_time() - began)
            if not mpc.solver_stats["success"]:
                raise RuntimeError(f"do-mpc: {mpc.solver_stats['return_status']}")
        return np.array(spent[1:])

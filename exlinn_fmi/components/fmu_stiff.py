"""SciPy's solvers for Model Exchange: stiff models, and high order."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import BDF, DOP853, LSODA, OdeSolver, Radau

from exlinn_fmi.components import fmu_solver as compiled
from exlinn_fmi.components.base import Values
from exlinn_fmi.components.fmu_exchange import DormandPrince, Solver
from exlinn_fmi.components.fmu_native import Instance, Refused

METHODS: dict[str, Any] = {"dop853": DOP853, "lsoda": LSODA, "bdf": BDF, "radau": Radau}


class ScipySolver(Solver):
    """One of SciPy's methods, restarted at events and where inputs may have jumped.

    Args:
        model: the FMU.
        method: a key of `METHODS`.
        instance: the FMU, for its Jacobian where it gives directional derivatives.
    """

    def __init__(self, model: compiled.Model, method: str, instance: Instance) -> None:
        super().__init__(model)
        self._method, self._instance = METHODS[method], instance
        description = instance.description
        states, rates = description.states.references, description.states.rates
        exact = description.interface.directional_derivatives and len(states) == len(model.x) > 0
        self._jacobian = {"jac": self._exact_jacobian} if exact and method in ("bdf", "radau") else {}
        self._states, self._rates = (np.array(r, dtype=np.uint32) for r in (states, rates))

    def integrate(self, end: float) -> int:
        """See `Solver`."""
        if not self.model.x.size:  # SciPy takes no empty systems
            return DormandPrince(self.model).integrate(end)
        try:
            return self._integrate(end)
        except _FmuFailed as failed:
            return failed.code
        except ValueError:  # what SciPy's linear algebra makes of derivatives that are not finite
            return compiled.NO_PROGRESS

    def _integrate(self, end: float) -> int:
        m = self.model
        t = m.t
        rtol = max(m.clock[compiled.RTOL], 100 * np.finfo(float).eps)  # SciPy's own bound
        options: dict[str, Any] = {"rtol": rtol, "atol": m.w[compiled.ATOL], **self._jacobian}
        if 0 < m.clock[compiled.H] < end - t:
            options["first_step"] = float(m.clock[compiled.H])
        solver = self._method(self._rate, t, m.x.copy(), end, **options)
        for _ in range(int(compiled.MOST_STEPS)):
            before = float(solver.t)
            solver.step()
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                return compiled.NO_PROGRESS
            m.clock[compiled.STEPS] += 1
            now, x, event = float(solver.t), solver.y, False
            if m.z.size and self._switched(now, x):
                now = self._locate(solver, before, now)
                x, event = solver.dense_output()(now) if now < solver.t else x, True
            m.x[:], m.clock[compiled.T] = x, now
            code = int(compiled.arrive(*m.arrays))
            if code or event:
                return code or compiled.STATE_EVENT
            if solver.status == "finished":
                m.clock[compiled.H] = max(float(solver.step_size or 0.0), 1e-3 * (end - t))
                return compiled.REACHED
        return compiled.TOO_MANY_STEPS

    def _rate(self, t: float, x: Values) -> Values:
        """ẋ at t and x."""
        m = self.model
        m.w[compiled.STAGE] = x
        code = compiled.derivatives(m.calls, m.clock, m.w, m.u, t, compiled.STAGE, compiled.K1)
        if code and code % compiled.FAILED == 2:
            return np.full(len(x), np.nan)  # outside the model's domain: a step too long
        if code:
            raise _FmuFailed(code)
        rate: Values = m.w[compiled.K1].copy()
        return rate

    def _exact_jacobian(self, t: float, x: Values) -> Values:
        """∂ẋ/∂x by the FMU's directional derivatives."""
        self._rate(t, x)
        n = len(x)
        jacobian, column, seed = np.zeros((n, n)), np.zeros(n), np.ones(1)
        for k in range(n):
            try:
                self._instance.directional_derivative(self._rates, self._states[k : k + 1], seed, column)
            except Refused as refused:
                raise _FmuFailed(compiled.FAILED * compiled.GET_DERIVATIVES + refused.code) from refused
            jacobian[:, k] = column
        return jacobian

    def _switched(self, t: float, x: Values) -> bool:
        """Whether an indicator has another sign at t and x than when the step began."""
        m = self.model
        m.w[compiled.STAGE] = x
        code = compiled.indicators(*m.arrays, t, compiled.STAGE, compiled.THERE)
        if code:
            raise _FmuFailed(code)
        return bool(compiled.switched(m.z, compiled.THERE))

    def _locate(self, solver: OdeSolver, low: float, high: float) -> float:
        """The first time after which an indicator has switched, by bisection of the step."""
        dense = solver.dense_output()
        while high - low > 4e-16 * max(abs(high), abs(low)):
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            if self._switched(middle, dense(middle)):
                high = middle
            else:
                low = middle
        return high


class _FmuFailed(Exception):  # noqa: N818 - carries a code out of SciPy
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code

"""What solves the optimal control problem: one interface, three words in the scenario.

- `rti`: one Gauss–Newton step (real-time iteration: M. Diehl et al., J. Process Control 12, 2002). A start
  without a plan is iterated to convergence, since there is nothing yet to improve on.
- `sqp`: Gauss–Newton steps until the KKT residual is below the tolerance, made globally convergent by a line
  search on an ℓ₁ merit function (J. Nocedal, S. Wright, Numerical Optimization, 2nd ed., §18.3).
- `ipopt`: interior point with exact second derivatives.

A solve comes in one piece (`solve`) or in two: `prepare`, all that can be done before the measurement is
there, and `feedback` with it. What goes wrong is a `Solution` that says so. `rti` and `sqp` come twice, with
the same answers: compiled (realtime.py), and by CasADi (gauss_newton.py), for machines without a C compiler.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Ocp, Targets
from exlinn_fmi.control.reference import References
from exlinn_fmi.errors import ExlinnError, SolverError


class SolveStatus(IntEnum):
    """Outcome of a solve; LOST: there was none, for measurements have been missing for too long."""

    SOLVED = 0
    LIMIT = 1
    FAILED = 2
    LOST = 3


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
        """Do what can be done before the measurement is there: most of `rti`, nothing of what is iterated.

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
    # Each of them builds on what is above.
    from exlinn_fmi.control.gauss_newton import GaussNewton

    if kind == "ipopt":
        from exlinn_fmi.control.ipopt import Ipopt

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

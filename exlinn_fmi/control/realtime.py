"""`rti` and `sqp` by the compiled kernel: answers as those of `GaussNewton`, a hundred times faster."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from exlinn_fmi.control.compiled import Kernel
from exlinn_fmi.control.gauss_newton import GaussNewton
from exlinn_fmi.control.ocp import Targets
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.solver import Plan, Solution, Solver, SolveStatus, Stats

REASONS = (
    "",
    "the measured state, the reference or the guess is not finite",
    "the model's predictions are not finite",
    "the quadratic program was not solved",
    "the plan is not finite",
)
"""In words what the kernel says as a number."""

METHODS = ("", "active set", "interior point")
"""The same for what solved the quadratic program."""


class CompiledGaussNewton(Solver):
    """Sequential quadratic programming in compiled code.

    Args:
        plain: the same solver by CasADi, for quadratic programs that the kernel cannot solve.

    Attributes:
        kernel: the compiled code with its memory.

    Raises:
        InputError: there is no C compiler, or the problem is too large.
        RunError: the compiler failed.
    """

    backend = "compiled"

    def __init__(self, plain: GaussNewton) -> None:
        super().__init__(plain.ocp, plain.iterations, plain.tolerance)
        self._plain = plain
        self.kernel = Kernel(plain.ocp, plain.iterations, plain.tolerance, plain.real_time)

    def prepare(
        self, references: References, guess: Plan, applied: Float[np.ndarray, " m"] | None = None
    ) -> None:
        """Linearise at the guess, lay out the quadratic program of a real-time iteration and factor it."""
        super().prepare(references, guess, applied)
        if self._plain.real_time:
            self._put(references, guess, applied)
            self.kernel.prepare()

    def feedback(self, x0: Float[np.ndarray, " n"]) -> Solution:
        """One step of the quadratic program that was prepared; where that is not to be had, a whole solve."""
        if not self._plain.real_time:
            return super().feedback(x0)
        self.kernel.x0[:] = x0
        self.kernel.feedback()
        self.kernel.finish()
        found = self._found(self._waiting[0])
        return super().feedback(x0) if found.status == SolveStatus.FAILED else found

    def solve(
        self,
        x0: Float[np.ndarray, " n"],
        references: References,
        guess: Plan | None = None,
        applied: Float[np.ndarray, " m"] | None = None,
    ) -> Solution:
        """Solve from a measured state; as `Solver.solve`."""
        self._put(references, guess, applied)
        self.kernel.x0[:] = x0
        self.kernel.solve(guess is not None)
        found = self._found(references)
        if found.stats.message == REASONS[3]:
            return self._plain.solve(x0, references, guess, applied)
        return found

    def _put(
        self, references: References, guess: Plan | None, applied: Float[np.ndarray, " m"] | None
    ) -> None:
        kernel = self.kernel
        kernel.x_ref[:], kernel.u_ref[:] = references.x, references.u
        kernel.p[:] = self.ocp.parameters(references.force)
        kernel.u_last[:] = np.nan if applied is None else applied
        # From no set of an earlier program: the same problem has the same solution to the last bit.
        kernel.on[:], kernel.slew[:], kernel.state[:] = 0, 0, 0
        kernel.head.extend = 0
        if guess is not None:
            kernel.x[:], kernel.u[:] = guess.x, guess.u

    def _found(self, references: References) -> Solution:
        """What the kernel has found."""
        kernel, head = self.kernel, self.kernel.head
        status = SolveStatus(head.status)
        message = REASONS[head.reason]
        if status == SolveStatus.LIMIT:
            message = (
                f"KKT residual {head.kkt:.2g} after {head.iterations} iterations "
                f"(tolerance {self.tolerance:g})"
            )
        stats = Stats(head.iterations, head.kkt, head.cost, head.slack, METHODS[head.method], message)
        targets = Targets(
            kernel.x_to.copy(),
            kernel.u_to.copy(),
            kernel.P_end.copy(),
            bool(head.riccati),
            references.force,
            weight=self.ocp.set_weight if head.riccati and self.ocp.set_weight else 1.0,
            level=head.level,
        )
        return Solution(kernel.x.copy(), kernel.u.copy(), status, stats, targets)

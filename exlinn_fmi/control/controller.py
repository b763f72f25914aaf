"""The NMPC controller as a component: Algorithm 1 (measure, infer the model, solve, apply the first input).

It is sampled and feeds through directly: at each of its ticks the outputs answer the measurements set at that
very tick. The solve takes place when an output is first read, and again only if a measurement is changed
before the step; `step` keeps the result as what the next tick starts from.

Where a solve fails, or a measurement is not finite, the previous plan goes on, shifted, as long as it has
inputs left; then `safe_input` is applied. Both are counted and reported, and no output is ever NaN or out
of bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Component, Indices, Status, Values
from exlinn_fmi.control.diagnosis import diagnose
from exlinn_fmi.control.ocp import Ocp, check_names
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.control.solver import Plan, Solution, SolveStatus, make_solver
from exlinn_fmi.errors import InputError, ModelError, nearest
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.scenario.control import Nmpc
from exlinn_fmi.scenario.derived import nmpc_variables


@dataclass(frozen=True)
class _Memory:
    """What one tick hands to the next.

    Args:
        time: of the coming tick [s].
        branch: branch of the references' kinematics, None before the first measurement.
        plan: guess for the coming tick, None where there is none.
        left: how many inputs of the plan are left to fall back on.
        references: the last reference.
        fallbacks: how often a fallback was needed so far.
        cost: last cost.
        kkt: last KKT residual.
        slack: last violation of a state bound.
    """

    time: float = 0.0
    branch: tuple[int, ...] | None = None
    plan: Plan | None = None
    left: int = 0
    references: References | None = None
    fallbacks: int = 0
    cost: float = 0.0
    kkt: float = 0.0
    slack: float = 0.0


class NmpcController(Component):
    """Nonlinear model predictive controller around a Lagrangian system.

    Inputs are the model's states, as measured. Outputs are its inputs, and how they came about: quantity
    and states of the reference, cost, status (0 solved, 1 iteration limit, 2 failed: fallback applied),
    iterations, KKT residual, time taken [s], fallbacks so far, largest violation of a softened bound over
    its range.

    Args:
        name: name in the scenario.
        system: the prediction model.
        options: the controller's settings.
        step: sampling time [s].
        folder: folder of the scenario, which file names start from.

    Attributes:
        warnings: what can be said against these settings before anything runs.

    Raises:
        ModelError: the settings name what the model does not have.
        DataError: the reference's signal cannot be used.
        SolverError: the solver is not available.
    """

    def __init__(self, name: str, system: LagrangianSystem, options: Nmpc, step: float, folder: Path) -> None:
        self.name = name
        try:
            self._generator = ReferenceGenerator(system, options.reference, folder, step, options.horizon)
            self._ocp = Ocp(system, options, step, self._generator.states)
            check_names("safe_input", options.safe_input, system.input_names)
        except ModelError as error:
            raise ModelError(f"components.{name}.nmpc.{error}") from None
        self._solver = make_solver(self._ocp, options.solver, options.iterations, options.tolerance)
        self._step = step
        safe = np.array([options.safe_input.get(key, 0.0) for key in system.input_names])
        self._safe: NDArray[np.float64] = np.clip(safe, self._ocp.limits.u_min, self._ocp.limits.u_max)
        self.variables = nmpc_variables(system.coordinates, options)
        self._measured = np.zeros(self._ocp.n)
        self._outputs = np.zeros(len(self.variables) - self._ocp.n)
        self._memory = _Memory()
        self._following: _Memory | None = None
        rest = np.zeros(self._ocp.n)
        branch = self._generator.branch(rest)
        self.warnings = diagnose(self._ocp, self._generator, self._generator.over(0.0, rest, branch))

    @property
    def sampled(self) -> bool:
        """Outputs hold between ticks."""
        return True

    @property
    def can_save_state(self) -> bool:
        """State can be saved and restored."""
        return True

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, float]
    ) -> Status:
        """Begin afresh; `starts` may give measurements that nothing is connected to.

        Raises:
            InputError: a name in `starts` is no input.
            DataError: a table that is to be an error outside its rows does not cover the run.
        """
        names = [v.name for v in self.variables[: self._ocp.n]]
        for key in starts:
            if key not in names:
                raise InputError(
                    f"components.{self.name}.start.{key}: no such input; {nearest(key, names, 'inputs')}"
                )
        self._generator.check(start_time, stop_time if np.isfinite(stop_time) else start_time)
        self._measured = np.array([float(starts.get(key, 0.0)) for key in names])
        self._memory, self._following = _Memory(time=start_time), None
        self.message = ""
        return Status.OK

    def exit_initialization(self) -> Status:
        """End initialisation."""
        return Status.OK

    def set(self, indices: Indices, values: Values) -> Status:
        """Set measurements; a changed one makes the outputs be computed again."""
        if not np.array_equal(self._measured[indices], values):
            self._measured[indices] = values
            self._following = None
        return Status.OK

    def get(self, indices: Indices, values: Values) -> Status:
        """Read measurements and outputs, solving first where that is due; WARNING if that went wrong."""
        status = Status.OK
        n = self._ocp.n
        outputs = indices >= n
        if self._following is None and outputs.any():
            status = self._tick()
        values[~outputs] = self._measured[indices[~outputs]]
        values[outputs] = self._outputs[indices[outputs] - n]
        return status

    def step(self, t: float, h: float) -> Status:
        """Go on to the next tick."""
        if self._following is None:
            self._tick()
        assert self._following is not None
        self._memory, self._following = replace(self._following, time=t + h), None
        return Status.OK

    def save_state(self) -> object:
        """A copy of the whole state."""
        return self._memory, self._following, self._measured.copy(), self._outputs.copy(), self.message

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned."""
        assert isinstance(state, tuple)
        self._memory, self._following, measured, outputs, self.message = state
        self._measured, self._outputs = measured.copy(), outputs.copy()

    def close(self) -> None:
        """Nothing to free."""

    def _tick(self) -> Status:
        """One round of Algorithm 1 at the present tick."""
        begin, memory = perf_counter(), self._memory
        usable = bool(np.isfinite(self._measured).all())
        # Without a measurement the plan says where the system should be by now.
        expected = memory.plan.x[0] if memory.plan is not None else np.zeros(self._ocp.n)
        state = self._measured.copy() if usable else expected
        branch = self._generator.branch(state) if memory.branch is None else memory.branch
        references = self._generator.over(memory.time, state, branch, memory.references)
        solution = self._solver.solve(self._measured.copy(), references, memory.plan)
        message = solution.stats.message
        if not usable:
            wrong = [
                v.name for v, x in zip(self.variables, self._measured, strict=False) if not np.isfinite(x)
            ]
            message = f"measurement of {', '.join(wrong)} is not finite"
        if solution.status == SolveStatus.FAILED:
            u, following, action = self._fall_back(memory, references)
            message = f"{message}; {action}"
        else:
            u, following = solution.u[0], self._accept(memory, solution, references)
        # A branch is decided by a measurement, and by nothing else.
        decided = branch if usable else memory.branch
        self._following = replace(following, branch=decided, references=references if usable else None)
        self._write(u, references, solution, self._following, perf_counter() - begin)
        if solution.status == SolveStatus.SOLVED:
            return Status.OK
        self.message = f"t = {memory.time:.9g} s: {message}"
        return Status.WARNING

    def _accept(self, memory: _Memory, solution: Solution, references: References) -> _Memory:
        """What follows a solution."""
        plan = Plan(*self._ocp.shift(solution.x, solution.u, references.force))
        stats = solution.stats
        return replace(
            memory, plan=plan, left=self._ocp.horizon - 1, cost=stats.cost, kkt=stats.kkt, slack=stats.slack
        )

    def _fall_back(self, memory: _Memory, references: References) -> tuple[NDArray[np.float64], _Memory, str]:
        """Input of the shifted plan, or the safe one, what follows it, and what was done."""
        count = memory.fallbacks + 1
        if memory.plan is None or memory.left == 0:
            return self._safe, replace(memory, plan=None, left=0, fallbacks=count), "applied the safe input"
        shifted = Plan(*self._ocp.shift(memory.plan.x, memory.plan.u, references.force))
        following = replace(memory, plan=shifted, left=memory.left - 1, fallbacks=count)
        return memory.plan.u[0], following, f"went on with the last plan, {memory.left} inputs left"

    def _write(
        self,
        u: NDArray[np.float64],
        references: References,
        solution: Solution,
        following: _Memory,
        seconds: float,
    ) -> None:
        """Fill the outputs, in the order of the variables."""
        bounded = np.clip(u, self._ocp.limits.u_min, self._ocp.limits.u_max)
        counts = [float(solution.status), float(solution.stats.iterations)]
        self._outputs = np.concatenate(
            [
                bounded,
                references.quantity,
                references.x[0],
                [following.cost],
                counts,
                [following.kkt, seconds, float(following.fallbacks), following.slack],
            ]
        )

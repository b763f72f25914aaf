"""The NMPC controller as a component: Algorithm 1 (measure, infer the model, solve, apply the first input).

It is sampled and feeds through directly: at each of its ticks the outputs answer the measurements set at that
very tick, unless `delay: computation` has them answer those of the tick before. The solve takes place when an
output is first read, and again only if a measurement is changed before the step. `step` keeps the result as
what the next tick starts from and prepares that: its reference and all of the solve that needs no
measurement, at the state and under the forces that are expected. Only `feedback_time` is between measurement
and input then.

A measurement that is missing is replaced by what the estimator expects, until `dropout.timeout`. Where a
solve fails the previous plan goes on, shifted, as long as it has inputs left; then, or where measurements are
missing for longer, `safe_input` is applied. All this is counted and reported, and no output is ever NaN or
out of bounds.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values
from exlinn_fmi.components.packing import pack, unpack
from exlinn_fmi.control.defaults import completed, estimator, measure, refined
from exlinn_fmi.control.diagnosis import diagnose
from exlinn_fmi.control.dropout import Heard, Listener
from exlinn_fmi.control.estimator import Belief, Estimator, Window
from exlinn_fmi.control.memory import Memory
from exlinn_fmi.control.ocp import HORIZON, Ocp, check_names
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.control.solver import Plan, Solution, Solver, SolveStatus, Stats, make_solver
from exlinn_fmi.errors import InputError, ModelError, nearest
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.scenario.control import Nmpc
from exlinn_fmi.scenario.derived import nmpc_variables


@dataclass(frozen=True)
class Parts:
    """What a controller is made of, for who builds the same elsewhere.

    Args:
        ocp: the optimal control problem.
        estimator: of state and disturbances.
        listener: to measurements that may be missing.
        generator: of references.
        solver: of the problem.
        step: sampling time [s].
        safe: input where there is nothing better, shape (m,).
        late: whether an input acts one sample later than what was measured for it.
        slow: whether that is because the solve takes a sample.
    """

    ocp: Ocp
    estimator: Estimator
    listener: Listener
    generator: ReferenceGenerator
    solver: Solver
    step: float
    safe: NDArray[np.float64]
    late: bool
    slow: bool


class NmpcController(Component):
    """Nonlinear model predictive controller around a Lagrangian system.

    Inputs are the model's states, as measured. Outputs are its inputs, and how they came about: quantities
    and states of the reference, estimated state and disturbances, cost with its first term and what it may
    have grown by a disturbance, status (0 solved, 1 iteration limit, 2 failed: fallback applied, 3 not solved
    for measurements have been missing for too long: safe input applied), missing measurements, iterations,
    KKT residual, time taken in all and between measurement and input [s], fallbacks so far, largest violation
    of a softened bound over its range; with a terminal set, cost of the plan's end and the set's level.

    Args:
        name: name in the scenario.
        system: the prediction model.
        options: the controller's settings.
        step: sampling time [s].
        folder: folder of the scenario, which file names start from.
        connected: states that something is connected to; all if not given.

    Attributes:
        warnings: what can be said against these settings before anything runs.

    Raises:
        ModelError: the settings name what the model does not have.
        DataError: the reference's signal cannot be used.
        SolverError: the solver is not available.
    """

    def __init__(
        self,
        name: str,
        system: LagrangianSystem,
        options: Nmpc,
        step: float,
        folder: Path,
        connected: Collection[str] | None = None,
    ) -> None:
        self.name = name
        try:
            sight = options.horizon or HORIZON
            generator = ReferenceGenerator(system, options.reference, folder, step, sight)
            check_names("safe_input", options.safe_input, system.input_names, "inputs")
            sizes, first = measure(options, system, generator, step, sight)
            options = refined(options, system, first, step)
            options = completed(options, system, sizes, first, step)
            self._ocp = Ocp(system, options, step, generator.states)
            self._estimator = estimator(options, system, sizes, first, step, connected)
        except ModelError as error:
            raise ModelError(f"components.{name}.nmpc.{error}") from None
        if self._ocp.horizon != sight:
            generator = ReferenceGenerator(system, options.reference, folder, step, self._ocp.horizon)
        self._generator, self._listener = generator, Listener(self._estimator, options.dropout, step)
        self._late, self._slow = options.delay != "none", options.delay == "computation"
        self._solver = make_solver(
            self._ocp, options.solver, options.iterations, options.tolerance, options.backend
        )
        self._step = step
        safe = np.array([options.safe_input.get(key, 0.0) for key in system.input_names])
        self._safe: NDArray[np.float64] = np.clip(safe, self._ocp.limits.u_min, self._ocp.limits.u_max)
        self.variables = nmpc_variables(system.coordinates, options)
        self._measured, self._starts = np.zeros(self._ocp.n), np.zeros(self._ocp.n)
        self._outputs = np.zeros(len(self.variables) - self._ocp.n)
        self._memory = Memory()
        self._following: Memory | None = None
        self._ready: Memory | None = None
        """What the solver is prepared for: no part of the state, for it can be had again."""
        self._preparation = 0.0
        self.warnings = diagnose(self._ocp, self._generator, first, self._estimator)
        self.facts = {"solver_backend": self._solver.backend}
        if self._solver.reason:
            self.warnings += (f"the solver is not compiled, and far slower: {self._solver.reason}",)

    @property
    def parts(self) -> Parts:
        """What it is made of."""
        return Parts(
            self._ocp,
            self._estimator,
            self._listener,
            self._generator,
            self._solver,
            self._step,
            self._safe,
            self._late,
            self._slow,
        )

    @property
    def sampled(self) -> bool:
        """Outputs hold between ticks."""
        return True

    @property
    def can_save_state(self) -> bool:
        """State can be saved and restored."""
        return True

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """Begin afresh; `starts` may give states that nothing is connected to, or that are not measured.

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
        self._starts = self._measured.copy()
        self._memory, self._following, self._ready = Memory(time=start_time), None, None
        self._preparation = 0.0
        self.message = ""
        return Status.OK

    def exit_initialization(self) -> Status:
        """End initialisation."""
        return Status.OK

    def set(self, indices: Indices, values: Values) -> Status:
        """Set measurements; a changed one makes the outputs be computed again."""
        if not np.array_equal(self._measured[indices], values, equal_nan=True):
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
        self._memory, self._following = self._prepare(replace(self._following, time=t + h)), None
        return Status.OK

    def save_state(self) -> object:
        """A copy of the whole state."""
        return self._memory, self._following, self._measured.copy(), self._outputs.copy(), self.message

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned."""
        assert isinstance(state, tuple)
        self._memory, self._following, measured, outputs, self.message = state
        self._measured, self._outputs = measured.copy(), outputs.copy()

    @property
    def can_serialize_state(self) -> bool:
        """Always."""
        return True

    def serialize_state(self, state: object) -> bytes:
        """A state as bytes."""
        return pack(state)

    def deserialize_state(self, data: bytes) -> object:
        """A state from bytes."""
        return unpack(data, (Memory, Plan, References, Belief, Window, Heard))

    def close(self) -> None:
        """Nothing to free."""

    def _prepare(self, memory: Memory) -> Memory:
        """Do what needs no measurements of the coming tick; what is to be remembered of it."""
        begin, belief, plan = perf_counter(), memory.belief, memory.plan
        coming = replace(memory, coming=None)
        if (
            belief is not None
            and plan is not None
            and memory.branch is not None
            and memory.applied is not None
        ):
            ahead = self._estimator.predict(belief, memory.applied) if self._late else belief
            state, force = self._estimator.state(ahead), self._estimator.force(ahead.mean)
            references = self._references(memory, state, memory.branch, force)
            guess = Plan(np.vstack([state, plan.x[1:]]), plan.u)
            coming = replace(memory, plan=guess, coming=references)
            self._make_ready(coming)
        self._preparation = perf_counter() - begin
        return coming

    def _make_ready(self, memory: Memory) -> None:
        """Prepare the solver, unless it is."""
        if self._ready is not memory:
            assert memory.coming is not None
            assert memory.plan is not None
            self._solver.prepare(memory.coming, memory.plan, memory.applied)
            self._ready = memory

    def _solve(self, memory: Memory, state: NDArray[np.float64], references: References) -> Solution:
        """The solution from a state, by what is prepared where anything is."""
        if memory.coming is None:
            return self._solver.solve(state, references, memory.plan, memory.applied)
        self._make_ready(memory)
        self._ready = None  # it is used up
        return self._solver.feedback(state)

    def _references(
        self, memory: Memory, state: NDArray[np.float64], branch: tuple[int, ...], force: NDArray[np.float64]
    ) -> References:
        """The reference of the coming tick's solve."""
        time = memory.time + (self._step if self._slow else 0.0)
        return self._generator.over(time, state, branch, memory.references, force)

    def _tick(self) -> Status:
        """One round of Algorithm 1 at the present tick."""
        begin, memory = perf_counter(), self._memory
        y, heard = self._listener.hear(memory.heard, memory.belief, self._measured)
        now, missing, lost = self._believe(memory, y), self._missing(y), self._listener.lost(heard)
        ahead = now
        if now is not None and self._late and memory.applied is not None:
            ahead = self._estimator.predict(now, memory.applied)
        state = np.zeros(self._ocp.n) if ahead is None else self._estimator.state(ahead)
        force = self._generator.still if ahead is None else self._estimator.force(ahead.mean)
        branch = self._generator.branch(state) if memory.branch is None else memory.branch
        references = memory.coming or self._references(memory, state, branch, force)
        if lost.any():
            memory, solution = replace(memory, plan=None), self._nothing(lost, references)
        else:
            unknown = np.full(self._ocp.n, np.nan)
            solution = self._solve(memory, unknown if ahead is None else state, references)
        feedback = perf_counter() - begin
        message = "; ".join(text for text in (missing, solution.stats.message) if text)
        if solution.status >= SolveStatus.FAILED:
            u, following, action = self._fall_back(memory, references)
            message = f"{message}; {action}"
        else:
            u, following = solution.u[0], self._accept(memory, solution, references)
        u = np.clip(u, self._ocp.limits.u_min, self._ocp.limits.u_max)
        # What is measured at the next tick belongs to that tick, or to this one where it arrives late.
        belief = ahead if ahead is None or self._late else self._estimator.predict(ahead, u)
        # A branch is decided by a state that is known, and by nothing else.
        decided = memory.branch if ahead is None else branch
        reported = references
        if self._slow:
            reported = memory.references or self._generator.over(memory.time, state, branch, None, force)
        self._following = replace(
            following,
            branch=decided,
            references=references if ahead is not None else None,
            belief=belief,
            applied=u,
            heard=heard,
        )
        applied = u if not self._slow else self._safe if memory.applied is None else memory.applied
        at_tick = ahead if not self._slow else now
        change = 0.0 if ahead is None else self._change(memory, state - references.x[0])
        times = self._preparation + perf_counter() - begin, feedback
        self._write(applied, reported, at_tick, solution, change, times)
        if solution.status == SolveStatus.SOLVED and not missing:
            return Status.OK
        self.message = f"t = {memory.time:.9g} s: {message}"
        return Status.WARNING

    def _believe(self, memory: Memory, y: NDArray[np.float64]) -> Belief | None:
        """What the measurements tell of the state at their time; None before all have come once."""
        belief = None if memory.belief is None else self._estimator.update(memory.belief, y)
        if belief is not None and belief.finite:
            return belief
        # At first, or where the model led the estimate astray.
        if self._missing(y):
            return None
        return self._estimator.begin(y, self._starts)

    def _missing(self, y: NDArray[np.float64]) -> str:
        """Which measurements are missing, in words."""
        wrong = self._estimator.noise.measured & ~np.isfinite(y)
        words = {False: "not finite", True: "stale"}
        return "; ".join(
            f"measurement of {self.variables[k].name} is {words[bool(np.isfinite(self._measured[k]))]}"
            for k in np.flatnonzero(wrong)
        )

    def _nothing(self, lost: NDArray[np.bool_], references: References) -> Solution:
        """No solution, for these measurements have been missing for too long."""
        names = ", ".join(self.variables[k].name for k in np.flatnonzero(lost))
        text = f"no measurement of {names} for longer than dropout.timeout ({self._listener.timeout:g} s)"
        return Solution(references.x, references.u, SolveStatus.LOST, Stats(message=text))

    def _change(self, memory: Memory, error: NDArray[np.float64]) -> float:
        """Most that the cost may grow by the error's being off its prediction, by w.

        With a cost eᵀPe: (e + w)ᵀP(e + w) − eᵀPe ≤ 2 √(eᵀPe wᵀPw) + wᵀPw.
        """
        if memory.error is None or memory.P is None:
            return 0.0
        w = error - memory.error
        off = max(0.0, float(w @ memory.P @ w))
        return 2.0 * float(np.sqrt(max(0.0, memory.cost - memory.stage) * off)) + off

    def _accept(self, memory: Memory, solution: Solution, references: References) -> Memory:
        """What follows a solution."""
        plan = Plan(*self._ocp.shift(solution.x, solution.u, references.force))
        stats, targets = solution.stats, solution.targets
        stage, end, level, P = 0.0, 0.0, 0.0, None
        if targets is not None:
            stage = self._ocp.weigh(
                np.vstack([solution.x[0] - targets.x[0], np.zeros(self._ocp.n)]),
                solution.u[:1] - targets.u[:1],
                targets.P,
            )
            P, level = targets.P / targets.weight, targets.level
            off = solution.x[-1] - targets.x[-1]
            end = float(off @ P @ off)
        return replace(
            memory,
            plan=plan,
            left=self._ocp.horizon - 1,
            cost=stats.cost,
            stage=stage,
            P=P,
            error=plan.x[0] - references.x[1],
            kkt=stats.kkt,
            slack=stats.slack,
            end=end,
            level=level,
        )

    def _fall_back(self, memory: Memory, references: References) -> tuple[NDArray[np.float64], Memory, str]:
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
        belief: Belief | None,
        solution: Solution,
        change: float,
        times: tuple[float, float],
    ) -> None:
        """Fill the outputs, in the order of the variables."""
        following, estimator = self._following, self._estimator
        assert following is not None
        assert following.heard is not None
        missing = np.count_nonzero(following.heard.silent)
        self._outputs = np.concatenate(
            [
                u,
                references.quantity,
                references.x[0],
                np.zeros(self._ocp.n) if belief is None else estimator.state(belief),
                self._generator.still if belief is None else estimator.force(belief.mean),
                [following.cost, following.stage, change],
                [float(solution.status), float(missing), float(solution.stats.iterations)],
                [following.kkt, *times, float(following.fallbacks), following.slack],
                [following.end, following.level][: 2 * bool(self._ocp.set_weight)],
            ]
        )

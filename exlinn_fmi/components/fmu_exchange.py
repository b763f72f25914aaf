"""Model Exchange: the FMU gives derivatives and event indicators, the integration is ours.

Between events a solver carries the states: Dormand and Prince's method, compiled (`fmu_solver`), or one of
SciPy's (`fmu_stiff`). At an event (an indicator changes its sign, a time that the FMU announced is reached,
or it asks for one after a step) the FMU goes through Event Mode, and integration starts afresh from there.

References: FMI 2.0 §3.2, FMI 3.0 §3.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from ctypes import c_size_t, c_void_p
from typing import Any

import numpy as np

from exlinn_fmi.components import fmu_solver as compiled
from exlinn_fmi.components.base import Values
from exlinn_fmi.components.fmu_events import EventMode, Stopped, close
from exlinn_fmi.components.fmu_native import ERROR, Instance, Refused
from exlinn_fmi.components.fmu_steppers import Stepper

SOLVERS = ("auto", "dopri5", "dop853", "lsoda", "bdf", "radau")
TOLERANCE = 1e-6
"""Relative tolerance where neither the scenario nor the FMU states one."""

MOST_EVENTS = 1000
"""Events in one instant before the model is taken to chatter."""


class Solver(ABC):
    """Integrates a model between events.

    Args:
        model: the FMU; its time and states are moved on.
    """

    def __init__(self, model: compiled.Model) -> None:
        self.model = model

    @abstractmethod
    def integrate(self, end: float) -> int:
        """Integrate to `end` [s] or the first event before; one of the codes of `fmu_solver`."""


class DormandPrince(Solver):
    """The compiled method, of order 5 with adaptive steps, for models that are not stiff."""

    def integrate(self, end: float) -> int:
        """See `Solver`."""
        code, _ = compiled.integrate(*self.model.arrays, end, NO_GRID, NO_TABLE, 0)
        return int(code)


NO_GRID, NO_TABLE = np.zeros(0), np.zeros((0, 0))


class ModelExchange(Stepper):
    """Carries a Model Exchange FMU over communication steps.

    Args:
        instance: the FMU, in Initialization Mode or before.
        solver: one of `SOLVERS`; ``auto`` begins with ``dopri5`` and goes on with ``radau`` where the model
            proves stiff.
        tolerance: relative tolerance; absolute ones are this times the states' nominal values.
    """

    has_events = True

    def __init__(self, instance: Instance, solver: str, tolerance: float) -> None:
        self._instance, self._choice, self._tolerance = instance, solver, tolerance
        self._events = EventMode(instance, "EnterContinuousTimeMode")
        self._stale = False

    # ── stepping ─────────────────────────────────────────────────────────────────────────────────────────

    def begin(self, t: float) -> None:
        """The first event, and all that integration needs."""
        self._events.begin(t)
        n, m = self._instance.state_counts()
        calls = np.array(self._instance.model_calls(), dtype=np.int64)
        if not self._instance.description.interface.completed_step:
            calls[compiled.COMPLETED] = 0
        self.model = compiled.Model.make(calls, n, m, self._tolerance)
        self.model.clock[compiled.T] = t
        self._solver = self._make(self._choice)
        self._load(nominals=True)

    def _make(self, name: str) -> Solver:
        if name in ("auto", "dopri5"):
            return DormandPrince(self.model)
        from exlinn_fmi.components.fmu_stiff import ScipySolver

        return ScipySolver(self.model, name, self._instance)

    def step(self, t: float, h: float) -> int:
        """Integrate from event to event; inputs are held, or follow the derivatives given."""
        self.settle()
        end, here, events = t + h, t, 0
        self.model.clock[compiled.T] = t
        self.model.calls[compiled.KEEP] = self._instance.roll_back
        while True:
            target = min(end, self._events.next_event)
            target = end if close(target, end) else target
            code = self._solver.integrate(target) if target > self.model.t else compiled.REACHED
            if code == compiled.STIFF:
                self._meet_stiffness()
                continue
            self._check(code)
            due = self._events.next_event <= self.model.t or close(self._events.next_event, self.model.t)
            if code == compiled.REACHED and not due:
                break
            events = events + 1 if close(here, self.model.t) else 0
            here = self.model.t
            if events > MOST_EVENTS:
                raise Stopped(
                    f"more than {MOST_EVENTS} events at t = {here:.9g} s: the model chatters", ERROR
                )
            self._event()
            if self.model.t >= end:
                break
        self._drop_derivatives()
        return 0

    def follow(self, references: Any, knots: Values, values: Values, outputs: Any, grid: Values) -> Values:
        """Integrate from the start along inputs that are straight between knots, all in compiled code.

        Args:
            references: (k,) value references of the inputs.
            knots: [s] (q,) ascending, from the present time on; the last is where to.
            values: [input units] (q, k) inputs at the knots.
            outputs: (p,) value references of continuous outputs.
            grid: [s] (r,) ascending times after the present one, none beyond the last knot.

        Returns:
            (r, p) outputs at the times of the grid, interpolated as precisely as the solver integrates.

        Raises:
            Refused: the FMU reports an error.
            Stopped: it asks to end, or it cannot be integrated.
        """
        states = list(self._instance.description.states.references)
        plain = len(states) == len(self.model.x) and set(outputs.tolist()) <= set(states)
        at, columns = (
            np.zeros(2, dtype=np.int64),
            [states.index(r) for r in outputs] if plain else slice(None),
        )
        table = np.zeros((len(grid), len(states) if plain else len(outputs)))
        self.model.vary(references, values[0], np.zeros(len(references)))
        self.model.sample(None if plain else outputs)  # to ask the FMU for its states would take longer
        while True:
            until = self._events.next_event
            code = compiled.follow(*self.model.arrays, until, knots, values, grid, table, at)
            if code == compiled.STIFF:
                self.model.clock[compiled.STIFFNESS] = -np.inf
                continue
            self._check(code)
            due = until <= self.model.t or close(until, self.model.t)
            if code != compiled.REACHED or due:
                self._event()
            elif at[0] == len(knots) - 1:
                return table[:, columns]

    def _meet_stiffness(self) -> None:
        """Go on with another solver, or not mind."""
        self.model.clock[compiled.STIFFNESS] = -np.inf
        if self._choice == "auto":
            self.remark = (
                f"stiff from t = {self.model.t:.9g} s on: solved by radau; say `solver: radau` or `bdf`"
            )
            self._solver = self._make("radau")

    def _event(self) -> None:
        """Go through Event Mode at the time reached."""
        changes = self._events.handle(self.model.t)
        self._load(changes.nominals)

    def _load(self, nominals: bool) -> None:
        """States, nominal values and indicators as Event Mode left them; the solver begins afresh."""
        m = self.model
        if m.x.size:
            self._instance.demand("GetContinuousStates", *_span(m.x))
            if nominals:
                scale = np.ones_like(m.x)
                self._instance.demand("GetNominalsOfContinuousStates", *_span(scale))
                m.w[compiled.ATOL] = self._tolerance * np.where(scale > 0, scale, 1.0)
        if m.z.size:
            self._instance.demand("GetEventIndicators", *_span(m.z[compiled.HERE]))
        m.clock[compiled.H] = 0.0

    # ── inputs and outputs ───────────────────────────────────────────────────────────────────────────────

    def enter_event_mode(self) -> None:
        """fmi…EnterEventMode."""
        self._events.enter()

    def inputs_changed(self) -> None:
        """Continuous inputs may have switched something."""
        self._stale = True

    def settle(self) -> None:
        """Handle the event that new values of discrete variables are, or that new inputs have caused."""
        if self._events.inside:
            self._event()
        elif self._stale and self.model.z.size:
            z = self.model.z
            self._instance.demand("GetEventIndicators", *_span(z[compiled.THERE]))
            if compiled.switched(z, compiled.THERE):
                self._event()
            else:
                z[compiled.HERE] = z[compiled.THERE]
        self._stale = False

    def set_derivatives(self, references: Any, values: Values, rates: Values) -> None:
        """Let inputs change over the next step.

        Args:
            references: (k,) value references.
            values: [input units] (k,) values at the present time.
            rates: [input units / s] (k,) their derivatives.
        """
        self.model.vary(references, values, rates)

    def _drop_derivatives(self) -> None:
        if self.model.u.size:
            self.model.vary(np.zeros(0, dtype=np.uint32), np.zeros(0), np.zeros(0))

    # ── state ────────────────────────────────────────────────────────────────────────────────────────────

    def snapshot(self) -> Values:
        """Time, solver and events; the states are in the FMU as well."""
        m = self.model
        return np.concatenate([m.clock, m.w.ravel(), m.z.ravel(), self._events.snapshot()])

    def restore(self, saved: Values) -> None:
        """Back to a snapshot."""
        m, at = self.model, 0
        for part in (m.clock, m.w, m.z):
            part[...] = saved[at : at + part.size].reshape(part.shape)
            at += part.size
        self._events.restore(saved[at:])
        stiff = self._choice == "auto" and np.isinf(m.clock[compiled.STIFFNESS])
        self._solver = self._make("radau" if stiff else self._choice)

    # ── failure ──────────────────────────────────────────────────────────────────────────────────────────

    def _check(self, code: int) -> None:
        """Stop on what is no reason to go on.

        Raises:
            Refused: the FMU reports an error.
            Stopped: it asks to end, or it cannot be integrated.
        """
        at = f"at t = {self.model.t:.9g} s"
        warned = int(self.model.calls[compiled.WARNED])
        self.model.calls[compiled.WARNED] = 0
        for place, name in enumerate(self._instance.model_functions, 1):
            if warned >> place & 1:
                self._instance.warned[name] = None
        if code >= compiled.FAILED:
            place, status = divmod(code, compiled.FAILED)
            name = self._instance.model_functions[place - 1]
            raise Refused(name, self._instance.code(status))
        if code == compiled.TERMINATE:
            raise Stopped(f"the FMU asks to end the simulation, {at}", 2)
        if code == compiled.TOO_MANY_STEPS:
            raise Stopped(
                f"the solver takes more than {compiled.MOST_STEPS:.0f} steps {at}: if the model is stiff, "
                "give the component `solver: radau`; else a larger `tolerance`",
                ERROR,
            )
        if code == compiled.NO_PROGRESS:
            raise Stopped(
                f"the solver makes no progress {at}: derivatives are not finite, or jump where no event is "
                "indicated",
                ERROR,
            )


def _span(array: Any) -> tuple[Any, Any]:
    """Pointer and length of an array, for a C function."""
    return c_void_p(array.ctypes.data), c_size_t(len(array))

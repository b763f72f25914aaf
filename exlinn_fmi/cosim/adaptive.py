"""Communication steps as short as the error asks for: every step is made once whole and once in halves.

The difference tells the error (Richardson); where it is too large all components go back and try a shorter
step. Steps are the master's step halved some number of times, so that all rows are met. Components with a
step of their own and sampled ones with inputs (controllers) keep to their ticks; sources follow the shorter
steps.

References: Hairer, Nørsett and Wanner, Solving Ordinary Differential Equations I, II.4; Busch and Schweizer,
"An explicit approach for controlling the macro-step size of co-simulation methods", 2011.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Indices, Values
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.recorder import Recorder
from exlinn_fmi.cosim.stepping import Stepper
from exlinn_fmi.errors import InputError

SMALLEST_SCALE = 1e-12
"""Values below are as good as zero: a variable's error counts relative to no less than this."""


@dataclass(frozen=True)
class AdaptiveOptions:
    """How exact steps must be.

    Args:
        tolerance: error per step relative to the largest value that a variable had so far.
        tolerances: absolute error per step by ``component.variable`` or pattern; the last that fits counts.
        min_step: shortest communication step [s]; a thousandth of the master's if not given.
    """

    tolerance: float = 1e-4
    tolerances: Mapping[str, float] = field(default_factory=dict)
    min_step: float | None = None


class Adaptive(Stepper):
    """Steps a plan with as many communication points between two ticks as the error asks for.

    Args:
        plan: initialised, with its first row done.
        recorder: takes the rows.
        start: start time [s].
        step: step of the master [s], which is the longest communication step too.
        options: how exact steps must be.

    Attributes:
        steps: communication steps made and kept.
        rejected: steps that were too inexact and made again.
        forced: steps that were too inexact and kept, since no shorter one was allowed.
        shortest: the shortest step that was kept [s].

    Raises:
        InputError: a component cannot go back, or the shortest step leaves no choice.
    """

    chunk = 1

    def __init__(
        self, plan: Plan, recorder: Recorder, start: float, step: float, options: AdaptiveOptions
    ) -> None:
        self._plan, self._recorder, self._start, self._step = plan, recorder, start, step
        self.seconds: Values = np.zeros(len(plan.components))
        halvings = int(math.log2(step / (options.min_step or step / 1000)) + 1e-9)
        if halvings < 1:
            raise InputError(
                f"adaptive: min_step {options.min_step:g} s leaves no choice; expected at most half of the "
                f"step, {step / 2:g} s"
            )
        self._units: int = 2**halvings
        self._size: int = (
            self._units
        )  # of the next step, in units; at least two, since it is made in halves too
        self._advances = [a for a in plan.advances if a.every == 1 and self._follows(a.component)]
        members = {a.component for a in self._advances}
        self._members = [plan.components[n] for n in sorted(members)]
        fixed = [plan.graph.names[n] for n in sorted(members) if not plan.components[n].can_save_state]
        if fixed:
            raise InputError(
                f"adaptive: {', '.join(fixed)} cannot save and restore the state, which trying a step takes; "
                "give it a `step` of its own, or run without `adaptive`"
            )
        self._visits = [x for every, x in plan.visits if x.component in members]
        self._watch(options)
        self._order = 1 if plan.extrapolation is None else plan.extrapolation.order + 1
        self.steps = self.rejected = self.forced = 0
        self.shortest = step

    def _follows(self, number: int) -> bool:
        """Whether a component takes part between ticks: all but controllers do."""
        component = self._plan.components[number]
        return not (component.sampled and any(v.causality == "input" for v in component.variables))

    def _watch(self, options: AdaptiveOptions) -> None:
        """Find the variables whose errors count, and their tolerances."""
        plan, places, given, absolute = self._plan, list[int](), list[int](), list[float]()
        for x in self._visits:
            if x.outputs is None:
                continue
            if plan.components[x.component].sampled:
                given += plan.places(x.taken)
                continue
            for k, place in zip(x.outputs, plan.places(x.taken), strict=True):
                port = (x.component, int(k))
                if plan.graph.variable(port).type == "Real":
                    path = plan.graph.path(port)
                    fits = [
                        value
                        for pattern, value in options.tolerances.items()
                        if path == pattern or fnmatchcase(path, pattern.replace("[", "[[]"))
                    ]
                    places.append(place)
                    absolute.append(fits[-1] if fits else 0.0)
        self._places: Indices = np.array(places, dtype=np.intp)
        self._given: Indices = np.array(given, dtype=np.intp)
        self._absolute, self._relative = np.array(absolute), options.tolerance
        self._largest: Values = np.full(len(places), SMALLEST_SCALE)

    # ── stepping ─────────────────────────────────────────────────────────────────────────────────────────

    def run(self, first: int, until: int) -> None:
        """Step from tick to tick, with shorter steps in between where they are needed."""
        plan, inside = self._plan, {a.component for a in self._advances}
        for k in range(first, until):
            t = self._start + k * self._step
            for a in plan.advances:
                if a.component not in inside and not k % a.every and k + a.every <= plan.ticks:
                    plan.step(a, t, a.h)
            at = 0
            while at < self._units:
                at += self._attempt(t, at)
            plan.propagate(k + 1, self._start + (k + 1) * self._step)
            self._recorder.record(k + 1, plan.signals, plan.columns)

    def _attempt(self, t: float, at: int) -> int:
        """Make a step that is exact enough, `at` units after t; gives its length in units."""
        unit = self._step / self._units
        while at % self._size:
            self._size //= 2
        while True:
            size = int(self._size)
            begin, h = t + at * unit, size * unit
            saved = self._save()
            self._move(begin, h)
            whole = self._plan.signals[self._places]
            self._restore(saved)
            given = [self._plan.signals[self._given]]
            for part in (begin, begin + h / 2):
                self._move(part, h / 2)
                given.append(self._plan.signals[self._given])
            halves = self._plan.signals[self._places]
            largest = np.maximum(self._largest, np.maximum(np.abs(whole), np.abs(halves)))
            allowed = np.where(self._absolute > 0, self._absolute, self._relative * largest)
            error = float((np.abs(whole - halves) / allowed).max(initial=0.0)) / (2**self._order - 1)
            if self._jumps(*given):
                error = max(error, 2.0)
            if error <= 1 or size <= 2:
                self.steps += 2
                self.forced += error > 1
                self.shortest = min(self.shortest, h / 2)
                self._largest = largest
                grown = error * 2.0 ** (self._order + 1) <= 0.5 and not (at + size) % (2 * size)
                self._size = min(2 * size, self._units) if grown else size
                return size
            self.rejected += 1
            self._size = size // 2
            self._restore(saved)

    def _jumps(self, begin: Values, middle: Values, end: Values) -> bool:
        """Whether a source leaps in the second half of a step, where neither way of making it can tell."""
        size = np.maximum(np.maximum(np.abs(begin), np.abs(middle)), np.abs(end))
        leap = np.abs(end - middle) > 10 * np.abs(middle - begin) + self._relative * size
        return bool(leap.any())

    def _move(self, t: float, h: float) -> None:
        """Step all that follow from t to t + h, and pass their values on."""
        for a in self._advances:
            self._plan.step(a, t, h)
        self._plan.signals[0] = t + h
        for x in self._visits:
            self._plan.exchange(x, self._plan.signals, t + h)
        self._plan.pass_on(0, t + h)

    def _save(self) -> tuple[list[object], Values, Values, Any]:
        plan = self._plan
        more = None if plan.extrapolation is None else plan.extrapolation.save()
        return [c.save_state() for c in self._members], plan.signals.copy(), plan.ahead.copy(), more

    def _restore(self, saved: tuple[list[object], Values, Values, Any]) -> None:
        plan, (states, signals, ahead, more) = self._plan, saved
        for component, state in zip(self._members, states, strict=True):
            component.restore_state(state)
        plan.signals[:], plan.ahead[:] = signals, ahead
        if plan.extrapolation is not None:
            plan.extrapolation.restore(more)

    # ── checkpoints and report ───────────────────────────────────────────────────────────────────────────

    def save(self) -> dict[str, Any]:
        """Size of the next step, scales and counts."""
        counts = [self.steps, self.rejected, self.forced, self.shortest]
        return {"size": self._size, "largest": self._largest, "counts": counts}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `save` gave."""
        self._size, self._largest = state["size"], state["largest"]
        self.steps, self.rejected, self.forced, self.shortest = state["counts"]

    def report(self) -> dict[str, Any]:
        """How many steps it took."""
        return {
            "communication_steps": self.steps,
            "rejected_steps": self.rejected,
            "inexact_steps": self.forced,
            "shortest_step": self.shortest,
        }

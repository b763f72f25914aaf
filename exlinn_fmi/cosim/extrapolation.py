"""Inputs between communication points: a polynomial through the last values instead of the last value held.

A component that takes derivatives of its inputs is given a straight line over its step, from the present
value to the polynomial's at the end; any other the polynomial's mean over the step, which is as accurate to
first order. Smooth, the line begins where the one before ended: no jump excites the component.

References: Kübler and Schiehlen, "Two methods of simulator coupling", 2000; Busch, "Zur effizienten Kopplung
von Simulationsprogrammen", 2012 (smoothing).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from exlinn_fmi.components.base import Indices, Status, Values, Variable

if TYPE_CHECKING:
    from exlinn_fmi.cosim.plan import Plan


@dataclass(frozen=True)
class ExtrapolationOptions:
    """How inputs go on over a step.

    Args:
        order: of the polynomial, 1 or 2.
        smooth: whether it begins where the one before ended.
    """

    order: int = 1
    smooth: bool = False


@dataclass
class _Target:
    """A component whose inputs are extrapolated.

    Args:
        inputs: which.
        places: where their sources' values are in the signal vector.
        history: the last times and values.
        reached: what the last polynomial ended with.
    """

    inputs: Indices
    places: Indices
    history: list[tuple[float, Values]]
    reached: Values | None = None


class Extrapolation:
    """The inputs of a plan that are extrapolated: real, continuous, and driven by what is not sampled.

    Args:
        plan: laid out.
        every: own step in ticks by component number; a source that is slower than its target is held.
        fresh: inputs that are refreshed by Gauss–Seidel, which know better.
        options: order and smoothing.

    Attributes:
        order: of the polynomials.
    """

    def __init__(
        self, plan: Plan, every: Sequence[int], fresh: set[tuple[int, int]], options: ExtrapolationOptions
    ) -> None:
        self._plan, self._options, self.order = plan, options, options.order
        driven = {
            i
            for o, i in plan.graph.connections
            if i not in fresh
            and (o, i) not in plan.graph.delayed
            and every[i[0]] % every[o[0]] == 0
            and not (plan.components[o[0]].sampled or plan.components[i[0]].sampled)
            and all(_continuous(plan.graph.variable(port)) for port in (o, i))
        }
        self._targets: dict[int, _Target] = {}
        found: dict[int, list[tuple[int, int]]] = {}
        for _, x in plan.visits:
            if x.inputs is not None:
                # As they are at their sources: components may change what they are given, e.g. convert units.
                for k, place in zip(x.inputs, x.sources, strict=True):
                    if (x.component, int(k)) in driven:
                        found.setdefault(x.component, []).append((int(k), int(place)))
        for number, pairs in found.items():
            inputs, places = (np.array(part, dtype=np.intp) for part in zip(*pairs, strict=True))
            self._targets[number] = _Target(inputs, places, [])

    def concerns(self, number: int) -> bool:
        """Whether a component has inputs that are extrapolated."""
        return number in self._targets

    def prepare(self, number: int, t: float, h: float) -> None:
        """Set the inputs of a component for its step from t to t + h [s].

        Raises:
            RunError: it does not take them.
        """
        target, component = self._targets[number], self._plan.components[number]
        now = self._plan.signals[target.places]
        target.history = [*target.history[-self._options.order :], (t, now)]
        end, mean = _polynomial(target.history, h)
        begin = now
        if self._options.smooth and target.reached is not None:
            begin = target.reached
            mean = mean + (begin - now) / 2
        target.reached = end
        # Copies, since the component may change what it is given.
        if component.takes_input_derivatives:
            status = component.set(target.inputs, begin.copy())
            status = max(status, component.set_input_derivatives(target.inputs, (end - begin) / h))
        else:
            status = component.set(target.inputs, mean.copy())
        if status != Status.OK:
            self._plan.judge(number, status, "setting extrapolated inputs", t)

    def save(self) -> dict[str, Any]:
        """Histories, in plain values."""
        return {str(n): [list(target.history), target.reached] for n, target in self._targets.items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go back to what `save` gave."""
        for number, (history, reached) in state.items():
            target = self._targets[int(number)]
            target.history, target.reached = list(history), reached


def _continuous(variable: Variable) -> bool:
    return variable.type == "Real" and variable.variability == "continuous"


def _polynomial(history: Sequence[tuple[float, Values]], h: float) -> tuple[Values, Values]:
    """The polynomial through the last values, at h after the last, and its mean until there (Newton)."""
    (t0, v0), *before = history[::-1]
    if not before:
        return v0, v0
    t1, v1 = before[0]
    slope = (v0 - v1) / (t0 - t1)
    end, mean = v0 + h * slope, v0 + h / 2 * slope
    if len(before) > 1:
        t2, v2 = before[1]
        bend = (slope - (v1 - v2) / (t1 - t2)) / (t0 - t2)
        end = end + h * (h + t0 - t1) * bend
        mean = mean + h * (h / 3 + (t0 - t1) / 2) * bend
    return end, mean

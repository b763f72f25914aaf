"""Variables of components that the scenario itself settles: sources, and what is made of a learned model."""

from __future__ import annotations

from collections.abc import Sequence

from exlinn_fmi.components.base import Variable
from exlinn_fmi.mechanics.coordinates import Coordinate, state_names, state_units
from exlinn_fmi.scenario.schema import (
    ComponentBase,
    ModelComponent,
    Nmpc,
    NmpcComponent,
    Reference,
    ScotchYoke,
    SignalComponent,
)


def derived_variables(spec: ComponentBase, learned: Sequence[Coordinate]) -> tuple[Variable, ...] | None:
    """Variables of a component that need no look at anything outside the scenario; None where they do.

    Args:
        spec: the component's section.
        learned: the coordinates that the scenario's `learn` section states.
    """
    if isinstance(spec, SignalComponent):
        return (Variable("y", "output", unit=spec.source.unit),)
    if isinstance(spec, ModelComponent) and spec.model == "learned" and learned:
        return model_variables(tuple(learned))
    if isinstance(spec, NmpcComponent) and spec.nmpc.model == "learned" and learned:
        return nmpc_variables(tuple(learned), spec.nmpc)
    return None


def model_variables(coordinates: tuple[Coordinate, ...]) -> tuple[Variable, ...]:
    """Variables of a learned model run as a component: inputs, then state, accelerations, stored energy."""
    states = zip(state_names(coordinates), state_units(coordinates), strict=True)
    return (
        *(Variable(c.input, "input", unit=c.input_unit or None, start=0.0) for c in coordinates if c.input),
        *(Variable(name, "output", unit=unit, start=0.0) for name, unit in states),
        *(Variable(c.acceleration, "output", unit=c.acceleration_unit) for c in coordinates),
        Variable("energy", "output", unit="J"),
    )


def nmpc_variables(coordinates: tuple[Coordinate, ...], options: Nmpc) -> tuple[Variable, ...]:
    """Variables of an NMPC controller: the model's state in, its inputs out, then how the solve went."""
    states = list(zip(state_names(coordinates), state_units(coordinates), strict=True))
    return (
        *(Variable(name, "input", unit=unit, start=0.0) for name, unit in states),
        *(Variable(c.input, "output", unit=c.input_unit or None) for c in coordinates if c.input),
        Variable("reference", "output", unit=reference_unit(options.reference, dict(states))),
        *(Variable(f"reference_{name}", "output", unit=unit) for name, unit in states),
        Variable("cost", "output"),
        Variable("solve_status", "output", "discrete", type="Integer"),
        Variable("iterations", "output", "discrete", type="Integer"),
        Variable("kkt", "output"),
        Variable("solve_time", "output", unit="s"),
        Variable("fallbacks", "output", "discrete", type="Integer"),
    )


def reference_unit(reference: Reference, states: dict[str, str]) -> str | None:
    """Unit of the quantity that a reference trajectory is for, None where nothing settles it."""
    if reference.trajectory.unit is not None:
        return reference.trajectory.unit
    if reference.through is None:
        return states.get(reference.coordinate)
    return "m" if isinstance(reference.through, ScotchYoke) else None

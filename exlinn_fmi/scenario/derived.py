"""Variables of components that the scenario itself settles: sources, and what is made of a learned model."""

from __future__ import annotations

from collections.abc import Sequence

from exlinn_fmi.components.base import Variable, VariableType
from exlinn_fmi.mechanics.coordinates import Coordinate, state_names, state_units
from exlinn_fmi.scenario.control import Nmpc, Reference, ScotchYoke
from exlinn_fmi.scenario.schema import (
    ComponentBase,
    ModelComponent,
    NmpcComponent,
    SensorComponent,
    SignalComponent,
)
from exlinn_fmi.scenario.signals import MEASURED, Channel

TERMINAL = {
    "terminal_cost": "cost of the plan's end by the Riccati equation",
    "terminal_level": "largest such cost within the terminal set, 0 where there is none",
}
"""What a controller with a terminal set tells besides."""


def derived_variables(spec: ComponentBase, learned: Sequence[Coordinate]) -> tuple[Variable, ...] | None:
    """Variables of a component that need no look at anything outside the scenario; None where they do.

    Args:
        spec: the component's section.
        learned: the coordinates that the scenario's `learn` section states.
    """
    if isinstance(spec, SignalComponent):
        return (Variable("y", "output", unit=spec.source.unit),)
    if isinstance(spec, SensorComponent):
        return sensor_variables(spec.sensor)
    if isinstance(spec, ModelComponent) and spec.model == "learned" and learned:
        return model_variables(tuple(learned))
    if isinstance(spec, NmpcComponent) and spec.nmpc.model == "learned" and learned:
        return nmpc_variables(tuple(learned), spec.nmpc)
    return None


def sensor_variables(channels: dict[str, Channel]) -> tuple[Variable, ...]:
    """Variables of a sensor: its inputs, then its outputs."""
    return (
        *(Variable(name, "input", unit=c.unit, start=0.0) for name, c in channels.items()),
        *(
            Variable(
                f"{name}{MEASURED}",
                "output",
                "discrete",
                unit=c.unit,
                description=f"measured {name}",
                depends_on=() if c.delay else (name,),
            )
            for name, c in channels.items()
        ),
    )


def model_variables(coordinates: tuple[Coordinate, ...]) -> tuple[Variable, ...]:
    """Variables of a learned model run as a component: inputs, then state, accelerations, stored energy.

    Which inputs an acceleration depends on is settled by learning; until then it may be all of them.
    """
    inputs = tuple(c.input for c in coordinates if c.input is not None)
    states = zip(state_names(coordinates), state_units(coordinates), strict=True)
    return (
        *(Variable(c.input, "input", unit=c.input_unit or None, start=0.0) for c in coordinates if c.input),
        *(Variable(name, "output", unit=unit, start=0.0) for name, unit in states),
        *(
            Variable(c.acceleration, "output", unit=c.acceleration_unit, depends_on=inputs)
            for c in coordinates
        ),
        Variable("energy", "output", unit="J"),
    )


def nmpc_variables(coordinates: tuple[Coordinate, ...], options: Nmpc) -> tuple[Variable, ...]:
    """Variables of an NMPC controller: the measured state, the inputs to apply, and how they came about.

    Args:
        coordinates: those of the model.
        options: the controller's settings.
    """
    states = list(zip(state_names(coordinates), state_units(coordinates), strict=True))
    names = tuple(name for name, _ in states)

    def output(name: str, unit: str | None, text: str, type_: VariableType = "Real") -> Variable:
        return Variable(name, "output", "discrete", unit, type_, description=text, depends_on=names)

    return (
        *(
            Variable(name, "input", "continuous", unit, start=0.0, description=f"measured {name}")
            for name, unit in states
        ),
        *(output(c.input, c.input_unit or None, "input to apply") for c in coordinates if c.input),
        *(
            output(name, reference_unit(reference, dict(states)), "what is to be followed")
            for name, reference in options.references.items()
        ),
        *(output(f"reference_{name}", unit, f"reference of {name}") for name, unit in states),
        *(output(f"estimate_{name}", unit, f"{name} that the solve began with") for name, unit in states),
        *(
            output(f"disturbance_{c.name}", c.force_unit, f"estimated force on {c.name} beside the inputs")
            for c in coordinates
        ),
        output("cost", "1", "cost J of the plan"),
        output("stage_cost", "1", "cost of the present state and input, the first term of J"),
        output("cost_disturbance", "1", "most that the state's being off its prediction adds to J"),
        output(
            "solve_status",
            "1",
            "0 solved, 1 limit, 2 failed: fallback, 3 lost: safe input",
            "Enumeration",
        ),
        output("missing", "1", "measurements that are missing: no number, or stale", "Integer"),
        output("iterations", "1", "iterations of the solver", "Integer"),
        output("kkt", "1", "KKT residual"),
        output("solve_time", "s", "time that reference and solve took, what is prepared before included"),
        output("feedback_time", "s", "the part of it between the measurements and the input"),
        output("fallbacks", "1", "fallbacks so far", "Integer"),
        output("slack", "1", "largest violation of a state bound in the plan, over the bound's range"),
        *(
            []
            if options.terminal_set is None
            else [output(name, "1", text) for name, text in TERMINAL.items()]
        ),
    )


def reference_unit(reference: Reference, states: dict[str, str]) -> str | None:
    """Unit of the quantity that a reference trajectory is for, None where nothing settles it."""
    if reference.trajectory.unit is not None:
        return reference.trajectory.unit
    if reference.through is None:
        return states.get(reference.coordinate)
    return "m" if isinstance(reference.through, ScotchYoke) else None

"""The vocabulary of scenario files: every key, its meaning, its default and its bounds.

The other parts take these models as their options (`learn` a `Learn`, `control` an `Nmpc`, …), so that each
setting is written down once. The JSON Schema that editors use is generated from here. Sections with much to
say have files of their own: `signals.py`, `control.py`, `learning.py`, `simulation.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from exlinn_fmi.components.base import Number
from exlinn_fmi.components.texts import handle
from exlinn_fmi.components.wide import exact
from exlinn_fmi.scenario.control import Nmpc
from exlinn_fmi.scenario.events import Event
from exlinn_fmi.scenario.learning import AnyLearn
from exlinn_fmi.scenario.signals import Channel, Signal
from exlinn_fmi.scenario.simulation import Simulate as Simulate
from exlinn_fmi.scenario.spec import (
    AnyStart,
    Name,
    NonNegative,
    Positive,
    Spec,
    VariablePath,
    flat_starts,
    form,
    telling_key,
)
from exlinn_fmi.scenario.study import Study

# ── components ───────────────────────────────────────────────────────────────────────────────────────────


class ComponentBase(Spec):
    """What every component may say."""

    step: Positive | None = Field(
        None, description="own communication step [s]: a multiple of the scenario's; that one if not given"
    )
    start: dict[str, AnyStart] = Field(
        default_factory=dict,
        description="start values of parameters, inputs and states, by variable name; lists for arrays",
    )

    def starts(self) -> dict[str, Number]:
        """Start values as components take them: arrays by element, texts by number, large numbers exactly."""
        flat = flat_starts(self.start)
        return {name: handle(v) if isinstance(v, str) else exact(v) for name, v in flat.items()}


class FmuComponent(ComponentBase):
    """A Functional Mock-up Unit: FMI 1.0, 2.0 or 3.0 Co-Simulation, 2.0 or 3.0 Model Exchange."""

    fmu: str = Field(description="the .fmu file, relative to the scenario")
    isolate: bool | None = Field(
        None,
        description="run it in a process of its own, where a crash or endless loop does no harm; if "
        "not given, that is so for FMUs outside the scenario's folder and the folders of `trust`",
    )
    timeout: Positive = Field(60.0, description="longest time that a call may take [s], if it is isolated")
    memory: Positive | None = Field(
        None, description="most memory that it may take [MB], if it is isolated; all there is if not given"
    )
    interface: Literal["co_simulation", "model_exchange"] | None = Field(
        None, description="how it is used; Co-Simulation where the FMU has it, if not given"
    )
    solver: Literal["auto", "dopri5", "dop853", "lsoda", "bdf", "radau"] = Field(
        "auto",
        description="for Model Exchange: dopri5 and dop853 for models that are not stiff, bdf and radau for "
        "stiff ones, lsoda for either; auto begins with dopri5 and takes radau if the model proves stiff",
    )
    tolerance: Positive | None = Field(
        None, description="relative tolerance of integration; what the FMU states, else 1e-6, if not given"
    )


class PlantComponent(ComponentBase):
    """One of the plants that come with exlinn, run in this process."""

    plant: str = Field(description="name of the plant, e.g. dc_motor_cart")


class PythonComponentSpec(ComponentBase):
    """Your own class: a `PythonComponent`, found as `module:Class` beside the scenario or installed."""

    python: str = Field(pattern=r"^[\w.]+:\w+$", description="module:Class")
    options: dict[str, Any] = Field(default_factory=dict, description="keyword arguments of the class")


class SignalComponent(ComponentBase):
    """A signal source with one output, `y`."""

    source: Signal = Field(description="the signal")


class SensorComponent(ComponentBase):
    """Noise, resolution and delay of signals: input `x`, output `x_measured`, sampled at its `step`."""

    sensor: dict[Name, Channel] = Field(min_length=1, description="what becomes of each signal, by its name")


class ModelComponent(ComponentBase):
    """A learned model, run as if it were the plant."""

    model: str = Field(
        description="`learned`: what this scenario's `learn` trains; else a folder with model.json"
    )


class NmpcComponent(ComponentBase):
    """The controller: inputs are the model's states, outputs its inputs."""

    nmpc: Nmpc = Field(description="the controller's settings")


COMPONENT_KEYS: Mapping[str, type[Spec]] = {
    "fmu": FmuComponent,
    "plant": PlantComponent,
    "python": PythonComponentSpec,
    "source": SignalComponent,
    "sensor": SensorComponent,
    "model": ModelComponent,
    "nmpc": NmpcComponent,
}
"""The key that tells what a component is, and the section it makes."""


def component_kind(value: Any) -> str | None:
    """Which key of `COMPONENT_KEYS` a component has."""
    return telling_key(value, COMPONENT_KEYS)


ComponentSpec = Annotated[
    Annotated[FmuComponent, Tag("fmu")]
    | Annotated[PlantComponent, Tag("plant")]
    | Annotated[PythonComponentSpec, Tag("python")]
    | Annotated[SignalComponent, Tag("source")]
    | Annotated[SensorComponent, Tag("sensor")]
    | Annotated[ModelComponent, Tag("model")]
    | Annotated[NmpcComponent, Tag("nmpc")],
    Discriminator(component_kind),
]

# ── the scenario ─────────────────────────────────────────────────────────────────────────────────────────


Paths = Annotated[
    Annotated[VariablePath, Tag("text")] | Annotated[list[VariablePath], Tag("a list")], Discriminator(form)
]


class Metrics(Spec):
    """How the closed loop is judged."""

    settle: NonNegative = Field(0.0, description="time at the start that the errors leave out [s]")
    output: Paths | None = Field(
        None,
        description="recorded variable that is compared with the reference's quantity; a list for several",
    )

    @property
    def outputs(self) -> list[str]:
        """The variables, in the order of the references."""
        return self.output if isinstance(self.output, list) else [self.output] if self.output else []


class Link(Spec):
    """A connection that changes the value: ``factor · value + offset``, after its unit is converted."""

    to: VariablePath = Field(description="where the connection leads, component.variable")
    factor: float = Field(1.0, description="what the value is multiplied by")
    offset: float = Field(0.0, description="what is added then, in the unit of the target")
    convert: bool = Field(True, description="whether the value is converted to the target's unit before")


Target = Annotated[
    Annotated[VariablePath, Tag("text")] | Annotated[Link, Tag("a mapping")], Discriminator(form)
]
Targets = Annotated[
    Annotated[VariablePath, Tag("text")]
    | Annotated[Link, Tag("a mapping")]
    | Annotated[list[Target], Tag("a list")],
    Discriminator(form),
]


class Scenario(Spec):
    """One experiment: components, how they are connected, and what is done with them."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_.-]+$", description="name of the scenario and of its result folder"
    )
    description: str = Field("", description="what it shows")
    seed: int = Field(0, ge=0, description="seed of everything random")
    components: dict[Name, ComponentSpec] = Field(
        default_factory=dict, description="what takes part, by name"
    )
    connections: dict[VariablePath, Targets] = Field(
        default_factory=dict,
        description="from: to, or from: [to, to], each component.variable or {to, factor, offset}",
    )
    events: list[Event] = Field(
        default_factory=list, description="what happens to signals, parameters and components during a run"
    )
    trust: list[str] = Field(
        default_factory=list,
        description="folders beside the scenario's own whose FMUs may run in this process, at full speed",
    )
    learn: AnyLearn | None = Field(None, description="learn a model of one component, or of measured data")
    simulate: Simulate | None = Field(None, description="run the components together")
    study: Study | None = Field(
        None, description="run the closed loop many times, with values drawn at random"
    )
    metrics: Metrics = Field(default_factory=lambda: Metrics(), description="how the closed loop is judged")

    def trusts(self, file: Path, folder: Path) -> bool:
        """Whether a file lies in the scenario's folder or in one that it trusts.

        Args:
            file: the file.
            folder: the scenario's folder.
        """
        return any(file.resolve().is_relative_to((folder / place).resolve()) for place in (".", *self.trust))

    def links(self) -> list[tuple[str, Link]]:
        """All connections as (from, connection)."""
        return [
            (source, target if isinstance(target, Link) else Link(to=target))
            for source, targets in self.connections.items()
            for target in (targets if isinstance(targets, list) else [targets])
        ]

    def connection_list(self) -> list[tuple[str, str]]:
        """All connections as (from, to)."""
        return [(source, link.to) for source, link in self.links()]

"""From a section of a scenario to a component: what variables it has, and the component itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from exlinn_fmi.components.base import Component, Variable
from exlinn_fmi.components.python import PythonComponent, load_python_component
from exlinn_fmi.scenario.derived import derived_variables, nmpc_variables
from exlinn_fmi.scenario.schema import (
    ComponentBase,
    FmuComponent,
    ModelComponent,
    NmpcComponent,
    PlantComponent,
    PythonComponentSpec,
    Scenario,
    SensorComponent,
    SignalComponent,
)

if TYPE_CHECKING:
    from exlinn_fmi.components.fmu import FmuSettings
    from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem


def inspect(spec: ComponentBase, folder: Path) -> Sequence[Variable]:
    """Variables that a component will have, found without running it.

    Args:
        spec: the component's section; not a controller or model that is still to be learned.
        folder: folder of the scenario, which relative paths start from.

    Raises:
        InputError: the component cannot be made; the message says why.
    """
    if isinstance(spec, FmuComponent):
        from exlinn_fmi.components.fmu import read_variables

        return read_variables(folder / spec.fmu, runnable=True, settings=fmu_settings(spec))
    if isinstance(spec, NmpcComponent):
        return nmpc_variables(model_system(spec.nmpc.model, folder, folder).coordinates, spec.nmpc)
    component = make("component", spec, folder, folder)
    try:
        return component.variables
    finally:
        component.close()


def build(name: str, scenario: Scenario, folder: Path, run_folder: Path) -> Component:
    """Make the component of that name.

    Args:
        name: its name in the scenario.
        scenario: the whole scenario.
        folder: folder of the scenario file.
        run_folder: where a model that this scenario learns is found.

    Raises:
        InputError: the component cannot be made; the message says why.
    """
    spec = scenario.components[name]
    if isinstance(spec, FmuComponent) and is_isolated(spec, scenario, folder):
        from exlinn_fmi.components.isolated import isolated_fmu

        memory = None if spec.memory is None else 1e6 * spec.memory
        return isolated_fmu(name, folder / spec.fmu, spec.timeout, memory, fmu_settings(spec))
    if isinstance(spec, SensorComponent):
        from exlinn_fmi.components.sensor import Sensor

        return Sensor(name, spec.sensor, scenario.seed)
    if not isinstance(spec, NmpcComponent):
        return make(name, spec, folder, run_folder)
    from exlinn_fmi.control.controller import NmpcController

    # An input that is connected to nothing acts on nothing: the controller must not count on it.
    links, own = scenario.connection_list(), f"{name}."
    driven = {source.removeprefix(own) for source, _ in links if source.startswith(own)}
    measured = {target.removeprefix(own) for _, target in links if target.startswith(own)}
    system = model_system(spec.nmpc.model, folder, run_folder).with_inputs(driven)
    step = spec.step or (scenario.simulate.step if scenario.simulate else 1e-3)
    return NmpcController(name, system, spec.nmpc, step, folder, measured)


def make(name: str, spec: ComponentBase, folder: Path, run_folder: Path) -> Component:
    """Make a component from its section alone."""
    # Each kind brings libraries of its own; none is loaded before it is used.
    if isinstance(spec, FmuComponent):
        from exlinn_fmi.components.fmu import FmuComponent as Fmu

        return Fmu(name, folder / spec.fmu, fmu_settings(spec))
    if isinstance(spec, PlantComponent):
        from exlinn_fmi.components.lagrangian import LagrangianComponent
        from exlinn_fmi.plants import plant

        return LagrangianComponent(name, plant(spec.plant))
    if isinstance(spec, ModelComponent):
        from exlinn_fmi.components.lagrangian import LagrangianComponent

        return LagrangianComponent(name, model_system(spec.model, folder, run_folder))
    if isinstance(spec, SignalComponent):
        from exlinn_fmi.components.signals import SignalSource

        return SignalSource(name, spec.source, folder)
    if isinstance(spec, SensorComponent):
        from exlinn_fmi.components.sensor import Sensor

        return Sensor(name, spec.sensor, 0)
    if isinstance(spec, PythonComponentSpec):
        return load_python_component(spec.python, name, spec.options, folder)
    raise TypeError(f"no component for {type(spec).__name__}")


def is_isolated(spec: FmuComponent, scenario: Scenario, folder: Path) -> bool:
    """Whether an FMU runs in a process of its own: as it says, else where the scenario does not trust it."""
    return spec.isolate if spec.isolate is not None else not scenario.trusts(folder / spec.fmu, folder)


def fmu_settings(spec: FmuComponent) -> FmuSettings:
    """How a scenario wants an FMU to be used."""
    from exlinn_fmi.components.fmu import FmuSettings

    return FmuSettings(spec.interface, spec.solver, spec.tolerance, spec.starts())


def model_system(reference: str, folder: Path, run_folder: Path) -> LagrangianSystem:
    """The equations of motion that a `model` entry names: ``learned``, ``plant:NAME`` or a folder.

    Raises:
        ModelError: there is no model there, or it cannot be read.
    """
    if reference.startswith("plant:"):
        from exlinn_fmi.plants import plant

        return plant(reference.removeprefix("plant:")).system
    from exlinn_fmi.learn.weights import load_model
    from exlinn_fmi.mechanics.learned import learned_system

    model = load_model(run_folder if reference == "learned" else folder / reference)
    return learned_system(model.spec, model.weights)


class Outline(PythonComponent):
    """A component that is not made yet, with its variables: enough to draw the graph, nothing to run."""

    def __init__(self, name: str, variables: Sequence[Variable], sampled: bool) -> None:
        super().__init__(name, variables)
        self._sampled = sampled

    @property
    def sampled(self) -> bool:
        """Whether outputs hold between communication points."""
        return self._sampled


def outline(name: str, scenario: Scenario, folder: Path) -> Component:
    """A component's outline; a model that is still to be learned needs no training for it."""
    spec = scenario.components[name]
    learned = [c.coordinate() for c in scenario.learn.coordinates] if scenario.learn else []
    variables = derived_variables(spec, learned) or inspect(spec, folder)
    return Outline(name, variables, isinstance(spec, SignalComponent | SensorComponent | NmpcComponent))

"""What the checks across sections know: the sound part of a scenario and the variables of its components."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from exlinn_fmi.components.base import Variable
from exlinn_fmi.errors import InputError, ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, check_coordinates
from exlinn_fmi.scenario.derived import derived_variables
from exlinn_fmi.scenario.explain import Finding, Sound, sound_part
from exlinn_fmi.scenario.learning import LearnFromData, LearnFromPlant, PlantCoordinate
from exlinn_fmi.scenario.schema import (
    ComponentBase,
    FmuComponent,
    ModelComponent,
    NmpcComponent,
    PythonComponentSpec,
    Scenario,
    SensorComponent,
    SignalComponent,
    component_kind,
)
from exlinn_fmi.scenario.words import KeyPath, closest, listing, missing_file, suggestion

Inspect = Callable[[ComponentBase, Path], Sequence[Variable]]
"""Finds the variables of a component without running it; raises `InputError` where it cannot be made."""

Role = Literal["output", "input"]


@dataclass(frozen=True)
class Survey:
    """What is known of a scenario before anything is run.

    Args:
        sound: the part of it without mistakes.
        folder: its folder.
        names: all its components, those with mistakes as well.
        coordinates: the coordinates that it learns; none where there is a mistake in them.
        variables: by component and name, for the components whose variables are known.
    """

    sound: Sound
    folder: Path
    names: tuple[str, ...]
    coordinates: tuple[Coordinate, ...]
    variables: Mapping[str, Mapping[str, Variable]]

    @property
    def scenario(self) -> Scenario:
        """The part of the scenario without mistakes."""
        return self.sound.scenario

    @property
    def names_are_known(self) -> bool:
        """Whether a name that is not among `names` is no component."""
        return bool(self.names) and not self.sound.in_doubt((), "components")

    def find(self, path: str, role: Role) -> tuple[Variable | None, str | None]:
        """The variable that ``component.variable`` names.

        Args:
            path: the name.
            role: what it should be, for the names that a message offers.

        Returns:
            The variable, None where it is not known; and what is wrong with the name, None where nothing is.
        """
        component, name = path.split(".", 1)
        if component not in self.names:
            if not self.names_are_known:
                return None, None
            return (
                None,
                f"there is no component {component!r}{suggestion(component, self.names, 'components')}",
            )
        known = self.variables.get(component)
        if known is None or name in known:
            return (known or {}).get(name), None
        fitting = [v.name for v in known.values() if v.causality == role]
        match = closest(name, fitting) or closest(name, known)
        hint = f"; did you mean {match!r}?" if match else listing(fitting, f"its {role}s")
        return None, f"{component} has no variable {name!r}{hint}"


def survey(data: Any, folder: Path, inspect: Inspect | None) -> tuple[Survey, list[Finding]]:
    """Gather what the checks need, and what is wrong with single components.

    Args:
        data: the scenario as plain data.
        folder: its folder.
        inspect: finds the variables of a component; without it those of FMUs, plants … stay unknown.
    """
    sound = sound_part(data)
    components = data.get("components") if isinstance(data, dict) else None
    names = tuple(components) if isinstance(components, dict) else ()
    variables: dict[str, Sequence[Variable]] = {}
    findings: list[Finding] = []
    for name, spec in sound.scenario.components.items():
        problems = list(_files(name, spec, folder))
        findings += problems
        if not problems and inspect is not None and _settled(name, spec, sound):
            try:
                variables[name] = inspect(spec, folder)
            except InputError as error:
                message = "; ".join(str(error).splitlines())
                findings.append((("components", name, component_kind(spec) or ""), message))
    coordinates = _coordinates(sound, variables)
    for name, spec in sound.scenario.components.items():
        if (derived := derived_variables(spec, coordinates)) is not None:
            variables[name] = derived
    by_name = {name: {v.name: v for v in found} for name, found in variables.items()}
    return Survey(sound, folder, names, coordinates, by_name), findings


def _coordinates(sound: Sound, variables: Mapping[str, Sequence[Variable]]) -> tuple[Coordinate, ...]:
    """The coordinates to learn, in the units that the plant states; none where there is a mistake in them."""
    learn = sound.scenario.learn
    if learn is None or any(path[:2] == ("learn", "coordinates") for path in sound.cut):
        return ()
    if isinstance(learn, LearnFromData):
        coordinates = tuple(spec.coordinate() for spec in learn.coordinates)
    else:
        coordinates = _plant_coordinates(learn, variables)
    try:
        check_coordinates(coordinates)
    except ModelError:
        return ()
    return coordinates


def _plant_coordinates(
    learn: LearnFromPlant, variables: Mapping[str, Sequence[Variable]]
) -> tuple[Coordinate, ...]:
    """Coordinates of a plant in its units; none where one of its variables is not what it should be."""
    plant = {f"{learn.plant}.{v.name}": v for v in variables.get(learn.plant, ())}
    if not all(_is_sound(spec, plant) for spec in learn.coordinates):
        return ()

    def unit(name: str | None, stated: str) -> str:
        variable = plant.get(f"{learn.plant}.{name}")
        return stated if variable is None or variable.unit is None else variable.unit

    return tuple(
        replace(
            c,
            unit=unit(c.name, c.unit),
            velocity_unit=unit(c.velocity, c.velocity_unit),
            input_unit=unit(c.input, c.input_unit),
        )
        for c in (spec.coordinate() for spec in learn.coordinates)
    )


def _is_sound(spec: PlantCoordinate, plant: Mapping[str, Variable]) -> bool:
    """Whether the variables of a coordinate are there and can be what they are said to be."""
    if spec.position is None and spec.topology != "cyclic":
        return False
    outputs = [path for path in (spec.position, spec.velocity, spec.acceleration) if path is not None]
    return not plant or (
        all(path in plant and plant[path].causality != "input" for path in outputs)
        and (spec.input is None or (spec.input in plant and plant[spec.input].causality == "input"))
    )


def _settled(name: str, spec: ComponentBase, sound: Sound) -> bool:
    """Whether a component must be looked at to know its variables, and is given well enough for that."""
    at: KeyPath = ("components", name)
    if isinstance(spec, NmpcComponent):
        return spec.nmpc.model != "learned" and not any(path[:2] == at for path in sound.cut)
    if isinstance(spec, PythonComponentSpec):
        return not sound.in_doubt(at, "options")
    learned = isinstance(spec, ModelComponent) and spec.model == "learned"
    return not learned and not isinstance(spec, SignalComponent | SensorComponent)


def _files(name: str, spec: ComponentBase, folder: Path) -> Iterator[Finding]:
    """Files and folders that a component names and that are not there."""
    at: KeyPath = ("components", name)
    if isinstance(spec, FmuComponent) and not (folder / spec.fmu).is_file():
        is_folder = (folder / spec.fmu).is_dir()
        message = (
            f"{spec.fmu!r} is a folder, expected an .fmu file"
            if is_folder
            else missing_file(spec.fmu, folder)
        )
        yield (*at, "fmu"), message
    if isinstance(spec, ModelComponent):
        yield from _model(spec.model, (*at, "model"), folder)
    if isinstance(spec, NmpcComponent) and not spec.nmpc.model.startswith("plant:"):
        yield from _model(spec.nmpc.model, (*at, "nmpc", "model"), folder)


def _model(name: str, at: KeyPath, folder: Path) -> Iterator[Finding]:
    if name == "learned" or (folder / name / "model.json").is_file():
        return
    if (folder / name).is_dir():
        yield at, f"no model in {name!r}: it has no model.json; give a folder that `exlinn train` wrote"
    else:
        hint = "; did you mean 'learned'?" if closest(name, ["learned"]) else ""
        yield at, f"expected `learned` or a folder with a model.json: {missing_file(name, folder)}{hint}"

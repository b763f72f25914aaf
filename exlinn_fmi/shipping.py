"""Controllers and closed loops of a run as FMUs and as a system structure (SSP)."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from exlinn_fmi.errors import InputError, nearest
from exlinn_fmi.factory import build, inspect
from exlinn_fmi.scenario.load import load_scenario, saved_scenario
from exlinn_fmi.scenario.schema import NmpcComponent

if TYPE_CHECKING:
    from exlinn_fmi.control.controller import NmpcController
    from exlinn_fmi.export.build import Options
    from exlinn_fmi.export.model import StateSpaceModel
    from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
    from exlinn_fmi.scenario.schema import Scenario


@dataclass(frozen=True)
class Origin:
    """A controller in its run.

    Args:
        scenario: the scenario that ran.
        folder: what relative file names of the scenario start from.
        run: the run folder.
        name: of the controller in the scenario.
    """

    scenario: Scenario
    folder: Path
    run: Path
    name: str

    @classmethod
    def find(cls, run: Path, scenario: Path | None = None, name: str | None = None) -> Origin:
        """The controller of a run.

        Args:
            run: the run folder.
            scenario: the scenario's own file, where it names files; that in the run folder if not given.
            name: of the controller; the only one if not given.

        Raises:
            InputError: there is no scenario, or no such controller.
        """
        file = scenario or run / "scenario.yaml"
        if not file.is_file():
            raise InputError(
                f"{run}: not a run folder (it has no scenario.yaml); give one that `exlinn run` wrote"
            )
        found = load_scenario(file).scenario if scenario else saved_scenario(file)
        names = [key for key, spec in found.components.items() if isinstance(spec, NmpcComponent)]
        if not names:
            raise InputError(f"{file}: there is no NMPC controller in this scenario")
        if name is None and len(names) > 1:
            raise InputError(
                f"{file}: there are several controllers ({', '.join(names)}); say which with --name"
            )
        if name is not None and name not in names:
            raise InputError(f"{file}: no controller {name!r}; {nearest(name, names, 'controllers')}")
        return cls(found, file.parent, run, name or names[0])

    @property
    def spec(self) -> NmpcComponent:
        """The controller's section."""
        spec = self.scenario.components[self.name]
        assert isinstance(spec, NmpcComponent)
        return spec

    @property
    def description(self) -> str:
        """What it is, in a line."""
        return f"NMPC, {self.name} of {self.scenario.name}"

    def model(self, system: LagrangianSystem) -> StateSpaceModel:
        """The prediction model to be exported beside the controller, its range watched where it is known."""
        from exlinn_fmi.export.build import learned_model
        from exlinn_fmi.export.model import system_model
        from exlinn_fmi.learn.weights import load_model

        if self.spec.nmpc.model != "learned":
            return system_model(system, "Model", "prediction model")
        found = load_model(self.run)
        ranges = found.provenance.get("ranges")
        return learned_model(found.spec, found.weights, "Model", "learned prediction model", ranges=ranges)

    def controller(self) -> NmpcController:
        """The controller as it ran."""
        from exlinn_fmi.control.controller import NmpcController

        made = build(self.name, self.scenario, self.folder, self.run)
        assert isinstance(made, NmpcController)
        return made


def ship_controller(origin: Origin, path: Path, options: Options) -> Path:
    """Write a controller as an FMU.

    Args:
        origin: where it is.
        path: file to write.
        options: how.

    Raises:
        InputError: it cannot be had, or has a part that no FMU can have.
        RunError: the compiler failed, or the file could not be written.
    """
    from exlinn_fmi.export.build import export_model
    from exlinn_fmi.export.controller import controller_model

    model = controller_model(
        origin.controller(), origin.spec.nmpc, origin.folder, path.stem, origin.description
    )
    return export_model(model, path, options)


def ship_loop(origin: Origin, path: Path, options: Options) -> Path:
    """Write controller and prediction model as a closed loop: one FMU, or a system structure of two.

    Args:
        origin: where the controller is.
        path: file to write, ``.fmu`` or ``.ssp``.
        options: how FMUs are written.

    Raises:
        InputError: the controller cannot be had, or has a part that no FMU can have.
        RunError: the compiler failed, or the file could not be written.
    """
    from exlinn_fmi.export.build import export_model
    from exlinn_fmi.export.controller import controller_model
    from exlinn_fmi.export.ssp import write_ssp

    if path.suffix not in (".fmu", ".ssp"):
        raise InputError(f"{path}: a loop is an .fmu or an .ssp; give a file name that ends so")
    controller, nmpc, text = origin.controller(), origin.spec.nmpc, origin.description
    if path.suffix == ".fmu":
        closed = controller_model(controller, nmpc, origin.folder, path.stem, f"{text}, and its model", True)
        return export_model(closed, path, options)
    system = controller.parts.ocp.system
    models = {
        "controller": controller_model(controller, nmpc, origin.folder, "Controller", text),
        "model": origin.model(system),
    }
    wires = {f"model.{name}": f"controller.{name}" for name in system.state_names}
    wires |= {f"controller.{name}": f"model.{name}" for name in system.input_names}
    with tempfile.TemporaryDirectory(prefix="exlinn-export-") as name:
        folder = Path(name)
        for part, model in models.items():
            export_model(model, folder / f"{part}.fmu", options)
        loop = {
            "name": path.stem,
            "description": text,
            "components": {part: {"fmu": f"{part}.fmu"} for part in models},
            "connections": wires,
            "simulate": {"stop": 10, "step": controller.parts.step},
        }
        (folder / "scenario.yaml").write_text(json.dumps(loop), "utf-8")  # JSON is YAML too
        loaded = load_scenario(folder / "scenario.yaml")
        specs = loaded.scenario.components
        return write_ssp(loaded, {part: inspect(spec, folder) for part, spec in specs.items()}, path)

"""A scenario's topology as a package of SSP 1.0 or 2.0, for other tools and for `exlinn` itself.

FMUs go along as they are. Components that are no FMUs are elements of a type of our own, with their section
of the scenario as an annotation: other tools see their connectors and connections, `exlinn` runs them.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

from exlinn_fmi.components.base import SiUnit, Variable
from exlinn_fmi.data.files import write_bytes
from exlinn_fmi.errors import InputError
from exlinn_fmi.scenario.load import LoadedScenario, named_files
from exlinn_fmi.scenario.schema import FmuComponent, ModelComponent, NmpcComponent
from exlinn_fmi.scenario.ssp import FMU, OWN, STRUCTURE
from exlinn_fmi.scenario.ssp_xml import ANNOTATION
from exlinn_fmi.scenario.units import si_unit

VERSIONS = ("1.0", "2.0")

_SPACE = "http://ssp-standard.org/SSP1/SystemStructure"
_SPACES = {"ssd": f"{_SPACE}Description", "ssc": f"{_SPACE}Common", "ssv": f"{_SPACE}ParameterValues"}
_DATE = (1980, 1, 1, 0, 0, 0)
"""Of all files in the package, so that it depends on the scenario alone."""


def write_ssp(
    loaded: LoadedScenario, variables: Mapping[str, Sequence[Variable]], file: Path, version: str = "1.0"
) -> Path:
    """Write the components and connections of a scenario as a package.

    Args:
        loaded: the scenario.
        variables: those of its components, by name.
        file: the ``.ssp`` file to write.
        version: one of `VERSIONS`.

    Returns:
        The file.

    Raises:
        InputError: a part of the scenario cannot go into a package.
        StorageError: it cannot be written.
    """
    for prefix, space in _SPACES.items():
        ElementTree.register_namespace(prefix, space)
    package = _Package(loaded, variables, version)
    root = package.description()
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {STRUCTURE: text, **package.files}.items():
            archive.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
    write_bytes(file, stream.getvalue())
    return file


def _element(parent: ElementTree.Element | None, tag: str, **attributes: str) -> ElementTree.Element:
    """A new element ``prefix:Name`` below a parent."""
    prefix, _, local = tag.partition(":")
    full = f"{{{_SPACES[prefix]}}}{local}"
    if parent is None:
        return ElementTree.Element(full, attributes)
    return ElementTree.SubElement(parent, full, attributes)


class _Package:
    """The description as it is put together, and the files that go along."""

    def __init__(
        self, loaded: LoadedScenario, variables: Mapping[str, Sequence[Variable]], version: str
    ) -> None:
        self.loaded, self.version = loaded, version
        self.variables = {name: {v.name: v for v in found} for name, found in variables.items()}
        self.files: dict[str, bytes] = {}
        self.units: dict[str, SiUnit] = {}

    def description(self) -> ElementTree.Element:
        """The whole description."""
        scenario = self.loaded.scenario
        root = _element(None, "ssd:SystemStructureDescription", version=self.version, name=scenario.name)
        if scenario.description:
            root.set("description", scenario.description)
        system = _element(root, "ssd:System", name=scenario.name)
        elements = _element(system, "ssd:Elements")
        for name in scenario.components:
            self._component(elements, name)
        connections = _element(system, "ssd:Connections")
        for source, link in scenario.links():
            self._connection(connections, source, link.to, link.factor, link.offset, link.convert)
        if self.units:
            units = _element(root, "ssd:Units")
            for name, si in sorted(self.units.items()):
                bases = zip(("kg", "m", "s", "A", "K", "mol", "cd", "rad"), si.powers, strict=True)
                attributes = {base: str(power) for base, power in bases if power}
                if (si.factor, si.offset) != (1.0, 0.0):
                    attributes |= {"factor": repr(si.factor), "offset": repr(si.offset)}
                _element(_element(units, "ssc:Unit", name=name), "ssc:BaseUnit", **attributes)
        if scenario.simulate is not None:
            span = {"startTime": repr(scenario.simulate.start), "stopTime": repr(scenario.simulate.stop)}
            _element(root, "ssd:DefaultExperiment", **span)
        kept = scenario.model_dump(
            mode="json", exclude_unset=True, include={"seed", "events", "simulate", "metrics"}
        )
        self._annotate(root, "ssd:Annotations", kept)
        return root

    def _component(self, parent: ElementTree.Element, name: str) -> None:
        """A component with its connectors and start values."""
        spec = self.loaded.scenario.components[name]
        section = spec.model_dump(mode="json", exclude_unset=True)
        starts = section.pop("start", {})
        element = _element(parent, "ssd:Component", name=name)
        if isinstance(spec, FmuComponent):
            element.set("type", FMU)
            element.set("source", self._fmu(self.loaded.folder / section.pop("fmu")))
            if (interface := section.pop("interface", None)) is not None:
                element.set("implementation", interface.title().replace("_", ""))
        else:
            element.set("type", OWN)
            element.set("source", f"#{name}")  # which SSP 1.0 demands
            self._pack_files(name)
        used = {
            end.split(".", 1)[1]
            for pair in self.loaded.scenario.connection_list()
            for end in pair
            if end.startswith(f"{name}.")
        }
        connectors = _element(element, "ssd:Connectors")
        for variable in self.variables[name].values():
            through = variable.causality in ("input", "output")
            if through or variable.name in starts or variable.name in used:
                self._connector(connectors, variable)
        if starts:
            self._parameters(element, name, starts)
        self._annotate(element, "ssd:Annotations", section)

    def _connector(self, parent: ElementTree.Element, variable: Variable) -> None:
        kind = {"independent": "local"}.get(variable.causality, variable.causality)
        connector = _element(parent, "ssd:Connector", name=variable.name, kind=kind)
        if variable.type != "Enumeration":  # whose items we do not know
            attributes = {}
            si = variable.si or (si_unit(variable.unit) if variable.unit else None)
            if variable.type == "Real" and variable.unit and si is not None:
                attributes["unit"] = variable.unit
                if self.units.setdefault(variable.unit, si) != si:
                    raise InputError(
                        f"unit {variable.unit!r} means one thing here and another there (see {variable.name})"
                    )
            _element(connector, f"ssc:{variable.type}", **attributes)

    def _parameters(self, parent: ElementTree.Element, name: str, starts: Mapping[str, Any]) -> None:
        """Start values as a parameter set."""
        values = _element(
            _element(_element(parent, "ssd:ParameterBindings"), "ssd:ParameterBinding"), "ssd:ParameterValues"
        )
        parameters = _element(
            _element(values, "ssv:ParameterSet", version=self.version, name=name), "ssv:Parameters"
        )
        for key, value in starts.items():
            kind = self.variables[name][key].type
            if kind == "Boolean":
                tag, text = "Boolean", "true" if value else "false"
            elif kind == "Real":
                tag, text = "Real", repr(float(value))
            else:
                tag, text = "Integer", str(int(value))
            _element(_element(parameters, "ssv:Parameter", name=key), f"ssv:{tag}", value=text)

    def _connection(
        self,
        parent: ElementTree.Element,
        source: str,
        target: str,
        factor: float,
        offset: float,
        convert: bool,
    ) -> None:
        (tail, output), (head, variable) = source.split(".", 1), target.split(".", 1)
        ends = {"startElement": tail, "startConnector": output, "endElement": head, "endConnector": variable}
        connection = _element(parent, "ssd:Connection", **ends)
        if not convert:
            connection.set("suppressUnitConversion", "true")
        if (factor, offset) != (1.0, 0.0):
            _element(connection, "ssc:LinearTransformation", factor=repr(factor), offset=repr(offset))

    def _annotate(self, parent: ElementTree.Element, tag: str, content: Mapping[str, Any]) -> None:
        """Put what SSP has no words for beside an element."""
        if content:
            annotation = _element(_element(parent, tag), "ssc:Annotation", type=ANNOTATION)
            data = ElementTree.SubElement(annotation, f"{{urn:{ANNOTATION}}}data")
            data.text = json.dumps(content, ensure_ascii=False)

    # ── files ────────────────────────────────────────────────────────────────────────────────────────────

    def _fmu(self, path: Path) -> str:
        """Name in the package of an FMU."""
        content, number = path.read_bytes(), 1
        name = f"resources/{path.name}"
        while self.files.get(name, content) != content:
            number += 1
            name = f"resources/{path.stem}_{number}.fmu"
        self.files[name] = content
        return name

    def _pack_files(self, name: str) -> None:
        """Files that a component names, at the same place below the scenario.

        Raises:
            InputError: they are not below it, or are still to be made.
        """
        spec = self.loaded.scenario.components[name]
        model = spec.model if isinstance(spec, ModelComponent) else ""
        model = spec.nmpc.model if isinstance(spec, NmpcComponent) else model
        if model == "learned":
            raise InputError(
                f"components.{name}: a model that is still to be learned cannot go into a package; train it, "
                "and name its folder (--set)"
            )
        for place in named_files(spec, folder=self.loaded.folder):
            if PurePosixPath(place).is_absolute() or ".." in PurePosixPath(place).parts:
                raise InputError(
                    f"components.{name}: {place!r} is not below the scenario's folder; move it there"
                )
            self.files[place] = (self.loaded.folder / place).read_bytes()

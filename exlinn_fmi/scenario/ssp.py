"""SSP: systems of FMUs as other tools exchange them, read into a scenario.

A system structure description (``.ssd``, alone or in a package ``.ssp``) is flattened: nested systems, other
descriptions and packages become components side by side, connections are followed through the connectors of
systems and through signal dictionaries, with conversions of units and linear transformations on their way,
parameter bindings become start values.

Reference: System Structure and Parameterization 1.0 and 2.0, ssp-standard.org.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

from ruamel.yaml import YAML

from exlinn_fmi.components.archive import LARGEST_XML, extract, open_archive, parse_xml
from exlinn_fmi.components.base import Variable
from exlinn_fmi.components.cache import Lease, lease
from exlinn_fmi.errors import InputError, Problem, ScenarioError, StorageError
from exlinn_fmi.scenario.ssp_system import Bound, Edge, ElementPath, Flat, Node, System, dotted
from exlinn_fmi.scenario.ssp_xml import annotation, children, first, number, tag_of, transformation, units_of

SUFFIXES = (".ssp", ".ssd")
STRUCTURE = "SystemStructure.ssd"
FMU, DEFINITION, PACKAGE = (
    f"application/x-{kind}" for kind in ("fmu-sharedlibrary", "ssp-definition", "ssp-package")
)
OWN = "application/x-exlinn-component"
"""Type of components that are no FMUs, with their section of a scenario as an annotation."""
STEPS = 1000
"""Steps of a run where nothing says how long one is."""

_SOURCES = ("output", "calculatedParameter", "constant", "local")
_TARGETS = ("input", "parameter", "structuralParameter")

Look = Callable[[Path], Sequence[Variable]]
"""Finds the variables of an FMU."""
_held: list[Lease] = []
"""Unpacked packages that this process uses until it ends."""


def scenario_text(file: Path, look: Look) -> tuple[str, Path]:
    """A scenario in YAML that does what a system description or package says, and the folder of its files.

    Args:
        file: an ``.ssp`` or ``.ssd`` file.
        look: finds the variables of an FMU.

    Raises:
        ScenarioError: the file or one of those that it names cannot be used.
    """
    try:
        folder = _unpacked(file) if file.suffix == ".ssp" else file.parent
        structure = folder / STRUCTURE if file.suffix == ".ssp" else file
        reader = _Reader(look, packaged=file.suffix == ".ssp")
        data = reader.scenario(structure)
    except InputError as error:
        raise ScenarioError(str(file), [Problem("", line) for line in str(error).splitlines()]) from error
    except ValueError as error:  # of int and float: an attribute that SSP has as a number
        raise ScenarioError(str(file), [Problem("", f"an attribute is no number: {error}")]) from error
    except RecursionError as error:
        raise ScenarioError(
            str(file), [Problem("", "systems are nested too deeply, or in each other")]
        ) from error
    stream = io.StringIO()
    yaml = YAML()
    yaml.width = 4096
    yaml.dump(data, stream)
    return stream.getvalue(), folder


def _unpacked(file: Path) -> Path:
    """Folder of an unpacked package, in use until this process ends.

    Raises:
        InputError: the package cannot be used.
        StorageError: there is no room for it.
    """

    def fill(folder: Path) -> None:
        with open_archive(file) as archive:
            extract(file, archive, folder, lambda _: True)

    with open_archive(file):
        pass  # which tells what is wrong with it
    try:
        with file.open("rb") as stream:
            key = f"{hashlib.file_digest(stream, 'sha256').hexdigest()[:32]}-ssp"
        _held.append(lease(key, fill))
    except OSError as error:
        raise StorageError(f"{file}: cannot be unpacked: {error}") from error
    if not (_held[-1].folder / STRUCTURE).is_file():
        raise InputError(f"{file}: no {STRUCTURE} at the top of the archive")
    return _held[-1].folder


class _Reader:
    """Gathers a description and all that it names."""

    def __init__(self, look: Look, packaged: bool) -> None:
        self.look, self.packaged, self.system = look, packaged, System()
        self.problems: list[str] = []

    def scenario(self, structure: Path) -> dict[str, Any]:
        """The scenario as plain data.

        Raises:
            InputError: all that is wrong.
        """
        root = self._root(structure, "SystemStructureDescription")
        self._visit(first(root, "System"), (), structure, units_of(root), {})
        if self.problems:
            raise InputError("\n".join(dict.fromkeys(self.problems)))
        data = Flat(self.system).data()
        experiment = first(root, "DefaultExperiment")
        start, stop = (
            float(default if experiment is None else experiment.get(key, default))
            for key, default in (("startTime", "0"), ("stopTime", "1"))
        )
        simulate = {"start": start, "stop": stop, "step": (stop - start) / STEPS}
        name = re.sub(r"[^A-Za-z0-9_.-]+", "_", root.get("name") or structure.stem) or "system"
        about = {"name": name, "description": root.get("description") or f"system {root.get('name')}"}
        return about | data | {"simulate": simulate} | annotation(root)

    def _root(self, file: Path, tag: str) -> ElementTree.Element:
        """Root of an XML file of SSP.

        Raises:
            InputError: it is no such file, or of an unknown version.
        """
        if not file.is_file():
            raise InputError(f"{file.name}: no such file")
        if file.stat().st_size > LARGEST_XML:
            raise InputError(f"{file.name}: larger than {LARGEST_XML / 2**20:.0f} MiB")
        root = parse_xml(file.name, file.read_bytes())
        version = root.get("version", "")
        if tag_of(root) != tag or not re.match(r"[12]\.\d", version):
            found = f"<{tag_of(root)}> of version {version or '?'}"
            raise InputError(f"{file.name}: found {found}, expected <{tag}> of SSP 1.0 or 2.0")
        return root

    def _file(self, source: str, base: Path, what: str) -> Path:
        """The file that a URI means.

        Raises:
            InputError: it leads elsewhere, or there is none.
        """
        parts = urlsplit(source)
        path = PurePosixPath(unquote(parts.path))
        outside = path.is_absolute() or (self.packaged and ".." in path.parts)
        if parts.scheme or parts.netloc or "\\" in source or outside:
            raise InputError(f"{what}: {source!r} is no file beside the description")
        file = base.parent / path
        if not file.is_file():
            raise InputError(f"{what}: no such file {source!r}")
        return file

    def _visit(
        self,
        element: ElementTree.Element | None,
        path: ElementPath,
        base: Path,
        units: Mapping[str, Variable],
        dictionaries: Mapping[str, ElementPath],
    ) -> None:
        """A system: its connectors, elements, connections and parameters."""
        if element is None:
            raise InputError(f"{base.name}: there is no <System> in it")
        self._connectors(element, path, units)
        own = dict(dictionaries)
        for entry in children(element, "SignalDictionaries", "SignalDictionary"):
            own[entry.get("name", "")] = self._dictionary(entry, path, base)
        for child in children(element, "Elements", "*"):
            name = child.get("name", "")
            here = (*path, name)
            self.system.children.setdefault(path, []).append(name)
            try:
                if tag_of(child) == "System":
                    self._visit(child, here, base, units, own)
                elif tag_of(child) == "SignalDictionaryReference":
                    self._connectors(child, here, units)
                    if child.get("dictionary", "") not in own:
                        raise InputError(
                            f"{dotted(here)}: there is no dictionary {child.get('dictionary')!r}"
                        )
                    self.system.dictionaries[here] = own[child.get("dictionary", "")]
                elif tag_of(child) == "Component":
                    self._component(child, here, base, units)
            except InputError as error:
                self.problems += str(error).splitlines()
        for connection in children(element, "Connections", "Connection"):
            try:
                self._connect(connection, path)
            except InputError as error:
                self.problems += str(error).splitlines()
        self._bind(element, path, base)

    def _component(
        self, element: ElementTree.Element, path: ElementPath, base: Path, units: Mapping[str, Variable]
    ) -> None:
        """A component: an FMU, one of ours, or another description in its place."""
        kind, source, what = element.get("type") or FMU, element.get("source") or "", dotted(path)
        if kind in (DEFINITION, PACKAGE):
            file = self._file(source, base, what)
            inner, packaged = file, self.packaged
            if kind == PACKAGE:
                inner = _unpacked(file) / (urlsplit(source).fragment or STRUCTURE)
                self.packaged = True
            root = self._root(inner, "SystemStructureDescription")
            self._visit(first(root, "System"), path, inner, units_of(root), {})
            self.packaged = packaged
            self._bind(element, path, inner)
            return
        if kind == OWN:
            section, variables = annotation(element), dict[str, Variable]()
            if not section:
                raise InputError(f"{what}: nothing says what kind of component it is")
            if self.packaged and "python" in section:
                raise InputError(
                    f"{what}: the package brings Python code, which is not run; if you trust it, unpack the "
                    f"package and run its {STRUCTURE}"
                )
        elif kind == FMU:
            file = self._file(source, base, what)
            interface = {"CoSimulation": "co_simulation", "ModelExchange": "model_exchange"}.get(
                element.get("implementation", "")
            )
            section = {"fmu": file.absolute().as_posix()}
            section |= {"interface": interface} if interface else {}
            if self.packaged:
                section["isolate"] = True  # it came with the package, whoever made that
            section |= annotation(element)
            variables = {v.name: v for v in self.look(file)}
        else:
            raise InputError(f"{what}: components of type {kind!r} cannot be run; expected {FMU}")
        self.system.sections[path], self.system.variables[path] = section, variables
        self._connectors(element, path, units)
        self._bind(element, path, base)

    def _connectors(
        self, element: ElementTree.Element, path: ElementPath, units: Mapping[str, Variable]
    ) -> None:
        """Kinds and units of an element's connectors."""
        for connector in children(element, "Connectors", "Connector"):
            node = (path, connector.get("name", ""))
            self.system.kinds[node] = connector.get("kind", "unspecified")
            for kind in connector:
                if kind.get("unit") in units:
                    self.system.units[node] = units[kind.get("unit", "")]

    def _dictionary(self, element: ElementTree.Element, path: ElementPath, base: Path) -> ElementPath:
        """A signal dictionary: signals with units that are seen wherever it is referred to."""
        here = ("dictionary", *path, element.get("name", ""))
        root = first(element, "SignalDictionary")
        if root is None:
            file = self._file(element.get("source") or "", base, f"dictionary {here[-1]!r}")
            root = self._root(file, "SignalDictionary")
        units = units_of(root)
        for entry in children(root, "DictionaryEntry"):
            for kind in entry:
                if kind.get("unit") in units:
                    self.system.units[here, entry.get("name", "")] = units[kind.get("unit", "")]
        return here

    # ── connections ──────────────────────────────────────────────────────────────────────────────────────

    def _connect(self, element: ElementTree.Element, path: ElementPath) -> None:
        """A connection, in the direction that values go."""
        ends = [self._end(element, side, path) for side in ("start", "end")]
        (start, one), (end, other) = ends
        what = f"connection {dotted((*start[0], start[1]))} – {dotted((*end[0], end[1]))}"
        if one == other != 0:
            kind = "give" if one > 0 else "take"
            raise InputError(f"{what}: both of its ends {kind} values")
        forward = one > 0 or other < 0 or (one == 0 and other == 0)
        source, target = (start, end) if forward else (end, start)
        factor, offset = transformation(element, what)
        convert = element.get("suppressUnitConversion") not in ("true", "1")
        self.system.edges.setdefault(source, []).append(Edge(target, factor, offset, convert))

    def _end(self, element: ElementTree.Element, side: str, path: ElementPath) -> tuple[Node, int]:
        """An end of a connection: 1 if it gives values, −1 if it takes them, 0 if that is open."""
        name, connector = element.get(f"{side}Element"), element.get(f"{side}Connector", "")
        here = (*path, name) if name else path
        if name and name not in self.system.children.get(path, ()):
            raise InputError(f"connection to {dotted((*here, connector))}: there is no element {name!r}")
        if element.get(f"{side}Indices"):
            raise InputError(
                f"connection to {dotted((*here, connector))}: parts of arrays cannot be connected"
            )
        if here in self.system.dictionaries:
            return (self.system.dictionaries[here], connector), 0
        kind = self.system.kinds.get((here, connector))
        if kind in (None, "unspecified", "inout"):
            variable = self.system.variables.get(here, {}).get(connector)
            kind = variable.causality if variable is not None else None
        role = (kind in _SOURCES) - (kind in _TARGETS)
        return (here, connector), role if name else -role

    # ── parameters ───────────────────────────────────────────────────────────────────────────────────────

    def _bind(self, element: ElementTree.Element, path: ElementPath, base: Path) -> None:
        """Parameter sets of an element, in their order."""
        for binding in children(element, "ParameterBindings", "ParameterBinding"):
            try:
                values = self._parameters(binding, path, base)
            except InputError as error:
                self.problems += str(error).splitlines()
                continue
            self.system.bindings.append((path, values))

    def _parameters(
        self, binding: ElementTree.Element, path: ElementPath, base: Path
    ) -> dict[str, list[Bound]]:
        """Values of one binding by name, after its mapping."""
        what = f"parameters of {dotted(path) or 'the system'}"
        root = first(binding, "ParameterValues", "ParameterSet")
        if root is None:
            root = self._root(self._source(binding, path, base, what), "ParameterSet")
        units, prefix = units_of(root), binding.get("prefix") or ""
        items = {
            e.get("name"): {i.get("name"): i.get("value") for i in children(e, "Item")}
            for e in children(root, "Enumerations", "Enumeration")
        }
        found: dict[str, list[Bound]] = {}
        for parameter in children(root, "Parameters", "Parameter"):
            name = prefix + parameter.get("name", "")
            kind = next((c for c in parameter if tag_of(c) not in ("Dimension", "Annotations")), None)
            if kind is not None:
                known = items.get(kind.get("name"), {})
                found[name] = [Bound(number(kind, known, what), units.get(kind.get("unit") or ""))]
        mapping = first(binding, "ParameterMapping")
        if mapping is None:
            return found
        inner = first(mapping, "ParameterMapping")
        if inner is None:
            inner = self._root(self._source(mapping, path, base, what), "ParameterMapping")
        mapped: dict[str, list[Bound]] = {}
        for entry in children(inner, "MappingEntry"):
            factor, offset = transformation(entry, what)
            convert = entry.get("suppressUnitConversion") not in ("true", "1")
            for given in found.get(entry.get("source", ""), ()):
                value = Bound(given.value, given.unit, factor, offset, convert)
                mapped.setdefault(entry.get("target", ""), []).append(value)
        return mapped

    def _source(self, element: ElementTree.Element, path: ElementPath, base: Path, what: str) -> Path:
        if element.get("sourceBase") == "component":
            raise InputError(f"{what}: files inside of a component are not supported")
        return self._file(element.get("source") or "", base, what)

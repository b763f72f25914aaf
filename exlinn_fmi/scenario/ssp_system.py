"""A system of SSP as it was gathered from its files, and how it is laid flat.

Gathering is in `ssp.py`. Here connections are followed through the connectors of systems and through signal
dictionaries, with all that changes values on the way, and parameters are given to what their names mean.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from exlinn_fmi.components.base import Variable
from exlinn_fmi.errors import InputError
from exlinn_fmi.scenario.units import linear

ElementPath = tuple[str, ...]
Node = tuple[ElementPath, str]
"""A connector: the path of its element, and its name."""


@dataclass(frozen=True)
class Edge:
    """A connection between two connectors in the direction that values go."""

    target: Node
    factor: float
    offset: float
    convert: bool


@dataclass(frozen=True)
class Bound:
    """A value of a parameter set: number, truth or text, its unit, and its transformation by a mapping."""

    value: float | bool | str
    unit: Variable | None
    factor: float = 1.0
    offset: float = 0.0
    convert: bool = True


@dataclass
class System:
    """What was gathered of a description and all that is in it."""

    sections: dict[ElementPath, dict[str, Any]] = field(default_factory=dict)
    variables: dict[ElementPath, dict[str, Variable]] = field(default_factory=dict)
    children: dict[ElementPath, list[str]] = field(default_factory=dict)
    kinds: dict[Node, str] = field(default_factory=dict)
    units: dict[Node, Variable] = field(default_factory=dict)
    edges: dict[Node, list[Edge]] = field(default_factory=dict)
    bindings: list[tuple[ElementPath, dict[str, list[Bound]]]] = field(default_factory=list)
    dictionaries: dict[ElementPath, ElementPath] = field(default_factory=dict)


def dotted(path: Sequence[str]) -> str:
    """A path as it is written."""
    return ".".join(path)


class Flat:
    """A gathered system as components and connections side by side."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.names = _names(list(system.sections))
        self.starts: dict[ElementPath, dict[str, Any]] = {path: {} for path in system.sections}
        self.problems: list[str] = []

    def data(self) -> dict[str, Any]:
        """Components and connections as plain data.

        Raises:
            InputError: all that does not fit together.
        """
        connections: dict[str, list[Any]] = {}
        for path in self.system.sections:
            for node in [n for n in self.system.edges if n[0] == path]:
                source = self._variable(node)
                for target, factor, offset, changed in self._reach(node, source):
                    name = f"{self.names[target[0]]}.{target[1]}"
                    link: Any = name
                    if changed:
                        link = {"to": name, "factor": factor, "offset": offset, "convert": False}
                    connections.setdefault(f"{self.names[path]}.{node[1]}", []).append(link)
        # What is bound higher up comes later and so overrides what is bound below (SSP 2.0 §5.3.3).
        for path, values in sorted(self.system.bindings, key=lambda binding: -len(binding[0])):
            for name, several in values.items():
                for value in several:
                    self._apply(path, name, value)
        if self.problems:
            raise InputError("\n".join(dict.fromkeys(self.problems)))
        components = {
            self.names[path]: section
            | ({"start": section.get("start", {}) | self.starts[path]} if self.starts[path] else {})
            for path, section in self.system.sections.items()
        }
        joined = {k: v[0] if len(v) == 1 else v for k, v in connections.items()}
        return {"components": components, "connections": joined}

    def _variable(self, node: Node) -> Variable | None:
        """What has the unit of a connector: what the description says, else the FMU's variable."""
        return self.system.units.get(node) or self.system.variables.get(node[0], {}).get(node[1])

    def _reach(self, start: Node, unit: Variable | None) -> Iterator[tuple[Node, float, float, bool]]:
        """Components' connectors that a value comes to; factor, offset, and whether these must be stated."""
        ahead, seen = [(start, 1.0, 0.0, unit, False)], {start}
        while ahead:
            node, factor, offset, unit, changed = ahead.pop(0)
            for edge in self.system.edges.get(node, ()):
                to = self._variable(edge.target)
                step = self._conversion(unit, to, node, edge)
                a, b = step[0] * edge.factor, step[1] * edge.factor + edge.offset
                state = a * factor, a * offset + b
                must = changed or (a, b) != (1.0, 0.0) or not edge.convert
                if edge.target[0] in self.system.sections:
                    yield edge.target, *state, must
                elif edge.target not in seen:
                    seen.add(edge.target)
                    ahead.append((edge.target, *state, to or unit, must))

    def _conversion(
        self, unit: Variable | None, to: Variable | None, node: Node, edge: Edge
    ) -> tuple[float, float]:
        if unit is None or to is None or not edge.convert:
            return 1.0, 0.0
        found = linear(unit, to)
        if found is None:
            ends = (
                f"{dotted((*node[0], node[1]))} [{unit.unit}] → {dotted((*edge.target[0], edge.target[1]))}"
            )
            self.problems.append(f"unit mismatch: {ends} [{to.unit}]")
        return found or (1.0, 0.0)

    def _apply(self, path: ElementPath, name: str, value: Bound) -> None:
        """Give a value to all that the name means in an element; to nothing if it means nothing."""
        if path in self.system.sections:
            known = self.system.variables[path]
            if not known or name in known:
                self.starts[path][name] = self._start(known.get(name), value, (*path, name))
            return
        node = (path, name)
        if node in self.system.kinds:
            edge = Edge(node, value.factor, value.offset, value.convert)
            unit = self.system.units.get(node)
            factor, offset = self._conversion(value.unit, unit, node, edge)
            a, b = factor * value.factor, offset * value.factor + value.offset
            for target, f, o, _ in self._reach(node, unit or value.unit):
                whole = Bound(value.value, None, a * f, b * f + o, convert=False)
                self._apply(target[0], target[1], whole)
        for child in self.system.children.get(path, ()):
            if name.startswith(f"{child}."):
                self._apply((*path, child), name.removeprefix(f"{child}."), value)

    def _start(self, variable: Variable | None, value: Bound, path: ElementPath) -> Any:
        given = value.value
        factor, offset = 1.0, 0.0
        if variable is not None and value.unit is not None and value.convert:
            edge = Edge((path[:-1], path[-1]), 1.0, 0.0, True)
            factor, offset = self._conversion(value.unit, variable, (path[:-1], path[-1]), edge)
        a, b = factor * value.factor, offset * value.factor + value.offset
        if (a, b) == (1.0, 0.0):
            return given
        if isinstance(given, bool | str):
            self.problems.append(f"{dotted(path)}: {given!r} cannot be transformed")
            return given
        return a * given + b


def _names(paths: Sequence[ElementPath]) -> dict[ElementPath, str]:
    """Names in the scenario: those in the system, joined, without what our names may not have."""
    found: dict[ElementPath, str] = {}
    for path in paths:
        name = base = re.sub(r"\W", "_", "_".join(path), flags=re.ASCII)
        if not re.match(r"[A-Za-z_]", name):
            name = base = f"_{base}"
        number = 1
        while name in found.values():
            number += 1
            name = f"{base}_{number}"
        found[path] = name
    return found

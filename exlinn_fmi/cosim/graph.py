"""The connection graph: who feeds whom, in which order values travel, where loops break, in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from exlinn_fmi.components.base import Component, Variable
from exlinn_fmi.cosim.order import Broken, Edge, Port, Visit, Wiring, break_loops, visits
from exlinn_fmi.errors import InputError, nearest


@dataclass(frozen=True)
class Delay:
    """A place where a value is one communication point old, so that an order exists.

    Args:
        kind: ``connection``: the target is given the source's value of the communication point before;
            ``dependency``: source and target are an input and an output of one component that does not say
            whether the output depends on the input directly; the output is read as if it did not.
        source: where it begins, ``component.variable``.
        target: where it leads to, ``component.variable``.
        reason: why, in a sentence.
    """

    kind: Literal["connection", "dependency"]
    source: str
    target: str
    reason: str


class Graph:
    """Components and their connections.

    Args:
        components: by name, in the scenario's order, which decides among equals.
        connections: (from, to) pairs of ``component.variable``: an output and an input.

    Attributes:
        components: as given.
        names: names of the components; their position is the component number in ports.
        connections: as ports, in the order given.
        visits: what to set and get at a communication point, in order.
        order: each component once, in the order in which the outputs of each are first known.
        loops: algebraic loops: the variables of each.
        delays: where loops were broken.

    Raises:
        InputError: everything that is wrong with the connections.
    """

    def __init__(self, components: Mapping[str, Component], connections: Sequence[tuple[str, str]]) -> None:
        self.components = dict(components)
        self.names = tuple(self.components)
        self._parts = tuple(self.components.values())
        self._numbers = [{v.name: k for k, v in enumerate(c.variables)} for c in self._parts]
        self.connections = self._check(connections)
        self._sources = {i: o for o, i in self.connections}
        wiring = self._wiring()
        broken = break_loops(wiring)
        self.visits: tuple[Visit, ...] = tuple(visits(len(self.names), wiring, broken))
        self.order = tuple(dict.fromkeys(self.names[v.component] for v in self.visits))
        self.loops = tuple(tuple(map(self.path, loop)) for loop in broken.loops)
        self.delays = tuple(self._delays(broken))
        self.delayed: frozenset[Edge] = frozenset(broken.delayed)
        self._dependencies = wiring

    # ── ports ────────────────────────────────────────────────────────────────────────────────────────────

    def variable(self, port: Port) -> Variable:
        """The variable that a port stands for, be it of its value or of its rest."""
        variables = self._parts[port[0]].variables
        return variables[port[1] % len(variables)]

    def rest(self, port: Port) -> Port | None:
        """The port of what float64 lacks of a value, see `Variable.wide`; None where that is not told."""
        source = self._sources.get(port, port)
        if self.variable(port).wide is None or self.variable(source).wide is None:
            return None
        return port[0], port[1] + len(self._parts[port[0]].variables)

    def path(self, port: Port) -> str:
        """A port as ``component.variable``."""
        return f"{self.names[port[0]]}.{self.variable(port).name}"

    def port(self, path: str) -> Port:
        """The port of a ``component.variable``.

        Raises:
            InputError: there is no such component or variable; near names are offered.
        """
        name, _, variable = path.partition(".")
        if name not in self.components:
            raise InputError(f"{path}: no component {name!r}; {nearest(name, self.names, 'components')}")
        number = self.names.index(name)
        if variable not in self._numbers[number]:
            hint = nearest(variable, self._numbers[number], "variables")
            raise InputError(f"{path}: component {name!r} has no variable {variable!r}; {hint}")
        return number, self._numbers[number][variable]

    # ── making ───────────────────────────────────────────────────────────────────────────────────────────

    def _check(self, connections: Iterable[tuple[str, str]]) -> tuple[Edge, ...]:
        """Connections as ports.

        Raises:
            InputError: all that is wrong with them, one per line.
        """
        problems, edges, driven = list[str](), list[Edge](), dict[Port, str]()
        for source, target in connections:
            where = f"connection {source} → {target}"
            try:
                o, i = self.port(source), self.port(target)
            except InputError as error:
                problems.append(f"{where}: {error}")
                continue
            if (found := self.variable(o).causality) != "output":
                problems.append(
                    f"{where}: {source} is of causality {found}; a connection starts at an output"
                )
            elif (found := self.variable(i).causality) != "input":
                problems.append(f"{where}: {target} is of causality {found}; a connection ends at an input")
            elif i in driven:
                problems.append(f"{where}: {target} is driven by {driven[i]} already; remove one of the two")
            elif not _fits(self.variable(o), self.variable(i)):
                types = f"{self.variable(o).type} into {self.variable(i).type}"
                problems.append(f"{where}: types do not fit, {types}; connect variables of the same type")
            else:
                driven[i] = source
                edges.append((o, i))
        if problems:
            raise InputError("\n".join(problems))
        return tuple(edges)

    def _wiring(self) -> Wiring:
        """Dependencies between those variables that are connected."""
        inputs: list[set[Port]] = [set() for _ in self.names]
        for _, i in self.connections:
            inputs[i[0]].add(i)
        declared, unknown = dict[Port, set[Port]](), dict[Port, set[Port]]()
        for o in {o for o, _ in self.connections}:
            depends_on = self.variable(o).depends_on
            if depends_on is None:
                unknown[o] = inputs[o[0]]
            else:
                declared[o] = {i for i in inputs[o[0]] if self.variable(i).name in depends_on}
        return Wiring(self.connections, declared, unknown, [c.sampled for c in self._parts])

    def _delays(self, broken: Broken) -> Iterable[Delay]:
        for o, i in broken.delayed:
            loop = next(loop for loop in broken.loops if o in loop and i in loop)
            members = ", ".join(dict.fromkeys(self.names[port[0]] for port in loop))
            reason = f"algebraic loop through {members}: the value of the communication point before is used"
            yield Delay("connection", self.path(o), self.path(i), reason)
        for i, o in broken.assumed:
            reason = (
                f"{self.names[o[0]]} does not say whether {self.variable(o).name} depends on "
                f"{self.variable(i).name} directly; taken not to, or a loop would close"
            )
            yield Delay("dependency", self.path(i), self.path(o), reason)

    # ── words ────────────────────────────────────────────────────────────────────────────────────────────

    def describe(self, solver: str | None = None) -> str:
        """Components in order, connections, feed-through, order of values, loops and delays as plain text.

        Args:
            solver: what solves algebraic loops, None where they are broken by delays.
        """
        solved = f", solved at each communication point ({solver})" if solver else ""
        late = [d for d in self.delays if d.kind == "dependency" or not solver]
        sections = {
            "components, in the order in which their outputs are known": self._component_lines(),
            "connections": [self._connection_line(edge) for edge in self.connections],
            "inputs that keep their start values": self._open_inputs(),
            "direct feed-through between connected variables": self._feed_through_lines(),
            "order of values at a communication point": self._visit_lines(),
            f"algebraic loops{solved}": [" — ".join(loop) for loop in self.loops],
            "one step late": [f"{d.source} → {d.target}: {d.reason}" for d in late],
        }
        lines = list[str]()
        for title, content in sections.items():
            lines += [title, *(f"  {line}" for line in content or ["none"])]
        return "\n".join(lines)

    def _component_lines(self) -> list[str]:
        width = max(map(len, self.names), default=0)
        lines = []
        for name in self.order:
            number = self.names.index(name)
            counts = []
            for word, causality, end in (("inputs", "input", 1), ("outputs", "output", 0)):
                there = sum(v.causality == causality for v in self._parts[number].variables)
                connected = {edge[end] for edge in self.connections if edge[end][0] == number}
                counts.append(f"{len(connected)} of {there} {word} connected")
            sampled = ["sampled"] * self._parts[number].sampled
            lines.append(f"{name:<{width}}  {', '.join(counts + sampled)}")
        return lines

    def _connection_line(self, edge: Edge) -> str:
        units = [self.variable(port).unit for port in edge]
        text = f"{self.path(edge[0])} → {self.path(edge[1])}"
        if None in units or units[0] == units[1]:
            return f"{text} [{units[0] or units[1] or '-'}]"
        return f"{text} [{units[0]} → {units[1]}]"

    def _open_inputs(self) -> list[str]:
        driven = {i for _, i in self.connections}
        return [
            self.path((number, k))
            for number, component in enumerate(self._parts)
            for k, variable in enumerate(component.variables)
            if variable.causality == "input" and (number, k) not in driven
        ]

    def _feed_through_lines(self) -> list[str]:
        lines = []
        for known, mark in ((self._dependencies.declared, ""), (self._dependencies.unknown, " (not stated)")):
            for o in sorted(known):
                if known[o]:
                    names = _listed([self.variable(i).name for i in sorted(known[o])])
                    lines.append(f"{self.names[o[0]]}: {names} → {self.variable(o).name}{mark}")
        return lines

    def _visit_lines(self) -> list[str]:
        width = max(map(len, self.names), default=0)
        lines = []
        for visit in self.visits:
            variables = self._parts[visit.component].variables
            acts = [
                f"{verb} {_listed([variables[k].name for k in indices])}"
                for verb, indices in (("set", visit.inputs), ("get", visit.outputs))
                if indices
            ]
            if acts:  # a component without connections is visited for what is recorded of it
                lines.append(f"{self.names[visit.component]:<{width}}  {', '.join(acts)}")
        return lines


def _fits(source: Variable, target: Variable) -> bool:
    """Whether values of the source's type can be given to the target without loss."""
    accepted = {
        "Real": ("Real", "Integer", "Boolean", "Enumeration"),
        "Integer": ("Integer", "Boolean", "Enumeration"),
        "Enumeration": ("Integer", "Enumeration"),
        "Boolean": ("Boolean",),
        "String": ("String",),
        "Binary": ("Binary",),
    }
    return source.type in accepted[target.type]


def _listed(names: Sequence[str], most: int = 8) -> str:
    """Names with commas, the first ones only if there are many."""
    rest = f" … ({len(names) - most} more)" if len(names) > most else ""
    return ", ".join(names[:most]) + rest

"""The order in which values travel at a communication point: direct feed-through, loops and where they break.

Everything here is about ports, (component number, variable index) pairs, so that it can be tested on graphs
that no component stands behind. A connection leads from an output port to an input port; direct
feed-through leads from an input port to an output port of the same component, and is either declared or
unknown (the component does not say). Without loops there is an order of visits to the components in which
every value is up to date when it is passed on; a component is visited more than once where it must be, e.g.
a plant: its state is read first, and the input that a controller makes of it is set later.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass

Port = tuple[int, int]
"""Component number in the scenario's order, and index of the variable."""

Edge = tuple[Port, Port]
"""A connection (output, input) or a dependency (input, output)."""


@dataclass(frozen=True)
class Wiring:
    """All that the order of values depends on.

    Args:
        connections: (output, input) pairs; an input appears once at most.
        declared: inputs that an output depends on directly, by connected output.
        unknown: inputs that an output may depend on, by connected output.
        sampled: by component, whether its outputs hold between communication points (sources, controllers).
    """

    connections: tuple[Edge, ...]
    declared: Mapping[Port, Set[Port]]
    unknown: Mapping[Port, Set[Port]]
    sampled: Sequence[bool]


@dataclass(frozen=True)
class Broken:
    """What must be given up so that an order exists.

    Args:
        loops: algebraic loops: ports of each, all of whose dependencies are declared.
        delayed: connections that pass on the value of the communication point before.
        assumed: unknown dependencies (input, output) that are taken not to be there.
    """

    loops: tuple[tuple[Port, ...], ...]
    delayed: tuple[Edge, ...]
    assumed: tuple[Edge, ...]


@dataclass(frozen=True)
class Visit:
    """One visit to a component: set these inputs, then get these connected outputs.

    Args:
        component: its number.
        inputs: indices of the inputs to set, ascending.
        outputs: indices of the connected outputs to get, ascending.
        last: whether it is the component's last visit at a communication point: all is set then.
    """

    component: int
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    last: bool


def break_loops(wiring: Wiring) -> Broken:
    """Find all loops and break each where it costs least.

    A loop of declared feed-through is an algebraic loop: a connection is delayed by one step, if possible one
    into a sampled component, else one that leads back in the scenario's order. A loop that only closes
    through unknown dependencies is opened by taking those of one component not to be there, if possible one
    that is not sampled, the first in the scenario's order: nothing is lost where the guess is right.
    """
    connections, delayed = list(wiring.connections), list[Edge]()
    declared, unknown, assumed = _edges(wiring.declared), _edges(wiring.unknown), list[Edge]()
    loops = _loops(connections + declared)
    found = loops
    while found:
        chosen = {_cheapest(connections, set(loop), wiring.sampled) for loop in found}
        delayed += sorted(chosen)
        connections = [c for c in connections if c not in chosen]
        found = _loops(connections + declared)

    while found := _loops(connections + declared + unknown):
        for loop in map(set, found):
            inside = [(i, o) for i, o in unknown if i in loop and o in loop]
            _, component = min((wiring.sampled[i[0]], i[0]) for i, _ in inside)
            assumed += sorted((i, o) for i, o in inside if i[0] == component)
        gone = set(assumed)
        unknown = [edge for edge in unknown if edge not in gone]
    return Broken(tuple(map(tuple, loops)), tuple(delayed), tuple(assumed))


def visits(count: int, wiring: Wiring, broken: Broken) -> list[Visit]:
    """The visits at a communication point, such that every value that is passed on is up to date.

    Components whose inputs are all known come first, in the scenario's order; where there is none, the first
    component that can give an output without them is visited for that. Each has one last visit.

    Args:
        count: number of components.
        wiring: the connections and dependencies.
        broken: from `break_loops` of that wiring.
    """
    todo = _Agenda(count, wiring, broken)
    plan = list[Visit]()
    while todo.complete or todo.able:
        if todo.complete:
            component = heapq.heappop(todo.complete)
            plan.append(todo.visit(component, set(todo.ungot[component]), last=True))
        else:
            component = heapq.heappop(todo.able)[0]
            ready = {o for o in todo.ungot[component] if not todo.missing[o]}
            # Outputs of one component become able one by one but are read together.
            if ready:
                plan.append(todo.visit(component, ready, last=False))
    return plan


class _Agenda:
    """What is still to be set and got, and what can be done next.

    Attributes:
        ungot: by component, its connected outputs that were not read yet.
        missing: by connected output, how many of the inputs that it needs have no value yet.
        complete: heap of components whose inputs all have values, and that had no last visit.
        able: heap of outputs that can be read.
    """

    def __init__(self, count: int, wiring: Wiring, broken: Broken) -> None:
        delayed, assumed = set(broken.delayed), set(broken.assumed)
        live = [c for c in wiring.connections if c not in delayed]
        waiting = {i for _, i in live}
        self._fanout = _targets(live)
        self._unset = [set[Port]() for _ in range(count)]
        self.ungot = [set[Port]() for _ in range(count)]
        for o, i in wiring.connections:
            self.ungot[o[0]].add(o)
            self._unset[i[0]].add(i)
        self._needs = {o: set(wiring.declared.get(o, ())) for outputs in self.ungot for o in outputs}
        for o, inputs in self._needs.items():
            inputs |= {i for i in wiring.unknown.get(o, ()) if (i, o) not in assumed}
        self._feeds = _targets(_edges(self._needs))
        self._open = [len(inputs & waiting) for inputs in self._unset]
        self.missing = {o: len(inputs & waiting) for o, inputs in self._needs.items()}
        self.complete = [c for c, n in enumerate(self._open) if not n]
        self.able = sorted(o for o, n in self.missing.items() if not n)

    def visit(self, component: int, outputs: set[Port], last: bool) -> Visit:
        """Read `outputs`, having set the inputs that they need, or all on the last visit."""
        needed = set[Port]().union(*(self._needs[o] for o in outputs))
        inputs = set(self._unset[component] if last else self._unset[component] & needed)
        self._unset[component] -= inputs
        self.ungot[component] -= outputs
        for target in (i for o in sorted(outputs) for i in self._fanout[o]):
            self._open[target[0]] -= 1
            if not self._open[target[0]]:
                heapq.heappush(self.complete, target[0])
            for o in self._feeds[target]:
                self.missing[o] -= 1
                if not self.missing[o]:
                    heapq.heappush(self.able, o)
        return Visit(component, _indices(inputs), _indices(outputs), last)


# ── edges and loops ──────────────────────────────────────────────────────────────────────────────────────


def _edges(dependencies: Mapping[Port, Set[Port]]) -> list[Edge]:
    """Dependencies as (input, output) pairs, in a fixed order."""
    return sorted((i, o) for o, inputs in dependencies.items() for i in inputs)


def _targets(edges: Iterable[Edge]) -> defaultdict[Port, list[Port]]:
    """Where the edges from each port lead to."""
    targets = defaultdict[Port, list[Port]](list)
    for start, end in edges:
        targets[start].append(end)
    return targets


def _indices(ports: Set[Port]) -> tuple[int, ...]:
    """Variable indices of ports of one component, ascending."""
    return tuple(sorted(index for _, index in ports))


def _cheapest(connections: Sequence[Edge], loop: Set[Port], sampled: Sequence[bool]) -> Edge:
    """The connection in a loop that is delayed to break it."""
    inside = [(o, i) for o, i in connections if o in loop and i in loop]
    return min(inside, key=lambda c: (not sampled[c[1][0]], c[0][0] < c[1][0], c[1], c[0]))


def _loops(edges: Sequence[Edge]) -> list[list[Port]]:
    """Strongly connected sets of more than one port, each sorted, by their first port (Tarjan 1972)."""
    targets = _targets(edges)
    number, low = dict[Port, int](), dict[Port, int]()
    stack, on_stack, found = list[Port](), set[Port](), list[list[Port]]()
    for root in sorted(targets):
        path = [] if root in number else [(root, iter(targets[root]))]
        while path:
            port, ahead = path[-1]
            if port not in number:
                number[port] = low[port] = len(number)
                stack.append(port)
                on_stack.add(port)
            for target in ahead:
                if target not in number:
                    path.append((target, iter(targets.get(target, ()))))
                    break
                if target in on_stack:
                    low[port] = min(low[port], number[target])
            else:
                path.pop()
                if path:
                    low[path[-1][0]] = min(low[path[-1][0]], low[port])
                if low[port] == number[port]:
                    cut = stack.index(port)
                    members, stack[cut:] = stack[cut:], []
                    on_stack.difference_update(members)
                    if len(members) > 1:
                        found.append(sorted(members))
    return sorted(found)

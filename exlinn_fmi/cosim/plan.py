"""The work at a communication point as plain array work: the signal vector and who reads and writes it.

All values that are passed on or recorded live in one vector, `Plan.signals`, whose first entry is the time.
Each visit of the graph owns two pieces of it, the inputs to set and the variables to get, so that a component
reads and writes the vector itself, and a connection is part of one gather between pieces. Whoever steps in
another way (compiled, with rollback, solving loops) finds all indices here.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values
from exlinn_fmi.components.texts import keep, kept
from exlinn_fmi.cosim.exchange import Advance, Exchange, Warned
from exlinn_fmi.cosim.extrapolation import Extrapolation, ExtrapolationOptions
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.loops import LoopOptions, Loops
from exlinn_fmi.cosim.order import Port
from exlinn_fmi.errors import ComponentError, InputError, RunError


class Plan:
    """The work at each tick k, t = start + k · step, laid out before the run begins.

    Args:
        graph: components and connections.
        components: the graph's components, possibly wrapped, in its order.
        recorded: variables to record.
        every: own step in ticks, by component number.
        ticks: number of the last tick.
        loops: the algebraic loops, where they are solved.
        extrapolation: the inputs that are extrapolated, where they are.
        step: step of the master [s].
        gauss_seidel: whether inputs are refreshed from components already stepped.
        loops: how algebraic loops are solved; without it they are broken by delays.
        extrapolation: how inputs go on over a step; without it they are held.

    Attributes:
        signals: the time, and the value of every variable that is passed on or recorded.
        ahead: with Gauss–Seidel, the values after a step that later steps of the same tick take.
        visits: the exchanges of a communication point in order, each with its component's own step in ticks.
        advances: the steps in order.
        hold_to, hold_from: places in `signals` of delayed values, and of what they are next.
        ticks: number of the last tick.
        loops: the algebraic loops, where they are solved.
        extrapolation: the inputs that are extrapolated, where they are.
        columns: where time and recorded variables are in `signals`.
        warnings: by component name.
    """

    def __init__(
        self,
        graph: Graph,
        components: Sequence[Component],
        recorded: Sequence[Port],
        every: Sequence[int],
        ticks: int,
        step: float,
        gauss_seidel: bool,
        loops: LoopOptions | None = None,
        extrapolation: ExtrapolationOptions | None = None,
    ) -> None:
        self.graph, self.components = graph, tuple(components)
        self.warnings: dict[str, Warned] = {}
        self.ticks = ticks
        self._lay_out(recorded)
        self.visits = [
            (every[v.component], self._exchange_of(v.component, self.signals, given, taken))
            for v, given, taken in self._pieces
        ]
        self.advances = self._plan_advances(every, step, gauss_seidel)
        self.loops = Loops(self, self._torn, loops) if loops is not None and self._torn else None
        self.extrapolation = (
            Extrapolation(self, every, set(self._fresh), extrapolation)
            if extrapolation is not None and extrapolation.order
            else None
        )

    # ── layout ───────────────────────────────────────────────────────────────────────────────────────────

    def _lay_out(self, recorded: Sequence[Port]) -> None:
        """Give every variable its place in the signal vector."""
        graph, places, size = self.graph, dict[Port, int](), 1

        def piece(ports: Iterable[Port]) -> dict[Port, int]:
            nonlocal size
            ports = list(ports)
            ports += [rest for port in ports if (rest := graph.rest(port)) is not None]
            new = {port: size + k for k, port in enumerate(ports)}
            size += len(new)
            return new

        connected = {port for edge in graph.connections for port in edge}
        moving = ("output", "local", "independent")
        extra = [p for p in recorded if p not in connected and graph.variable(p).causality in moving]
        self._pieces = []
        for visit in graph.visits:
            number = visit.component
            given = piece((number, k) for k in visit.inputs)
            also = [p for p in extra if visit.last and p[0] == number]
            taken = piece([*((number, k) for k in visit.outputs), *also])
            self._pieces.append((visit, given, taken))
            places |= given | taken
        still = [p for p in sorted(recorded) if p not in places]
        constants = [piece(ports) for _, ports in groupby(still, key=lambda p: p[0])]
        late = sorted({o for o, _ in graph.delayed})
        held = [piece(ports) for _, ports in groupby(late, key=lambda p: p[0])]
        for ports in constants:
            places |= ports
        holds = {port: place for ports in held for port, place in ports.items()}
        self._torn = list(holds)

        self.signals: Values = np.zeros(size)
        rests = [rest for p in recorded if (rest := graph.rest(p)) is not None]
        self.columns = _indices([0, *(places[p] for p in [*recorded, *rests])])
        self._source = {i: (holds if (o, i) in graph.delayed else places)[o] for o, i in graph.connections}
        for o, i in graph.connections:
            if (upper := graph.rest(o)) is not None and (lower := graph.rest(i)) is not None:
                self._source[lower] = (holds if (o, i) in graph.delayed else places)[upper]
        self._constants = [self._exchange_of(_number(p), self.signals, {}, p) for p in constants]
        self._before_first = [self._exchange_of(_number(p), self.signals, {}, p) for p in held]
        self.hold_to = _indices(holds.values())
        self.hold_from = _indices(places[port] for port in holds)

    def _exchange_of(
        self,
        number: int,
        vector: Values,
        given: Mapping[Port, int],
        taken: Mapping[Port, int],
        source: Mapping[Port, int] | None = None,
    ) -> Exchange:
        """An exchange whose pieces lie in `vector`; the values to set come from the places `source`."""
        source = self._source if source is None else source
        component = self.components[number]
        return Exchange(
            number,
            component.set,
            _indices(k for _, k in given) if given else None,
            _indices(source[port] for port in given),
            vector[_span(given)],
            component.get,
            _indices(k for _, k in taken) if taken else None,
            vector[_span(taken)],
        )

    def _plan_advances(self, every: Sequence[int], step: float, gauss_seidel: bool) -> list[Advance]:
        """Steps in the graph's order.

        With Gauss–Seidel, an input is refreshed if its source was stepped before and over the same time, and
        neither of the two is sampled: sampled components hold what they gave and what they took.
        """
        graph = self.graph
        numbers = [graph.names.index(name) for name in graph.order]
        turn = {number: k for k, number in enumerate(numbers)}
        fresh = {
            i: o
            for o, i in graph.connections
            if gauss_seidel
            and turn[o[0]] < turn[i[0]]
            and every[o[0]] == every[i[0]]
            and not (self.components[o[0]].sampled or self.components[i[0]].sampled)
            and (o, i) not in graph.delayed
        }
        pairs = [(graph.rest(i), graph.rest(o)) for i, o in fresh.items()]
        fresh |= {i: o for i, o in pairs if i is not None and o is not None}
        self._fresh = fresh
        ports = [*sorted(set(fresh.values())), *sorted(fresh)]
        place = {port: k for k, port in enumerate(ports)}
        self.ahead: Values = np.zeros(len(ports))
        source = {i: place[o] for i, o in fresh.items()}
        advances = []
        for n in numbers:
            given = {p: place[p] for p in sorted(fresh) if p[0] == n}
            taken = {p: place[p] for p in sorted(set(fresh.values())) if p[0] == n}
            before = self._exchange_of(n, self.ahead, given, {}, source) if given else None
            after = self._exchange_of(n, self.ahead, {}, taken, source) if taken else None
            advances.append(Advance(n, every[n], every[n] * step, self.components[n].step, before, after))
        return advances

    # ── work ─────────────────────────────────────────────────────────────────────────────────────────────

    def initialize(self, start: float, stop: float, starts: Mapping[str, Mapping[str, Number]]) -> None:
        """Initialise all components, with initial values passed through the connections.

        Args:
            start: start time [s].
            stop: stop time [s].
            starts: start values by component and variable.

        Raises:
            InputError: a start value that a component does not take.
            RunError: a component failed.
        """
        for number, (name, component) in enumerate(zip(self.graph.names, self.components, strict=True)):
            try:
                status = component.enter_initialization(start, stop, starts.get(name, {}))
            except (InputError, RunError):
                raise
            except Exception as error:
                raise self.wrapped(number, error, start) from error
            if status:
                self.judge(number, status, "initialisation", start)
        for exchange in self._before_first:
            self.exchange(exchange, self.signals, start)
        self.propagate(0, start)
        for number, component in enumerate(self.components):
            try:
                status = component.exit_initialization()
            except Exception as error:
                raise self.wrapped(number, error, start) from error
            if status:
                self.judge(number, status, "the end of initialisation", start)
        for exchange in self._constants:
            self.exchange(exchange, self.signals, start)

    def propagate(self, k: int, t: float) -> None:
        """Pass values through all connections of the components due at tick k.

        Args:
            k: number of the tick.
            t: its time [s].

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """
        signals = self.signals
        signals[0] = t
        for every, exchange in self.visits:
            if not k % every:
                self.exchange(exchange, signals, t)
        self.pass_on(k, t)

    def pass_on(self, k: int, t: float) -> None:
        """Give delayed values on to the next tick, or solve the loops that they stand for.

        Raises:
            LoopError: a loop has no solution that was found.
        """
        if self.loops is not None:
            self.loops.close(k, t)
        elif self.hold_to.size:
            self.signals[self.hold_to] = self.signals[self.hold_from]

    def advance(self, k: int, t: float) -> None:
        """Step the components due at tick k, each over its own step.

        Args:
            k: number of the tick.
            t: its time [s].

        Raises:
            RunError: a component failed or gave a value that is not finite.
        """
        for a in self.advances:
            # A last own step that leads beyond the end is left out: nobody would read what comes of it.
            if not k % a.every and k + a.every <= self.ticks:
                self.step(a, t, a.h)

    def step(self, a: Advance, t: float, h: float) -> None:
        """Step one component from t to t + h [s].

        Raises:
            RunError: it failed or gave a value that is not finite.
        """
        if a.before is not None:
            self.exchange(a.before, self.ahead, t)
        try:
            if self.extrapolation is not None and self.extrapolation.concerns(a.component):
                self.extrapolation.prepare(a.component, t, h)
            status = a.step(t, h)
        except Exception as error:
            raise self.wrapped(a.component, error, t) from error
        if status:
            self.judge(a.component, status, "the step", t)
        if a.after is not None:
            self.exchange(a.after, self.ahead, t + h)

    def exchange(self, x: Exchange, vector: Values, t: float) -> None:
        """Do an exchange with inputs from `vector`, and check what comes of it."""
        if x.inputs is not None:
            x.given[:] = vector[x.sources]
        self.trade(x, t)
        # Sum of squares: several times faster than isfinite, and finite only if all are.
        if x.outputs is not None and not x.taken.dot(x.taken) < math.inf:
            self.check_finite(x, t)

    def trade(self, x: Exchange, t: float) -> None:
        """Set what is given and get what is taken of a component."""
        try:
            if x.inputs is not None and (status := x.set(x.inputs, x.given)):
                self.judge(x.component, status, "setting inputs", t)
            if x.outputs is not None and (status := x.get(x.outputs, x.taken)):
                self.judge(x.component, status, "reading outputs", t)
        except RunError:
            raise
        except Exception as error:
            raise self.wrapped(x.component, error, t) from error

    def places(self, piece: Values) -> range:
        """Where a piece of `signals` lies in it."""
        first = (piece.ctypes.data - self.signals.ctypes.data) // self.signals.itemsize
        return range(first, first + len(piece))

    # ── checkpoints ──────────────────────────────────────────────────────────────────────────────────────

    def save(self) -> dict[str, Any]:
        """All that is needed to go on from here, in plain values.

        Raises:
            NotImplementedError: a component cannot write its state; the text names all that cannot.
        """
        states, problems = {}, []
        for name, component in zip(self.graph.names, self.components, strict=True):
            try:
                if component.can_serialize_state:
                    states[name] = component.serialize_state(component.save_state())
                else:
                    problems.append(f"{name}: it has no way to")
            except NotImplementedError as error:
                problems.append(f"{name}: {error}")
        if problems:
            raise NotImplementedError("; ".join(problems))
        warnings = {name: [warned.count, warned.first] for name, warned in self.warnings.items()}
        return {
            "components": states,
            "texts": kept(),
            "signals": self.signals,
            "ahead": self.ahead,
            "warnings": warnings,
            "loops": None if self.loops is None else self.loops.save(),
            "extrapolation": None if self.extrapolation is None else self.extrapolation.save(),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from what `save` gave, in components that are initialised alike."""
        keep(state["texts"])
        for name, component in zip(self.graph.names, self.components, strict=True):
            component.restore_state(component.deserialize_state(state["components"][name]))
        self.signals[:], self.ahead[:] = state["signals"], state["ahead"]
        self.warnings = {name: Warned(*warned) for name, warned in state["warnings"].items()}
        if self.loops is not None:
            self.loops.restore(state["loops"])
        if self.extrapolation is not None:
            self.extrapolation.restore(state["extrapolation"])

    # ── failure ──────────────────────────────────────────────────────────────────────────────────────────

    def check_finite(self, x: Exchange, t: float) -> None:
        """Name the first value that is not finite; the square of a large one may overflow without harm.

        Raises:
            ComponentError: there is one.
        """
        wrong = np.flatnonzero(~np.isfinite(x.taken))
        if wrong.size and x.outputs is not None:
            variable = self.graph.variable((x.component, int(x.outputs[wrong[0]]))).name
            message = f"the value is {x.taken[wrong[0]]}, expected a finite number"
            raise ComponentError(self.graph.names[x.component], message, variable, t)

    def warn(self, number: int, text: str) -> None:
        """Count a warning of a component."""
        warned = self.warnings.setdefault(self.graph.names[number], Warned(0, text))
        warned.count += 1

    def judge(self, number: int, status: int, what: str, t: float) -> None:
        """Count a warning; stop on anything worse.

        Raises:
            ComponentError: status DISCARD or beyond.
        """
        name, said = self.graph.names[number], self.components[number].message or "no text"
        if status == Status.WARNING:
            self.warn(number, f"{what} at t = {t:.9g} s: {said}")
            return
        word = status.name if isinstance(status, Status) else repr(status)
        raise ComponentError(name, f"{what} ended with status {word}: {said}", time=t)

    def wrapped(self, number: int, error: Exception, t: float) -> RunError:
        """An exception out of a component's code as an error that names the component and the place."""
        if isinstance(error, RunError):
            return error
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(frame.filename).name}:{frame.lineno}"
        return ComponentError(self.graph.names[number], f"{type(error).__name__}: {error} ({place})", time=t)


def _indices(numbers: Iterable[int]) -> Indices:
    return np.array(list(numbers), dtype=np.intp)


def _span(places: Mapping[Port, int]) -> slice:
    """The piece of a vector that adjacent places make."""
    return slice(min(places.values()), max(places.values()) + 1) if places else slice(0, 0)


def _number(ports: Mapping[Port, int]) -> int:
    """Number of the component that ports belong to."""
    return next(iter(ports))[0]

"""What an FMU is made from: named x, u, p, y and the equations (x, u, p) → (ẋ, y) of any system."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, state_units
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol, bind, longest_step
from exlinn_fmi.mechanics.expansion import Expansion, Network
from exlinn_fmi.mechanics.plant import Plant

SOLVER_STEP = "solver_step"
"""Name of the parameter that bounds the internal step of Co-Simulation [s]."""

_EFFORT = {"mechanical": "generalised force", "electrical": "voltage"}

Role = Literal["state", "input", "parameter", "setting", "derivative", "output", "time"]
Ranges = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Quantity:
    """A variable of the FMU.

    Args:
        name: FMI structured name.
        unit: SI unit, empty for none.
        description: one line.
        start: start value of what is known before the start: states, inputs, parameters.
        role: what it is to the model.
        limits: smallest and largest usual value, None where nothing is known.
        boolean: whether it is a truth value.
        sampled: whether it changes at ticks only.
    """

    name: str
    unit: str = ""
    description: str = ""
    start: float = 0.0
    role: Role = "output"
    limits: tuple[float, float] | None = None
    boolean: bool = False
    sampled: bool = False

    @property
    def nominal(self) -> float:
        """Its order of magnitude: the largest size that is usual, 1 where nothing is known."""
        size = max(map(abs, self.limits or (self.start,)))
        return size if size > 0 and math.isfinite(size) else 1.0


@dataclass(frozen=True)
class StateSpaceModel:
    """A model ẋ = f(x, u, p), y = g(x, u, p) ready for export.

    The *known* values are z = (x, u, p); `equations` maps them on the *unknown* ones, (ẋ, y). With the
    settings between the two they are the array that value references index.

    Args:
        identifier: C identifier, the name of the binary.
        description: one line.
        states: x; outputs of the FMU whose start can be set.
        inputs: u.
        parameters: p.
        derivatives: ẋ; outputs of the FMU except those named ``der(…)``.
        outputs: y, outputs beyond states and derivatives.
        equations: z → (ẋ, y), a CasADi function of one column; with a network inside (z, r) → (ẋ, y), where
            r is what the network gives: its outputs and then, feature by feature, their slopes.
        solver_step: longest internal step of Co-Simulation [s], a parameter of the FMU.
        velocity_of: for each of the first derivatives, those of positions, the index of the velocity in x.
        network: a network that is evaluated apart from the equations, in loops.
        features: z → what the network sees.
        ranges: smallest and largest value of states and inputs that the model was trained with, by name.
        sample: sampling time of a controller [s], which is for Co-Simulation alone.
        code: the C code of a controller by file name, in place of what is generated from `equations`.
        terminals: for each coordinate its name, its kind and the variables that belong to it.
    """

    identifier: str
    description: str
    states: tuple[Quantity, ...]
    inputs: tuple[Quantity, ...]
    parameters: tuple[Quantity, ...]
    derivatives: tuple[Quantity, ...]
    outputs: tuple[Quantity, ...]
    equations: ca.Function
    solver_step: float
    velocity_of: tuple[int, ...] = ()
    network: Network | None = None
    features: ca.Function | None = None
    ranges: Ranges = field(default_factory=dict)
    sample: float | None = None
    code: Mapping[str, str] = field(default_factory=dict)
    terminals: tuple[tuple[str, str, tuple[str, ...]], ...] = ()

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", self.identifier):
            raise ModelError(
                f"{self.identifier!r} cannot name an FMU; "
                "use letters, digits and _, and do not begin with a digit"
            )
        names = [q.name for q in self.variables]
        for name in names:
            if names.count(name) > 1:
                raise ModelError(f"{self.identifier}: two variables are named {name!r}; rename one of them")

    @property
    def known(self) -> tuple[Quantity, ...]:
        """The variables of z = (x, u, p)."""
        return self.states + self.inputs + self.parameters

    @property
    def unknown(self) -> tuple[Quantity, ...]:
        """The variables of (ẋ, y)."""
        return self.derivatives + self.outputs

    @property
    def settings(self) -> tuple[Quantity, ...]:
        """How the FMU goes about it."""
        if self.sample is not None:
            return ()
        step = "longest internal step of the Runge-Kutta method (Co-Simulation)"
        tolerance = "relative tolerance of adaptive Dormand-Prince steps, 0 for fixed ones (Co-Simulation)"
        clamp = "whether states and inputs enter the equations no farther out than the model was trained"
        return (
            Quantity(SOLVER_STEP, "s", step, self.solver_step, "setting"),
            Quantity("solver_tolerance", "1", tolerance, 0.0, "setting"),
        ) + (Quantity("clamp", "", clamp, role="setting", boolean=True),) * bool(self.ranges)

    @property
    def watched(self) -> tuple[Quantity, ...]:
        """What a model that knows its range says of it."""
        margin = "distance to the nearest end of the trained range, relative to that range; negative outside"
        within = "whether all states and inputs are inside the range that the model was trained in"
        return (
            Quantity("range_margin", "", margin),
            Quantity("in_range", "", within, boolean=True),
        ) * bool(self.ranges)

    @cached_property
    def variables(self) -> tuple[Quantity, ...]:
        """All variables, in the order of their value references."""
        time = Quantity("time", "s", "time", role="time")
        return (*self.known, *self.settings, *self.unknown, *self.watched, time)

    @cached_property
    def dependencies(self) -> tuple[tuple[int, ...], ...]:
        """For each unknown value, and what is watched, the indices of the known ones that it depends on."""
        found = _rows(self.equations, 0, len(self.unknown))
        if self.features is not None:
            seen = set().union(*_rows(self.features, 0, self.features.size1_out(0)))
            for own, through in zip(found, _rows(self.equations, 1, len(self.unknown)), strict=True):
                own |= seen if through else set()
        ranged = {k for k, quantity in enumerate(self.known) if quantity.name in self.ranges}
        return tuple(tuple(sorted(f)) for f in [*found, *(ranged for _ in self.watched)])

    def evaluate(self, known: NDArray[np.float64]) -> NDArray[np.float64]:
        """(ẋ, y) at one z, by CasADi and NumPy: what the C code is to agree with."""
        return self._evaluator(known)

    @cached_property
    def _evaluator(self) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """`evaluate` on arrays that are tied to the functions once."""
        z, unknown, network = np.zeros(len(self.known)), np.zeros(len(self.unknown)), self.network
        if network is None or self.features is None:
            equations = bind(self.equations, (z,), (unknown,))

            def given() -> None:
                """Nothing is given but z."""

        else:
            seen, r = np.zeros(network.inputs), np.zeros(network.size)
            features = bind(self.features, (z,), (seen,))
            equations = bind(self.equations, (z, r), (unknown,))

            def given() -> None:
                features()
                r[:] = network.value_and_slopes(seen)

        def evaluate(known: NDArray[np.float64]) -> NDArray[np.float64]:
            z[:] = known
            given()
            equations()
            return unknown.copy()

        return evaluate


def _rows(function: ca.Function, argument: int, rows: int) -> list[set[int]]:
    """For each row of the result, the entries of an argument that it depends on."""
    found: list[set[int]] = [set() for _ in range(rows)]
    for row, column in zip(*function.jac_sparsity(0, argument).get_triplet(), strict=True):
        found[row].add(column)
    return found


def plant_model(plant: Plant) -> StateSpaceModel:
    """The model of a ground-truth plant: its own outputs, start state and parameters.

    Args:
        plant: one of `exlinn_fmi.plants`.
    """
    system = plant.system
    own = plant.output_list[len(system.state_names) + system.n :]
    outputs = tuple(Quantity(o.name, o.unit, o.description) for o in own)
    return _model(
        system, plant.model_name, plant.description, plant.start, outputs, plant.output, usual=plant.usual
    )


def system_model(
    system: LagrangianSystem,
    identifier: str,
    description: str = "",
    start: Mapping[str, float] | None = None,
    ranges: Ranges | None = None,
) -> StateSpaceModel:
    """The model of any extended Lagrangian system, a learned one for instance; its output is its energy.

    Args:
        system: the equations of motion.
        identifier: name of the FMU.
        description: one line.
        start: initial state by name; where not given, what is nearest to 0 in its range.
        ranges: smallest and largest value of states and inputs that it was trained with, by name.
    """
    return _model(system, identifier, description, start or {}, (ENERGY,), system.output, ranges or {})


ENERGY = Quantity("energy", "J", "stored energy")


def expanded_model(
    expansion: Expansion,
    identifier: str,
    description: str = "",
    start: Mapping[str, float] | None = None,
    ranges: Ranges | None = None,
) -> StateSpaceModel:
    """The model of a learned system whose network is evaluated apart, in loops; else as `system_model`."""
    return _model(
        expansion.system,
        identifier,
        description,
        start or {},
        (ENERGY,),
        expansion.system.output,
        ranges or {},
        expansion,
    )


def _model(
    system: LagrangianSystem,
    identifier: str,
    description: str,
    start: Mapping[str, float],
    outputs: tuple[Quantity, ...],
    output: ca.Function,
    ranges: Ranges | None = None,
    expansion: Expansion | None = None,
    usual: Ranges | None = None,
) -> StateSpaceModel:
    """Name the variables of a system and put its equations in one function of one column.

    `output` gives states, accelerations and then `outputs`.

    Raises:
        ModelError: ẋ is not finite at the start state.
    """
    kept = [c for c in system.coordinates if c.topology != "cyclic"]
    angles = {c.name for c in system.coordinates if c.topology == "circle"}
    seen = {
        name: (low, high) for name, (low, high) in (ranges or {}).items() if name not in angles and low < high
    }
    units = state_units(system.coordinates)
    texts = [f"generalised coordinate, {c.kind}" for c in kept]
    texts += [f"generalised velocity of {c.name}, {c.kind}" for c in system.coordinates]
    states = tuple(
        Quantity(name, unit, text, start.get(name, _rest(seen.get(name))), "state", seen.get(name))
        for name, unit, text in zip(system.state_names, units, texts, strict=True)
    )
    derivatives = tuple(
        Quantity(f"der({c.name})", c.velocity_unit, f"time derivative of {c.name}", role="derivative")
        for c in kept
    )
    derivatives += tuple(
        Quantity(c.acceleration, c.acceleration_unit, f"time derivative of {c.velocity}", role="derivative")
        for c in system.coordinates
    )
    inputs = tuple(
        Quantity(
            c.input,
            c.input_unit,
            f"{_EFFORT[c.kind]} on {c.name}",
            _rest(seen.get(c.input)),
            "input",
            ({**(usual or {}), **seen}).get(c.input),
        )
        for c in system.coordinates
        if c.input is not None
    )
    parameters = tuple(
        Quantity(p.name, p.unit, p.description, p.value, "parameter")
        for p in (system.parameters if expansion is None else ())
    )
    n, m = len(states), len(inputs)
    z = ca.SX.sym("z", n + m + len(parameters))
    x, u = z[:n], z[n : n + m]
    arguments, p = [z], z[n + m :]
    features: Symbol = None
    if expansion is not None:
        given, features = ca.SX.sym("r", expansion.network.size), expansion.features(*system.split_state(x))
        arguments, p = [z, given], ca.vertcat(given, features)
        features = ca.Function("features", [z], [ca.densify(features)])
    y = output(x, u, p)[n + system.n :]
    unknown = ca.densify(ca.vertcat(system.derivative(x, u, p), y))
    model = StateSpaceModel(
        identifier,
        description,
        states,
        inputs,
        parameters,
        derivatives,
        outputs,
        ca.Function("equations", arguments, [ca.cse(unknown)]),
        0.0 if expansion else system.solver_step(start),
        tuple(n - system.n + i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"),
        expansion.network if expansion else None,
        features,
        {name: seen[name] for name in [*system.state_names, *system.input_names] if name in seen},
        terminals=tuple(map(_terminal, system.coordinates)),
    )
    return replace(model, solver_step=_solver_step(model)) if expansion else model


def _solver_step(model: StateSpaceModel) -> float:
    """As `LagrangianSystem.solver_step`, with poles from differences: there is no formula of the network.

    Raises:
        ModelError: ẋ is not finite at the start state.
    """
    n, start = len(model.states), np.array([q.start for q in model.known])
    jacobian = np.zeros((n, n))
    for k, quantity in enumerate(model.states):
        shift = np.zeros_like(start)
        shift[k] = 1e-5 * quantity.nominal
        jacobian[:, k] = (model.evaluate(start + shift) - model.evaluate(start - shift))[:n] / (2 * shift[k])
    if not np.isfinite(jacobian).all():
        raise ModelError(
            "the equations are not finite at the start state; check the start values, or train again"
        )
    return longest_step(jacobian)


def _rest(limits: tuple[float, float] | None) -> float:
    """0, or what is nearest to it inside the trained range."""
    low, high = limits or (0.0, 0.0)
    return min(max(0.0, low), high)


def _terminal(c: Coordinate) -> tuple[str, str, tuple[str, ...]]:
    """What belongs to a coordinate: its position and velocity, and what acts on it."""
    position = () if c.topology == "cyclic" else (c.name,)
    return c.name, c.kind, (*position, c.velocity, *([c.input] if c.input else []))

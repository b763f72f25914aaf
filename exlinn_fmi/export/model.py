"""What an FMU is made from: named x, u, p, y and the equations (x, u, p) → (ẋ, y) of any system."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import state_units
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.plant import Plant

SOLVER_STEP = "solver_step"
"""Name of the parameter that bounds the internal step of Co-Simulation [s]."""

_EFFORT = {"mechanical": "generalised force", "electrical": "voltage"}


@dataclass(frozen=True)
class Quantity:
    """A variable of the FMU.

    Args:
        name: FMI structured name.
        unit: SI unit, empty for none.
        description: one line.
        start: start value of what is known before the start: states, inputs, parameters.
    """

    name: str
    unit: str = ""
    description: str = ""
    start: float = 0.0


@dataclass(frozen=True)
class StateSpaceModel:
    """A model ẋ = f(x, u, p), y = g(x, u, p) ready for export.

    The *known* values are z = (x, u, p); `equations` maps them on the *unknown* ones, (ẋ, y). With the
    solver step between the two they are the array that value references index.

    Args:
        identifier: C identifier, the name of the binary.
        description: one line.
        states: x; outputs of the FMU whose start can be set.
        inputs: u.
        parameters: p.
        derivatives: ẋ; outputs of the FMU except those named ``der(…)``.
        outputs: y, outputs beyond states and derivatives.
        equations: z → (ẋ, y), a CasADi function of one column.
        solver_step: longest internal step of Co-Simulation [s], a parameter of the FMU.
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

    @cached_property
    def variables(self) -> tuple[Quantity, ...]:
        """All variables, in the order of their value references."""
        text = "longest internal step of the Runge-Kutta method (Co-Simulation)"
        solver = Quantity(SOLVER_STEP, "s", text, self.solver_step)
        return (*self.known, solver, *self.unknown)

    @cached_property
    def dependencies(self) -> tuple[tuple[int, ...], ...]:
        """For each of the unknown values, the indices of the known ones that it depends on."""
        pattern = self.equations.jac_sparsity(0, 0)
        rows, columns = pattern.get_triplet()
        found: list[list[int]] = [[] for _ in self.unknown]
        for row, column in zip(rows, columns, strict=True):
            found[row].append(column)
        return tuple(tuple(sorted(f)) for f in found)


def plant_model(plant: Plant) -> StateSpaceModel:
    """The model of a ground-truth plant: its own outputs, start state and parameters.

    Args:
        plant: one of `exlinn_fmi.plants`.
    """
    system = plant.system
    own = plant.output_list[len(system.state_names) + system.n :]
    outputs = tuple(Quantity(o.name, o.unit, o.description) for o in own)
    return _model(system, plant.model_name, plant.description, plant.start, outputs, plant.output)


def system_model(
    system: LagrangianSystem, identifier: str, description: str = "", start: Mapping[str, float] | None = None
) -> StateSpaceModel:
    """The model of any extended Lagrangian system, a learned one for instance; its output is its energy.

    Args:
        system: the equations of motion.
        identifier: name of the FMU.
        description: one line.
        start: initial state by name, 0 where not given.
    """
    energy = Quantity("energy", "J", "stored energy")
    return _model(system, identifier, description, start or {}, (energy,), system.output)


def _model(
    system: LagrangianSystem,
    identifier: str,
    description: str,
    start: Mapping[str, float],
    outputs: tuple[Quantity, ...],
    output: ca.Function,
) -> StateSpaceModel:
    """Name the variables of a system and put its equations in one function of one column.

    `output` gives states, accelerations and then `outputs`.

    Raises:
        ModelError: ẋ is not finite at the start state.
    """
    kept = [c for c in system.coordinates if c.topology != "cyclic"]
    units = state_units(system.coordinates)
    texts = [f"generalised coordinate, {c.kind}" for c in kept]
    texts += [f"generalised velocity of {c.name}, {c.kind}" for c in system.coordinates]
    states = tuple(
        Quantity(name, unit, text, start.get(name, 0.0))
        for name, unit, text in zip(system.state_names, units, texts, strict=True)
    )
    derivatives = tuple(
        Quantity(f"der({c.name})", c.velocity_unit, f"time derivative of {c.name}") for c in kept
    )
    derivatives += tuple(
        Quantity(c.acceleration, c.acceleration_unit, f"time derivative of {c.velocity}")
        for c in system.coordinates
    )
    inputs = tuple(
        Quantity(c.input, c.input_unit, f"{_EFFORT[c.kind]} on {c.name}")
        for c in system.coordinates
        if c.input is not None
    )
    parameters = tuple(Quantity(p.name, p.unit, p.description, p.value) for p in system.parameters)

    n, m = len(states), len(inputs)
    z = ca.SX.sym("z", n + m + len(parameters))
    x, u, p = z[:n], z[n : n + m], z[n + m :]
    y = output(x, u, p)[n + system.n :]
    unknown = ca.densify(ca.vertcat(system.derivative(x, u, p), y))
    equations = ca.Function("equations", [z], [ca.cse(unknown)], ["z"], ["unknown"])
    step = system.solver_step(start)
    return StateSpaceModel(
        identifier, description, states, inputs, parameters, derivatives, outputs, equations, step
    )

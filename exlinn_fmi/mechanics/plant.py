"""What a ground-truth plant page states: coordinates, parameters, energies, dissipation and outputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca

from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter, state_units
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol


@dataclass(frozen=True)
class Energies:
    """The energy terms of an extended Lagrangian [J], with the paper's symbols.

    Args:
        T: kinetic energy.
        V: potential energy.
        W_m: energy stored in magnetic fields of the circuit alone.
        W_e: energy stored in electric fields of the circuit alone.
        W_star: coupling energy W*, with its sign.
    """

    T: Symbol = 0
    V: Symbol = 0
    W_m: Symbol = 0
    W_e: Symbol = 0
    W_star: Symbol = 0

    @property
    def lagrangian(self) -> Symbol:
        """𝓛 = (T − V) + (W_m − W_e) + W*."""
        return (self.T - self.V) + (self.W_m - self.W_e) + self.W_star


@dataclass(frozen=True)
class Output:
    """An output y of a plant: name, unit, expression, and what it is."""

    name: str
    unit: str
    value: Symbol
    description: str = ""


@dataclass(frozen=True)
class Point:
    """The symbols that an output formula may use: q, v = q̇, a = q̈ (n), u (m), p (by name), energies, D, 𝓛."""

    q: Symbol
    v: Symbol
    a: Symbol
    u: Symbol
    p: Any
    energies: Energies
    dissipation: Symbol


class _ByName:
    """Parameters as attributes: p.j_m is the symbol of j_m."""

    def __init__(self, parameters: tuple[Parameter, ...], column: Symbol) -> None:
        for k, parameter in enumerate(parameters):
            setattr(self, parameter.name, column[k])


@dataclass(frozen=True)
class Plant:
    """A ground-truth plant. Python component, FMU and C code are all made from this one description.

    Args:
        name: name in scenarios, e.g. ``dc_motor_cart``.
        model_name: name as an FMU, e.g. ``DCMotorCart``.
        description: one line.
        coordinates: the generalised coordinates.
        parameters: physical parameters with default values.
        energies: (q, v, p) → Energies, p by name.
        dissipation: (v, p) → D.
        outputs: (Point) → outputs beyond the state and the accelerations, which every plant gives.
        start: initial state by name, 0 where not given.
        usual: the range that each input usually moves in, by name.
    """

    name: str
    model_name: str
    description: str
    coordinates: tuple[Coordinate, ...]
    parameters: tuple[Parameter, ...]
    energies: Callable[[Symbol, Symbol, Any], Energies]
    dissipation: Callable[[Symbol, Any], Symbol]
    outputs: Callable[[Point], tuple[Output, ...]] = lambda point: ()
    start: dict[str, float] = field(default_factory=dict)
    usual: dict[str, tuple[float, float]] = field(default_factory=dict)

    @cached_property
    def system(self) -> LagrangianSystem:
        """The plant's equations of motion."""
        return LagrangianSystem.build(
            self.coordinates,
            lambda q, v, p: self.energies(q, v, _ByName(self.parameters, p)).lagrangian,
            lambda v, p: self.dissipation(v, _ByName(self.parameters, p)),
            self.parameters,
        )

    @cached_property
    def _outputs(self) -> tuple[Symbol, Symbol, Symbol, tuple[Output, ...]]:
        system = self.system
        x = ca.SX.sym("x", len(system.state_names))
        u, p = ca.SX.sym("u", len(system.input_names)), ca.SX.sym("p", len(self.parameters))
        q, v = system.split_state(x)
        a = system.forward(q, v, u, p)
        named = _ByName(self.parameters, p)
        states = tuple(
            Output(name, unit, x[k])
            for k, (name, unit) in enumerate(
                zip(system.state_names, state_units(self.coordinates), strict=True)
            )
        )
        accelerations = tuple(
            Output(c.acceleration, c.acceleration_unit, a[i]) for i, c in enumerate(self.coordinates)
        )
        point = Point(q, v, a, u, named, self.energies(q, v, named), self.dissipation(v, named))
        return x, u, p, states + accelerations + self.outputs(point)

    @property
    def output_list(self) -> tuple[Output, ...]:
        """All outputs: state, accelerations, then the plant's own."""
        return self._outputs[3]

    @cached_property
    def output(self) -> ca.Function:
        """(x, u, p) → y, in the order of `output_list`."""
        x, u, p, outputs = self._outputs
        y = ca.vertcat(*(ca.densify(ca.SX(o.value)) for o in outputs))
        return ca.Function("output", [x, u, p], [y], ["x", "u", "p"], ["y"])

    def feed_through(self, output: str) -> tuple[str, ...]:
        """Names of the inputs that an output depends on directly.

        Args:
            output: name of the output.
        """
        _, u, _, outputs = self._outputs
        value = next(ca.SX(o.value) for o in outputs if o.name == output)
        return tuple(name for k, name in enumerate(self.system.input_names) if ca.depends_on(value, u[k]))

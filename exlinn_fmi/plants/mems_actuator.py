"""Electrostatic actuator, a plate on a spring before a fixed one: electric coupling Q²/2C(x), pull-in.

C(x) = ε A/(gap − x). A constant voltage v has equilibria k x = ε A v²/(2 (gap − x)²), where Q = C(x) v; two
of them meet at x = gap/3 under the pull-in voltage √(8 k gap³/(27 ε A)), 1446 V at the default parameters.
Above it the plate runs into the fixed one. There is no stop on this page: it holds for x < gap.

The charge is a state, since energy depends on it. The circuit needs an inductance, however small: without
one 𝓛 has no term in Q̇², the mass matrix is singular, and the charge follows a first-order law that no
Euler–Lagrange equation in Q̈ gives. Here l/r = 2 ms, well below r C = 14 ms and the plate's 200 ms.

The defaults are those of a desk-top demonstrator: µm, pF and µs would be a matter of units only. In x/gap,
v/v_pull-in and t √(k/m) an actuator of any size moves alike with the same b/√(k m), r C √(k/m), l/r √(k/m).
"""

from __future__ import annotations

from typing import Any

from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import Symbol
from exlinn_fmi.mechanics.plant import Energies, Output, Plant, Point

COORDINATES = (
    Coordinate("x", "m", "mechanical", "line", input="F_ext", input_unit="N"),
    Coordinate("Q", "C", "electrical", "line", velocity="i", velocity_unit="A", input="v", input_unit="V"),
)

PARAMETERS = (
    Parameter("m", 0.02, "kg", "mass of the moving plate"),
    Parameter("k", 20.0, "N/m", "stiffness of its suspension"),
    Parameter("b", 0.1, "N.s/m", "viscous damping of the plate"),
    Parameter("area", 0.04, "m2", "area A of a plate"),
    Parameter("gap", 5e-3, "m", "distance of the plates with the spring relaxed"),
    Parameter("epsilon", 8.8541878188e-12, "F/m", "permittivity between the plates"),
    Parameter("r", 2e8, "Ohm", "series resistance"),
    Parameter("l", 4e5, "H", "series inductance: l/r is the rise time of the supply"),
)


def capacitance(x: Symbol, p: Any) -> Symbol:
    """C(x) = ε A/(gap − x)."""
    return p.epsilon * p.area / (p.gap - x)


def energies(q: Symbol, v: Symbol, p: Any) -> Energies:
    """𝓛 = m ẋ²/2 − k x²/2 + l Q̇²/2 − Q²/2C(x)."""
    (x, Q), (x_dot, i) = (q[0], q[1]), (v[0], v[1])
    return Energies(
        T=p.m * x_dot**2 / 2,
        V=p.k * x**2 / 2,
        W_m=p.l * i**2 / 2,
        W_star=-(Q**2) / (2 * capacitance(x, p)),
    )


def dissipation(v: Symbol, p: Any) -> Symbol:
    """D = b ẋ²/2 + r Q̇²/2."""
    return p.b * v[0] ** 2 / 2 + p.r * v[1] ** 2 / 2


def outputs(at: Point) -> tuple[Output, ...]:
    """Capacitance, voltage across the plates, their attraction Q²/(2 ε A), and every energy term."""
    x, Q, p = at.q[0], at.q[1], at.p
    return (
        Output("C", "F", capacitance(x, p), "capacitance C(x)"),
        Output("v_C", "V", Q / capacitance(x, p), "voltage across the plates"),
        Output("f_e", "N", Q**2 / (2 * p.epsilon * p.area), "electrostatic force on the plate, along x"),
        Output("T", "J", at.energies.T, "kinetic energy"),
        Output("V", "J", at.energies.V, "potential energy of the suspension"),
        Output("W_m", "J", at.energies.W_m, "magnetic energy of the inductance"),
        Output("W_star", "J", at.energies.W_star, "coupling energy: minus the electric energy of the plates"),
        Output("L", "J", at.energies.lagrangian, "extended Lagrangian"),
        Output("D", "W", at.dissipation, "Rayleigh dissipation function"),
    )


PLANT = Plant(
    name="mems_actuator",
    model_name="MEMSActuator",
    description="Electrostatic parallel-plate actuator on a spring",
    coordinates=COORDINATES,
    parameters=PARAMETERS,
    energies=energies,
    dissipation=dissipation,
    outputs=outputs,
    usual={"F_ext": (-0.003, 0.003), "v": (-1200.0, 1200.0)},
)

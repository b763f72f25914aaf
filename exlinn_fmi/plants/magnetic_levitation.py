"""Steel ball in the field of a vertical solenoid: magnetic coupling ½ L(x) i², unstable below the coil.

x is the depth of the ball below the centre of the coil. L(x) = l_0 + l_1/(1 + (x/a)²) is largest with the
ball in the centre, so the field pulls it there from both sides, and a constant current balances its weight at
two depths. At the farther one, the levitation known from laboratories, it falls or is drawn in: with the
default parameters x = a = 20 mm, i = 2 √(a m g/l_1) = 0.6264 A and v = r i = 6.264 V (a pole at +21.5 1/s).
Here the plant starts. At the nearer one, x = 5.91 mm with the same current, the ball hangs stably.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import Symbol
from exlinn_fmi.mechanics.plant import Energies, Output, Plant, Point

COORDINATES = (
    Coordinate("x", "m", "mechanical", "line", input="F_ext", input_unit="N"),
    Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v", input_unit="V"),
)

PARAMETERS = (
    Parameter("m", 0.05, "kg", "mass of the ball"),
    Parameter("g", 9.81, "m/s2", "gravity"),
    Parameter("l_0", 0.2, "H", "inductance of the coil with the ball far away"),
    Parameter("l_1", 0.1, "H", "what the ball adds in the centre of the coil"),
    Parameter("a", 0.02, "m", "depth at which it adds half of that"),
    Parameter("b", 0.2, "N.s/m", "viscous friction of the ball"),
    Parameter("r", 10.0, "Ohm", "coil resistance"),
)


def inductance(x: Symbol, p: Any) -> Symbol:
    """L(x) = l_0 + l_1/(1 + (x/a)²)."""
    return p.l_0 + p.l_1 / (1 + (x / p.a) ** 2)


def energies(q: Symbol, v: Symbol, p: Any) -> Energies:
    """𝓛 = m ẋ²/2 + m g x + L(x) Q̇²/2."""
    x, (x_dot, i) = q[0], (v[0], v[1])
    return Energies(
        T=p.m * x_dot**2 / 2,
        V=-p.m * p.g * x,
        W_star=inductance(x, p) * i**2 / 2,
    )


def dissipation(v: Symbol, p: Any) -> Symbol:
    """D = b ẋ²/2 + r Q̇²/2."""
    return p.b * v[0] ** 2 / 2 + p.r * v[1] ** 2 / 2


def outputs(at: Point) -> tuple[Output, ...]:
    """Inductance, magnetic force ½ L'(x) i², flux linkage L(x) i, and every energy term."""
    x, i, p = at.q[0], at.v[1], at.p
    slope = -2 * p.l_1 * x / p.a**2 / (1 + (x / p.a) ** 2) ** 2
    return (
        Output("L_x", "H", inductance(x, p), "inductance L(x)"),
        Output("f_e", "N", slope * i**2 / 2, "magnetic force on the ball, along x"),
        Output("flux", "Wb", inductance(x, p) * i, "flux linkage"),
        Output("T", "J", at.energies.T, "kinetic energy"),
        Output("V", "J", at.energies.V, "potential energy"),
        Output("W_star", "J", at.energies.W_star, "coupling energy: magnetic co-energy of the coil"),
        Output("L", "J", at.energies.lagrangian, "extended Lagrangian"),
        Output("D", "W", at.dissipation, "Rayleigh dissipation function"),
    )


PLANT = Plant(
    name="magnetic_levitation",
    model_name="MagneticLevitation",
    description="Steel ball below and inside a vertical solenoid",
    coordinates=COORDINATES,
    parameters=PARAMETERS,
    energies=energies,
    dissipation=dissipation,
    outputs=outputs,
    start={"x": 0.02, "i": 2 * sqrt(0.02 * 0.05 * 9.81 / 0.1)},
    usual={"F_ext": (-0.1, 0.1), "v": (6.0, 12.0)},
)

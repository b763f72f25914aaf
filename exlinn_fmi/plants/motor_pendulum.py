"""DC motor driving a pendulum under gravity, with viscous and smoothed Coulomb friction.

phi is the angle from hanging down. The motor stalls at 3 N.m under 12 V, the pendulum weighs 0.589 N.m at
most: it can be held anywhere and turned over. Below speeds of about s the Coulomb friction
tau_c tanh(phi_dot/s) is viscous, so that the equations stay smooth: the pendulum creeps, it never sticks.
"""

from __future__ import annotations

from typing import Any

from casadi import cos, sin, tanh

from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import Symbol
from exlinn_fmi.mechanics.friction import log_cosh
from exlinn_fmi.mechanics.plant import Energies, Output, Plant, Point

COORDINATES = (
    Coordinate("phi", "rad", "mechanical", "circle", input="tau_ext", input_unit="N.m"),
    Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v", input_unit="V"),
)

PARAMETERS = (
    Parameter("j_m", 0.002, "kg.m2", "moment of inertia of the motor"),
    Parameter("m", 0.2, "kg", "mass of the bob"),
    Parameter("d", 0.3, "m", "length of the pendulum"),
    Parameter("g", 9.81, "m/s2", "gravity"),
    Parameter("l", 0.02, "H", "armature inductance"),
    Parameter("k_e", 0.5, "N.m/A", "torque and back-EMF constant"),
    Parameter("b", 0.02, "N.m.s/rad", "viscous friction"),
    Parameter("tau_c", 0.05, "N.m", "Coulomb friction"),
    Parameter("s", 0.2, "rad/s", "speed over which it is smoothed"),
    Parameter("r", 2.0, "Ohm", "armature resistance"),
)


def energies(q: Symbol, v: Symbol, p: Any) -> Energies:
    """𝓛 = (j_m + m d²) φ̇²/2 + m g d cos φ + l Q̇²/2 + k_e Q̇ φ."""
    phi, (phi_dot, i) = q[0], (v[0], v[1])
    return Energies(
        T=(p.j_m + p.m * p.d**2) * phi_dot**2 / 2,
        V=-p.m * p.g * p.d * cos(phi),
        W_m=p.l * i**2 / 2,
        W_star=p.k_e * i * phi,
    )


def dissipation(v: Symbol, p: Any) -> Symbol:
    """D = b φ̇²/2 + tau_c s log cosh(φ̇/s) + r Q̇²/2."""
    return p.b * v[0] ** 2 / 2 + p.tau_c * p.s * log_cosh(v[0] / p.s) + p.r * v[1] ** 2 / 2


def outputs(at: Point) -> tuple[Output, ...]:
    """Height of the bob, torques of motor and friction, and every energy term."""
    phi, phi_dot, i, p = at.q[0], at.v[0], at.v[1], at.p
    friction = p.b * phi_dot + p.tau_c * tanh(phi_dot / p.s)
    return (
        Output("x", "m", p.d * sin(phi), "horizontal position of the bob"),
        Output("y", "m", -p.d * cos(phi), "height of the bob above the axis"),
        Output("tau_e", "N.m", p.k_e * i, "electromagnetic torque"),
        Output("tau_f", "N.m", friction, "friction torque, against the motion"),
        Output("T", "J", at.energies.T, "kinetic energy"),
        Output("V", "J", at.energies.V, "potential energy"),
        Output("W_m", "J", at.energies.W_m, "magnetic energy of the armature"),
        Output("W_star", "J", at.energies.W_star, "coupling energy"),
        Output("L", "J", at.energies.lagrangian, "extended Lagrangian"),
        Output("D", "W", at.dissipation, "Rayleigh dissipation function"),
    )


PLANT = Plant(
    name="motor_pendulum",
    model_name="MotorPendulum",
    description="DC motor with pendulum, gravity and Coulomb friction",
    coordinates=COORDINATES,
    parameters=PARAMETERS,
    energies=energies,
    dissipation=dissipation,
    outputs=outputs,
    usual={"tau_ext": (-0.2, 0.2), "v": (-12.0, 12.0)},
)

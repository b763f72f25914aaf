"""Planar arm of two links under gravity, each joint driven by a DC motor through a gear.

phi_1 is the angle of the first link from hanging down, phi_2 that of the second from the direction of the
first. The links are uniform rods. A motor turns n times as fast as its joint; the second one rides on the
first link, so that its rotor turns with phi_1_dot + n phi_2_dot. Motors, gears and joints are alike.
"""

from __future__ import annotations

from typing import Any

from casadi import cos, sin

from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import Symbol
from exlinn_fmi.mechanics.plant import Energies, Output, Plant, Point

COORDINATES = (
    Coordinate("phi_1", "rad", "mechanical", "circle", input="tau_1", input_unit="N.m"),
    Coordinate("phi_2", "rad", "mechanical", "circle", input="tau_2", input_unit="N.m"),
    Coordinate(
        "Q_1", "C", "electrical", "cyclic", velocity="i_1", velocity_unit="A", input="v_1", input_unit="V"
    ),
    Coordinate(
        "Q_2", "C", "electrical", "cyclic", velocity="i_2", velocity_unit="A", input="v_2", input_unit="V"
    ),
)

PARAMETERS = (
    Parameter("m_1", 1.0, "kg", "mass of the first link"),
    Parameter("m_2", 0.5, "kg", "mass of the second link"),
    Parameter("d_1", 0.3, "m", "length of the first link"),
    Parameter("d_2", 0.25, "m", "length of the second link"),
    Parameter("g", 9.81, "m/s2", "gravity"),
    Parameter("j_m", 5e-5, "kg.m2", "moment of inertia of a motor's rotor"),
    Parameter("n", 20.0, "1", "gear ratio: turns of the motor for one of the joint"),
    Parameter("l", 0.01, "H", "armature inductance of a motor"),
    Parameter("k_e", 0.05, "N.m/A", "torque and back-EMF constant of a motor"),
    Parameter("b", 0.2, "N.m.s/rad", "viscous friction of a joint"),
    Parameter("r", 1.5, "Ohm", "armature resistance of a motor"),
)


def energies(q: Symbol, v: Symbol, p: Any) -> Energies:
    """𝓛 = kinetic energy of links and rotors − V + l (i_1² + i_2²)/2 + n k_e (i_1 φ_1 + i_2 φ_2)."""
    (phi_1, phi_2), (w_1, w_2, i_1, i_2) = (q[0], q[1]), (v[0], v[1], v[2], v[3])
    w_12 = w_1 + w_2
    # Squared speed of the second link's centre of mass: the elbow's, and its own about the elbow.
    centre = (p.d_1 * w_1) ** 2 + (p.d_2 / 2 * w_12) ** 2 + p.d_1 * p.d_2 * cos(phi_2) * w_1 * w_12
    rods = p.m_1 * p.d_1**2 / 3 * w_1**2 + p.m_2 * centre + p.m_2 * p.d_2**2 / 12 * w_12**2
    rotors = p.j_m * ((p.n * w_1) ** 2 + (w_1 + p.n * w_2) ** 2)
    elbow, middle = p.d_1 * cos(phi_1), p.d_2 / 2 * cos(phi_1 + phi_2)  # how far below what carries them
    return Energies(
        T=(rods + rotors) / 2,
        V=-p.g * (p.m_1 * elbow / 2 + p.m_2 * (elbow + middle)),
        W_m=p.l * (i_1**2 + i_2**2) / 2,
        W_star=p.n * p.k_e * (i_1 * phi_1 + i_2 * phi_2),
    )


def dissipation(v: Symbol, p: Any) -> Symbol:
    """D = b (φ̇_1² + φ̇_2²)/2 + r (i_1² + i_2²)/2."""
    return p.b * (v[0] ** 2 + v[1] ** 2) / 2 + p.r * (v[2] ** 2 + v[3] ** 2) / 2


def outputs(at: Point) -> tuple[Output, ...]:
    """Position of the tip, torques of the motors at the joints, and every energy term."""
    phi_1, phi_12, i_1, i_2, p = at.q[0], at.q[0] + at.q[1], at.v[2], at.v[3], at.p
    return (
        Output("x", "m", p.d_1 * sin(phi_1) + p.d_2 * sin(phi_12), "horizontal position of the tip"),
        Output("y", "m", -p.d_1 * cos(phi_1) - p.d_2 * cos(phi_12), "height of the tip above joint 1"),
        Output("tau_e1", "N.m", p.n * p.k_e * i_1, "torque of the first motor at its joint"),
        Output("tau_e2", "N.m", p.n * p.k_e * i_2, "torque of the second motor at its joint"),
        Output("T", "J", at.energies.T, "kinetic energy"),
        Output("V", "J", at.energies.V, "potential energy"),
        Output("W_m", "J", at.energies.W_m, "magnetic energy of the armatures"),
        Output("W_star", "J", at.energies.W_star, "coupling energy"),
        Output("L", "J", at.energies.lagrangian, "extended Lagrangian"),
        Output("D", "W", at.dissipation, "Rayleigh dissipation function"),
    )


PLANT = Plant(
    name="two_link_arm",
    model_name="TwoLinkArm",
    description="Planar arm of two links with geared DC motors",
    coordinates=COORDINATES,
    parameters=PARAMETERS,
    energies=energies,
    dissipation=dissipation,
    outputs=outputs,
    usual={"tau_1": (-1.0, 1.0), "tau_2": (-0.5, 0.5), "v_1": (-24.0, 24.0), "v_2": (-24.0, 24.0)},
)

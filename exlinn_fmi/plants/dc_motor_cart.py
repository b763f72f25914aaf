"""DC motor driving a cart through a scotch yoke (x = d cos α): the paper's case study, eqs. (18), (19).

m_c and d are not given in the paper; ours are 1 kg and 0.2 m.
"""

from __future__ import annotations

from typing import Any

from casadi import cos, sin

from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import Symbol
from exlinn_fmi.mechanics.plant import Energies, Output, Plant, Point

COORDINATES = (
    Coordinate("alpha", "rad", "mechanical", "circle", input="tau_ext", input_unit="N.m"),
    Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v", input_unit="V"),
)

PARAMETERS = (
    Parameter("j_m", 0.1, "kg.m2", "moment of inertia of the motor"),
    Parameter("m_c", 1.0, "kg", "mass of the cart"),
    Parameter("d", 0.2, "m", "crank radius of the scotch yoke"),
    Parameter("l", 1.0, "H", "armature inductance"),
    Parameter("k_e", 1.0, "N.m/A", "torque and back-EMF constant"),
    Parameter("b_m", 0.5, "N.m.s/rad", "viscous friction of the motor"),
    Parameter("r", 5.0, "Ohm", "armature resistance"),
)


def energies(q: Symbol, v: Symbol, p: Any) -> Energies:
    """Eq. (18): 𝓛 = j_m α̇²/2 + m_c (d sin α · α̇)²/2 + l Q̇²/2 + k_e Q̇ α."""
    alpha, (alpha_dot, i) = q[0], (v[0], v[1])
    return Energies(
        T=p.j_m * alpha_dot**2 / 2 + p.m_c * (p.d * sin(alpha) * alpha_dot) ** 2 / 2,
        W_m=p.l * i**2 / 2,
        W_star=p.k_e * i * alpha,
    )


def dissipation(v: Symbol, p: Any) -> Symbol:
    """Eq. (18): D = b_m α̇²/2 + r Q̇²/2."""
    return p.b_m * v[0] ** 2 / 2 + p.r * v[1] ** 2 / 2


def outputs(at: Point) -> tuple[Output, ...]:
    """Cart position and speed, electromagnetic torque, and every energy term."""
    alpha, alpha_dot, i = at.q[0], at.v[0], at.v[1]
    return (
        Output("x", "m", at.p.d * cos(alpha), "cart position"),
        Output("x_dot", "m/s", -at.p.d * sin(alpha) * alpha_dot, "cart speed"),
        Output("tau_e", "N.m", at.p.k_e * i, "electromagnetic torque"),
        Output("T", "J", at.energies.T, "kinetic energy"),
        Output("W_m", "J", at.energies.W_m, "magnetic energy of the armature"),
        Output("W_star", "J", at.energies.W_star, "coupling energy"),
        Output("L", "J", at.energies.lagrangian, "extended Lagrangian"),
        Output("D", "W", at.dissipation, "Rayleigh dissipation function"),
    )


PLANT = Plant(
    name="dc_motor_cart",
    model_name="DCMotorCart",
    description="DC motor with cart driven through a scotch yoke",
    coordinates=COORDINATES,
    parameters=PARAMETERS,
    energies=energies,
    dissipation=dissipation,
    outputs=outputs,
    usual={"tau_ext": (-1.0, 1.0), "v": (-24.0, 24.0)},
)

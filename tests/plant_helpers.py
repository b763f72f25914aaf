"""The equations of motion of every plant written out by hand, and a run that moves each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.plants import PLANTS, plant

Array = NDArray[np.float64]


def dc_motor_cart(x: Array, u: Array, p: Any) -> list[Any]:
    """Eq. (19) of the paper."""
    alpha, omega, i = x
    tau, v = u
    cart, sine = p.m_c * p.d**2, np.sin(alpha)
    torque = tau + p.k_e * i - p.b_m * omega - cart * sine * np.cos(alpha) * omega**2
    return [omega, torque / (p.j_m + cart * sine**2), (v - p.k_e * omega - p.r * i) / p.l]


def magnetic_levitation(x: Array, u: Array, p: Any) -> list[Any]:
    """Newton's law with the force ½ L'(x) i², and d/dt (L(x) i) = v − r i."""
    depth, speed, i = x
    force, v = u
    ratio = 1 + (depth / p.a) ** 2
    inductance, slope = p.l_0 + p.l_1 / ratio, -2 * p.l_1 * depth / p.a**2 / ratio**2
    acceleration = p.g + (slope * i**2 / 2 - p.b * speed + force) / p.m
    return [speed, acceleration, (v - p.r * i - slope * speed * i) / inductance]


def mems_actuator(x: Array, u: Array, p: Any) -> list[Any]:
    """A mass on a spring under Q²/(2εA), and Kirchhoff's law with v_C = Q (gap − x)/(εA)."""
    position, charge, speed, i = x
    force, v = u
    plates = p.epsilon * p.area
    acceleration = (charge**2 / (2 * plates) - p.k * position - p.b * speed + force) / p.m
    return [speed, i, acceleration, (v - p.r * i - charge * (p.gap - position) / plates) / p.l]


def motor_pendulum(x: Array, u: Array, p: Any) -> list[Any]:
    """The pendulum's equation with motor torque and friction, and the armature's."""
    phi, omega, i = x
    tau, v = u
    friction = p.b * omega + p.tau_c * np.tanh(omega / p.s)
    torque = tau + p.k_e * i - p.m * p.g * p.d * np.sin(phi) - friction
    return [omega, torque / (p.j_m + p.m * p.d**2), (v - p.r * i - p.k_e * omega) / p.l]


def two_link_arm(x: Array, u: Array, p: Any) -> list[Any]:
    """The textbook's M(φ)φ̈ + C(φ, φ̇) + G(φ) of two rods, with rotors added; Cramer's rule for φ̈."""
    phi_1, phi_2, w_1, w_2, i_1, i_2 = x
    tau_1, tau_2, v_1, v_2 = u
    own, cross = p.m_2 * p.d_2**2 / 3, p.m_2 * p.d_1 * p.d_2 / 2
    m_11 = (p.m_1 / 3 + p.m_2) * p.d_1**2 + own + 2 * cross * np.cos(phi_2) + p.j_m * (p.n**2 + 1)
    m_12 = own + cross * np.cos(phi_2) + p.j_m * p.n
    m_22 = own + p.j_m * p.n**2
    weight_2 = p.m_2 * p.g * p.d_2 / 2 * np.sin(phi_1 + phi_2)
    weight_1 = (p.m_1 / 2 + p.m_2) * p.g * p.d_1 * np.sin(phi_1) + weight_2
    swirl = cross * np.sin(phi_2)
    right_1 = tau_1 + p.n * p.k_e * i_1 - p.b * w_1 - weight_1 + swirl * (2 * w_1 * w_2 + w_2**2)
    right_2 = tau_2 + p.n * p.k_e * i_2 - p.b * w_2 - weight_2 - swirl * w_1**2
    determinant = m_11 * m_22 - m_12**2
    return [
        w_1,
        w_2,
        (m_22 * right_1 - m_12 * right_2) / determinant,
        (m_11 * right_2 - m_12 * right_1) / determinant,
        (v_1 - p.r * i_1 - p.n * p.k_e * w_1) / p.l,
        (v_2 - p.r * i_2 - p.n * p.k_e * w_2) / p.l,
    ]


@dataclass(frozen=True)
class Case:
    """How a plant is moved: start state, and inputs that jump about a mean.

    Args:
        start: state by name.
        mean: of each input.
        spread: of each input, ±.
        sizes: of the states.
        losses: friction coefficients and resistances by name: without them nothing is dissipated.
        equations: (x, u, p by name) → ẋ, by hand.
    """

    start: Mapping[str, float]
    mean: Mapping[str, float]
    spread: Mapping[str, float]
    sizes: tuple[float, ...]
    losses: tuple[str, ...]
    equations: Callable[[Array, Array, Any], list[Any]]

    def inputs(self, steps: int, hold: int, seed: int = 0) -> dict[str, Array]:
        """Random inputs for each step, that change every `hold` steps."""
        random = np.random.default_rng(seed)
        jumps = {name: random.uniform(-1, 1, -(-steps // hold)) for name in self.mean}
        return {
            name: self.mean[name] + self.spread[name] * np.repeat(jump, hold)[:steps]
            for name, jump in jumps.items()
        }


CASES = {
    "dc_motor_cart": Case(
        {"alpha": 0.7, "alpha_dot": -1.5, "i": 0.4},
        {"tau_ext": 0.0, "v": 4.0},
        {"tau_ext": 0.3, "v": 8.0},
        (6.0, 8.0, 3.0),
        ("b_m", "r"),
        dc_motor_cart,
    ),
    # Around the depth where the ball hangs stably: elsewhere it falls, and errors grow with exp(21 t).
    "magnetic_levitation": Case(
        {"x": 0.002, "x_dot": 0.1, "i": 0.9},
        {"F_ext": 0.0, "v": 9.0},
        {"F_ext": 0.1, "v": 1.5},
        (0.04, 0.5, 2.0),
        ("b", "r"),
        magnetic_levitation,
    ),
    "mems_actuator": Case(
        {"x": 0.0005, "Q": 4e-8, "x_dot": 0.01, "i": 1e-6},
        {"F_ext": 0.0, "v": 0.0},
        {"F_ext": 0.003, "v": 1200.0},
        (4e-3, 1e-7, 0.1, 1e-5),
        ("b", "r"),
        mems_actuator,
    ),
    "motor_pendulum": Case(
        {"phi": 2.5, "phi_dot": -3.0, "i": 0.4},
        {"tau_ext": 0.0, "v": 1.0},
        {"tau_ext": 0.2, "v": 8.0},
        (6.0, 10.0, 5.0),
        ("b", "tau_c", "r"),
        motor_pendulum,
    ),
    "two_link_arm": Case(
        {"phi_1": 1.0, "phi_2": -2.0, "phi_1_dot": 3.0, "i_2": 1.0},
        {"tau_1": 0.0, "tau_2": 0.0, "v_1": 0.0, "v_2": 0.0},
        {"tau_1": 1.0, "tau_2": 0.5, "v_1": 12.0, "v_2": 8.0},
        (6.0, 6.0, 8.0, 8.0, 8.0, 8.0),
        ("b", "r"),
        two_link_arm,
    ),
}
"""One for each plant."""

assert CASES.keys() == PLANTS.keys()


def parameters(page: Plant, **other: float) -> SimpleNamespace:
    """A plant's parameters by name, with other values where given."""
    return SimpleNamespace(**{p.name: p.value for p in page.parameters} | other)


def column(page: Plant, **other: float) -> Array:
    """A plant's parameters as the column p."""
    named = vars(parameters(page, **other))
    return np.array([named[p.name] for p in page.parameters])


def start_state(name: str) -> Array:
    """Start state of a plant's case."""
    return np.array([CASES[name].start.get(state, 0.0) for state in plant(name).system.state_names])


def random_points(name: str, count: int, seed: int = 0) -> tuple[Array, Array]:
    """States all over the range that a plant moves in and inputs, shapes (count, states) and (count, m)."""
    case, random = CASES[name], np.random.default_rng(seed)
    x = random.uniform(-1, 1, (count, len(case.sizes))) * case.sizes
    u = random.uniform(-1, 1, (count, len(case.mean))) * list(case.spread.values())
    return x, u + list(case.mean.values())

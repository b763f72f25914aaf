"""The extended Lagrangian core against closed forms, conservation laws and random systems."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, state_names, state_units
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.plants import plant

DCWC = plant("dc_motor_cart")
P = DCWC.system.parameter_values


def random_system(n: int, seed: int) -> LagrangianSystem:
    """A dense system of n line coordinates: M(q) ≻ 0, gyroscopic A(q), potential V(q), convex D."""
    rng = np.random.default_rng(seed)
    w, k = ca.DM(rng.normal(size=(n, n))), ca.DM(rng.normal(size=(n, n)))

    def lagrangian(q: ca.SX, v: ca.SX, p: ca.SX) -> ca.SX:
        factor = w + ca.diag(ca.sin(q))
        mass = factor @ factor.T + ca.SX.eye(n)
        return ca.dot(v, mass @ v) / 2 + ca.dot(ca.tanh(k @ q), v) - ca.sumsqr(ca.cos(k @ q))

    def dissipation(v: ca.SX, p: ca.SX) -> ca.SX:
        return ca.sumsqr(w @ v) / 2 + ca.sum1(ca.log(ca.cosh(v)))

    coordinates = tuple(Coordinate(f"q{i}", "m", input=f"F{i}", input_unit="N") for i in range(n))
    return LagrangianSystem.build(coordinates, lagrangian, dissipation)


@settings(max_examples=25, deadline=None)
@given(n=st.integers(1, 4), seed=st.integers(0, 10_000))
def test_inverse_of_forward_is_identity(n: int, seed: int) -> None:
    system = random_system(n, seed)
    q, v, u = np.random.default_rng(seed).normal(size=(3, 7, n))
    none = np.empty(0)
    a = evaluate(system.forward, q, v, u, none)
    np.testing.assert_allclose(evaluate(system.inverse, q, v, a, none), u, rtol=1e-8, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(n=st.integers(1, 4), seed=st.integers(0, 10_000))
def test_mass_matrix_is_symmetric_and_positive_definite_where_the_lagrangian_says_so(
    n: int, seed: int
) -> None:
    q, v = np.random.default_rng(seed).normal(size=(2, 5, n))
    mass = evaluate(random_system(n, seed).mass_matrix, q, v, np.empty(0)).reshape(5, n, n)
    np.testing.assert_allclose(mass, mass.transpose(0, 2, 1), atol=1e-12)
    assert np.linalg.eigvalsh(mass).min() >= 1 - 1e-9


def test_equations_of_motion_19_follow_symbolically_from_18() -> None:
    j, m, d, inductance, k, b, r = sympy.symbols("j_m m_c d l k_e b_m r")
    t = sympy.symbols("t")
    alpha, charge = sympy.Function("alpha")(t), sympy.Function("Q")(t)
    s = [sympy.symbols(x) for x in ("al", "w", "i", "dw", "di")]
    w, i = alpha.diff(t), charge.diff(t)
    lagrangian = (
        j * w**2 / 2 + m * (d * sympy.sin(alpha) * w) ** 2 / 2 + inductance * i**2 / 2 + k * i * alpha
    )
    dissipation = b * w**2 / 2 + r * i**2 / 2
    names = {w.diff(t): s[3], i.diff(t): s[4], w: s[1], i: s[2], alpha: s[0]}
    for row, (x, velocity) in enumerate(((alpha, w), (charge, i))):
        equation = lagrangian.diff(velocity).diff(t) - lagrangian.diff(x) + dissipation.diff(velocity)
        equation = equation.doit().subs(names)
        mechanical = (
            (j + m * d**2 * sympy.sin(s[0]) ** 2) * s[3]
            + (b + m * d**2 * sympy.sin(s[0]) * sympy.cos(s[0]) * s[1]) * s[1]
            - k * s[2]
        )
        electrical = inductance * s[4] + r * s[2] + k * s[1]
        assert sympy.simplify(equation - (mechanical, electrical)[row]) == 0


def test_plant_page_gives_the_equations_of_motion_19() -> None:
    p = dict(zip([x.name for x in DCWC.parameters], P, strict=True))
    q, v, a = np.random.default_rng(3).normal(size=(3, 50, 2))
    force = evaluate(DCWC.system.inverse, q, v, a, P)
    s, c = np.sin(q[:, 0]), np.cos(q[:, 0])
    cart = p["m_c"] * p["d"] ** 2
    row1 = (
        (p["j_m"] + cart * s**2) * a[:, 0]
        + (p["b_m"] + cart * s * c * v[:, 0]) * v[:, 0]
        - p["k_e"] * v[:, 1]
    )
    row2 = p["l"] * a[:, 1] + p["r"] * v[:, 1] + p["k_e"] * v[:, 0]
    np.testing.assert_allclose(force, np.stack([row1, row2], 1), atol=1e-13)


def test_symbolic_19_has_no_free_charge() -> None:
    assert DCWC.system.state_names == ["alpha", "alpha_dot", "i"]


@settings(max_examples=15, deadline=None)
@given(n=st.integers(1, 3), seed=st.integers(0, 10_000))
def test_power_balance_holds_at_every_point(n: int, seed: int) -> None:
    system, none = random_system(n, seed), np.empty(0)
    q, v, u = np.random.default_rng(seed).normal(size=(3, 6, n))
    a, h = evaluate(system.forward, q, v, u, none), 1e-5
    rate = (
        evaluate(system.energy, q + h * v, v + h * a, none)
        - evaluate(system.energy, q - h * v, v - h * a, none)
    ) / (2 * h)
    supplied = np.sum(v * u, 1, keepdims=True)
    loss = np.array([float(system.power(v[k], u[k], none)[1]) for k in range(6)])[:, None]
    np.testing.assert_allclose(rate, supplied - loss, rtol=1e-4, atol=1e-4)


def simulate(h: float, stop: float = 2.0) -> tuple[float, float]:
    """Stored energy minus supplied work plus loss after `stop` seconds, and the energy supplied."""
    step, system = DCWC.system.rk4(), DCWC.system
    x, u, balance, supplied = np.array([0.3, 2.0, 0.5]), np.array([0.1, 4.0]), 0.0, 0.0

    def stored(x: np.ndarray) -> float:
        return float(system.energy([x[0], 0], x[1:], P))

    def power(x: np.ndarray) -> np.ndarray:
        return np.array([float(value) for value in system.power(x[1:], u, P)])

    balance -= stored(x)
    for _ in range(round(stop / h)):
        middle, end = np.array(step(x, u, P, h / 2)).ravel(), np.array(step(x, u, P, h)).ravel()
        work = h / 6 * (power(x) + 4 * power(middle) + power(end))  # Simpson, of RK4's order
        balance -= work[0] - work[1]
        supplied += work[0]
        x = end
    return abs(balance + stored(x)), supplied


def test_energy_balance_along_a_trajectory_closes_with_the_order_of_the_integrator() -> None:
    (coarse, supplied), (fine, _) = simulate(0.02), simulate(0.01)
    assert fine < 1e-7 * supplied
    assert coarse / fine > 2**3.5


def test_rk4_substeps_equal_repeated_steps() -> None:
    x, u = np.array([0.3, 2.0, 0.5]), np.array([0.0, 4.0])
    once = np.array(DCWC.system.rk4(2)(x, u, P, 0.02)).ravel()
    step = DCWC.system.rk4()
    twice = np.array(step(step(x, u, P, 0.01), u, P, 0.01)).ravel()
    np.testing.assert_allclose(once, twice, rtol=1e-15)


def test_charge_that_stores_energy_may_not_be_called_cyclic() -> None:
    with pytest.raises(ModelError, match="'Q' is said to be cyclic"):
        LagrangianSystem.build(
            (Coordinate("Q", "C", "electrical", "cyclic", velocity="i"),),
            lambda q, v, p: v[0] ** 2 - q[0] ** 2,
            lambda v, p: ca.SX(0),
        )


def test_equal_names_are_refused() -> None:
    with pytest.raises(ModelError, match="'v' is used twice"):
        LagrangianSystem.build(
            (Coordinate("x", "m", velocity="v"), Coordinate("y", "m", velocity="v")),
            lambda q, v, p: ca.sumsqr(v),
            lambda v, p: ca.SX(0),
        )


def test_system_without_coordinates_is_refused() -> None:
    with pytest.raises(ModelError, match="found none"):
        LagrangianSystem.build((), lambda q, v, p: ca.SX(0), lambda v, p: ca.SX(0))


def test_names_and_units_follow_the_coordinate() -> None:
    angle = Coordinate("phi", "rad", topology="circle")
    charge = Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A")
    assert (angle.velocity, angle.acceleration, angle.acceleration_unit) == ("phi_dot", "phi_ddot", "rad/s2")
    assert (charge.acceleration, charge.acceleration_unit) == ("i_dot", "A/s")
    assert state_names((angle, charge)) == ["phi", "phi_dot", "i"]
    assert state_units((angle, charge)) == ["rad", "rad/s", "A"]


def test_accelerations_and_nothing_else_depend_on_the_inputs() -> None:
    through = {o.name: DCWC.feed_through(o.name) for o in DCWC.output_list}
    assert {name for name, inputs in through.items() if inputs} == {"alpha_ddot", "i_dot"}


def test_unknown_plant_lists_those_there_are() -> None:
    with pytest.raises(Exception, match="dc_motor_cart"):
        plant("dc_motor")


def test_a_force_besides_the_inputs_acts_as_an_input_does():
    system, x = DCWC.system, np.array([0.3, 1.0, -0.5])
    force, p = np.array([0.2, -3.0]), P
    pushed = evaluate(system.loaded().derivative, x, np.zeros(2), np.concatenate([p, force]))
    np.testing.assert_allclose(pushed, evaluate(system.derivative, x, force, p), atol=1e-14)
    units = [q.unit for q in system.loaded().parameters[-2:]]
    assert units == ["N.m", "V"]

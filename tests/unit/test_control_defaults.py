"""What a scenario leaves open is derived from model and reference; units do not matter."""

from __future__ import annotations

import numpy as np
import pytest
from control_helpers import close_loop, constant, controller

from exlinn_fmi.control.qp import StageQp, make_qp_solver
from exlinn_fmi.control.scaling import ScaledQp, units
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants import plant
from exlinn_fmi.scenario.control import Reference, Weights
from exlinn_fmi.scenario.signals import Sine
from exlinn_fmi.scenario.spec import Bounds


def spring(stiffness: float, mass: float = 1.0) -> LagrangianSystem:
    """A damped mass on a spring."""
    return LagrangianSystem.build(
        (Coordinate("x", "m", input="f", input_unit="N"),),
        lambda q, v, p: 0.5 * mass * v[0] ** 2 - 0.5 * stiffness * q[0] ** 2,
        lambda v, p: 0.1 * mass * v[0] ** 2,
    )


@pytest.mark.parametrize(
    ("stiffness", "horizon"),
    [(25.0, 30), (100.0, 15), (1e4, 10), (0.25, 100)],
    ids=["", "fast", "min", "max"],
)
def test_the_horizon_is_one_and_a_half_of_the_slowest_response(stiffness, horizon):
    made = controller(spring(stiffness), reference=constant("x", 0.1))
    assert made._ocp.horizon == horizon  # 1.5/√stiffness over 10 ms, within 10 … 100


def test_substeps_follow_the_fastest_pole():
    assert controller()._ocp.discrete.n_instructions() < 500
    stiff = controller(spring(9e4), reference=constant("x", 0.1))  # |λ| = 300 1/s, six in 10 ms
    one = controller(spring(9e4), reference=constant("x", 0.1), substeps=1)
    six = controller(spring(9e4), reference=constant("x", 0.1), substeps=6)
    counts = [made._ocp.discrete.n_instructions() for made in (stiff, one, six)]
    assert counts[0] == counts[2] > counts[1]


def test_weights_that_are_given_are_taken():
    made = controller(weights=Weights(states=7.0, inputs={"v": 2.0}))._ocp
    np.testing.assert_array_equal(made.Q, np.diag([7.0, 0.0, 0.0]))
    np.testing.assert_array_equal(made.R, [[2.0]])


def test_an_input_weighs_one_at_half_of_its_range():
    made = controller(inputs={"v": Bounds(min=-2.0, max=6.0)})._ocp
    assert pytest.approx(1 / 16) == made.R


def test_the_papers_cost_has_the_papers_weights():
    made = controller(cost="paper")._ocp
    assert (made.Q[0, 0], made.R[0, 0]) == (10.0, 1e-3)


def test_the_closed_loop_is_the_same_in_other_units_of_force():
    """A force counted in units a thousand times as large, of a system a thousand times as heavy."""
    bounds, reference = (
        Bounds(min=-30.0, max=30.0),
        Reference(coordinate="x", trajectory=Sine(signal="sine", amplitude=0.3, frequency=1.0)),
    )
    heavy = Bounds(min=-3e4, max=3e4)
    one = controller(spring(25.0), reference=reference, inputs={"f": bounds})
    other = controller(spring(25e3, 1e3), reference=reference, inputs={"f": heavy})
    rows = close_loop(one, np.zeros(2), 1.0, system=spring(25.0))
    scaled = close_loop(other, np.zeros(2), 1.0, system=spring(25e3, 1e3))
    np.testing.assert_allclose(rows["x"], scaled["x"], atol=1e-7)


def test_a_plate_of_nanocoulombs_and_kilovolts_is_tracked():
    system = plant("mems_actuator").system.with_inputs(["v"])
    path = Sine(signal="sine", amplitude=4e-4, frequency=1.0, offset=1e-3)
    made = controller(
        system,
        reference=Reference(coordinate="x", trajectory=path),
        inputs={"v": Bounds(min=0.0, max=2000.0)},
    )
    rows = close_loop(made, np.array([1e-3, 9e-8, 0.0, 0.0]), 0.6, system=system)
    assert np.abs(rows["x"] - rows["reference"])[-20:].max() < 1e-9
    assert np.all(rows["solve_status"] == 0)


# ── units of the quadratic programs ──────────────────────────────────────────────────────────────────────


def program(n: int, m: int, soft: int, spread: float, seed: int) -> StageQp:
    """A program whose states are counted in units `spread` apart."""
    rng, N = np.random.default_rng(seed), 5
    s = np.logspace(0.0, np.log10(spread), n)
    A, B = rng.normal(size=(N, n, n)) * s[:, None] / s, rng.normal(size=(N, n, m)) * s[:, None]
    H = np.diag(1.0 / s**2)
    return StageQp(
        A=A,
        B=B,
        c=rng.normal(size=(N, n)) * s,
        dx0=rng.normal(size=n) * s,
        H_x=H,
        H_end=3.0 * H,
        H_u=np.eye(m),
        g=rng.normal(size=(N + 1, n)) / s,
        r=rng.normal(size=(N, m)),
        u_low=np.full((N, m), -0.5),
        u_high=np.full((N, m), 0.5),
        low=np.tile(-2.0 * s[:soft], (N, 1)),
        high=np.tile(2.0 * s[:soft], (N, 1)),
        l1=50.0 / s[:soft],
        l2=50.0 / s[:soft] ** 2,
    )


@pytest.mark.parametrize("seed", range(5))
def test_units_change_nothing_but_the_numbers(seed):
    soft = np.arange(2)
    even = make_qp_solver(5, 3, 2, soft).solve(program(3, 2, 2, 1.0, seed))
    wide = ScaledQp(make_qp_solver(5, 3, 2, soft), soft).solve(program(3, 2, 2, 1e12, seed))
    assert even.solved
    assert wide.solved
    s = np.logspace(0.0, 12.0, 3)
    np.testing.assert_allclose(wide.du, even.du, atol=1e-6)
    np.testing.assert_allclose(wide.dx / s, even.dx, atol=1e-5)
    np.testing.assert_allclose(wide.slack / s[:2], even.slack, atol=1e-5)


def test_units_are_powers_of_two_and_ones_where_nothing_is_gained():
    x, u = units(np.diag([4.0, 1e14]), np.eye(1), np.zeros((2, 1)))
    np.testing.assert_array_equal(x, [0.5, 2.0**-23])
    np.testing.assert_array_equal(u, [1.0])
    np.testing.assert_array_equal(units(np.diag([4.0, 1e4]), np.eye(1), np.zeros((2, 1)))[0], [1.0, 1.0])
    np.testing.assert_array_equal(units(np.zeros((2, 2)), np.eye(1), np.zeros((2, 1)))[0], [1.0, 1.0])

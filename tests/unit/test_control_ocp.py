"""The optimal control problem: sensitivities, cost, bounds, terminal weight."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from control_helpers import CART, LIMITS, STEP, arm, constant, generator, motor_cart, oscillator
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.control.ocp import FALLBACK_TERMINAL, Ocp, rk4_sensitivities
from exlinn_fmi.control.riccati import solve_dare
from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.scenario.control import Nmpc, Weights
from exlinn_fmi.scenario.spec import Bounds


def ocp(system: LagrangianSystem, **options) -> Ocp:
    spec = Nmpc(**({"reference": CART} | options))
    return Ocp(system, spec, STEP, [system.state_names.index(spec.reference.coordinate)])


# ── Riccati ──────────────────────────────────────────────────────────────────────────────────────────────


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 6), m=st.integers(1, 3))
def test_dare_is_that_of_scipy(seed, n, m):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    root, R = rng.normal(size=(n, n)), np.diag(rng.uniform(0.1, 2.0, m))
    Q = root @ root.T + 0.1 * np.eye(n)
    P = solve_dare(A, B, Q, R)
    expected = scipy.linalg.solve_discrete_are(A, B, Q, R)
    np.testing.assert_allclose(P, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_dare_of_what_cannot_be_stabilised_is_none():
    assert solve_dare(2.0 * np.eye(1), np.zeros((1, 1)), np.eye(1), np.eye(1)) is None


def test_dare_of_what_is_not_finite_is_none():
    assert solve_dare(np.full((1, 1), np.nan), np.eye(1), np.eye(1), np.eye(1)) is None


def test_dare_with_a_singular_input_weight_is_none():
    assert solve_dare(np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1))) is None


# ── dynamics ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("substeps", [1, 3])
@pytest.mark.parametrize("system", [motor_cart(), arm(), oscillator()], ids=["motor", "arm", "oscillator"])
def test_chained_sensitivities_are_the_derivatives_of_rk4(system, substeps):
    n, m, p = len(system.state_names), len(system.input_names), system.parameter_values
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    step = system.rk4(substeps)(x, u, p, STEP)
    direct = ca.Function("direct", [x, u], [step, ca.jacobian(step, x), ca.jacobian(step, u)])
    at = np.linspace(-1.0, 2.0, n), np.linspace(0.5, 3.0, m)
    found = rk4_sensitivities(system, substeps)(*at, p, STEP)
    for one, other in zip(found, direct(*at), strict=True):
        np.testing.assert_allclose(one.full(), other.full(), atol=1e-14)


def test_linearisation_follows_a_small_change_of_the_plan():
    made, rng = ocp(motor_cart()), np.random.default_rng(0)
    x, u = rng.normal(size=(31, 3)), rng.normal(size=(30, 1))
    dx, du = 1e-5 * rng.normal(size=(31, 3)), 1e-5 * rng.normal(size=(30, 1))
    at = made.linearise(x, u, np.zeros(2))
    change = np.einsum("kij,kj->ki", at.A, dx[:-1]) + np.einsum("kij,kj->ki", at.B, du)
    np.testing.assert_allclose(made.predict(x + dx, u + du, np.zeros(2)) - at.next, change, atol=1e-11)
    np.testing.assert_array_equal(made.predict(x, u, np.zeros(2)), at.next)


def test_results_of_a_linearisation_survive_the_next_one():
    made = ocp(motor_cart())
    first = made.linearise(np.zeros((31, 3)), np.zeros((30, 1)), np.zeros(2))
    kept = first.A.copy()
    made.linearise(np.ones((31, 3)), np.ones((30, 1)), np.zeros(2))
    np.testing.assert_array_equal(first.A, kept)


def test_a_shifted_plan_begins_one_interval_later_and_ends_where_the_model_says():
    made = ocp(oscillator(), reference=constant("x", 0.0), horizon=3)
    x, u = np.arange(8.0).reshape(4, 2), np.arange(3.0)[:, None]
    later_x, later_u = made.shift(x, u, np.zeros(1))
    np.testing.assert_array_equal(later_x[:3], x[1:])
    np.testing.assert_array_equal(later_u[:, 0], [1.0, 2.0, 2.0])
    np.testing.assert_allclose(later_x[3], evaluate(made.discrete, x[3], u[2], [0.0], [STEP])[0])


# ── cost ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_cost_is_that_of_equation_13_without_a_last_input():
    made = ocp(oscillator(), reference=constant("x", 0.0), horizon=2, cost="paper")
    targets = made.targets(generator(oscillator(), constant("x", 0.0), 2).over(0.0, np.zeros(2), (0,)))
    x, u = np.array([[1.0, 9.0], [2.0, 9.0], [3.0, 4.0]]), np.array([[5.0], [6.0]])
    end = x[2] @ targets.P @ x[2]
    assert made.cost(x, u, targets) == pytest.approx(10 * (1 + 4) + 1e-3 * (25 + 36) + end)


def test_one_number_weighs_the_referenced_state():
    np.testing.assert_array_equal(np.diag(ocp(motor_cart()).Q), [10.0, 0.0, 0.0])


def test_weights_by_name_are_taken_as_they_are():
    made = ocp(motor_cart(), weights=Weights(states={"i": 2.0, "alpha": 1.0}, inputs={"v": 0.5}))
    np.testing.assert_array_equal(np.diag(made.Q), [1.0, 0.0, 2.0])
    assert made.R == [[0.5]]


def test_cost_of_the_paper_weighs_the_whole_input_and_tracking_its_deviation():
    references = generator(motor_cart()).over(0.0, np.array([np.pi / 2, 0.0, 0.0]), (0,))
    assert np.all(ocp(motor_cart(), cost="paper").targets(references).u == 0.0)
    np.testing.assert_array_equal(ocp(motor_cart()).targets(references).u, references.u)


def test_terminal_weight_solves_the_riccati_equation_at_the_horizons_end():
    made = ocp(motor_cart())
    references = generator(motor_cart()).over(0.0, np.array([np.pi / 2, 0.0, 0.0]), (0,))
    targets = made.targets(references)
    A, B = made.linearise_at(references.x[-1], references.u[-1], np.zeros(2))
    expected = scipy.linalg.solve_discrete_are(A, B, made.Q, made.R)
    np.testing.assert_allclose(targets.P, expected, rtol=1e-8, atol=1e-8 * expected.max())
    assert targets.riccati


def test_terminal_weight_may_be_a_multiple_of_q():
    made = ocp(motor_cart(), weights=Weights(terminal=3.0))
    targets = made.targets(generator(motor_cart()).over(0.0, np.zeros(3), (0,)))
    np.testing.assert_array_equal(targets.P, 3.0 * made.Q)
    assert not targets.riccati


def test_without_a_riccati_solution_the_terminal_weight_is_a_multiple_of_q():
    # The pendulum hangs upside down and no input reaches it.
    lost = LagrangianSystem.build(
        (Coordinate("a", "rad", input="t"), Coordinate("b", "rad")),
        lambda q, v, p: 0.5 * ca.sumsqr(v) - 10.0 * ca.cos(q[1]),
        lambda v, p: 0.0 * v[0],
    )
    made = ocp(lost, reference=constant("b", 0.1))
    targets = made.targets(generator(lost, constant("b", 0.1)).over(0.0, np.zeros(4), (0,)))
    assert not targets.riccati
    np.testing.assert_array_equal(targets.P, FALLBACK_TERMINAL * made.Q)


def test_an_input_without_weight_has_a_riccati_solution():
    made = ocp(motor_cart(), weights=Weights(inputs=0.0))
    assert made.targets(generator(motor_cart()).over(0.0, np.zeros(3), (0,))).riccati


# ── bounds ───────────────────────────────────────────────────────────────────────────────────────────────


def test_state_bounds_are_moved_inwards_by_the_back_off():
    lim = ocp(motor_cart(), **LIMITS).limits
    assert lim.soft == [2]
    assert lim.x_max == [4.0 * (1 - 0.005)]
    assert lim.x_min == [-4.0 * (1 - 0.005)]


def test_a_bound_on_one_side_leaves_the_other_free():
    lim = ocp(motor_cart(), states={"i": Bounds(max=4.0), "alpha": Bounds(min=0.0)}).limits
    np.testing.assert_array_equal(lim.soft, [0, 2])
    np.testing.assert_array_equal(lim.x_min, [0.005, -np.inf])
    assert lim.x_max[0] == np.inf


def test_violation_is_penalised_and_reported_over_the_range_of_the_bound():
    made = ocp(motor_cart(), **LIMITS)
    x = np.zeros((31, 3))
    assert made.penalty(x) == made.slack(x) == 0.0
    x[7, 2] = -6.0
    assert made.slack(x) == pytest.approx(0.5)
    s = 2.0 + 4.0 * 0.005
    assert made.penalty(x) == pytest.approx(made.l1[0] * s + made.l2[0] * s**2 / 2)


def test_references_are_kept_within_bounds():
    tight = {"inputs": {"v": Bounds(min=-1.0, max=1.0)}, "states": {"i": Bounds(min=-0.1, max=0.1)}}
    made = ocp(motor_cart(), **tight)
    targets = made.targets(generator(motor_cart()).over(0.0, np.array([np.pi / 2, 0.0, 0.0]), (0,)))
    assert np.abs(targets.u).max() <= 1.0
    assert np.abs(targets.x[:, 2]).max() <= 0.1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"inputs": {"V": Bounds(max=1.0)}}, r"^inputs: the model has no 'V'; the inputs are: v"),
        ({"states": {"alpah": Bounds(max=1.0)}}, r"^states: .* did you mean 'alpha'"),
        ({"weights": Weights(states={"j": 1.0})}, r"^weights.states: the model has no 'j'"),
        ({"weights": Weights(inputs={"w": 1.0})}, r"^weights.inputs: the model has no 'w'"),
        ({"inputs": {"v": Bounds(min=2.0, max=1.0)}}, r"^inputs.v: min 2 is above max 1; exchange them"),
    ],
)
def test_wrong_names_and_bounds_are_refused(options, message):
    with pytest.raises(ModelError, match=message):
        ocp(motor_cart(), **options)


def test_a_model_without_input_is_refused():
    free = LagrangianSystem.build(
        (Coordinate("x", "m"),), lambda q, v, p: 0.5 * v[0] ** 2, lambda v, p: 0.1 * v[0] ** 2
    )
    with pytest.raises(ModelError, match="no input that the controller could move"):
        ocp(free, reference=constant("x", 0.0))

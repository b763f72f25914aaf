"""States and disturbances from what is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from control_helpers import (
    CART,
    HERE,
    LIMITS,
    STEP,
    constant,
    controller,
    levitation,
    measure,
    motor_cart,
    oscillator,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Status
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.control.estimator import (
    Belief,
    Direct,
    Estimator,
    ExtendedKalman,
    Noise,
    unobservable,
)
from exlinn_fmi.control.moving_horizon import MovingHorizon
from exlinn_fmi.control.riccati import solve_dare
from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.control import Estimator as Spec
from exlinn_fmi.scenario.control import Nmpc

START = np.array([np.pi / 2, 0.0, 0.0])


def noise(measured: list[bool], coordinates: int, disturbed: list[int], size: float = 1.0) -> Noise:
    """Everything of size one, sensors a hundredth of that."""
    n, d = len(measured), len(disturbed)
    return Noise(
        measured=np.array(measured),
        measurement=np.full(n, 0.01 * size),
        process=np.zeros(n),
        force=np.full(coordinates, 0.1),
        disturbed=np.array(disturbed, dtype=np.intp),
        walk=np.full(d, 0.5),
        first=np.full(n + d, size),
    )


def kalman(**options) -> ExtendedKalman:
    return ExtendedKalman(oscillator(), noise([True, False], 1, [0]), STEP, 1, **options)


def run(made: Estimator, inputs: np.ndarray, measurements: np.ndarray) -> list[Belief]:
    """Beliefs after each measurement; the first begins at it."""
    beliefs = [made.begin(measurements[0], np.zeros(made.n))]
    for u, y in zip(inputs, measurements[1:], strict=True):
        beliefs.append(made.update(made.predict(beliefs[-1], u), y))
    return beliefs


def motion(
    system: LagrangianSystem, x: np.ndarray, inputs: np.ndarray, force: np.ndarray | None = None
) -> np.ndarray:
    """States of the true system under inputs and a constant force."""
    loaded, states = system.loaded(), [x]
    p = np.concatenate([system.parameter_values, np.zeros(system.n) if force is None else force])
    step = loaded.rk4()
    for u in inputs:
        states.append(evaluate(step, states[-1], u, p, [STEP])[0])
    return np.array(states)


# ── filters ──────────────────────────────────────────────────────────────────────────────────────────────


def test_of_a_linear_system_it_is_the_kalman_filter():
    rng, made = np.random.default_rng(1), kalman()
    inputs, y = rng.normal(size=(20, 1)), np.column_stack([rng.normal(size=21), np.full(21, np.nan)])
    _, F, Q = made.linearised(np.zeros((1, 3)), np.zeros((1, 1)))
    by_input = made.linearised(np.zeros((1, 3)), np.ones((1, 1)))[0][0]
    C, R = np.array([[1.0, 0.0, 0.0]]), np.array([[1e-4]])
    z, P = np.array([y[0, 0], 0.0, 0.0]), np.diag([1e-4, 1.0, 1.0])
    for u, seen in zip(inputs, y[1:, 0], strict=True):
        z, P = F[0] @ z + by_input * u, F[0] @ P @ F[0].T + Q[0]
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        z, P = z + K[:, 0] * (seen - z[0]), (np.eye(3) - K @ C) @ P
    found = run(made, inputs, y)[-1]
    np.testing.assert_allclose(found.mean, z, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, P, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("window", [1, 4, 30])
def test_of_a_linear_system_the_moving_horizon_is_the_kalman_filter(window):
    rng = np.random.default_rng(2)
    inputs, y = rng.normal(size=(12, 1)), np.column_stack([rng.normal(size=13), np.full(13, np.nan)])
    y[5] = np.nan
    moving = MovingHorizon(oscillator(), noise([True, False], 1, [0]), STEP, 1, window, iterations=1)
    for one, other in zip(run(moving, inputs, y), run(kalman(), inputs, y), strict=True):
        np.testing.assert_allclose(one.mean, other.mean, rtol=1e-7, atol=1e-9)


def test_the_steady_gain_is_where_the_updated_one_goes():
    made = kalman()
    inputs, y = np.zeros((400, 1)), np.column_stack([np.zeros(401), np.full(401, np.nan)])
    P = made.predict(run(made, inputs, y)[-1], np.zeros(1)).covariance
    steady = kalman(steady=(np.zeros(2), np.zeros(1)))
    assert steady.settled
    np.testing.assert_allclose(P, steady.fixed, rtol=1e-6)
    belief = replace(made.begin(np.zeros(2), np.zeros(2)), covariance=np.eye(3))
    np.testing.assert_allclose(
        steady.update(belief, np.array([1.0, np.nan])).mean,
        made.update(replace(belief, covariance=P), np.array([1.0, np.nan])).mean,
        rtol=1e-6,
    )


def test_a_disturbance_that_is_never_corrected_has_no_steady_gain():
    lost = noise([True, False], 1, [0])
    lost = replace(lost, measured=np.array([False, False]))
    assert not ExtendedKalman(oscillator(), lost, STEP, 1, (np.zeros(2), np.zeros(1))).settled


@pytest.mark.parametrize("kind", ["ekf", "mhe"])
def test_a_constant_force_and_an_unmeasured_speed_are_found(kind):
    system, force = motor_cart(), np.array([0.1, -0.5])
    spec = noise([True, False, True], 2, [0, 1])
    made = (
        ExtendedKalman(system, spec, STEP, 1)
        if kind == "ekf"
        else MovingHorizon(system, spec, STEP, 1, window=8, iterations=2)
    )
    inputs = 3.0 + np.sin(0.3 * np.arange(300))[:, None]
    x = motion(system, START, inputs, force)
    y = np.where([True, False, True], x, np.nan)
    found = run(made, inputs, y)[-1]
    np.testing.assert_allclose(made.state(found), x[-1], atol=1e-6)
    np.testing.assert_allclose(made.force(found.mean), force, atol=1e-5)


def falling_ball(
    current: float, speed: float, ticks: int
) -> tuple[Noise, np.ndarray, np.ndarray, np.ndarray]:
    """A levitated ball of which the height alone is measured, well; its speed and current are unknown."""
    spec = noise([True, False, False], 2, [])
    sizes = {"measurement": np.full(3, 1e-4), "first": np.array([1e-4, 1.0, 4.0]), "force": np.full(2, 1e-3)}
    inputs = np.full((ticks, 1), 10.0)
    x = motion(levitation(), np.array([0.05, speed, current]), inputs)
    return replace(spec, **sizes), inputs, x, np.where([True, False, False], x, np.nan)


def test_a_window_finds_the_state_of_a_nonlinear_motion_where_a_filter_is_misled():
    spec, inputs, x, y = falling_ball(2.0, 0.6, 8)
    filtered = run(ExtendedKalman(levitation(), spec, STEP, 1), inputs, y)[-1]
    window = run(MovingHorizon(levitation(), spec, STEP, 1, 30, 4), inputs, y)[-1]
    assert abs(window.mean[1] - x[-1, 1]) < 0.01 * abs(filtered.mean[1] - x[-1, 1])


def test_a_window_that_leads_nowhere_ends_in_no_exception():
    spec, inputs, _, y = falling_ball(4.0, 0.0, 12)
    assert not run(MovingHorizon(levitation(), spec, STEP, 1, 30, 4), inputs, y)[-1].finite


def test_what_is_not_measured_is_predicted():
    made = kalman()
    belief = made.begin(np.array([0.3, np.nan]), np.array([0.0, -0.2]))
    np.testing.assert_array_equal(belief.mean, [0.3, -0.2, 0.0])
    ahead = made.predict(belief, np.array([1.0]))
    lost = made.update(ahead, np.full(2, np.nan))
    np.testing.assert_array_equal(lost.mean, ahead.mean)
    np.testing.assert_array_equal(lost.covariance, ahead.covariance)


def test_directly_measured_states_are_taken_as_they_are():
    made = Direct(oscillator(), noise([True, True], 1, []), STEP, 1)
    belief = made.predict(made.begin(np.array([0.1, 0.2]), np.zeros(2)), np.array([1.0]))
    expected = evaluate(oscillator().rk4(), [0.1, 0.2], [1.0], [], [STEP])[0]
    np.testing.assert_allclose(belief.mean, expected)
    np.testing.assert_allclose(made.update(belief, np.array([9.0, np.nan])).mean, [9.0, expected[1]])


@settings(max_examples=20, deadline=None)
@given(turns=st.integers(-3, 3))
def test_an_angle_is_corrected_by_the_shorter_way_round(turns):
    made = ExtendedKalman(motor_cart(), noise([True, False, True], 2, [0]), STEP, 1)
    belief = made.predict(made.begin(np.array([1.0, np.nan, 0.2]), np.zeros(3)), np.zeros(1))
    straight = made.update(belief, np.array([1.1, np.nan, 0.2]))
    turned = made.update(belief, np.array([1.1 + 2 * np.pi * turns, np.nan, 0.2]))
    np.testing.assert_allclose(turned.mean, straight.mean, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
@example(seed=102)
@example(seed=773)
def test_covariances_stay_symmetric_and_positive(seed):
    rng = np.random.default_rng(seed)
    # Measured along a motion: what no motion explains sends the filter where the model is not finite, and
    # the controller then begins anew.
    inputs = 10 * rng.normal(size=(30, 1))
    y = motion(motor_cart(), 3 * rng.normal(size=3), inputs) + 0.01 * rng.normal(size=(31, 3))
    y[1:][rng.random((30, 3)) < 0.3] = np.nan
    made = ExtendedKalman(motor_cart(), noise([True, False, True], 2, [0, 1]), STEP, 1)
    P = run(made, inputs, y)[-1].covariance
    assert np.isfinite(P).all()
    np.testing.assert_allclose(P, P.T, rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(P)[0] > -1e-12


def test_what_measurements_do_not_tell_is_named():
    glider = LagrangianSystem.build(
        (Coordinate("x", "m", input="f"),), lambda q, v, p: 0.5 * v[0] ** 2, lambda v, p: 0.1 * v[0] ** 2
    )
    made = ExtendedKalman(glider, noise([False, True], 1, [0]), STEP, 1)
    assert unobservable(made, np.zeros(2), np.zeros(1)) == ["x"]
    assert unobservable(kalman(), np.zeros(2), np.zeros(1)) == []


def test_the_steady_covariance_solves_the_riccati_equation_of_the_filter():
    made = kalman(steady=(np.zeros(2), np.zeros(1)))
    _, F, Q = made.linearised(np.zeros((1, 3)), np.zeros((1, 1)))
    np.testing.assert_allclose(
        made.fixed, solve_dare(F[0].T, np.eye(3)[:, :1], Q[0], np.array([[1e-4]])), rtol=1e-9
    )


# ── in the controller ────────────────────────────────────────────────────────────────────────────────────


def observer(connected: tuple[str, ...] = ("alpha", "i"), **options) -> NmpcController:
    settings_ = Nmpc(**({"reference": CART} | LIMITS | options))
    made = NmpcController("controller", motor_cart(), settings_, STEP, HERE, connected)
    made.enter_initialization(0.0, 10.0, {})
    made.exit_initialization()
    return made


def loaded_loop(made: NmpcController, ticks: int, torque: float, late: bool = False) -> dict[str, np.ndarray]:
    """The motor under a load that the controller does not know of; α and i are measured, some a tick late."""
    system, p, x, rows = PLANT.system, PLANT.system.parameter_values, START, []
    step, seen = system.rk4(10), START
    for k in range(ticks):
        y = seen if late else x
        outputs, _ = measure(made, y[0], 0.0, y[2])
        rows.append(outputs | dict(zip(system.state_names, x, strict=True)))
        made.step(k * STEP, STEP)
        seen, x = x, evaluate(step, x, [torque, outputs["v"]], p, [STEP])[0]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def offset(rows: dict[str, np.ndarray]) -> float:
    """Largest distance of the cart from its reference in the last half second [m]."""
    return float(np.abs(0.2 * np.cos(rows["alpha"]) - rows["reference"])[-50:].max())


@pytest.mark.parametrize(
    ("options", "late"),
    [
        ({}, False),
        ({"estimator": Spec(gain="steady")}, False),
        ({"estimator": Spec(type="mhe", window=5)}, False),
        ({"delay": "measurement"}, True),
        ({"delay": "computation"}, False),
    ],
    ids=["ekf", "steady gain", "mhe", "late measurement", "late input"],
)
def test_under_an_unknown_load_the_cart_is_tracked_without_offset(options, late):
    rows = loaded_loop(observer(**options), 200, 0.1, late)
    assert offset(rows) < 1e-6
    assert rows["disturbance_alpha"][-1] == pytest.approx(0.1, abs=1e-4)
    np.testing.assert_allclose(rows["estimate_alpha_dot"][-50:], rows["alpha_dot"][-50:], atol=1e-4)
    assert np.all(rows["solve_status"] == 0)


def test_without_disturbances_the_load_leaves_an_offset():
    assert offset(loaded_loop(observer(estimator=Spec(disturbances=[])), 150, 0.1)) > 1e-4


def test_a_delay_that_is_not_compensated_costs_a_thousand_times_the_error():
    assert offset(loaded_loop(observer(), 150, 0.0, late=True)) > 1e-3


def test_an_input_that_takes_a_sample_is_the_answer_to_the_tick_before():
    made = observer(("alpha", "alpha_dot", "i"), delay="computation", safe_input={"v": 2.0})
    first = measure(made, *START)[0]["v"]
    made.step(0.0, STEP)
    second = measure(made, 1.5, 0.1, 0.0)[0]["v"]
    again = measure(made, 0.5, 3.0, 1.0)[0]["v"]
    assert first == 2.0
    assert second == again != first


def test_a_state_that_is_not_connected_is_estimated_and_one_that_is_not():
    assert isinstance(observer()._estimator, ExtendedKalman)
    assert isinstance(observer(("alpha", "alpha_dot", "i"))._estimator, Direct)
    assert isinstance(controller()._estimator, Direct)
    assert isinstance(observer(estimator="none")._estimator, Direct)
    named = observer(("alpha", "alpha_dot", "i"), estimator=Spec(type="ekf", measured=["alpha"]))
    np.testing.assert_array_equal(named._estimator.noise.measured, [True, False, False])


def test_disturbances_are_as_many_as_the_measurements_tell_apart():
    assert list(observer()._estimator.noise.disturbed) == [0, 1]
    assert list(observer(("alpha",))._estimator.noise.disturbed) == [0]
    chosen = observer(estimator=Spec(type="ekf", disturbances={"Q": 2.0}))._estimator.noise
    assert (list(chosen.disturbed), list(chosen.walk)) == ([1], [2.0])


def test_noise_is_a_share_of_the_size_or_as_given():
    default = observer()._estimator.noise.measurement
    share = observer(estimator=Spec(type="ekf", noise=1e-2))._estimator.noise.measurement
    np.testing.assert_allclose(share, 100 * default)
    own = observer(estimator=Spec(type="ekf", noise={"i": 0.05}, process={"i": 2.0}))._estimator.noise
    np.testing.assert_allclose(own.measurement, [*default[:2], 0.05])
    np.testing.assert_array_equal(own.process, [0, 0, 2.0])


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Spec(measured=["w"]), r"nmpc.estimator.measured: the model has no 'w'"),
        (Spec(noise={"w": 1.0}), r"nmpc.estimator.noise: the model has no 'w'"),
        (Spec(process={"w": 1.0}), r"nmpc.estimator.process: the model has no 'w'"),
        (Spec(disturbances=["i"]), r"nmpc.estimator.disturbances: the model has no 'i'"),
    ],
)
def test_wrong_names_are_refused_with_their_place(spec, message):
    with pytest.raises(ModelError, match=message):
        observer(estimator=spec)


def test_nothing_measured_is_refused():
    with pytest.raises(ModelError, match=r"no state is measured; connect some of alpha, alpha_dot, i"):
        observer(())


def test_doubts_about_the_estimator_are_told():
    hidden = observer(("alpha_dot", "i"), reference=constant("alpha", 0.0), estimator="ekf").warnings
    assert any("what is measured does not tell alpha at the start" in w for w in hidden)
    steady = observer(
        ("alpha_dot", "i"), reference=constant("alpha", 0.0), estimator=Spec(type="ekf", gain="steady")
    ).warnings
    assert any("no steady state" in w for w in steady)


def test_a_measurement_that_drops_out_is_told_and_survived():
    made = observer()
    measure(made, *START)
    made.step(0.0, STEP)
    outputs, status = measure(made, np.nan, 0.0, 0.0)
    assert (status, outputs["missing"], outputs["solve_status"]) == (Status.WARNING, 1, 0)
    assert "measurement of alpha is not finite" in made.message


def test_an_estimate_that_was_led_astray_begins_anew():
    made = observer()
    measure(made, *START)
    made.step(0.0, STEP)
    made._memory = replace(made._memory, belief=replace(made._memory.belief, mean=np.full(5, np.nan)))
    outputs, status = measure(made, *START)
    assert (status, outputs["estimate_alpha"]) == (Status.OK, START[0])


def test_a_covariance_in_which_the_noise_is_lost_begins_anew():
    made = observer()
    measure(made, *START)
    made.step(0.0, STEP)
    lost = replace(made._memory.belief, covariance=np.full((5, 5), 1e120))
    assert not made._estimator.update(lost, START).finite
    made._memory = replace(made._memory, belief=lost)
    outputs, status = measure(made, *START)
    assert (status, outputs["estimate_alpha"]) == (Status.OK, START[0])


@pytest.mark.parametrize("seed", [0, 102, 773, 861])
def test_measurements_that_no_motion_explains_end_in_no_exception(seed):
    made, rng = observer(), np.random.default_rng(seed)
    for k, y in enumerate(3 * rng.normal(size=(31, 3))):
        outputs, _ = measure(made, y[0], 0.0, y[2])
        made.step(k * STEP, STEP)
        assert np.isfinite(outputs["v"])

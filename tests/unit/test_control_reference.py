"""Reference states and inputs by inverting the model."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from control_helpers import (
    CART,
    STEP,
    arm,
    constant,
    generator,
    levitation,
    motor_cart,
    oscillator,
    plate_actuator,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.errors import DataError, ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.scenario.control import Linear, Reference, ScotchYoke
from exlinn_fmi.scenario.signals import Sine, Step, Table

START = np.array([np.pi / 2, 0.0, 0.0])


def sine(coordinate: str, amplitude: float = 1.0, offset: float = 0.0, frequency: float = 0.4) -> Reference:
    signal = Sine(signal="sine", amplitude=amplitude, frequency=frequency, offset=offset)
    return Reference(coordinate=coordinate, trajectory=signal)


def assert_follows_model(system: LagrangianSystem, made: References, step: float = STEP) -> None:
    """The derivative of x* by differences is what the model says of x* and u*."""
    x, h = made.grid_x, step / 2
    slope = (x[:-4] - 8 * x[1:-3] + 8 * x[3:-1] - x[4:]) / (12 * h)
    model = evaluate(system.derivative, x[2:-2], made.grid_u[2:-2], system.parameter_values)
    np.testing.assert_allclose(slope, model, atol=1e-4 * (1 + np.abs(model).max()))


def test_flat_reference_of_the_motor_is_the_analytic_one():
    made = generator(motor_cart()).over(0.35, START, (0,))
    time = ca.SX.sym("t")
    alpha = ca.acos(0.75 * ca.sin(2 * np.pi * 0.4 * time))

    def dot(y):
        return ca.jacobian(y, time)

    w = dot(alpha)
    inertia = 0.1 + 1.0 * 0.2**2 * ca.sin(alpha) ** 2
    i = (inertia * dot(w) + (0.5 + 1.0 * 0.2**2 * ca.sin(alpha) * ca.cos(alpha) * w) * w) / 1.0
    v = 1.0 * dot(i) + 5.0 * i + 1.0 * w
    exact = ca.Function("exact", [time], [ca.vertcat(alpha, w, i), v]).map(30)
    nodes, middles = 0.35 + STEP * np.arange(30), 0.35 + STEP * (np.arange(30) + 0.5)
    np.testing.assert_allclose(made.x[:30], exact(nodes)[0].full().T, atol=1e-10)
    np.testing.assert_allclose(made.u, exact(middles)[1].full().T, atol=1e-7)
    assert made.quantity[0] == pytest.approx(0.15 * np.sin(2 * np.pi * 0.4 * 0.35))


@pytest.mark.parametrize(
    ("system", "reference", "start"),
    [
        (oscillator(), sine("x"), [0.0, 0.0]),
        (levitation(), sine("x", 0.01, 0.05), [0.05, 0.0, 1.0]),
        (levitation(), sine("x", 0.01, 0.05), [0.05, 0.0, 0.0]),
        (plate_actuator(), sine("x", 0.02, 0.5), [0.5, 0.5, 0.0, 0.0]),
        (motor_cart(), sine("alpha_dot", 2.0, 5.0), START),
    ],
    ids=["one coordinate", "square law", "square law from its singular point", "charge", "speed"],
)
def test_flat_references_obey_the_model(system, reference, start):
    made = generator(system, reference)
    assert made.inversion.flat
    assert_follows_model(system, made.over(0.2, np.array(start), (0,)))


@settings(max_examples=20, deadline=None)
@given(start=st.floats(-20, 20), time=st.floats(0, 10))
def test_reference_stays_on_the_branch_of_the_measured_angle(start, time):
    made = generator(motor_cart(), horizon=5)
    branch = made.branch(np.array([start, 0.0, 0.0]))
    angle = made.over(time, START, branch).grid_x[:, 0]
    assert np.all(np.floor(angle / np.pi) == np.floor(start / np.pi))


def test_moving_on_by_a_step_gives_what_starting_anew_does():
    made = generator(motor_cart())
    moved = made.over(0.0, START, (0,))
    for k in range(1, 70):
        moved = made.over(k * STEP, START, (0,), moved)
    anew = made.over(69 * STEP, START, (0,))
    np.testing.assert_allclose(moved.grid_x, anew.grid_x, atol=1e-8)
    np.testing.assert_allclose(moved.grid_u, anew.grid_u, atol=1e-7)


def test_another_time_or_branch_starts_anew():
    made = generator(motor_cart())
    first = made.over(0.0, START, (0,))
    np.testing.assert_array_equal(made.over(0.5, START, (0,), first).x, made.over(0.5, START, (0,)).x)
    np.testing.assert_array_equal(made.over(STEP, START, (2,), first).x, made.over(STEP, START, (2,)).x)


def test_position_of_a_referenced_speed_is_counted_from_the_measured_one():
    made = generator(motor_cart(), constant("alpha_dot", 3.0)).over(0.0, np.array([7.0, 0.0, 0.0]), (0,))
    np.testing.assert_allclose(made.grid_x[:, 0], 7.0 + 3.0 * STEP / 2 * np.arange(61))


def test_reference_through_a_gear():
    through = Linear(map="linear", gain=0.5, offset=1.0)
    gear = constant("x", 3.0).model_copy(update={"through": through})
    made = generator(oscillator(), gear).over(0.0, np.zeros(2), (0,))
    np.testing.assert_allclose(made.x, np.tile([4.0, 0.0], (31, 1)))
    np.testing.assert_allclose(made.u, 16.0)  # the spring's 4 N/m


@pytest.mark.parametrize(
    ("system", "reference", "why"),
    [
        (arm(), constant("a", 0.3), "0 equations without input do not determine 1"),
        (motor_cart(), constant("i", 1.0), "derivatives of the other coordinates"),
    ],
)
def test_what_is_not_flat_gets_steady_references_and_says_so(system, reference, why):
    made = generator(system, reference)
    assert not made.inversion.flat
    assert why in made.inversion.reason


def test_steady_reference_is_a_rest_of_the_model():
    system = arm()
    made = generator(system, constant("a", 0.3)).over(0.0, np.zeros(4), (0,))
    np.testing.assert_allclose(made.x[:, 0], 0.3)
    np.testing.assert_allclose(made.x[:, 2:], 0.0)
    rate = evaluate(system.derivative, made.x[0], made.u[0], system.parameter_values)
    np.testing.assert_allclose(rate, 0.0, atol=1e-9)


def test_other_coordinates_of_both_kinds_are_not_flat():
    made = LagrangianSystem.build(
        (
            Coordinate("a", "rad", input="ta"),
            Coordinate("b", "rad"),
            Coordinate("Q", "C", "electrical", "cyclic", velocity="i"),
        ),
        lambda q, v, p: 0.5 * ca.sumsqr(v) - (q[0] - q[1]) ** 2 + v[2] * q[1],
        lambda v, p: 0.1 * ca.sumsqr(v),
    )
    assert "some of the other coordinates are cyclic" in generator(made, constant("a", 0.1)).inversion.reason


def test_coordinates_that_nothing_links_are_not_flat():
    made = LagrangianSystem.build(
        (Coordinate("a", "rad", input="ta"), Coordinate("b", "rad")),
        lambda q, v, p: 0.5 * v[0] ** 2 + 0.5 * v[1] ** 2,
        lambda v, p: 0.1 * ca.sumsqr(v),
    )
    assert not generator(made, constant("a", 0.1)).inversion.flat


def test_unreachable_reference_is_finite():
    # No current pushes the ball away from the magnet at ten times its weight.
    wild = sine("x", 0.04, 0.05, frequency=8.0)
    made = generator(levitation(), wild).over(0.0, np.array([0.05, 0.0, 1.0]), (0,))
    assert np.isfinite(made.grid_x).all()
    assert np.isfinite(made.grid_u).all()


def test_reference_of_a_model_that_is_not_finite_is_finite():
    broken = LagrangianSystem.build(
        (Coordinate("x", "m"), Coordinate("Q", "C", "electrical", "cyclic", velocity="i", input="u")),
        lambda q, v, p: 0.5 * ca.sumsqr(v) + ca.sqrt(q[0] - 10) * v[1] ** 2,
        lambda v, p: 0.1 * ca.sumsqr(v),
    )
    made = generator(broken, constant("x", 0.1)).over(0.0, np.zeros(3), (0,))
    assert np.isfinite(made.grid_x).all()


def test_steps_give_rests_on_both_sides():
    jump = Reference(coordinate="x", trajectory=Step(signal="step", time=0.1, before=0.0, after=1.0))
    made = generator(oscillator(), jump).over(0.0, np.zeros(2), (0,))
    np.testing.assert_allclose(made.x[:, 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(made.u[:, 0], np.where(np.arange(30) < 10, 0.0, 4.0), atol=1e-6)


def test_horizon_may_look_beyond_a_table_but_the_run_may_not(tmp_path):
    (tmp_path / "path.csv").write_text("time,y\n0,0\n1,1\n")
    table = Table(signal="table", file="path.csv", column="y", outside="error")
    spec = Reference(coordinate="x", trajectory=table)
    made = ReferenceGenerator(oscillator(), spec, tmp_path, STEP, 30)
    assert made.over(0.9, np.zeros(2), (0,)).x[-1, 0] == pytest.approx(1.0)
    made.check(0.0, 1.0)
    with pytest.raises(DataError):
        made.check(0.0, 2.0)


def test_unknown_coordinate_names_the_nearest():
    with pytest.raises(ModelError, match=r"no state 'alhpa'; did you mean 'alpha'"):
        generator(motor_cart(), constant("alhpa", 0.0))


def test_a_scotch_yoke_needs_a_position():
    yoke = ScotchYoke(map="scotch_yoke", crank=0.2)
    with pytest.raises(ModelError, match="refer to 'alpha'"):
        generator(motor_cart(), constant("alpha_dot", 0.0).model_copy(update={"through": yoke}))


def test_gain_zero_cannot_be_inverted():
    flat = Linear(map="linear", gain=0.0)
    with pytest.raises(ModelError, match="gain: 0 cannot be inverted"):
        generator(motor_cart(), constant("alpha", 0.0).model_copy(update={"through": flat}))


# ── several references, and a force besides the inputs ───────────────────────────────────────────────────


def test_two_references_of_two_driven_coordinates_are_flat():
    system, starts = arm(), np.array([0.3, -0.2, 0.0, 0.0])
    made = generator(system, [sine("a", 0.3), sine("b", 0.2, 0.1)])
    assert made.inversion.flat
    references = made.over(0.2, starts, (0, 0))
    assert_follows_model(system, references)
    np.testing.assert_allclose(references.quantity, references.x[0, :2], atol=1e-12)


def test_one_coordinate_cannot_follow_two_references():
    with pytest.raises(ModelError, match="two references are for the same coordinate"):
        generator(motor_cart(), [CART, constant("alpha_dot", 1.0)])


def test_a_wrong_reference_among_several_is_told_by_its_number():
    with pytest.raises(ModelError, match=r"reference\[1\].coordinate: the model has no state 'w'"):
        generator(motor_cart(), [CART, constant("w", 1.0)])


def test_the_reference_input_holds_against_a_constant_force():
    made, force = generator(motor_cart()), np.array([0.3, -0.5])
    free = made.over(0.0, START, (0,))
    held = made.over(0.0, START, (0,), force=force)
    # k_e i takes the torque over, and r i with the voltage goes with it.
    np.testing.assert_allclose(held.grid_x[:, 2], free.grid_x[:, 2] - 0.3, atol=1e-9)
    np.testing.assert_allclose(held.grid_u[:, 0], free.grid_u[:, 0] - 5.0 * 0.3 + 0.5, atol=1e-8)
    moved = made.over(STEP, START, (0,), free, force)
    np.testing.assert_allclose(moved.grid_u, made.over(STEP, START, (0,), None, force).grid_u, atol=1e-7)


def almost_constant_inductance(share: float) -> LagrangianSystem:
    """A plate actuator whose inductance depends on the plate's position: no flat output, strictly."""
    return LagrangianSystem.build(
        (
            Coordinate("x", "m"),
            Coordinate("Q", "C", "electrical", "line", velocity="i", velocity_unit="A", input="u"),
        ),
        lambda q, v, p: (
            0.5 * v[0] ** 2
            + 0.5 * (1 + share * q[0]) * v[1] ** 2
            - 0.5 * q[0] ** 2
            - 0.5 * q[1] ** 2 * (2.0 - q[0])
        ),
        lambda v, p: 0.5 * v[0] ** 2 + 0.5 * v[1] ** 2,
    )


def test_a_system_that_is_flat_but_for_its_error_is_taken_for_flat():
    system = almost_constant_inductance(1e-3)
    made = generator(system, sine("x", 0.02, 0.5))
    assert made.inversion.flat
    assert_follows_model(system, made.over(0.2, np.array([0.5, 0.5, 0.0, 0.0]), (0,)))
    exact = generator(plate_actuator(), sine("x", 0.02, 0.5)).over(0.2, np.array([0.5, 0.5, 0.0, 0.0]), (0,))
    near = made.over(0.2, np.array([0.5, 0.5, 0.0, 0.0]), (0,))
    assert 0.0 < np.abs(near.grid_u - exact.grid_u).max() < 1e-3


def test_a_system_that_is_far_from_flat_is_not():
    made = generator(almost_constant_inductance(100.0), sine("x", 0.2, 0.5, frequency=2.0))
    assert not made.inversion.flat

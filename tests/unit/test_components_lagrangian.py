"""In-process plants and bare systems as components: closed forms and reference solutions."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from fmu_helpers import Driver
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from exlinn_fmi.components.base import Status
from exlinn_fmi.components.lagrangian import LagrangianComponent
from exlinn_fmi.errors import InputError
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, bind, feed_through, internal_steps
from exlinn_fmi.plants import plant

PLANT = plant("dc_motor_cart")


@pytest.fixture
def oscillator() -> LagrangianSystem:
    """x'' = −x + F: x = cos t from (1, 0)."""
    return LagrangianSystem.build(
        (Coordinate("x", "m", input="F", input_unit="N"),),
        lambda q, v, p: (v[0] ** 2 - q[0] ** 2) / 2,
        lambda v, p: ca.SX(0),
    )


def test_an_oscillator_follows_the_cosine(oscillator: LagrangianSystem) -> None:
    driver = Driver(LagrangianComponent("o", oscillator)).begin(h=0.01, x=1.0)
    driver.run(100)
    expected = [np.cos(1.0), -np.sin(1.0), -np.cos(1.0), 0.5]
    assert driver.get("x", "x_dot", "x_ddot", "energy") == pytest.approx(expected, abs=1e-12)


def test_the_internal_step_is_bounded(oscillator: LagrangianSystem) -> None:
    fine, coarse = (
        Driver(LagrangianComponent("o", oscillator, max_step=step)).begin(h=0.5, x=1.0)
        for step in (1e-3, 0.5)
    )
    for driver in (fine, coarse):
        driver.run(2)
    errors = [abs(driver.get("x")[0] - np.cos(1.0)) for driver in (fine, coarse)]
    assert errors[0] < 1e-12
    assert 1e-5 < errors[1] < 1e-2


@given(factor=st.integers(1, 10_000), step=st.sampled_from([1e-3, 1e-4, 2e-3, 1 / 3]))
def test_a_multiple_of_the_internal_step_takes_that_many_steps(factor: int, step: float) -> None:
    assert internal_steps(factor * step, step) == factor


def test_a_step_a_little_longer_takes_one_more() -> None:
    assert [internal_steps(h, 1e-3) for h in (1e-9, 1e-3, 1.01e-3)] == [1, 1, 2]


def test_the_plant_agrees_with_a_reference_solver() -> None:
    driver = Driver(LagrangianComponent("plant", PLANT)).begin(h=0.01, alpha=0.3, i=0.5, r=4.0)
    driver.set(v=12.0, tau_ext=0.1)
    driver.run(100)
    p = PLANT.system.parameter_values.copy()
    p[[parameter.name for parameter in PLANT.parameters].index("r")] = 4.0
    f = PLANT.system.derivative
    reference = solve_ivp(
        lambda _, x: f(x, [0.1, 12.0], p).full().ravel(),
        (0, 1),
        [0.3, 0.0, 0.5],
        "DOP853",
        rtol=1e-12,
        atol=1e-12,
    )
    assert driver.get("alpha", "alpha_dot", "i") == pytest.approx(reference.y[:, -1].tolist(), abs=1e-9)


def test_outputs_of_a_plant_follow_its_formulas() -> None:
    driver = Driver(LagrangianComponent("plant", PLANT)).begin(alpha=0.4, alpha_dot=2.0, i=1.5)
    x, x_dot, tau_e, loss = driver.get("x", "x_dot", "tau_e", "D")
    assert (x, x_dot) == pytest.approx((0.2 * np.cos(0.4), -0.2 * np.sin(0.4) * 2.0))
    assert (tau_e, loss) == pytest.approx((1.5, 0.5 * 4 / 2 + 5 * 1.5**2 / 2))


def test_accelerations_follow_inputs_at_once() -> None:
    driver = Driver(LagrangianComponent("plant", PLANT)).begin()
    driver.set(v=3.0)
    assert driver.get("i_dot") == pytest.approx([3.0])
    driver.set(v=-3.0)
    assert driver.get("i_dot") == pytest.approx([-3.0])


def test_variables_say_what_they_are() -> None:
    found = {v.name: v for v in LagrangianComponent("plant", PLANT).variables}
    assert (found["v"].causality, found["v"].unit, found["v"].start) == ("input", "V", 0.0)
    assert (found["r"].causality, found["r"].variability, found["r"].start) == ("parameter", "fixed", 5.0)
    assert (found["alpha"].causality, found["alpha"].unit, found["alpha"].start) == ("output", "rad", 0.0)
    assert (found["x"].unit, found["x"].start, found["x"].description) == ("m", None, "cart position")
    assert (found["i_dot"].unit, found["i_dot"].depends_on) == ("A/s", ("v",))
    assert (found["alpha_ddot"].unit, found["alpha_ddot"].depends_on) == ("rad/s2", ("tau_ext",))
    assert found["alpha"].depends_on == found["tau_e"].depends_on == ()


def test_a_bare_system_gives_state_accelerations_and_energy() -> None:
    variables = LagrangianComponent("model", PLANT.system).variables
    outputs = [(v.name, v.unit) for v in variables if v.causality == "output"]
    expected = [
        ("alpha", "rad"),
        ("alpha_dot", "rad/s"),
        ("i", "A"),
        ("alpha_ddot", "rad/s2"),
        ("i_dot", "A/s"),
    ]
    assert outputs == [*expected, ("energy", "J")]


def test_a_bare_system_moves_as_its_plant() -> None:
    ends = []
    for what in (PLANT, PLANT.system):
        driver = Driver(LagrangianComponent("c", what)).begin(h=0.01, alpha=1.0)
        driver.set(v=5.0)
        driver.run(20)
        ends.append(driver.get("alpha", "alpha_dot", "i", "i_dot"))
    assert ends[0] == ends[1]


def test_a_plants_own_start_state_is_kept() -> None:
    from dataclasses import replace

    component = LagrangianComponent("plant", replace(PLANT, start={"alpha": 0.7}))
    assert Driver(component).begin().get("alpha") == [0.7]


def test_parameters_are_fixed_once_the_run_has_begun() -> None:
    driver = Driver(LagrangianComponent("plant", PLANT)).begin()
    assert driver.set(r=1.0) == Status.ERROR
    assert driver.component.message == "r cannot be set during a run"


def test_calculated_outputs_take_no_start_value() -> None:
    with pytest.raises(InputError, match=r"plant\.tau_e: is calculated by the component"):
        Driver(LagrangianComponent("plant", PLANT)).begin(tau_e=1.0)


def test_a_restored_state_gives_the_same_future() -> None:
    component = LagrangianComponent("plant", PLANT)
    driver = Driver(component).begin(alpha=0.3)
    driver.set(v=10.0)
    driver.run(3)
    state, ticks = component.save_state(), driver.ticks
    driver.run(5)
    future = driver.get("alpha", "alpha_dot", "i")
    component.restore_state(state)
    driver.ticks = ticks
    driver.run(5)
    assert driver.get("alpha", "alpha_dot", "i") == future


def test_two_components_of_one_plant_do_not_touch_each_other() -> None:
    one, two = (Driver(LagrangianComponent(name, PLANT)).begin() for name in ("one", "two"))
    one.set(v=10.0)
    one.run(5)
    assert two.get("i", "v") == [0.0, 0.0]


def test_a_bound_function_reads_and_writes_its_arrays(oscillator: LagrangianSystem) -> None:
    x, u, p, y = np.array([1.0, 2.0]), np.array([3.0]), np.zeros(0), np.zeros(4)
    call = bind(oscillator.output, (x, u, p), (y,))
    for _ in range(2):
        call()
        assert y.tolist() == [x[0], x[1], u[0] - x[0], (x @ x) / 2]
        x *= 2.0


def test_feed_through_is_read_off_the_formulas() -> None:
    system = LagrangianSystem.build(
        (Coordinate("a", "m", input="F"), Coordinate("b", "m", input="G"), Coordinate("c", "m")),
        lambda q, v, p: v[0] ** 2 + p[0] * v[0] * v[1] + v[1] ** 2 + v[2] ** 2,
        lambda v, p: ca.SX(0),
        (Parameter("k", 0.5, "kg"),),
    )
    assert feed_through(system.output)[6:] == [(0, 1), (0, 1), (), ()]

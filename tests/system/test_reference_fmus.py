"""The behaviours of the Modelica Association's reference FMUs, against their known solutions, in all uses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest
from fmu_helpers import Driver
from reference_fmus import reference
from scipy.integrate import solve_ivp

from exlinn_fmi.components.base import Status
from exlinn_fmi.components.fmu import FmuComponent, FmuSettings
from exlinn_fmi.components.fmu_exchange import SOLVERS

USES = [(version, kind) for version in (2, 3) for kind in ("co_simulation", "model_exchange")]
G, E, V_MIN = 9.81, 0.7, 0.1


@pytest.fixture
def opened(tmp_path: Path) -> Iterator:
    """Opens a reference FMU, closed at the end."""
    with ExitStack() as stack:

        def open_(name: str, version: int, kind: str, *defines: str, **settings: object) -> Driver:
            path = reference(tmp_path, name, version, *defines)
            component = FmuComponent("it", path, FmuSettings(kind, **settings))
            return Driver(stack.enter_context(closing(component)))

        yield open_


# ── bouncing ball: state events ──────────────────────────────────────────────────────────────────────────


def ball(t: float) -> tuple[float, float]:
    """Height and velocity of a ball dropped from 1 m, in closed form; at rest once it bounces below V_MIN."""
    begun, up = -math.sqrt(2 / G), math.sqrt(2 * G)
    while t > begun + 2 * up / G:
        begun, up = begun + 2 * up / G, E * up
        if up < V_MIN:
            return 0.0, 0.0
    s = t - begun
    return up * s - G / 2 * s * s, up - G * s


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("version", [2, 3])
def test_a_bouncing_ball_flies_as_its_closed_form(opened, version: int, solver: str) -> None:
    driver = opened("BouncingBall", version, "model_exchange", solver=solver, tolerance=1e-10)
    driver.begin(h=0.05, stop=4.0)
    for k in range(80):
        assert driver.get("h", "v") == pytest.approx(
            ball(0.05 * k), abs=1e-6 if solver in ("bdf", "lsoda") else 1e-7
        )
        driver.run(1)
    assert driver.get("h", "v", "g") == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("step", [1e-3, 0.7, 3.0])
def test_bounces_do_not_depend_on_the_communication_step(opened, step: float) -> None:
    driver = opened("BouncingBall", 2, "model_exchange", tolerance=1e-10).begin(h=step, stop=4.2)
    driver.run(round(2.1 / step) if step < 1 else 1)
    assert driver.get("h", "v") == pytest.approx(ball(driver.ticks * step), abs=1e-8)


@pytest.mark.parametrize("version", [2, 3])
def test_a_bouncing_ball_falls_by_eulers_method_in_co_simulation(opened, version: int) -> None:
    """In FMI 3 every bounce is an early return and an event that we handle."""
    driver = opened("BouncingBall", version, "co_simulation").begin(h=0.1, stop=4.0)
    h, v = 1.0, 0.0
    for k in range(300):
        h, v = h + 0.01 * v, v - 0.01 * G
        if h <= 0 and v < 0:
            h, v = 0.0, -E * v
        if k % 10 == 9:
            driver.run(1)
            assert driver.get("h", "v") == pytest.approx([h, v], abs=1e-9)


def test_a_restored_ball_bounces_on_to_the_last_bit(opened) -> None:
    driver = opened("BouncingBall", 2, "model_exchange").begin(h=0.1, stop=4.0)
    driver.run(8)
    saved = driver.component.save_state()
    driver.run(10)
    onward = driver.get("h", "v")
    driver.component.restore_state(saved)
    driver.ticks = 8
    driver.run(10)
    assert driver.get("h", "v") == onward


# ── stair: time events, and an FMU that ends the simulation ──────────────────────────────────────────────


@pytest.mark.parametrize(("version", "kind"), USES)
@pytest.mark.parametrize("step", [0.1, 0.25, 1.0])
def test_a_stair_rises_each_second_and_asks_to_end_at_nine(
    opened, version: int, kind: str, step: float
) -> None:
    driver = opened("Stair", version, kind).begin(h=step, stop=20.0)
    for k in range(round(9 / step)):
        assert driver.get("counter") == [1 + math.floor(k * step + 1e-9)]
        status = driver.step()
        if k < round(9 / step) - 1:
            assert status == Status.OK, driver.component.message
    assert status == Status.DISCARD
    assert "asks to end the simulation" in driver.component.message


@pytest.mark.parametrize(
    ("version", "kind"), [(2, "model_exchange"), (3, "model_exchange"), (3, "co_simulation")]
)
def test_several_time_events_in_one_step_are_all_handled(opened, version: int, kind: str) -> None:
    driver = opened("Stair", version, kind).begin(h=3.5, stop=7.0)
    driver.run(1)
    assert driver.get("counter") == [4.0]


# ── Van der Pol and Dahlquist: continuous states ─────────────────────────────────────────────────────────


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("version", [2, 3])
def test_van_der_pol_follows_scipy(opened, version: int, solver: str) -> None:
    driver = opened("VanDerPol", version, "model_exchange", solver=solver, tolerance=1e-9)
    driver.begin(h=1.0, stop=10.0)
    driver.run(10)
    expected = solve_ivp(
        lambda t, x: [x[1], (1 - x[0] ** 2) * x[1] - x[0]],
        (0, 10),
        [2.0, 0.0],
        "DOP853",
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    assert driver.get("x0", "x1") == pytest.approx(expected.tolist(), abs=1e-5)


@pytest.mark.parametrize("version", [2, 3])
def test_van_der_pol_goes_by_eulers_method_in_co_simulation(opened, version: int) -> None:
    driver = opened("VanDerPol", version, "co_simulation").begin(h=0.1, stop=10.0)
    driver.run(30)
    x0, x1 = 2.0, 0.0
    for _ in range(300):
        x0, x1 = x0 + 0.01 * x1, x1 + 0.01 * ((1 - x0 * x0) * x1 - x0)
    assert driver.get("x0", "x1") == pytest.approx([x0, x1], abs=1e-9)


def test_a_stiff_van_der_pol_is_handed_to_radau(opened) -> None:
    driver = opened("VanDerPol", 2, "model_exchange", tolerance=1e-6).begin(h=100.0, stop=400.0, mu=200.0)
    statuses = [driver.step() for _ in range(4)]
    expected = solve_ivp(
        lambda t, x: [x[1], 200 * (1 - x[0] ** 2) * x[1] - x[0]],
        (0, 400),
        [2.0, 0.0],
        "Radau",
        rtol=1e-9,
        atol=1e-9,
    ).y[:, -1]
    assert driver.get("x0", "x1") == pytest.approx(expected.tolist(), abs=1e-2)
    assert statuses.count(Status.WARNING) == 1
    assert driver.component.message.startswith("stiff from t = ")


def test_directional_derivatives_are_those_of_the_equations(opened) -> None:
    for version in (2, 3):
        driver = opened("VanDerPol", version, "model_exchange").begin(h=0.1, stop=1.0, mu=2.0)
        driver.run(3)
        c, (x0, x1) = driver.component, driver.get("x0", "x1")
        of, to = (
            np.array([c.index(n) for n in names], dtype=np.intp)
            for names in (("der(x0)", "der(x1)"), ("x0", "x1"))
        )
        change = c.directional_derivative(of, to, np.array([1.0, 2.0]))
        expected = [2.0, -4 * x0 * x1 - 1 + 2 * 2 * (1 - x0 * x0)]
        assert change.tolist() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("version", [2, 3])
def test_dahlquist_decays(opened, version: int) -> None:
    driver = opened("Dahlquist", version, "model_exchange", tolerance=1e-10).begin(h=0.5, stop=10.0, k=2.0)
    driver.run(20)
    assert driver.get("x") == pytest.approx([math.exp(-20.0)], abs=1e-10)


@pytest.mark.parametrize("version", [2, 3])
def test_dahlquist_decays_by_eulers_method_in_co_simulation(opened, version: int) -> None:
    driver = opened("Dahlquist", version, "co_simulation").begin(h=0.1, stop=10.0)
    driver.run(30)
    assert driver.get("x") == pytest.approx([0.99**300], rel=1e-9)


# ── resource ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("version", "kind"), USES)
def test_a_resource_is_read(opened, version: int, kind: str) -> None:
    driver = opened("Resource", version, kind).begin(h=0.1, stop=1.0)
    driver.run(2)
    assert driver.get("y") == [float(ord("a"))]


# ── a switch: events of states, of inputs, of discrete inputs, asked for after a step ────────────────────


def heater(t: float, period: int = 0) -> tuple[float, float]:
    """State, and whether it is on, of the heater with heat 3, set point 1 and band 0.1, in closed form."""
    up, down = math.log(3 - 0.9) - math.log(3 - 1.1), math.log(1.1 / 0.9)
    first = math.log(3 / 1.9)
    if t <= first:
        return 3 * (1 - math.exp(-t)), 1.0
    s = (t - first) % (up + down)
    return (1.1 * math.exp(-s), 0.0) if s <= down else (3 - 2.1 * math.exp(-(s - down)), 1.0)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("solver", ["dopri5", "radau"])
def test_hysteresis_switches_at_the_times_of_its_closed_form(opened, version: int, solver: str) -> None:
    driver = opened("Switch", version, "model_exchange", solver=solver, tolerance=1e-10).begin(
        h=0.05, stop=5.0
    )
    for k in range(60):
        x, on = heater(0.05 * k)
        assert driver.get("x", "on") == pytest.approx([x, on], abs=1e-7)
        driver.run(1)


@pytest.mark.parametrize("version", [2, 3])
def test_a_discrete_input_is_set_in_event_mode_and_acts_at_once(opened, version: int) -> None:
    driver = opened("Switch", version, "model_exchange").begin(h=0.1, stop=5.0)
    driver.run(2)
    (before,) = driver.get("switched")
    driver.set(load=0.0, offset=-2.0)
    assert driver.get("on", "switched") == [0.0, before + 1]
    driver.set(load=0.0, offset=-2.0)
    driver.run(1)
    assert driver.get("on") == [0.0]


def test_a_discrete_input_is_set_in_event_mode_in_co_simulation(opened) -> None:
    driver = opened("Switch", 3, "co_simulation").begin(h=0.1, stop=5.0)
    driver.run(2)
    driver.set(offset=-2.0)
    assert driver.get("on") == [0.0]
    driver.run(1)


def test_input_derivatives_reach_a_co_simulation_fmu_for_one_step(opened) -> None:
    driver = opened("Switch", 2, "co_simulation").begin(h=0.1, stop=5.0, set=100.0)
    assert driver.component.takes_input_derivatives
    driver.component.set_input_derivatives(driver.component.indices("input")[:1], np.array([20.0]))
    x = load = 0.0
    for k in range(20):
        x += 0.01 * (3.0 + load - x)
        load += 0.01 * (20.0 if k < 10 else 0.0)
    driver.run(2)
    assert driver.get("x", "load") == pytest.approx([x, load], rel=1e-12)
    assert not opened("Switch", 3, "co_simulation").component.takes_input_derivatives


def test_steps_shorter_than_those_of_the_fmu_are_done_whatever_time_it_tells(opened) -> None:
    x = []
    for defines in ((), ("COARSE=0.1",)):
        driver = opened("Dahlquist", 3, "co_simulation", *defines).begin(h=0.01, stop=1.0)
        driver.run(25)
        x += driver.get("x")
    assert x[0] == x[1]


def test_an_event_after_a_step_is_heeded_and_so_is_the_wish_to_end(opened) -> None:
    driver = opened("Switch", 2, "model_exchange").begin(h=0.1, stop=20.0, set=200.0)
    driver.set(load=100.0)
    status = Status.OK
    while status == Status.OK:
        status = driver.step()
    assert status == Status.DISCARD
    assert driver.component.message.startswith("the FMU asks to end the simulation, at t = ")
    assert driver.get("x")[0] > 99


# ── trouble ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_error_inside_the_right_hand_side_is_told(opened, solver: str) -> None:
    driver = opened("Dahlquist", 2, "model_exchange", "FAULT_DERIVATIVES=3", solver=solver).begin(
        h=0.2, stop=2.0
    )
    driver.run(2)
    assert driver.step() == Status.ERROR
    assert driver.component.message.startswith("fmi2GetDerivatives returned fmi2Error")


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("fault", ["FAULT_NAN", "FAULT_DERIVATIVES=2"])
def test_derivatives_that_are_not_finite_or_are_discarded_stop_the_solver(
    opened, solver: str, fault: str
) -> None:
    driver = opened("Dahlquist", 2, "model_exchange", fault, solver=solver).begin(h=0.2, stop=2.0)
    driver.run(2)
    assert driver.step() == Status.ERROR
    assert driver.component.message.startswith("the solver makes no progress at t = 0.")

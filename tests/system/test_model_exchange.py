"""Model Exchange: other people's FMUs and our own against closed forms, SciPy and their own Co-Simulation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest
from fmu_helpers import Driver, other_fmus
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from exlinn_fmi.components.fmu import FmuComponent, FmuSettings
from exlinn_fmi.components.fmu_exchange import SOLVERS
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.plants import PLANTS, plant

SPRINGS = np.block([[np.zeros((2, 2)), np.eye(2)], [np.array([[-2.0, 1.0], [1.0, -2.0]]), np.zeros((2, 2))]])
"""Two masses and three springs, all 1."""


@pytest.fixture
def exchange() -> Iterator:
    """Opens an FMU for Model Exchange, closed at the end."""
    with ExitStack() as stack:

        def opened(path: Path, solver: str = "auto", tolerance: float | None = 1e-9) -> Driver:
            settings = FmuSettings("model_exchange", solver, tolerance)
            return Driver(stack.enter_context(closing(FmuComponent("me", path, settings))))

        yield opened


@pytest.mark.parametrize("solver", SOLVERS)
def test_openmodelica_springs_swing_as_their_matrix_says(exchange, solver: str) -> None:
    driver = exchange(other_fmus()["MassSpringSystem"], solver).begin(h=0.1, stop=1.0)
    driver.run(10)
    expected = expm(SPRINGS) @ [0.0, 1.0, 1.0, 0.0]
    tolerance = 1e-5 if solver in ("bdf", "lsoda") else 1e-7  # they restart at each of the ten points
    assert driver.get("x1", "x2", "v1", "v2") == pytest.approx(expected.tolist(), abs=tolerance)


def test_two_coupled_springs_exchange_what_they_need_each_step(exchange) -> None:
    h, driver = 1e-3, {k: exchange(other_fmus()[f"MassSpringSubSystem{k}"]) for k in (1, 2)}
    for each in driver.values():
        each.begin(h=h, stop=1.0)
    for _ in range(1000):
        (x1,), (x2,) = driver[1].get("x1"), driver[2].get("x2")
        driver[1].set(x2=x2)
        driver[2].set(x1=x1)
        driver[1].run(1)
        driver[2].run(1)
    expected = expm(SPRINGS) @ [0.0, 1.0, 1.0, 0.0]
    assert driver[1].get("x1") + driver[2].get("x2") == pytest.approx(expected[:2].tolist(), abs=2 * h)


@pytest.mark.parametrize("name", sorted(PLANTS))
def test_our_fmus_move_alike_in_both_kinds_of_use(root: Path, exchange, name: str) -> None:
    path = root / "fmus" / f"{plant(name).model_name}.fmu"
    me = exchange(path, tolerance=1e-10).begin(h=0.01, stop=1.0)
    with closing(FmuComponent("cs", path, FmuSettings("co_simulation"))) as component:
        cs = Driver(component).begin(h=0.01, stop=1.0)
        inputs = [v.name for v in component.variables if v.causality == "input"]
        outputs = [v.name for v in component.variables if v.causality == "output"]
        for k in range(50):
            for driver in (me, cs):
                driver.set(**{u: 0.1 * np.sin(0.1 * k) for u in inputs})
                driver.run(1)
        one, other = np.array(me.get(*outputs)), np.array(cs.get(*outputs))
    assert np.abs(one - other).max() <= 1e-6 * np.abs(other).max()


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_motor_moves_as_scipy_integrates_its_equations(root: Path, exchange, solver: str) -> None:
    system = plant("dc_motor_cart").system
    start = {"alpha": 0.7, "alpha_dot": -1.5, "i": 0.4}
    driver = exchange(root / "fmus" / "DCMotorCart.fmu", solver, 1e-8).begin(h=0.1, stop=2.0, **start)
    x = np.array(list(start.values()))
    for k in range(20):
        voltage = 12.0 * np.sin(0.7 * k)
        driver.set(v=voltage)
        driver.run(1)

        def rate(_: float, x: np.ndarray, v: float = voltage) -> np.ndarray:
            return evaluate(system.derivative, x, [0.0, v], system.parameter_values).ravel()

        x = solve_ivp(rate, (0.0, 0.1), x, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    assert driver.get(*start) == pytest.approx(x.tolist(), abs=3e-6 if solver in ("bdf", "lsoda") else 3e-7)


def test_a_second_run_begins_afresh(root: Path, exchange) -> None:
    driver = exchange(root / "fmus" / "DCMotorCart.fmu")
    ends = []
    for _ in range(2):
        driver.begin(h=0.1, stop=1.0, alpha=0.3, v=5.0)
        driver.run(5)
        ends.append(driver.get("alpha", "i"))
    assert ends[0] == ends[1]


def test_a_restored_state_goes_on_to_the_last_bit(root: Path, exchange) -> None:
    driver = exchange(root / "fmus" / "DCMotorCart.fmu").begin(h=0.1, stop=2.0, alpha=0.3, v=5.0)
    driver.run(5)
    saved = driver.component.save_state()
    driver.run(5)
    onward = driver.get("alpha", "alpha_dot", "i")
    driver.component.restore_state(saved)
    driver.ticks = 5
    driver.run(5)
    assert driver.get("alpha", "alpha_dot", "i") == onward


def test_input_derivatives_act_inside_the_step(root: Path, exchange) -> None:
    """A ramp of the voltage over a long step, told by value and slope, against the ramp in small steps."""
    path = root / "fmus" / "DCMotorCart.fmu"
    ramp, held = exchange(path, tolerance=1e-10), exchange(path, tolerance=1e-10)
    ramp.begin(h=0.2, stop=2.0)
    index = np.array([ramp.component.index("v")], dtype=np.intp)
    ramp.set(v=1.0)
    assert ramp.component.takes_input_derivatives
    ramp.component.set_input_derivatives(index, np.array([30.0]))
    ramp.run(1)
    held.begin(h=0.2 / 2000, stop=2.0)
    for k in range(2000):
        held.set(v=1.0 + 30.0 * (k + 0.5) * 1e-4)
        held.run(1)
    assert ramp.get("alpha", "alpha_dot", "i") == pytest.approx(held.get("alpha", "alpha_dot", "i"), abs=1e-6)

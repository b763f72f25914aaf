"""Whole trajectories through Model Exchange: the same as step by step, and right where inputs vary."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from reference_fmus import reference
from scipy.integrate import solve_ivp
from test_reference_fmus import ball

from exlinn_fmi.components.fmu import FmuComponent, FmuSettings
from exlinn_fmi.components.fmu_trajectory import trajectory
from exlinn_fmi.errors import ComponentError, InputError
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.plants import plant

STATES = ("alpha", "alpha_dot", "i")


@pytest.fixture
def motor(root: Path) -> Iterator[FmuComponent]:
    settings = FmuSettings("model_exchange", tolerance=1e-9)
    with closing(FmuComponent("motor", root / "fmus" / "DCMotorCart.fmu", settings)) as component:
        yield component


def test_a_varying_input_acts_inside_the_right_hand_side(motor: FmuComponent) -> None:
    times = np.linspace(0, 2, 41)
    voltage = 12 * np.sin(3 * times)
    found = trajectory(motor, times, STATES, {"v": voltage}, {"alpha": 0.3})
    system = plant("dc_motor_cart").system

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        u = [0.0, np.interp(t, times, voltage)]
        return evaluate(system.derivative, x, u, system.parameter_values).ravel()

    expected = solve_ivp(
        rate, (0, 2), [0.3, 0.0, 0.0], "DOP853", times, rtol=1e-11, atol=1e-11, max_step=0.05
    ).y.T
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


def test_rows_are_as_precise_between_steps_as_at_their_ends(motor: FmuComponent) -> None:
    fine = trajectory(motor, np.linspace(0, 2, 2001), STATES, starts={"alpha": 0.3, "v": 5.0})
    coarse = trajectory(motor, np.linspace(0, 2, 5), STATES, starts={"alpha": 0.3, "v": 5.0})
    np.testing.assert_allclose(fine[::500], coarse, rtol=0, atol=1e-7)


@pytest.mark.parametrize("version", [2, 3])
def test_a_trajectory_bounces(tmp_path: Path, version: int) -> None:
    settings = FmuSettings("model_exchange", tolerance=1e-10)
    with closing(FmuComponent("ball", reference(tmp_path, "BouncingBall", version), settings)) as component:
        times = np.linspace(0, 3, 301)
        found = trajectory(component, times, ("h", "v"))
        asked = trajectory(component, times, ("v", "der(v)", "h"))  # the FMU itself, not for states alone
    assert (found == asked[:, [2, 0]]).all()
    np.testing.assert_allclose(found, [ball(t) for t in times], rtol=0, atol=1e-7)


def test_a_trajectory_ends_with_an_error_where_the_fmu_does(tmp_path: Path) -> None:
    path = reference(tmp_path, "Dahlquist", 2, "FAULT_DERIVATIVES=3")
    with closing(FmuComponent("it", path, FmuSettings("model_exchange"))) as component:
        assert trajectory(component, [0.0, 0.1], ["x"])[1, 0] == pytest.approx(math.exp(-0.1), abs=1e-5)
        with pytest.raises(
            ComponentError, match=r"it at t = 0\.\d+ s: fmi2GetDerivatives returned fmi2Error"
        ):
            trajectory(component, [0.0, 2.0], ["x"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0, 0.0], ["alpha"]), "must ascend"),
        (([0.0, 1.0], ["alfa"]), r"motor\.alfa: no scalar Real .*did you mean 'alpha'"),
        (([0.0, 1.0], ["alpha"], {"r": [1.0, 1.0]}), r"motor\.r: no scalar Real"),
    ],
)
def test_what_does_not_fit_is_told(motor: FmuComponent, arguments: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        trajectory(motor, *arguments)


def test_co_simulation_has_no_trajectories(root: Path) -> None:
    with (
        closing(FmuComponent("motor", root / "fmus" / "DCMotorCart.fmu")) as component,
        pytest.raises(InputError, match="is open for Co-Simulation"),
    ):
        trajectory(component, [0.0, 1.0], ["alpha"])

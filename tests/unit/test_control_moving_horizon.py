"""The moving horizon: compiled and by numpy, beside the smoother by Rauch, Tung and Striebel."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from control_helpers import HERE, LIMITS, STEP, constant, levitation, measure, motor_cart, oscillator
from test_control_estimator import motion, noise, run
from test_control_kernel import ANGLE, CHARGE, DEGREES, PLACE, network

from exlinn_fmi.control import compiled
from exlinn_fmi.control.compiled_window import CompiledPasses
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.control.estimator import Window
from exlinn_fmi.control.moving_horizon import MovingHorizon, PlainPasses
from exlinn_fmi.errors import InputError
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.scenario.control import Estimator as Spec
from exlinn_fmi.scenario.control import Nmpc

SYSTEMS = {
    "oscillator": oscillator(),
    "motor": motor_cart(),
    "levitation": levitation(),
    "network": network((ANGLE, CHARGE), seed=3),
    "three coordinates": network((DEGREES, PLACE, CHARGE), seed=4),
}


def estimator(system: LagrangianSystem, backend: str, window: int = 5) -> MovingHorizon:
    """All but the last state are measured; a disturbance on the first coordinate."""
    n = len(system.state_names)
    spec = noise([True] * (n - 1) + [False] * (n > 1), system.n, [0])
    return MovingHorizon(system, replace(spec, process=np.full(n, 0.02)), STEP, 2, window, 2, backend)


def measurements(system: LagrangianSystem, ticks: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and noisy measurements of a motion, some of them missing, an angle now and then a turn off."""
    rng = np.random.default_rng(5)
    inputs = 0.3 * rng.normal(size=(ticks, len(system.input_names)))
    start = 0.1 + 0.05 * rng.random(len(system.state_names))
    y = motion(system, start, inputs) + 1e-3 * rng.normal(size=(ticks + 1, len(start)))
    y[rng.random(y.shape) < 0.2] = np.nan
    return inputs, y


@pytest.mark.parametrize("name", SYSTEMS)
def test_compiled_it_gives_the_same_answers(name):
    system = SYSTEMS[name]
    inputs, y = measurements(system, 25)
    one, other = (estimator(system, backend) for backend in ("compiled", "casadi"))
    assert isinstance(one.passes, CompiledPasses)
    assert isinstance(other.passes, PlainPasses)
    turns = np.where(np.isfinite(one.turn), one.turn, 0.0) * np.arange(26)[:, None]
    for a, b in zip(run(one, inputs, y + turns), run(other, inputs, y), strict=True):
        np.testing.assert_allclose(a.mean, b.mean, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-14)
        np.testing.assert_allclose(a.window.points, b.window.points, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(a.window.arrival[0], b.window.arrival[0], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(a.window.arrival[1], b.window.arrival[1], rtol=1e-6, atol=1e-14)


def rauch(made: MovingHorizon, window: Window, y: np.ndarray) -> np.ndarray:
    """Points after one Gauss–Newton step, smoothed by the inverse of the predicted covariance."""
    following, F, Q = made.linearised(window.points, window.u)
    (mean, P), steps = window.arrival, []
    for k in range(len(window.points)):
        mean, P = made.corrected(mean, P, window.y[k])
        ahead = following[k] + F[k] @ (mean - window.points[k]), F[k] @ P @ F[k].T + Q[k]
        steps.append((mean, P, *ahead))
        mean, P = ahead
    later, points = made.corrected(mean, P, y)[0], []
    for k, (mean, P, ahead, predicted) in reversed(list(enumerate(steps))):
        later = mean + np.linalg.lstsq(predicted, F[k] @ P, rcond=None)[0].T @ (later - ahead)
        points.append(later)
    return np.array(points[::-1])


@pytest.mark.parametrize("backend", ["compiled", "casadi"])
@pytest.mark.parametrize("name", ["motor", "network"])
def test_it_smooths_as_rauch_tung_and_striebel_do(name, backend):
    system = SYSTEMS[name]
    inputs, y = measurements(system, 12)
    made = estimator(system, backend)
    ahead = made.predict(run(made, inputs[:-1], y[:-1])[-1], inputs[-1])
    points, _ = made.passes.smoothed(ahead.window, y[-1], 1)
    np.testing.assert_allclose(points, rauch(made, ahead.window, y[-1]), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("backend", ["compiled", "casadi"])
def test_a_covariance_beyond_all_measure_is_a_belief_that_is_not_finite(backend):
    inputs, y = measurements(motor_cart(), 8)
    made = estimator(motor_cart(), backend)
    belief = run(made, inputs, np.nan_to_num(y))[-1]
    size = len(belief.mean)
    lost = replace(belief.window, arrival=(belief.mean, np.full((size, size), 1e120)))
    ahead = made.predict(replace(belief, window=lost), inputs[-1])
    assert not np.isfinite(ahead.window.arrival[0]).any()
    assert not made.update(ahead, np.zeros(3)).finite


def test_without_a_compiler_it_is_computed_by_numpy(monkeypatch):
    def none(*_):
        raise InputError("no C compiler found")

    monkeypatch.setattr(compiled, "cached_library", none)
    assert isinstance(estimator(oscillator(), "auto").passes, PlainPasses)
    with pytest.raises(InputError, match="no C compiler"):
        estimator(oscillator(), "compiled")


@pytest.mark.parametrize("backend", ["auto", "casadi"])
@pytest.mark.parametrize("kind", ["ekf", "mhe"])
def test_measurements_that_no_motion_explains_make_no_warnings(kind, backend):
    options = {"reference": constant("alpha", 1.0), "estimator": Spec(type=kind), "backend": backend}
    for seed in (0, 861):
        made = NmpcController(
            "controller", motor_cart(), Nmpc(**(options | LIMITS)), STEP, HERE, ("alpha", "i")
        )
        made.enter_initialization(0.0, 10.0, {})
        made.exit_initialization()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for k, y in enumerate(3 * np.random.default_rng(seed).normal(size=(31, 3))):
                outputs, _ = measure(made, y[0], 0.0, y[2])
                made.step(k * STEP, STEP)
                assert np.isfinite(outputs["v"])

"""Plants that are integrated by Euler steps are found out, and none else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.data.integration import euler_steps
from exlinn_fmi.mechanics.coordinates import Coordinate

COORDINATES = (Coordinate(name="s", unit="m", velocity="v", input="f", input_unit="N"),)
H = 0.01


def acceleration(t: float, s: float, v: float) -> float:
    return float(np.sin(7 * H * int(t / H + 1e-9)) - 0.5 * v - 60 * s)


def explicit(t: float, s: float, v: float) -> tuple[float, float]:
    return s + H * v, v + H * acceleration(t, s, v)


def semi_implicit(t: float, s: float, v: float) -> tuple[float, float]:
    v += H * acceleration(t, s, v)
    return s + H * v, v


def exact(t: float, s: float, v: float) -> tuple[float, float]:
    run = solve_ivp(lambda _, y: (y[1], acceleration(t, *y)), (0, H), (s, v), rtol=1e-9, atol=1e-12)
    return float(run.y[0, -1]), float(run.y[1, -1])


def data(step: Callable[[float, float, float], tuple[float, float]], noise: float = 0.0) -> Dataset:
    rows = [(0.02, 0.0)]
    for k in range(400):
        rows.append(step(k * H, *rows[-1]))
    s, v = np.array(rows).T + noise * np.random.default_rng(0).normal(size=(2, 401))
    time = H * np.arange(401)
    columns = {"time": time, "s": s, "v": v, "f": np.sin(7 * time)}
    return Dataset.from_columns(columns, COORDINATES)


@pytest.mark.parametrize("step", [explicit, semi_implicit])
@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_euler_steps_are_told(step: Callable[..., tuple[float, float]], noise: float) -> None:
    (note,) = euler_steps(data(step, noise))
    assert "'s' goes by Euler steps as long as the communication step, 0.01 s" in note
    assert "model_exchange" in note


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-3])
def test_fine_integration_is_not(noise: float) -> None:
    assert euler_steps(data(exact, noise)) == []

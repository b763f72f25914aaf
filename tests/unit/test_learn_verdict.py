"""Whether a model has learned anything, told by short runs beside the data that it was fitted to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from learn_helpers import MOTOR_CART, motor_cart, multisine, simulate

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.verdict import NOTHING, POOR, judge
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants.dc_motor_cart import PLANT as MOTOR
from exlinn_fmi.plants.motor_pendulum import PLANT as PENDULUM

STATES = ["alpha", "alpha_dot", "i"]


def changed(system: LagrangianSystem, **values: float) -> LagrangianSystem:
    parameters = (replace(p, value=values.get(p.name, p.value)) for p in system.parameters)
    return replace(system, parameters=tuple(parameters))


def motor() -> tuple[LagrangianSystem, Dataset]:
    """The plant itself, and its data."""
    return MOTOR.system.with_inputs({"v"}), Dataset(motor_cart(7.0), MOTOR_CART)


def noisy(data: Dataset, share: float, seed: int = 0) -> Dataset:
    frame = data.frame.copy()
    names = [name for c in data.coordinates for name in (c.name, c.velocity) if name in frame]
    noise = np.random.default_rng(seed).standard_normal((len(frame), len(names)))
    frame[names] += share * frame[names].std().to_numpy() * noise
    return Dataset(frame, data.coordinates)


@pytest.mark.parametrize(("share", "most"), [(0.0, 1e-6), (0.01, POOR), (0.05, POOR)])
def test_the_truth_is_not_doubted_whatever_the_noise(share, most) -> None:
    system, data = motor()
    assert judge(system, noisy(data, share)).error < most


def test_a_model_in_which_hardly_anything_moves_has_learned_nothing() -> None:
    system, data = motor()
    found = judge(changed(system, j_m=1e4, l=1e4), data)
    assert found.error > NOTHING
    assert found.velocity in ("alpha_dot", "i")


def test_a_model_that_is_somewhat_off_is_poor() -> None:
    system, data = motor()
    found = judge(changed(system, k_e=1.4), data)
    assert POOR < found.error < NOTHING
    assert "mispredicts the data that it was trained on" in str(found)


def test_the_time_where_the_data_are_bad_is_told() -> None:
    system, data = motor()
    frame = data.frame.copy()
    frame["v"] = frame["v"].where(~frame["time"].between(2.0, 2.5), 0.0)  # a plug fell out of the recorder
    found = judge(system, Dataset(frame, data.coordinates))
    assert 1.8 < found.time < 2.5


def test_a_model_that_diverges_has_learned_nothing() -> None:
    system, data = motor()
    assert judge(changed(system, b_m=-5.0), data).error > 10


def test_an_unstable_motion_that_noise_pushes_off_is_no_fault_of_the_model() -> None:
    system, step = PENDULUM.system.with_inputs({"v"}), 5e-3
    time = step * np.arange(200)
    inputs = 0.05 * multisine(1.0, (0.5, 3), 8, 0.0, 0, time)[:, None]
    upright = np.zeros(len(system.state_names))
    upright[0] = np.pi
    frames = [
        simulate(system, inputs * sign, step, upright + 0.01 * k, k) for k, sign in enumerate((1, -1, 0.5))
    ]
    import pandas as pd

    data = Dataset(pd.concat(frames), system.coordinates)
    assert judge(system, noisy(data, 0.02)).error < POOR


def test_what_never_moves_beyond_its_noise_is_not_judged() -> None:
    system, data = motor()
    frame = data.frame.copy()
    random = np.random.default_rng(0)
    frame[STATES] = random.standard_normal((len(frame), 3))
    assert judge(system, Dataset(frame, data.coordinates)).velocity == ""


def test_short_trajectories_are_judged_as_far_as_they_go() -> None:
    system, data = motor()
    frame = data.frame[:60].assign(trajectory=np.arange(60) // 6).reset_index(drop=True)
    assert judge(system, Dataset(frame, data.coordinates)).error < 1e-3

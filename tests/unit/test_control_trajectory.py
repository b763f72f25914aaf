"""Kinematics on a continuous branch, and derivatives of sampled signals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from exlinn_fmi.control.trajectory import REACH, branch_of, coordinate_of, derivatives, integral
from exlinn_fmi.scenario.control import Linear, ScotchYoke

SPACING = 5e-3
YOKE = ScotchYoke(map="scotch_yoke", crank=0.2)


def times(count: int = 60) -> np.ndarray:
    return SPACING * np.arange(-REACH, count + REACH)


def inner(t: np.ndarray) -> np.ndarray:
    return t[REACH:-REACH]


@given(start=st.floats(-50, 50), phase=st.floats(0, 6), amplitude=st.floats(0.01, 1.0))
def test_scotch_yoke_is_inverted_on_the_branch_of_the_measured_angle_without_a_jump(start, phase, amplitude):
    position = amplitude * np.sin(np.linspace(0, 6, 5000) + phase)
    angle = coordinate_of(YOKE, position, branch_of(YOKE, start))
    assert np.abs(np.diff(angle)).max() < 0.1
    assert np.all(np.floor(angle / np.pi) == np.floor(start / np.pi))
    reach = 0.2 * (1 - YOKE.margin)
    np.testing.assert_allclose(0.2 * np.cos(angle), np.clip(position, -reach, reach), atol=1e-12)


def test_linear_kinematics_are_inverted():
    through = Linear(map="linear", gain=2.0, offset=1.0)
    assert coordinate_of(through, np.array([5.0]), branch_of(through, 100.0)) == [2.0]


def test_without_kinematics_quantity_and_coordinate_are_one():
    assert coordinate_of(None, np.array([5.0]), branch_of(None, 100.0)) == [5.0]


def test_derivatives_of_a_sine_are_those_of_the_sine():
    t, w = times(), 2.5
    found = derivatives(np.sin(w * t), SPACING, 4)
    at = w * inner(t)
    expected = [np.sin(at), w * np.cos(at), -(w**2) * np.sin(at), -(w**3) * np.cos(at), w**4 * np.sin(at)]
    for row, exact, tolerance in zip(found, expected, (0, 1e-11, 1e-9, 1e-7, 1e-4), strict=True):
        np.testing.assert_allclose(row, exact, atol=tolerance)


@given(jump=st.floats(-1e3, 1e3), at=st.floats(0.05, 0.25))
def test_a_step_has_no_derivative_on_either_side(jump, at):
    found = derivatives(np.where(times() >= at, jump, 0.0), SPACING, 4)
    assert np.abs(found[1:]).max() <= 1e-6 * abs(jump)


def test_next_to_a_jump_each_side_keeps_its_own_derivatives():
    t = times()
    after = inner(t) >= 0.15
    found = derivatives(np.where(t >= 0.15, np.sin(t), -3.0), SPACING, 3)
    np.testing.assert_allclose(found[1], np.where(after, np.cos(inner(t)), 0.0), atol=1e-9)
    np.testing.assert_allclose(found[3], np.where(after, -np.cos(inner(t)), 0.0), atol=1e-3)


def test_a_kink_has_no_wild_acceleration():
    found = derivatives(np.maximum(0.0, times() - 0.1), SPACING, 3)
    assert np.abs(found[1]).max() <= 1.0 + 1e-9
    assert np.abs(found[2:]).max() < 1e-4


def test_a_coarse_table_gives_speed_and_acceleration_but_no_wild_higher_derivative():
    rows = np.arange(-1.0, 1.5, 0.03)
    t = times()
    found = derivatives(np.interp(t, rows, np.sin(2.5 * rows)), SPACING, 4)
    np.testing.assert_allclose(found[1], 2.5 * np.cos(2.5 * inner(t)), atol=0.05)
    assert np.abs(found[2]).max() < 2 * 2.5**2
    assert np.abs(found[3]).max() < 2 * 2.5**3


def test_a_signal_that_jumps_all_the_time_is_a_sequence_of_rests():
    levels = np.repeat(np.random.default_rng(0).integers(0, 2, 50), 2)[: 60 + 2 * REACH]
    found = derivatives(levels.astype(float), SPACING, 3)
    np.testing.assert_array_equal(found[1:], 0.0)


@given(value=st.floats(-1e6, 1e6), orders=st.integers(0, 4))
def test_a_constant_has_no_derivative(value, orders):
    found = derivatives(np.full(2 * REACH + 3, value), SPACING, orders)
    assert found.shape == (orders + 1, 3)
    assert np.all(found[0] == value)
    assert np.all(found[1:] == 0.0)


def test_a_single_inner_sample_is_enough():
    assert derivatives(times(1) ** 2, SPACING, 2)[:, 0] == pytest.approx([0.0, 0.0, 2.0], abs=1e-8)


def test_integral_is_of_fourth_order():
    errors = []
    for count in (21, 41):
        t = np.linspace(0, 1, count)
        errors.append(np.abs(integral(np.cos(3 * t), -3 * np.sin(3 * t), t[1]) - np.sin(3 * t) / 3).max())
    assert errors[0] < 1e-5
    assert 14 < errors[0] / errors[1] < 18

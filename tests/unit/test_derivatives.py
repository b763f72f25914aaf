"""Derivatives of sampled signals against analytic ones, clean and noisy, edges included."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.data.derivatives import SHORTEST, best_window, derivative, integral, noise_level
from exlinn_fmi.errors import DataError

TIME = np.arange(4001) * 1e-3
W1, W2 = 4 * np.pi, 0.8 * np.pi
SIGNAL = np.sin(W1 * TIME + 0.3) + 0.5 * np.cos(W2 * TIME)
DERIVATIVES = {
    1: W1 * np.cos(W1 * TIME + 0.3) - 0.5 * W2 * np.sin(W2 * TIME),
    2: -(W1**2) * np.sin(W1 * TIME + 0.3) - 0.5 * W2**2 * np.cos(W2 * TIME),
}
RANDOM = np.random.default_rng(0).standard_normal(len(TIME))


@pytest.mark.parametrize(("order", "tolerance"), [(1, 1e-10), (2, 1e-7)])
def test_clean_signals_are_differentiated_up_to_the_edges(order: int, tolerance: float) -> None:
    error = derivative(TIME, SIGNAL, order) - DERIVATIVES[order]
    assert np.abs(error).max() < tolerance * np.abs(DERIVATIVES[order]).max()


@pytest.mark.parametrize(("order", "tolerance"), [(1, 0.01), (2, 0.05)])
def test_the_window_makes_one_percent_of_noise_harmless(order: int, tolerance: float) -> None:
    error = derivative(TIME, SIGNAL + 0.01 * RANDOM, order) - DERIVATIVES[order]
    assert np.sqrt(np.mean(error**2)) < tolerance * DERIVATIVES[order].std()


@pytest.mark.parametrize("level", [1e-5, 1e-3, 0.05])
def test_the_chosen_window_is_nearly_as_good_as_the_best(level: float) -> None:
    noisy = SIGNAL + level * RANDOM

    def error(window: int) -> float:
        return float(np.sqrt(np.mean((derivative(TIME, noisy, 1, window) - DERIVATIVES[1]) ** 2)))

    best = min(error(w) for w in (9, 15, 25, 41, 71, 101, 151, 201, 301, 401, 601, 801))
    assert error(best_window(noisy)) < 1.5 * best


def test_a_clean_signal_gets_the_shortest_window() -> None:
    assert best_window(SIGNAL) == SHORTEST


@pytest.mark.parametrize("level", [1e-6, 1e-3, 0.1])
def test_noise_level_is_the_standard_deviation_of_the_noise(level: float) -> None:
    assert noise_level(SIGNAL + level * RANDOM) == pytest.approx(level, rel=0.1)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=7, max_size=7), st.integers(9, 60))
def test_polynomials_of_degree_six_are_exact(coefficients: list[float], rows: int) -> None:
    polynomial = np.polynomial.Polynomial(coefficients)
    time = np.linspace(-1, 1, rows)
    assert derivative(time, polynomial(time), 1, 9) == pytest.approx(polynomial.deriv()(time), abs=1e-7)


@settings(max_examples=20, deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
def test_units_do_not_change_the_result(seconds: float, unit: float) -> None:
    noisy = (SIGNAL + 0.01 * RANDOM)[:500]
    scaled = derivative(TIME[:500] * seconds, noisy * unit)
    assert scaled * seconds / unit == pytest.approx(derivative(TIME[:500], noisy), rel=1e-6, abs=1e-6)


def test_a_short_signal_is_refused() -> None:
    with pytest.raises(DataError, match="found 8 rows, expected at least 9"):
        derivative(TIME[:8], SIGNAL[:8])


def test_uneven_steps_are_refused_with_the_row() -> None:
    time = TIME.copy()
    time[100:] += 5e-3
    with pytest.raises(DataError, match=r"row 100 .* step 0.006 s, expected 0.001 s"):
        derivative(time, SIGNAL)


# ── inputs that belong to estimated derivatives ──────────────────────────────────────────────────────────


def test_integrals_of_held_and_straight_inputs_are_exact() -> None:
    time = np.array([0.0, 1.0, 1.5, 3.0])
    values = np.array([2.0, 4.0, -2.0, 1.0])
    assert integral(time, values, "hold") == pytest.approx([0, 2, 4, 1])
    assert integral(time, values, "hold", 2) == pytest.approx([0, 1, 1 + 1 + 0.5, 2.5 + 6 - 2.25])
    straight = 3 * time - 1
    assert integral(time, straight, "linear") == pytest.approx(1.5 * time**2 - time)
    assert integral(time, straight, "linear", 2) == pytest.approx(0.5 * time**3 - time**2 / 2)

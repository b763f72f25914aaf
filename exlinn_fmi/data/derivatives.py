"""Time derivatives of sampled signals by Savitzky–Golay filters whose window follows the noise.

Local polynomials of degree 6 are fitted by least squares in a window that slides over the samples; the
first and last half window are read off the polynomials there (no padding), so the edges are of full order.
The window is chosen for each signal: from the shortest on, it grows as long as the estimate stays within
the noise bands of all shorter windows (Lepski's rule), so that clean signals keep the shortest window
(error O(h⁶)) and noisy ones get the longest that does not bend the signal.

References: Savitzky, Golay (1964), Anal. Chem. 36, 1627; Goldenshluger, Nemirovski (1997), Math. Methods
    Stat. 6, 135.
"""

from __future__ import annotations

from math import comb
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs, savgol_filter

from exlinn_fmi.errors import DataError

DEGREE = 6
SHORTEST = 9
"""Samples in the shortest window: degree + 3, so that some noise is averaged even there."""
LONGEST = 1001
GROWTH = 1.3
BAND = 2.5
"""Width of the noise band in standard deviations."""
EVEN = 1e-3
"""Sampling steps may differ by this share of their median."""

Signal = Float[NDArray[np.float64], " N"]
Between = Literal["hold", "linear"]
"""How an input goes from row to row."""


def derivative(time: Signal, values: Signal, order: int = 1, window: int | None = None) -> Signal:
    """Derivative of a signal.

    Args:
        time: sampling times [s], equally spaced, increasing.
        values: the signal.
        order: 1 or 2.
        window: number of samples in the window, odd; chosen by the noise if not given.

    Raises:
        DataError: too few samples, or the steps differ.
    """
    if len(time) < SHORTEST:
        raise DataError(
            f"found {len(time)} rows, expected at least {SHORTEST} to estimate a derivative; "
            "record for longer"
        )
    steps = np.diff(time)
    step = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - step) > EVEN * step)
    if len(uneven):
        row = int(uneven[0]) + 1
        raise DataError(
            f"row {row} of the trajectory: step {steps[row - 1]:.6g} s, expected {step:.6g} s throughout to "
            "estimate a derivative; resample to equal steps, or give each part a trajectory of its own"
        )
    size = best_window(values, order) if window is None else window
    return np.asarray(_filter(values, size, order) / step**order)


def integral(time: Signal, values: Signal, between: Between, order: int = 1) -> Signal:
    """Integral of a sampled signal from the first row on, once or twice.

    Args:
        time: sampling times [s].
        values: the signal.
        between: ``hold``: it keeps its value to the next row; ``linear``: it goes there on a straight line.
        order: 1 or 2.
    """
    h, now = np.diff(time), values[:-1]
    after = now if between == "hold" else values[1:]
    once = np.concatenate([[0.0], np.cumsum(h * (now + after) / 2)])
    if order == 1:
        return once
    return np.concatenate([[0.0], np.cumsum(h * once[:-1] + h**2 * (2 * now + after) / 6)])


LEAST_NOISE = 1e-12
"""Least noise that a signal is taken to have, as a share of its size: that of floating point, summed up."""


def noise_level(values: Signal) -> float:
    """Standard deviation of white noise on a smooth signal, from its eighth differences.

    Args:
        values: the signal; at least 9 samples.
    """
    order = 8
    gain = np.sqrt(comb(2 * order, order))  # of white noise through that many differences
    differences = np.diff(values, order)
    return float(np.median(np.abs(differences)) / 0.6745 / gain)


def noise_gain(window: int, order: int = 1) -> float:
    """Standard deviation of the derivative of white noise of deviation 1, at unit steps.

    Args:
        window: number of samples in the filter's window.
        order: of the derivative.
    """
    return float(np.linalg.norm(savgol_coeffs(window, DEGREE, deriv=order)))


def best_window(values: Signal, order: int = 1) -> int:
    """The window that Lepski's rule chooses.

    Args:
        values: the signal; at least 9 samples.
        order: of the derivative.
    """
    floor = 4 * np.finfo(float).eps * float(np.max(np.abs(values), initial=0.0))
    sigma = max(noise_level(values), floor)
    tried: list[tuple[Signal, float]] = []
    chosen, size = SHORTEST, float(SHORTEST)
    while int(size) | 1 <= min(len(values), LONGEST):
        window = int(size) | 1
        estimate = _filter(values, window, order)
        deviation = sigma * noise_gain(window, order)
        inner = slice(window // 2, len(values) - window // 2)
        for other, spread in tried:
            if _rms(estimate[inner] - other[inner]) > BAND * float(np.hypot(deviation, spread)) / 2:
                return chosen
        tried.append((estimate, deviation))
        chosen = window
        size *= GROWTH
    return chosen


def _filter(values: Signal, window: int, order: int) -> Signal:
    """The filter at unit steps."""
    return np.asarray(savgol_filter(values, window, DEGREE, deriv=order, delta=1.0, mode="interp"))


def _rms(values: Signal) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0

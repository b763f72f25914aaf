"""Noise that is correlated from row to row: what it is like, and honest intervals under it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.linalg import block_diag, toeplitz
from scipy.signal import butter, lfilter, sosfiltfilt, sosfreqz
from test_learn_estimate import OPTIONS, TRUTH
from test_learn_noise_trajectory import COORDINATES, FAMILY, STATES, TRUE, clean, noisy

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.colour import Colour, colour, spread_of
from exlinn_fmi.learn.estimate import estimate
from exlinn_fmi.learn.trajectory import Fit, Information, cut, maximum_likelihood
from exlinn_fmi.scenario.learning import Identify

SETTLE = 500
LOW_PASS = butter(4, 0.2, output="sos")


def white(seed: int, rows: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((rows, 3))


def autoregressive(seed: int, rows: int) -> np.ndarray:
    """Of deviation 1; 0.8 of each row goes into the next."""
    return 0.6 * lfilter([1], [1, -0.8], white(seed, rows + SETTLE), axis=0)[SETTLE:]


def filtered(seed: int, rows: int) -> np.ndarray:
    """White noise through the filter of measured data, a fifth of the frequencies left."""
    low = sosfiltfilt(LOW_PASS, white(seed, rows + 2 * SETTLE), axis=0)[SETTLE:-SETTLE]
    return low / np.sqrt(np.mean(low**2, axis=0))


KINDS = {"white": white, "autoregressive": autoregressive, "filtered": filtered}


def shaped(kind: str, seed: int = 0) -> Dataset:
    """The motor with cart, and such noise of 1 %."""
    frame = clean().frame.copy()
    frame[STATES] += 0.01 * frame[STATES].std().to_numpy() * KINDS[kind](seed, len(frame))
    return Dataset(frame, COORDINATES)


# ── what the noise is like ───────────────────────────────────────────────────────────────────────────────


def test_white_noise_is_found_white() -> None:
    for seed in range(10):
        found = colour([white(seed, 3000), white(seed + 100, 500)])
        assert found.order == 0
        assert found.memory == pytest.approx(1)
        assert found.innovation == pytest.approx(np.eye(3), abs=0.1)


def test_an_autoregressive_process_is_found() -> None:
    found = colour([autoregressive(0, 8000), autoregressive(1, 8000)])
    assert found.coefficients[0] == pytest.approx(0.8 * np.eye(3), abs=0.03)
    assert found.innovation == pytest.approx(0.36 * np.eye(3), abs=0.02)
    assert found.memory == pytest.approx(9, rel=0.15)  # (1 + 0.8)/(1 - 0.8)


def test_the_density_below_a_filters_cut_off_is_found() -> None:
    gain = np.abs(sosfreqz(LOW_PASS)[1]) ** 2  # forwards and backwards
    exact = 1 / np.mean(gain**2)
    density = colour([filtered(0, 20_000)]).spectrum(np.linspace(0.001, 0.05, 50)).real
    assert density.diagonal(axis1=1, axis2=2).mean(axis=0) == pytest.approx(exact, rel=0.1)


def test_channels_may_share_their_noise() -> None:
    common = autoregressive(0, 20_000)
    mixed = common @ np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    density = colour([mixed]).spectrum(np.zeros(1))[0].real
    assert density[0, 1] == pytest.approx(0.5 * density[0, 0], rel=0.15)
    assert abs(density[0, 2]) < 0.1 * density[0, 0]


def test_series_too_short_to_tell_count_as_white() -> None:
    assert colour([autoregressive(0, 25)]).order == 0
    assert colour([np.zeros((100, 2))]).order == 0


def test_the_sum_over_frequencies_is_that_over_rows() -> None:
    random = np.random.default_rng(0)
    noise = Colour(0.5 * np.eye(1)[None], np.eye(1))
    z = [random.standard_normal((rows, 1, 2)) for rows in (40, 30)]
    rows = [toeplitz(0.5 ** np.arange(len(part))) / (1 - 0.25) for part in z]
    joined = np.concatenate(z)[:, 0]
    assert spread_of(noise, z) == pytest.approx(joined.T @ block_diag(*rows) @ joined, rel=1e-9)


# ── intervals ────────────────────────────────────────────────────────────────────────────────────────────


@lru_cache
def fitted(kind: str, seed: int) -> Fit:
    data = shaped(kind, 10 + seed)
    return maximum_likelihood(FAMILY.system(), cut(data, STATES, ["v"]), TRUE)


def covered(kind: str, sets: int, widened: bool = True) -> float:
    """Share of 95 % intervals that hold the truth."""
    inside = []
    for fit in (fitted(kind, seed) for seed in range(sets)):
        information = fit.information if widened else Information(fit.information.matrix)
        inside.append(np.abs(fit.p - TRUE) < 1.96 * np.sqrt(np.diag(information.covariance)))
    return float(np.mean(inside))


@pytest.mark.parametrize("kind", ["autoregressive", "filtered"])
def test_intervals_hold_the_truth_though_rows_are_correlated(kind) -> None:
    assert 0.88 <= covered(kind, 12) <= 1.0
    assert covered(kind, 12, widened=False) < 0.75


def test_white_noise_leaves_intervals_as_they_are() -> None:
    for seed in range(3):
        information = fitted("white", seed).information
        assert information.spread is None
        assert information.widening == 1


@pytest.mark.parametrize("kind", ["autoregressive", "filtered"])
def test_parameters_come_with_intervals_and_it_is_said_why_they_are_wide(kind) -> None:
    identified, note = estimate(shaped(kind), OPTIONS, TRUTH, "auto")
    assert identified is not None
    assert "the noise is correlated from row to row, so that intervals are" in note
    table, plain = identified.parameters, estimate(noisy(0.01), OPTIONS, TRUTH, "auto")
    assert (np.abs(table["identified"] - table["true"]) < 4 * table["std"]).all()
    assert plain.identified is not None
    assert (table["std"] > 1.5 * plain.identified.parameters["std"]).all()
    assert "the noise is white" in plain.note


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_family_does_not_explain_is_not_taken_for_noise(kind) -> None:
    missing = {k: v for k, v in OPTIONS.lagrangian.items() if k != "m_c*d^2"}
    options = Identify(lagrangian=missing, dissipation=OPTIONS.dissipation)
    identified, note = estimate(shaped(kind), options, TRUTH, "auto")
    assert identified is None
    assert "times the noise" in note

"""Fits to noisy trajectories: noise, weak form, sensitivities, maximum likelihood and its covariance."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from learn_helpers import multisine, simulate

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import DataError
from exlinn_fmi.learn.noise import CLEAN, relative_noise
from exlinn_fmi.learn.trajectory import Information, Shooting, cut, maximum_likelihood
from exlinn_fmi.learn.weak import inverse_regression, weak_regression
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.mechanics.sensitivity import Propagator

COORDINATES = (
    Coordinate("alpha", "rad", "mechanical", "circle"),
    Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="v", input_unit="V"),
)
FAMILY = MonomialBasis(
    COORDINATES,
    ("0.5*alpha_dot^2", "0.5*sin(alpha)^2*alpha_dot^2", "0.5*i^2", "i*alpha"),
    ("0.5*alpha_dot^2", "0.5*i^2"),
)
TRUE = np.array([0.1, 0.04, 1.0, 1.0, 0.5, 5.0])
STATES = ["alpha", "alpha_dot", "i"]


@lru_cache
def clean() -> Dataset:
    """4 s of the motor with cart."""
    family = FAMILY.system()
    parameters = tuple(replace(p, value=v) for p, v in zip(family.parameters, TRUE, strict=True))
    t = np.arange(2000) * 2e-3
    u = multisine(2.0, (0.2, 4), 12, 3.0, 1, t)[:, None]
    return Dataset(simulate(replace(family, parameters=parameters), u, 2e-3), COORDINATES)


def noisy(level: float, seed: int = 0) -> Dataset:
    """The same with white noise of this share of each state's standard deviation."""
    random = np.random.default_rng(seed)
    frame = clean().frame.copy()
    frame[STATES] += level * frame[STATES].std().to_numpy() * random.standard_normal((len(frame), 3))
    return Dataset(frame, COORDINATES)


def test_noise_is_estimated_within_a_tenth() -> None:
    assert list(relative_noise(noisy(0.02)).values()) == pytest.approx([0.02] * 3, rel=0.1)


def test_clean_data_are_found_clean() -> None:
    assert max(relative_noise(clean()).values()) < CLEAN


def test_short_trajectories_say_nothing_of_noise() -> None:
    short = Dataset(noisy(0.02).frame[:10], COORDINATES)
    assert (short.noise < 1e-9).all()


def test_weak_form_needs_no_accelerations() -> None:
    blind = clean().frame.assign(alpha_ddot=0.0, i_dot=0.0)
    assert weak_regression(FAMILY, Dataset(blind, COORDINATES)).solve() == pytest.approx(TRUE, rel=1e-4)


def test_inverse_form_is_exact_where_accelerations_are() -> None:
    regression = inverse_regression(FAMILY, clean())
    assert regression.solve() == pytest.approx(TRUE, rel=1e-10)
    assert regression.misfit(TRUE) < 1e-10


def test_a_ridge_shrinks() -> None:
    regression = inverse_regression(FAMILY, clean())
    assert np.linalg.norm(regression.solve(1.0)) < np.linalg.norm(regression.solve())


def test_sensitivities_are_finite_differences() -> None:
    propagator = Propagator(FAMILY.system(), 2e-3)
    random = np.random.default_rng(0)
    start, u = random.standard_normal((3, 3)), random.standard_normal((3, 20, 1))
    *_, last = propagator.sensitivities(propagator.run(start, u, TRUE), u, TRUE)
    step = 1e-6
    for k, (dx, dp) in enumerate(
        [*((e, 0 * TRUE) for e in np.eye(3)), *((np.zeros(3), e) for e in np.eye(6))]
    ):
        ends = [propagator.run(start + s * dx, u, TRUE + s * dp)[:, -1] for s in (step, -step)]
        assert last[:, :, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6, abs=1e-8)


def test_gradient_and_matrix_are_those_of_the_sum_of_squares() -> None:
    data = noisy(0.01)
    shooting = Shooting(FAMILY.system(), cut(Dataset(data.frame[:100], COORDINATES), STATES, ["v"]))
    theta = shooting.start(TRUE * 1.01)
    at = shooting.normal(theta)
    assert at.value == pytest.approx(shooting.value(theta))
    for k in (0, 3, 5, 6, 10, len(theta) - 1):
        step = np.zeros_like(theta)
        step[k] = 1e-6
        slope = (shooting.value(theta + step) - shooting.value(theta - step)) / 2e-6
        assert 2 * at.gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-4 * np.abs(at.gradient).max())
        change = (shooting.normal(theta + step).gradient - shooting.normal(theta - step).gradient) / 2e-6
        # Gauss–Newton leaves out what the residuals' curvature adds; along a first state there is hardly any.
        if k > 5:
            assert at.matrix[k, 6:] == pytest.approx(change[6:], rel=0.05, abs=1e-3 * at.matrix[k, k])


def test_every_row_counts_once() -> None:
    frame = noisy(0.01).frame[:1234]
    two = Dataset(frame.assign(trajectory=(np.arange(len(frame)) >= 700).astype(int)), COORDINATES)
    segments = cut(two, STATES, ["v"])
    assert segments.total == 1234
    assert (segments.follows < 0).sum() == 2


def test_a_gap_is_refused() -> None:
    frame = clean().frame[:100].copy()
    frame.loc[50:, "time"] += 0.1
    with pytest.raises(DataError, match=r"a step of 0.102 s where 0.002 s are usual"):
        cut(Dataset(frame, COORDINATES), STATES, ["v"])


def test_steps_may_differ() -> None:
    # Every third row on average is missing, inputs as they were held in between.
    frame = clean().frame
    kept = np.sort(np.random.default_rng(0).choice(len(frame), 2 * len(frame) // 3, replace=False))
    rows = np.arange(len(frame))
    held = np.add.reduceat(frame["v"].to_numpy(), kept) / np.diff(np.append(kept, len(frame)))
    thin = frame.iloc[kept].assign(v=held)
    assert rows[-1] - kept[-1] < 5
    segments = cut(Dataset(thin, COORDINATES), STATES, ["v"])
    assert len(np.unique(np.round(segments.steps, 6))) > 2
    fit = maximum_likelihood(FAMILY.system(), segments, TRUE * [1.5, 0.5, 1.3, 0.8, 1.2, 0.7])
    assert fit.p == pytest.approx(TRUE, rel=1e-3)


def test_maximum_likelihood_finds_clean_parameters_from_a_bad_start() -> None:
    segments = cut(clean(), STATES, ["v"])
    fit = maximum_likelihood(FAMILY.system(), segments, TRUE * [1.5, 0.5, 1.3, 0.8, 1.2, 0.7])
    assert fit.p == pytest.approx(TRUE, rel=1e-8)


def test_deviations_are_those_of_the_fisher_information() -> None:
    spread = 0.01 * clean().frame[STATES].std().to_numpy()
    exact = Shooting(FAMILY.system(), replace(cut(clean(), STATES, ["v"]), sigma=spread))
    bound = np.sqrt(np.diag(exact.information(exact.start(TRUE)).covariance))
    fit = maximum_likelihood(FAMILY.system(), cut(noisy(0.01), STATES, ["v"]), TRUE)
    assert np.sqrt(np.diag(fit.information.covariance)) == pytest.approx(bound, rel=0.1)
    assert (np.abs(fit.p - TRUE) < 4 * bound).all()
    assert fit.sigma == pytest.approx(spread, rel=0.1)


def test_a_direction_that_no_data_show_is_named() -> None:
    doubled = MonomialBasis(COORDINATES, (*FAMILY.lagrangian, "2*alpha*i"), FAMILY.dissipation)
    data = cut(noisy(0.01), STATES, ["v"])
    shooting = Shooting(doubled.system(), data)
    unknown = shooting.information(shooting.start(np.insert(TRUE, 4, 0.0))).unknown
    assert unknown.shape[0] == 1
    assert set(np.flatnonzero(np.abs(unknown[0]) > 1e-3)) == {3, 4}


def test_what_is_known_of_one_parameter_where_the_others_are_known() -> None:
    information = Information(np.array([[2.0, 1.0], [1.0, 2.0]]))
    assert information.only(np.array([True, False])).covariance == pytest.approx(0.5)
    assert information.covariance[0, 0] == pytest.approx(2 / 3)

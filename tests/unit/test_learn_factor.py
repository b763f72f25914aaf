"""The factor of a mass matrix that is known at samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learn_helpers import motor_cart_dataset

from exlinn_fmi.learn.factor import fit_cholesky, fit_factor
from exlinn_fmi.learn.structured import iterate_structured, structured_spec
from exlinn_fmi.scenario.learning import Structured


def circle(count: int = 300) -> np.ndarray:
    """[1, sin, cos] around the circle."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.column_stack([np.ones(count), np.sin(angle), np.cos(angle)])


def squared(factor: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """LLᵀ at the samples."""
    values = np.einsum("ick,bk->bic", factor, basis)
    return values @ values.transpose(0, 2, 1)


def test_factor_of_the_cart_s_mass_is_exact_with_a_second_column() -> None:
    basis = circle()
    mass = (0.1 + 0.04 * basis[:, 1] ** 2)[:, None, None]
    one, two = (fit_factor(mass, basis, columns, np.random.default_rng(0)) for columns in (1, 2))
    assert np.abs(squared(two, basis) - mass).max() < 1e-12
    assert np.abs(squared(one, basis) - mass).max() > 1e-4  # √(j + m sin²α) is not linear in sin and cos


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_a_factor_is_found_again_whatever_it_was(seed: int) -> None:
    random, basis = np.random.default_rng(seed), circle()
    truth = 0.3 * random.standard_normal((2, 3, 3))
    truth[[0, 1], [0, 1], 0] += 2
    mass = squared(truth, basis)
    found = squared(fit_factor(mass, basis, 3, random), basis)
    assert np.sqrt(np.mean((found - mass) ** 2)) < 1e-3 * np.abs(mass).max()


def test_a_cholesky_factor_on_a_rich_basis_squares_to_mass_and_its_derivative() -> None:
    x = np.linspace(-1, 1, 200)
    powers = np.arange(25)
    basis = np.polynomial.chebyshev.chebvander(x, 24)
    slopes = np.stack([np.polynomial.chebyshev.Chebyshev.basis(k).deriv()(x) for k in powers], axis=1)
    mass = np.stack([[2 + np.sin(x), 0.3 * x], [0.3 * x, 1 + x**2 / 2]]).transpose(2, 0, 1)
    change = np.stack([[np.cos(x), 0.3 + 0 * x], [0.3 + 0 * x, x]]).transpose(2, 0, 1)
    found = fit_cholesky(mass, change[..., None], basis, slopes[..., None])
    assert np.abs(squared(found, basis) - mass).max() < 1e-10
    factor, moved = (np.einsum("ick,bk->bic", found, b) for b in (basis, slopes))
    half = moved @ factor.transpose(0, 2, 1)
    assert np.abs(half + half.transpose(0, 2, 1) - change).max() < 1e-8


def test_units_of_the_coordinates_do_not_matter() -> None:
    basis, unit = circle(), np.array([1e3, 1e-3])
    mass = squared(np.array([[[2, 0, 0], [0, 0.5, 0]], [[0, 0, 0.3], [1, 0, 0.2]]]), basis)
    one = squared(fit_factor(mass, basis, 3, np.random.default_rng(1)), basis)
    other = squared(fit_factor(mass * np.outer(unit, unit), basis, 3, np.random.default_rng(1)), basis)
    assert other / np.outer(unit, unit) == pytest.approx(one, rel=1e-6)


def test_a_plant_whose_mass_is_quadratic_in_the_features_is_learned_before_the_first_iteration() -> None:
    data = motor_cart_dataset()
    options = Structured(preset="structured")
    spec, start = structured_spec(data, options, 0)
    assert next(iterate_structured(spec, start, data, data, options)).loss < 1e-16

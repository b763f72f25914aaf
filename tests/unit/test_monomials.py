"""Monomials: grammar, errors, expressions and their Euler–Lagrange operators."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.monomials import Factor, Monomial, MonomialBasis, parse_monomial
from exlinn_fmi.plants.dc_motor_cart import COORDINATES, PLANT

NAMES = ("alpha", "alpha_dot", "i")
TRUE_BASIS = MonomialBasis(
    COORDINATES,
    ("0.5*alpha_dot^2", "0.5*sin(alpha)^2*alpha_dot^2", "0.5*i^2", "i*alpha"),
    ("0.5*alpha_dot^2", "0.5*i^2"),
)


@pytest.mark.parametrize(
    ("text", "monomial"),
    [
        ("i", Monomial(1.0, (Factor("i"),))),
        ("0.5*i^2", Monomial(0.5, (Factor("i", power=2),))),
        (" -1e-3 * i ", Monomial(-1e-3, (Factor("i"),))),
        (".5*cos(alpha)^-1*i", Monomial(0.5, (Factor("alpha", "cos", -1), Factor("i")))),
        (
            "sin(alpha)^2*alpha_dot^2",
            Monomial(1.0, (Factor("alpha", "sin", 2), Factor("alpha_dot", power=2))),
        ),
    ],
)
def test_texts_of_the_grammar_are_read(text: str, monomial: Monomial) -> None:
    assert parse_monomial(text, NAMES) == monomial


@pytest.mark.parametrize(
    "text", ["", "2", "2*", "i+i", "tan(i)", "i^0.5", "i**2", "sin(2i)", "tanh(i)", "2i", "i*3"]
)
def test_other_texts_are_refused_with_the_grammar_or_the_reason(text: str) -> None:
    with pytest.raises(ModelError, match=r"factor|at least one name"):
        parse_monomial(text, NAMES)


def test_a_misspelt_name_gets_a_suggestion() -> None:
    with pytest.raises(ModelError, match=r"unknown name 'alpha_dt'; did you mean 'alpha_dot'\?"):
        parse_monomial("0.5*alpha_dt^2", NAMES)


def test_an_unlike_name_gets_the_known_names() -> None:
    with pytest.raises(ModelError, match="known names: alpha, alpha_dot, i"):
        parse_monomial("pressure", NAMES)


def test_no_name_is_known_among_none() -> None:
    with pytest.raises(ModelError, match="no name is known here"):
        parse_monomial("pressure", ())


@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 4))
def test_value_is_that_of_the_formula(alpha: float, i: float, power: int) -> None:
    monomial = parse_monomial(f"1.5*sin(alpha)^{power}*i^3*cos(i)", NAMES)
    value = monomial.evaluate({"alpha": alpha, "i": i})
    assert value == pytest.approx(1.5 * np.sin(alpha) ** power * i**3 * np.cos(i))


def test_a_cyclic_position_is_no_name_of_a_feature() -> None:
    with pytest.raises(ModelError, match="unknown name 'Q'"):
        MonomialBasis(COORDINATES, ("Q*alpha_dot",), ())


def test_a_position_is_no_name_of_dissipation() -> None:
    with pytest.raises(ModelError, match="unknown name 'alpha'"):
        MonomialBasis(COORDINATES, (), ("alpha*alpha_dot^2",))


def test_regressor_of_the_true_basis_is_the_plants_inverse_model() -> None:
    random = np.random.default_rng(0)
    q, v, a = random.standard_normal((3, 50, 2))
    p = PLANT.system.parameter_values
    j_m, m_c, d, inductance, k_e, b_m, r = p
    truth = np.array([j_m, m_c * d**2, inductance, k_e, b_m, r])
    force = evaluate(PLANT.system.inverse, q, v, a, p)
    assert evaluate(TRUE_BASIS.regressor, q, v, a, TRUE_BASIS.start) @ truth == pytest.approx(
        force, abs=1e-12
    )


def test_values_of_the_true_basis_make_the_plants_lagrangian_and_dissipation() -> None:
    q, v = np.random.default_rng(1).standard_normal((2, 20, 2))
    p = PLANT.system.parameter_values
    j_m, m_c, d, inductance, k_e, b_m, r = p
    values = evaluate(TRUE_BASIS.values(), q, v)
    lagrangian = values[:, :4] @ [j_m, m_c * d**2, inductance, k_e]
    assert lagrangian == pytest.approx(evaluate(PLANT.system.lagrangian, q, v, p)[:, 0])
    assert values[:, 4:] @ [b_m, r] == pytest.approx(evaluate(PLANT.system.dissipation, v, p)[:, 0])


def test_a_basis_may_have_no_terms_for_dissipation() -> None:
    basis = MonomialBasis(COORDINATES, ("0.5*i^2", "i*alpha"), ())
    assert evaluate(basis.regressor, *np.ones((3, 3, 2)), basis.start).shape == (3, 2, 2)

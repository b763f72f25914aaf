"""SI units as exponents of base units."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from exlinn_fmi.errors import ModelError
from exlinn_fmi.export.units import BASE, base_exponents

UNITS = st.sampled_from([*BASE, "N", "J", "W", "V", "Ohm", "H", "C", "F", "T", "Wb", "Hz", "Pa", "S"])


@pytest.mark.parametrize(
    ("unit", "exponents"),
    [
        ("rad/s2", {"s": -2, "rad": 1}),
        ("A/s", {"s": -1, "A": 1}),
        ("V", {"kg": 1, "m": 2, "s": -3, "A": -1}),
        ("kg.m2", {"kg": 1, "m": 2}),
        ("N.m/A", {"kg": 1, "m": 2, "s": -2, "A": -1}),
        ("N.m.s/rad", {"kg": 1, "m": 2, "s": -1, "rad": -1}),
        ("1/s", {"s": -1}),
        ("m.s-2", {"m": 1, "s": -2}),
        ("J/N.m", {}),
        ("1", {}),
        ("", {}),
    ],
)
def test_unit_is_written_in_base_units(unit: str, exponents: dict[str, int]) -> None:
    assert base_exponents(unit) == exponents


@pytest.mark.parametrize(
    ("product", "unit"),
    [
        ("W.s", "J"),
        ("V.A", "W"),
        ("Ohm.A", "V"),
        ("H.A/s", "V"),
        ("C/s", "A"),
        ("F.V", "C"),
        ("N.m/s", "W"),
        ("Wb/A", "H"),
    ],
)
def test_products_agree_with_the_units_they_make(product: str, unit: str) -> None:
    assert base_exponents(product) == base_exponents(unit)


@given(UNITS, UNITS)
def test_a_unit_divided_out_again_leaves_nothing(a: str, b: str) -> None:
    assert base_exponents(f"{a}.{b}/{b}") == base_exponents(a)


@pytest.mark.parametrize("unit", ["mm", "rpm", "N*m", "kg m2", "m²", "V/s/s"])
def test_what_is_no_coherent_si_unit_is_refused_by_name(unit: str) -> None:
    with pytest.raises(ModelError, match="is no SI unit without a prefix"):
        base_exponents(unit)

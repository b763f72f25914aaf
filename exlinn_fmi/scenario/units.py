"""Units written as text: whether two mean the same, and how to get from one to the other."""

from __future__ import annotations

import math
import re
from collections import Counter

from exlinn_fmi.components.base import SiUnit, Variable

_SPELLING = str.maketrans({"·": ".", "*": ".", " ": "", "^": "", "²": "2", "³": "3", "Ω": "Ohm"})

_BASES = {*"msAVNCWJHFTKg", "rad", "Hz", "Ohm", "Wb", "Pa", "kg"}
_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_SCALED = {
    "deg": (math.pi / 180, "rad"),
    "°": (math.pi / 180, "rad"),
    "rev": (2 * math.pi, "rad"),
    "rpm": (2 * math.pi / 60, "rad/s"),
    "min": (60.0, "s"),
    "h": (3600.0, "s"),
    "g": (1e-3, "kg"),
    "Nm": (1.0, "N.m"),
}
"""Units that are a multiple of another and no prefix of it."""

_SI: dict[str, tuple[int, ...]] = {
    "kg": (1,),
    "m": (0, 1),
    "s": (0, 0, 1),
    "A": (0, 0, 0, 1),
    "K": (0, 0, 0, 0, 1),
    "mol": (0, 0, 0, 0, 0, 1),
    "cd": (0, 0, 0, 0, 0, 0, 1),
    "rad": (0, 0, 0, 0, 0, 0, 0, 1),
    "Hz": (0, 0, -1),
    "N": (1, 1, -2),
    "Pa": (1, -1, -2),
    "J": (1, 2, -2),
    "W": (1, 2, -3),
    "C": (0, 0, 1, 1),
    "V": (1, 2, -3, -1),
    "Ohm": (1, 2, -3, -2),
    "F": (-1, -2, 4, 2),
    "Wb": (1, 2, -2, -1),
    "T": (1, 0, -2, -1),
    "H": (1, 2, -2, -2),
}
"""Exponents of kg, m, s, A, K, mol, cd, rad; zeros at the end are left out."""
_SHIFTED = {"degC": (1.0, 273.15), "°C": (1.0, 273.15), "degF": (5 / 9, 459.67 * 5 / 9)}
"""Temperatures that begin elsewhere: factor and offset to K."""
_UNSTATED = (None, "", "1", "-")


def same_unit(one: str | None, other: str | None) -> bool:
    """Whether two units agree; one that is not stated, or ``1``, agrees with any.

    ``N.m.s/rad`` and ``N·m·s·rad-1`` agree, ``mm`` and ``m`` do not, nor do ``C/s`` and ``A``: a unit is also
    a label, and the two ends of a connection should carry the same.
    """
    return one in _UNSTATED or other in _UNSTATED or _factors(str(one)) == _factors(str(other))


def _factors(unit: str) -> Counter[str] | str:
    """Exponent of each factor; the text itself where it is no product of powers."""
    text = unit.translate(_SPELLING)
    total: Counter[str] = Counter()
    for k, side in enumerate(text.split("/")):
        for factor in side.strip("()").split("."):
            match = re.fullmatch(r"([A-Za-z°%µ]+)([-+]?\d+)?|1", factor)
            if match is None:
                return text
            total[match[1] or ""] += int(match[2] or 1) * (-1 if k else 1)
    return Counter({name: power for name, power in total.items() if name and power})


def conversion(found: str, wanted: str) -> float | None:
    """Factor from one unit to another, None where there is none: rpm → rad/s, mA → A, but not C/s → A.

    Args:
        found: unit of a value, of SI units with or without prefix, deg, rev, rpm, min, h.
        wanted: the unit that it should have.
    """
    (one, factors), (other, targets) = _scaled(found), _scaled(wanted)
    return one / other if factors == targets else None


def si_unit(unit: str) -> SiUnit | None:
    """A unit written as text in terms of SI base units; None where it is not known."""
    if unit in _SHIFTED:
        factor, offset = _SHIFTED[unit]
        return SiUnit((0, 0, 0, 0, 1, 0, 0, 0), factor, offset)
    scale, factors = _scaled(unit)
    if isinstance(factors, str) or not set(factors) <= set(_SI):
        return None
    powers = [0] * 8
    for symbol, power in factors.items():
        for k, exponent in enumerate(_SI[symbol]):
            powers[k] += power * exponent
    kg, m, s, A, K, mol, cd, rad = powers
    return SiUnit((kg, m, s, A, K, mol, cd, rad), scale)


def linear(source: Variable, target: Variable) -> tuple[float, float] | None:
    """Factor and offset from values of one variable to those of another; None where their units do not fit.

    The definitions that FMUs give of their units count, else what the unit's text means. A unit that is not
    stated, or ``1``, fits any.
    """
    if source.unit in _UNSTATED or target.unit in _UNSTATED:
        return 1.0, 0.0
    one = source.si or si_unit(str(source.unit))
    other = target.si or si_unit(str(target.unit))
    if one is None or other is None:
        return (1.0, 0.0) if same_unit(source.unit, target.unit) else None
    if one.powers != other.powers:
        return None
    return one.factor / other.factor, (one.offset - other.offset) / other.factor


def _scaled(unit: str) -> tuple[float, Counter[str] | str]:
    """A unit as a multiple of factors without prefix."""
    factors = _factors(unit)
    if isinstance(factors, str):
        return 1.0, factors
    scale, total = 1.0, Counter[str]()
    for symbol, power in factors.items():
        multiple, base = _base(symbol)
        scale *= multiple**power
        for name, exponent in base.items():
            total[name] += power * exponent
    return scale, Counter({name: power for name, power in total.items() if power})


def _base(symbol: str) -> tuple[float, Counter[str]]:
    """A symbol as a multiple of units without prefix."""
    if symbol in _SCALED:
        multiple, text = _SCALED[symbol]
        return multiple, Counter(_factors(text))
    if symbol not in _BASES and symbol[1:] in _BASES and symbol[0] in _PREFIXES:
        multiple, factors = _base(symbol[1:])
        return _PREFIXES[symbol[0]] * multiple, factors
    return 1.0, Counter({symbol: 1})

"""SI units as text and as FMI's exponents of base units: ``N.m/A`` is kg·m²·s⁻²·A⁻¹."""

from __future__ import annotations

import math
import re
from collections import Counter

from exlinn_fmi.errors import ModelError

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""FMI's base units, in the order of its XML schema."""

_COHERENT: dict[str, dict[str, int]] = {
    **{unit: {unit: 1} for unit in BASE},
    "1": {},
    "Hz": {"s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "C": {"s": 1, "A": 1},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "F": {"kg": -1, "m": -2, "s": 4, "A": 2},
    "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "S": {"kg": -1, "m": -2, "s": 3, "A": 2},
    "Wb": {"kg": 1, "m": 2, "s": -2, "A": -1},
    "T": {"kg": 1, "s": -2, "A": -1},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
}
"""Units without a factor: a value in them is a value in base units."""


DISPLAY = {
    "rad": ("deg", 180 / math.pi),
    "rad/s": ("deg/s", 180 / math.pi),
    "rad/s2": ("deg/s2", 180 / math.pi),
}
"""Units that people would rather see another way: what it is called, and how many make one."""


def base_exponents(unit: str) -> dict[str, int]:
    """Exponents of the base units in a product of SI units.

    Args:
        unit: factors joined by ``.``, each a unit with an integer exponent behind it where that is not 1,
            and at most one ``/`` in front of those that divide: ``kg.m2``, ``N.m.s/rad``, ``rad/s2``.

    Returns:
        The exponents that are not 0, in the order of `BASE`.

    Raises:
        ModelError: a factor is no coherent SI unit.
    """
    total: Counter[str] = Counter()
    numerator, _, denominator = unit.partition("/")
    for side, sign in ((numerator, 1), (denominator, -1)):
        for factor in filter(None, side.split(".")):
            match = re.fullmatch(r"(1|[A-Za-z]+)(-?\d+)?", factor)
            if match is None or match[1] not in _COHERENT:
                raise ModelError(
                    f"unit {unit!r}: {factor!r} is no SI unit without a prefix; "
                    f"write it with {', '.join(sorted(_COHERENT, key=str.lower))}, as in 'N.m.s/rad'"
                )
            for base, exponent in _COHERENT[match[1]].items():
                total[base] += sign * exponent * int(match[2] or 1)
    return {base: total[base] for base in BASE if total[base]}

"""Names, numbers and units as print has them."""

from __future__ import annotations

import math
import re

import numpy as np

PREFIXES = {-15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def axis_label(name: str, unit: str) -> str:
    """Name and unit as an axis says them."""
    return name if name and not unit else f"{name} [{typeset(unit) or '1'}]".strip()


def typeset(unit: str) -> str:
    """A unit as print has it: ``kg.m2/s2`` is kg·m²/s²."""
    return re.sub(r"(?<=[^\W\d])-?\d+", lambda m: m[0].translate(SUPERSCRIPTS), unit).replace(".", "·")


def readable(size: float, unit: str) -> tuple[float, str]:
    """A factor that brings values up to `size` between 1 and 1000, and the unit they then have."""
    if not 0 < size < np.inf:
        return 1.0, unit
    if unit == "ms":
        factor, unit = readable(1e-3 * size, "s")
        return 1e-3 * factor, unit
    exponent = int(np.clip(3 * np.floor(np.log10(size) / 3), -15, 6))
    if exponent == 0:
        return 1.0, unit
    head = unit.partition("/")[0].partition(".")[0]
    if head.isalpha() and head != "kg":
        return 10.0**-exponent, PREFIXES[exponent] + unit
    power = "10" + str(exponent).translate(SUPERSCRIPTS)
    return 10.0**-exponent, f"{power} {unit}".strip()


def number(x: float, digits: int) -> str:
    """A number with so many significant digits, powers of ten as print has them; – where there is none."""
    if math.isnan(x):
        return "–"
    if not math.isfinite(x) or (x == int(x) and abs(x) < 1e6):
        return f"{x:g}".replace("-", "−")
    if 1e-3 <= abs(x) < 1e5:
        return f"{x:.{digits}g}".replace("-", "−") if "e" not in f"{x:.{digits}g}" else f"{x:.0f}"
    mantissa, _, exponent = f"{x:.{digits - 1}e}".partition("e")
    return f"{mantissa} × 10{str(int(exponent)).translate(SUPERSCRIPTS)}".replace("-", "−")


def shortened(name: str, most: int = 52) -> str:
    """A name that fits in a legend, cut in the middle."""
    return name if len(name) <= most else f"{name[: most // 2 - 1]}…{name[-most // 2 :]}"


def words(name: str) -> str:
    """A column's name in words."""
    return name.replace("_", " ")

"""Whole numbers of 64 bits in two float64: the nearest one, and the rest, a whole number up to 1024.

Up to 2⁵³ the rest is 0. Sums are taken modulo 2⁶⁴, as the nearest float64 of the greatest is beyond it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Number, Values

EXACT = 2**53
"""Whole numbers up to it are float64."""
UNIT = 2048
"""Numbers below 2⁶⁴ that are multiples of it are float64."""


def exact(value: Number) -> Number:
    """A number as float64, or as it is where that may not hold it."""
    return value if isinstance(value, int) and abs(value) > EXACT else float(value)


def rest_of(whole: NDArray[Any]) -> Values:
    """What float64 lacks of numbers of type int64 or uint64."""
    above, below = np.float64(UNIT) * (whole // UNIT), (whole % UNIT).astype(float)
    nearest = above + below
    return np.asarray(below - (nearest - above))


def joined(nearest: Values, rest: Values, kind: str) -> NDArray[Any]:
    """The numbers of type `kind`, int64 or uint64, that `nearest` and `rest` make; see `fits`."""
    above = np.floor(nearest / UNIT)
    below = nearest - UNIT * above + rest
    return np.asarray(above.astype(np.int64) * UNIT + below.astype(np.int64)).view(kind)


def fits(nearest: Values, rest: Values, kind: str) -> NDArray[np.bool_]:
    """Whether `nearest` and `rest` make numbers of type `kind`."""
    low, beyond = (0.0, 2.0**64) if kind == "uint64" else (-(2.0**63), 2.0**63)
    inside = (low <= nearest) & ((nearest < beyond) | ((nearest == beyond) & (rest < 0)))
    return np.asarray(
        inside & (np.floor(nearest) == nearest) & (np.abs(rest) <= UNIT) & (np.floor(rest) == rest)
    )

"""Whether two units written as text mean the same."""

from __future__ import annotations

import re
from collections import Counter

_SPELLING = str.maketrans({"·": ".", "*": ".", " ": "", "^": "", "²": "2", "³": "3", "Ω": "Ohm"})


def same_unit(one: str | None, other: str | None) -> bool:
    """Whether two units agree; one that is not stated, or ``1``, agrees with any.

    ``N.m.s/rad`` and ``N·m·s·rad-1`` agree, ``mm`` and ``m`` do not, nor do ``C/s`` and ``A``: a unit is also
    a label, and the two ends of a connection should carry the same.
    """
    unstated = (None, "", "1", "-")
    return one in unstated or other in unstated or _factors(str(one)) == _factors(str(other))


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

"""Texts and binaries among numbers: each is kept once in this process, and a number stands for it.

All values travel as float64. A `String` or `Binary` variable's value is the number of a text here, so that
connections, start values and recordings need to know nothing of texts; who shows one asks `text`.
"""

from __future__ import annotations

_kept: list[str | bytes] = [""]
_numbers: dict[str | bytes, int] = {"": 0}


def handle(value: str | bytes) -> float:
    """The number that stands for a text in this process; 0 is the empty one."""
    number = _numbers.get(value)
    if number is None:
        number = _numbers[value] = len(_kept)
        _kept.append(value)
    return float(number)


def text(number: float) -> str | bytes:
    """What a number of `handle` stands for.

    Raises:
        ValueError: it stands for nothing.
    """
    if not (0 <= number < len(_kept) and number == int(number)):
        raise ValueError(f"{number} stands for no text")
    return _kept[int(number)]


def shown(number: float) -> str:
    """A text as it is written to files: binaries in hexadecimal digits."""
    value = text(number)
    return value.hex() if isinstance(value, bytes) else value

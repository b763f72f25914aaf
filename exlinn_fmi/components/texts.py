"""Texts and binaries among numbers: each is kept once in this process, and a number stands for it.

All values travel as float64. A `String` or `Binary` variable's value is the number of a text here, so that
connections, start values and recordings need to know nothing of texts; who shows one asks `text`. The number
is a hash of the content: a run that goes on in another process has the same numbers there.
"""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import blake2b

_kept: dict[float, str | bytes] = {0.0: ""}
_numbers: dict[str | bytes, float] = {"": 0.0}


def handle(value: str | bytes) -> float:
    """The number that stands for a text: a whole one below 2⁵²; 0 is the empty text."""
    number = _numbers.get(value)
    if number is None:
        content = b"b" + value if isinstance(value, bytes) else b"t" + value.encode("utf-8", "surrogatepass")
        number = float(int.from_bytes(blake2b(content, digest_size=8).digest(), "big") >> 12)
        if number in _kept:  # among 10⁶ texts once in 10⁴ runs: better an end than the wrong text
            raise OverflowError(f"two texts have the same number: {value!r} and {_kept[number]!r}")
        _numbers[value], _kept[number] = number, value
    return number


def text(number: float) -> str | bytes:
    """What a number of `handle` stands for.

    Raises:
        ValueError: it stands for nothing.
    """
    try:
        return _kept[number]
    except KeyError:
        raise ValueError(f"{number} stands for no text") from None


def shown(number: float) -> str:
    """A text as it is written to files: binaries in hexadecimal digits."""
    value = text(number)
    return value.hex() if isinstance(value, bytes) else value


def kept() -> list[str | bytes]:
    """All texts that have numbers, for a process that is to go on with them."""
    return list(_numbers)


def keep(values: Iterable[str | bytes]) -> None:
    """Know the texts that another process knew."""
    for value in values:
        handle(value)

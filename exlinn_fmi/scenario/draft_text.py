"""How a draft writes names and texts: YAML that needs no thought, names that the vocabulary takes."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator
from itertools import count
from pathlib import Path

from exlinn_fmi.mechanics.coordinates import Kind, Topology

_WORDS = ("true", "false", "null")
"""What YAML would not take for a text."""


def scenario_name(file: Path) -> str:
    """A name for a scenario from that of a file: letters, digits, ``_``, ``.`` and ``-``."""
    plain = unicodedata.normalize("NFKD", file.stem).encode("ascii", "ignore").decode()
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", plain).strip("_.") or "mine"


def as_name(raw: str, otherwise: str) -> str:
    """A name of letters, digits and ``_`` from a variable's or a column's; `otherwise` where none is left."""
    leaf = re.sub(r"\W+", "_", raw, flags=re.ASCII).strip("_") or otherwise
    return leaf if not leaf[0].isdigit() else f"{otherwise}_{leaf}"


def distinct(name: str, taken: Iterable[str]) -> str:
    """A name that is not taken: with a number behind it if it has to be."""
    known = set(taken)
    return name if name not in known else next(n for k in count(2) if (n := f"{name}_{k}") not in known)


def as_text(value: str) -> str:
    """A text as a YAML value or key in a block, in quotes where it needs them."""
    plain = re.fullmatch(r"[A-Za-z_./][\w./ ()\[\],-]*(?<! )", value) and value.lower() not in _WORDS
    return value if plain else _quoted(value)


def as_key(value: str) -> str:
    """A text as a YAML value or key within brackets."""
    plain = re.fullmatch(r"[A-Za-z_./][\w./-]*", value) and value.lower() not in _WORDS
    return value if plain else _quoted(value)


def _quoted(value: str) -> str:
    """A text in quotes, with what cannot be printed as a code."""
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value) + '"'


def as_comment(value: str) -> str:
    """A text as part of a comment: on one line, not too long."""
    flat = " ".join("".join(c if c.isprintable() else " " for c in value).split())
    return flat if len(flat) <= 90 else f"{flat[:89]}…"


def kind_lines(kind: Kind, topology: Topology, cyclic: str) -> Iterator[str]:
    """What kind of coordinate it is, where that has to be said; and what a cyclic one's velocity is for."""
    if kind == "electrical":
        yield "  kind: electrical"
    told = {"circle": "TODO: line if it never makes a full turn", "cyclic": cyclic}
    if topology != "line":
        yield f"  topology: {topology}   # {told[topology]}"

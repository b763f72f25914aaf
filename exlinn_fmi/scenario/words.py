"""The words of error texts: key paths, what was found, and the nearest valid names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from exlinn_fmi.scenario.spec import form

KeyPath = tuple[str | int, ...]
"""Where a value stands in a scenario: keys of mappings and indices of lists, from the top."""

LISTED = 12
"""Longest list of valid names that an error text spells out."""


def key_path(path: Iterable[str | int]) -> str:
    """A key path as the user writes it, e.g. ``learn.training[0].duration``."""
    text = ""
    for key in path:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
    return text


def closest(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate that `name` is probably a misspelling of, None if none is near."""
    folded = {candidate.lower(): candidate for candidate in candidates}
    matches = get_close_matches(name.lower(), folded, n=1)
    return folded[matches[0]] if matches else None


def suggestion(name: str, candidates: Sequence[str], role: str = "valid") -> str:
    """End of an error text on a wrong name: the nearest valid one, or else the valid ones.

    Args:
        name: the wrong name.
        candidates: the valid names.
        role: what the valid ones are called, e.g. ``its outputs``.
    """
    match = closest(name, candidates)
    if match is not None:
        return f"; did you mean {match!r}?"
    return listing(candidates, role)


def listing(names: Sequence[str], role: str = "valid") -> str:
    """End of an error text: the valid names, the first of them where they are many."""
    if not names:
        return ""
    more = f", … ({len(names)} in all)" if len(names) > LISTED else ""
    return f"; {role}: {', '.join(names[:LISTED])}{more}"


def found(value: Any) -> str:
    """What a value is, for ``expected …, found …``."""
    match value:
        case bool():
            return "true" if value else "false"
        case int() | float():
            return str(value)
        case str():
            return f"text {value if len(value) <= 60 else value[:57] + '…'!r}"
        case list() | dict() if not value:
            return f"an empty {form(value).removeprefix('a ')}"
        case _:
            return form(value)


def either(names: Sequence[str]) -> str:
    """``a, b or c``."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def missing_file(name: str, folder: Path) -> str:
    """Error text on a file or folder that a scenario names and that is not there.

    Args:
        name: the path as written in the scenario.
        folder: the scenario's folder, which relative paths start from.
    """
    path = folder / name
    if not path.parent.is_dir():
        return f"no such file {name!r}: there is no folder {path.parent.as_posix()!r}"
    beside = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() == path.suffix.lower())
    prefix = name.removesuffix(path.name)
    tail = suggestion(path.name, beside, f"there {'is' if len(beside) == 1 else 'are'}")
    match = closest(path.name, beside)
    if match is not None:
        tail = f"; did you mean {prefix + match!r}?"
    elif Path(name).exists():
        tail = f"; relative paths start from the scenario's folder, {folder.as_posix()!r}"
    return f"no such file {name!r}{tail}"

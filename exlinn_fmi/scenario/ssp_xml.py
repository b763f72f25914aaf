"""The XML of SSP: elements whatever their namespace, and those that several kinds of files have."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

from exlinn_fmi.components.base import SiUnit, Variable
from exlinn_fmi.errors import InputError

ANNOTATION = "com.github.exlinn"
"""Type of annotations with what SSP has no words for, as JSON."""

_BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


def tag_of(element: ElementTree.Element) -> str:
    """Name of an element without its namespace, which differs from version to version."""
    return element.tag.rpartition("}")[2]


def children(element: ElementTree.Element | None, *path: str) -> Iterator[ElementTree.Element]:
    """Elements down a path of names; ``*`` is any."""
    if element is None:
        return
    if not path:
        yield element
        return
    for child in element:
        if path[0] in ("*", tag_of(child)):
            yield from children(child, *path[1:])


def first(element: ElementTree.Element | None, *path: str) -> ElementTree.Element | None:
    """The first element down a path of names."""
    return next(children(element, *path), None)


def annotation(element: ElementTree.Element) -> dict[str, Any]:
    """What we wrote beside an element, {} where nothing is."""
    for annotation in children(element, "Annotations", "Annotation"):
        if annotation.get("type") == ANNOTATION:
            try:
                found = json.loads("".join(annotation.itertext()))
            except ValueError as error:
                raise InputError(f"annotation {ANNOTATION}: {error}") from error
            return found if isinstance(found, dict) else {}
    return {}


def number(
    kind: ElementTree.Element, items: Mapping[str | None, str | None], what: str
) -> float | bool | str:
    """Value of a parameter as its type has it."""
    text, tag = kind.get("value", ""), tag_of(kind)
    if tag == "Boolean" and text in ("true", "false", "1", "0"):
        return text in ("true", "1")
    if tag in ("String", "Binary"):
        return text
    if tag == "Enumeration":
        text = items.get(text) or text
    try:
        return float(text) if tag in ("Real", "Float64", "Float32") else int(text)
    except ValueError:
        raise InputError(f"{what}: {text!r} is no value of type {tag}") from None


def units_of(root: ElementTree.Element) -> dict[str, Variable]:
    """Units by name, each as the unit of a variable."""
    found = {}
    for unit in children(root, "Units", "Unit"):
        name, base = unit.get("name", ""), first(unit, "BaseUnit")
        si = None
        if base is not None:
            kg, m, s, A, K, mol, cd, rad = (int(base.get(key, "0")) for key in _BASES)
            factor, offset = float(base.get("factor", "1")), float(base.get("offset", "0"))
            si = SiUnit((kg, m, s, A, K, mol, cd, rad), factor, offset)
        found[name] = Variable(name, unit=name, si=si)
    return found


def transformation(element: ElementTree.Element, what: str) -> tuple[float, float]:
    """Factor and offset of a linear transformation."""
    for child in element:
        if tag_of(child) == "LinearTransformation":
            return float(child.get("factor", "1")), float(child.get("offset", "0"))
        if tag_of(child).endswith("MappingTransformation"):
            raise InputError(f"{what}: <{tag_of(child)}> is not supported, <LinearTransformation> alone is")
    return 1.0, 0.0

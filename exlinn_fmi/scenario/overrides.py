"""Overrides ``key.path=value``, written into the text of a scenario with its comments kept."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any, get_args, get_origin

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from exlinn_fmi.errors import Problem
from exlinn_fmi.scenario.document import TextResolver, parse
from exlinn_fmi.scenario.places import alternatives, below, choose, entry, is_model
from exlinn_fmi.scenario.schema import Scenario
from exlinn_fmi.scenario.words import KeyPath, key_path, suggestion


class _UnfitError(Exception):
    """An override that does not fit the scenario, with the reason as its text."""


def _round_trip() -> YAML:
    """A reader and writer that leaves all it is not told to change as it is written."""
    yaml = YAML()
    yaml.Resolver = TextResolver
    yaml.preserve_quotes = True
    yaml.width = 10**6
    yaml.indent(mapping=2, sequence=4, offset=2)
    return yaml


def apply(text: str, overrides: Sequence[str]) -> tuple[str, dict[KeyPath, str], list[Problem]]:
    """Set values in the text of a scenario.

    Args:
        text: valid YAML with a mapping at the top.
        overrides: ``key.path=value`` each, the value being YAML; list indices as ``[0]`` or ``.0``.
            ``component.variable=value`` stands for a start value.

    Returns:
        The new text, the override at each key path that was set, and a problem for each that does not fit.
    """
    yaml, problems, applied = _round_trip(), [], {}
    document = yaml.load(text)
    for override in overrides:
        name, equals, value = override.partition("=")
        try:
            if not equals or not name.strip():
                raise _UnfitError(f"an override reads key.path=value, found {override!r}")
            applied[_set(document, _keys(name.strip(), document), _value(value))] = override
        except _UnfitError as unfit:
            problems.append(Problem(name.strip() if equals else "", f"{unfit} (override {override!r})"))
    if not applied:
        return text, applied, problems
    stream = io.StringIO()
    yaml.dump(document, stream)
    return stream.getvalue(), applied, problems


def _keys(name: str, document: Any) -> list[str]:
    """The parts of a key path: ``a[0].b`` gives a, [0], b; a component's variable is its start value."""
    keys = [part for part in re.sub(r"(\[\d+\])", r".\1.", name).split(".") if part]
    short = keys[0] not in Scenario.model_fields and keys[0] in (document.get("components") or {})
    return ["components", keys[0], "start", *keys[1:]] if short and len(keys) > 1 else keys


def _joined(keys: list[str]) -> str:
    """Parts of a key path as one key."""
    return "".join(key if key.startswith("[") else f".{key}" for key in keys).removeprefix(".")


def _value(text: str) -> Any:
    """The value of an override, as ruamel's round trip holds it."""
    problems = parse(text).problems
    if problems:
        raise _UnfitError(problems[0].message)
    return _round_trip().load(text)


def _set(document: Any, keys: list[str], value: Any) -> KeyPath:
    """Set the value under the keys; sections that the vocabulary knows are made where they are missing."""
    at, annotation, path = document, Scenario, list[str | int]()
    while True:
        key, rest = _next(at, annotation, keys, path, value)
        path.append(key)
        if not rest:
            if isinstance(entry(at, key), dict | list):
                at.ca.items.pop(key, None)  # comments about what was inside go with it
            at[key] = value
            return tuple(path)
        annotation = below(annotation, key, at)
        if entry(at, key) is None:
            if not any(is_model(form) or get_origin(form) is dict for form in alternatives(annotation)):
                raise _UnfitError(f"{key_path(path)!r} is not given yet; set the whole of it")
            at[key] = CommentedMap()
        at, keys = at[key], rest


def _next(at: Any, annotation: Any, keys: list[str], path: list[Any], value: Any) -> tuple[Any, list[str]]:
    """The key to go on with, and the parts of the path that then are left."""
    where = f"{key_path(path)!r}" if path else "the scenario"
    if isinstance(at, list):
        index = keys[0].strip("[]")
        if not index.isdigit() or int(index) >= len(at):
            raise _UnfitError(f"{where} is a list of {len(at)}, counted from 0: there is no {index!r} in it")
        return int(index), keys[1:]
    if not isinstance(at, dict):
        raise _UnfitError(f"{where} is no section: there is nothing under it")
    for length in range(len(keys), 0, -1):  # keys may hold dots, as those of `connections` do
        if (known := _joined(keys[:length])) in at:
            return known, keys[length:]
    chosen = choose(annotation, at)
    if is_model(chosen):
        names = list(chosen.model_fields)
        if keys[0] not in names:
            names += [] if path else list(at.get("components") or ())
            raise _UnfitError(f"no key {keys[0]!r} in {where}{suggestion(keys[0], names, 'its keys')}")
        return keys[0], keys[1:]
    if get_origin(chosen) is dict and not isinstance(value, dict) and _sections(get_args(chosen)[1]):
        near = [k for k in at if len(k.split(".")) <= len(keys)]
        given = ".".join(keys[: max((len(k.split(".")) for k in near), default=1)])
        raise _UnfitError(f"no {given!r} in {where}{suggestion(given, near, 'there are')}")
    return _joined(keys), []


def _sections(annotation: Any) -> bool:
    """Whether only sections may stand here."""
    return all(is_model(form) for form in alternatives(annotation))

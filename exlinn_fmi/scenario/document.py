"""YAML 1.2 text to plain data, with the line of every key path and every mistake in the text.

Scalars follow the core schema of YAML 1.2.2 §10.3.2 to the letter: ``1e-3`` is a number, ``on`` is text,
``010`` is ten. ruamel does the syntax; what a scalar means is decided here, since its own resolver leaves
``.5e3`` a text and makes dates of what looks like one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.resolver import VersionedResolver
from ruamel.yaml.tag import Tag

from exlinn_fmi.errors import Problem
from exlinn_fmi.scenario.words import KeyPath, key_path

MOST_VALUES = 100_000
"""Values in one file beyond which aliases have been nested with ill intent."""

_TAG = "tag:yaml.org,2002:"
_CORE: tuple[tuple[str, re.Pattern[str], Callable[[str], Any]], ...] = (
    ("null", re.compile(r"(null|Null|NULL|~|)"), lambda text: None),
    ("bool", re.compile(r"(true|True|TRUE|false|False|FALSE)"), lambda text: text.lower() == "true"),
    ("int", re.compile(r"[-+]?[0-9]+"), int),
    ("int", re.compile(r"0o[0-7]+"), lambda text: int(text[2:], 8)),
    ("int", re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text, 16)),
    ("float", re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    ("float", re.compile(r"[-+]?\.(inf|Inf|INF)"), lambda text: -math.inf if text[0] == "-" else math.inf),
    ("float", re.compile(r"\.(nan|NaN|NAN)"), lambda text: math.nan),
)


class TextResolver(VersionedResolver):
    """Takes every scalar for text, so that ruamel keeps what the user wrote, digit for digit."""

    def resolve(self, kind: type[Node], value: str | None, implicit: tuple[bool, bool]) -> Tag:
        """Tag of a node that has none: text, or null where nothing stands at all."""
        if kind is ScalarNode:
            return Tag(suffix=f"{_TAG}null" if value == "" and implicit[0] else f"{_TAG}str")
        return self.DEFAULT_SEQUENCE_TAG if kind is SequenceNode else self.DEFAULT_MAPPING_TAG


class CoreResolver(TextResolver):
    """Takes plain scalars for what the YAML 1.2 core schema says they are."""

    def resolve(self, kind: type[Node], value: str | None, implicit: tuple[bool, bool]) -> Tag:
        """Tag of a node that has none."""
        if kind is ScalarNode and implicit[0] and value is not None:
            for name, pattern, _ in _CORE:
                if pattern.fullmatch(value):
                    return Tag(suffix=_TAG + name)
        return super().resolve(kind, value, implicit)


@dataclass(frozen=True)
class Document:
    """What a scenario file says.

    Args:
        data: plain mappings, lists and scalars; None where the text is not YAML.
        lines: line of every key path, counted from 1.
        problems: mistakes in the text.
        faulty: key paths of values that could not be read; `data` has None there.
    """

    data: Any
    lines: dict[KeyPath, int] = field(default_factory=dict)
    problems: tuple[Problem, ...] = ()
    faulty: frozenset[KeyPath] = frozenset()

    def line(self, path: KeyPath) -> int:
        """Line of a key path, or of the nearest thing around it that the file has; 0 where it has none."""
        while path and path not in self.lines:
            path = path[:-1]
        return self.lines.get(path, 0)


def parse(text: str) -> Document:
    """Read YAML 1.2 text; mistakes come back as problems."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Resolver = CoreResolver
    reading = _Reading()
    try:
        node = yaml.compose(text)
        data = None if node is None else reading.value(node, ())
    except MarkedYAMLError as error:
        return Document(None, {}, (_syntax_problem(error),))
    except YAMLError as error:  # characters that YAML does not allow
        position = getattr(error, "position", 0)
        line = text.count("\n", 0, position) + 1
        return Document(None, {}, (Problem("", f"not YAML: {error.reason}", line),))  # type: ignore[attr-defined]
    except RecursionError:
        return Document(None, {}, (Problem("", "lists and mappings are nested too deeply"),))
    except _TooManyValuesError:
        message = f"more than {MOST_VALUES} values, with aliases counted as what they stand for"
        return Document(None, {}, (Problem("", message),))
    return Document(data, reading.lines, tuple(reading.problems), frozenset(reading.faulty))


def _syntax_problem(error: MarkedYAMLError) -> Problem:
    """A syntax error of ruamel's in our words."""
    mark = error.problem_mark or error.context_mark
    message = (error.problem or error.context or "").strip()
    if error.context and error.context_mark and error.context_mark.line != mark.line:
        message += f" {error.context.strip()} that begins on line {error.context_mark.line + 1}"
    hint = ""
    if "another document" in message:
        message = "a scenario is one document, and here '---' begins another"
    elif r"\t" in message:
        hint = "; indent with spaces, not tabs"
    elif "mapping values are not allowed" in message:
        hint = "; put text that holds ': ' in quotes, and check the indentation"
    return Problem("", f"not YAML: {message} (column {mark.column + 1}){hint}", mark.line + 1)


class _TooManyValuesError(Exception):
    """Aliases of aliases have grown beyond `MOST_VALUES`."""


class _Reading:
    """Node tree to plain data; collects lines and problems on the way."""

    def __init__(self) -> None:
        self.lines: dict[KeyPath, int] = {}
        self.problems: list[Problem] = []
        self.faulty: set[KeyPath] = set()
        self._open: set[int] = set()

    def value(self, node: Node, path: KeyPath) -> Any:
        """The plain value of a node."""
        line = node.start_mark.line + 1
        self.lines.setdefault(path, line)
        if len(self.lines) > MOST_VALUES:
            raise _TooManyValuesError
        if isinstance(node, ScalarNode):
            return self._scalar(node, path, line)
        if str(node.tag) not in (f"{_TAG}map", f"{_TAG}seq"):
            return self._fault(path, f"the tag {node.tag} has no meaning here; leave it out", line)
        if id(node) in self._open:
            return self._fault(path, "an alias stands within what it is an alias of", line)
        self._open.add(id(node))
        if isinstance(node, MappingNode):
            result: Any = self._mapping(node, path)
        else:
            result = [self.value(item, (*path, k)) for k, item in enumerate(node.value)]
        self._open.remove(id(node))
        return result

    def _scalar(self, node: ScalarNode, path: KeyPath, line: int) -> Any:
        name = str(node.tag).removeprefix(_TAG)
        if name == "str":
            return node.value
        for kind, pattern, convert in _CORE:
            if kind == name and pattern.fullmatch(node.value):
                try:
                    return convert(node.value)
                except ValueError:  # Python refuses whole numbers of thousands of digits
                    return self._fault(path, "a number of too many digits", line)
        return self._fault(path, f"the tag {node.tag} has no meaning here; leave it out", line)

    def _mapping(self, node: MappingNode, path: KeyPath) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, ScalarNode):
                self._problem(path, "a key must be a name, found a list or mapping", line)
                continue
            key = str(key_node.value)
            below = (*path, key)
            if key == "<<" and key_node.style is None:
                self._problem(path, "merge keys (<<) are not part of YAML 1.2; write the keys out", line)
            elif key in mapping:
                self._problem(below, f"key {key!r} is given twice, first on line {self.lines[below]}", line)
            else:
                self.lines[below] = line
                mapping[key] = self.value(value_node, below)
        return mapping

    def _problem(self, path: KeyPath, message: str, line: int) -> None:
        self.problems.append(Problem(key_path(path), message, line))

    def _fault(self, path: KeyPath, message: str, line: int) -> None:
        self.faulty.add(path)
        self._problem(path, message, line)

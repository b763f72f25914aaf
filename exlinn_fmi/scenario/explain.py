"""What pydantic finds wrong with a scenario, in our words: found versus expected, and the nearest valid name.

Also the other half of reporting every mistake at once: `sound_part` is what is left of a scenario when the
mistakes are cut out, so that the checks across sections can go on with it.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import Field, ValidationError
from pydantic_core import ErrorDetails

from exlinn_fmi.scenario.places import (
    Place,
    alternatives,
    entry,
    is_model,
    kind_field,
    locate,
    telling_keys,
)
from exlinn_fmi.scenario.schema import ComponentBase, ComponentSpec, Scenario
from exlinn_fmi.scenario.spec import Spec
from exlinn_fmi.scenario.study import Relative
from exlinn_fmi.scenario.words import KeyPath, closest, either, found, listing, suggestion

Finding = tuple[KeyPath, str]
"""A mistake: where, and the text of the message."""

PATTERNS = {
    r"^[A-Za-z_][A-Za-z0-9_]*$": "a name of letters, digits and _ that begins with no digit",
    r"^[A-Za-z_][A-Za-z0-9_]*\..+$": "a variable as component.variable",
    r"^[A-Za-z_][A-Za-z0-9_]*(\..+)?$": "a component, or a variable as component.variable",
    r"^[\w.]+:\w+$": "a class as module:Class",
    r"^[A-Za-z0-9_.-]+$": "a name of letters, digits, _, . and -",
}
"""What each pattern of the vocabulary asks for, in words."""
_EXPECTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a mapping of names to values",
    "finite_number": "a finite number",
}
_BOUNDS = {
    "greater_than": (">", "gt"),
    "greater_than_equal": ("≥", "ge"),
    "less_than": ("<", "lt"),
    "less_than_equal": ("≤", "le"),
}


class Draft(Scenario):
    """A scenario in which nothing is required at the top."""

    name: str = ""
    components: dict[str, ComponentSpec] = Field(default_factory=dict)


def schema_findings(data: Any, known: frozenset[KeyPath] = frozenset()) -> list[Finding]:
    """Everything that is wrong with plain data as a scenario, section by section.

    Args:
        data: the scenario as plain data.
        known: places that were reported before, which are not reported again.
    """
    errors = [(error, locate(error["loc"], data)) for error in _errors(Scenario, data)]
    # Of a section that says of itself that it is two things, no more is said: it depends on which it is.
    torn = {place.path[:-1]: place.path for error, place in errors if _is_torn(error, place)}
    findings = []
    for error, place in errors:
        finding = _explain(error, place)
        around = (place.path[:k] for k in range(len(place.path)))
        moot = any(torn.get(section, place.path) != place.path for section in around)
        if finding is not None and place.path not in known and not moot:
            findings.append(finding)
    return list(dict.fromkeys(findings))


def _is_torn(error: ErrorDetails, place: Place) -> bool:
    """Whether a section has a second key of those one of which tells what it is."""
    return error["type"] == "extra_forbidden" and place.path[-1] in telling_keys(place.model)


@dataclass(frozen=True)
class Sound:
    """What is left of a scenario when its mistakes are cut out.

    Args:
        scenario: the rest, valid.
        cut: places that were cut.
        unknown: those among them whose key is unknown, so perhaps meant for a key that now has its default.
    """

    scenario: Draft
    cut: frozenset[KeyPath]
    unknown: frozenset[KeyPath]

    def in_doubt(self, section: KeyPath, key: str) -> bool:
        """Whether a setting may have been given in another way than it now reads."""
        around = (section[:k] for k in range(1, len(section) + 1))
        return (
            (*section, key) in self.cut
            or any(path in self.cut for path in around)
            or any(path[:-1] == section for path in self.unknown)
        )


def sound_part(data: Any) -> Sound:
    """Cut the mistakes out of a scenario, so that the checks across its sections can go on with the rest."""
    rest = copy.deepcopy(data) if isinstance(data, dict) else {}
    cut, unknown = set(), set()
    while errors := _errors(Draft, rest):
        places = [(error["type"], locate(error["loc"], rest)) for error in errors]
        for kind, place in places:
            missing = isinstance(place.siblings, Mapping) and place.path[-1] not in place.siblings
            cut.add(_cut(rest, place.path[:-1] if missing else place.path))
            if kind == "extra_forbidden":
                unknown.add(place.path)
    return Sound(Draft.model_validate(rest), frozenset(cut), frozenset(unknown))


def _cut(data: Any, path: KeyPath) -> KeyPath:
    """Take out what stands at a path; a list as a whole, so that no other member changes its place."""
    while path and isinstance(path[-1], int):
        path = path[:-1]
    holder = data
    for key in path[:-1]:
        holder = entry(holder, key)
    if isinstance(holder, dict) and path:
        holder.pop(path[-1], None)
    return path


def _errors(model: type[Spec], data: Any) -> list[ErrorDetails]:
    try:
        model.model_validate(data)
    except ValidationError as error:
        return error.errors(include_url=False)
    return []


def _explain(error: ErrorDetails, place: Place) -> Finding | None:
    """One pydantic error in our words; None where another error says it better."""
    kind, context, value = error["type"], error.get("ctx", {}), place.value
    if kind == "missing":
        return _missing(place)
    if kind == "extra_forbidden":
        return place.path, _unknown_key(place)
    if kind.startswith("union_tag") or (
        kind.startswith("model_") and len(alternatives(place.annotation)) > 1
    ):
        return _no_form(place)
    if kind == "string_pattern_mismatch":
        text = str(place.path[-1]) if place.is_key else value
        return place.path, f"expected {PATTERNS[context['pattern']]}, found {found(text)}"
    if kind in _BOUNDS:
        sign, key = _BOUNDS[kind]
        return place.path, f"expected {sign} {context[key]:g}, found {found(value)}"
    if kind == "literal_error":
        choices = _literals(place.annotation)
        return place.path, _no_choice(value, choices) if choices else f"expected true, found {found(value)}"
    if kind in ("too_short", "too_long"):
        return place.path, _wrong_length(context, value)
    if kind.startswith("model_"):
        return place.path, f"expected a mapping, found {found(value)}"
    expected = _EXPECTED.get(kind)
    if expected is None:  # an error that no annotation of the vocabulary gives as yet
        return place.path, error["msg"].removeprefix("Input should be ")
    return place.path, f"expected {expected}, found {found(value)}{_number_hint(expected, value)}"


def _number_hint(expected: str, value: Any) -> str:
    """What to do about a number that was written as text."""
    if "number" not in expected or not isinstance(value, str):
        return ""
    if re.fullmatch(r"[-+]?[\d_]*\.?[\d_]+([eE][-+]?\d+)?", value):
        return "; take '_' out" if "_" in value else "; take away the quotes"
    if re.match(r"[-+]?[\d.]+(e[-+]?\d+)?\s*[A-Za-zµ°Ω%]", value):
        return "; write the number alone, in the unit that the key is given in (SI)"
    if re.search(r"\d\s*[-+*/^]|pi\b|π", value):
        return "; formulas are not evaluated, write the number"
    return ""


def _missing(place: Place) -> Finding | None:
    """A key that must be there and is not, unless it is there misspelt, which `_unknown_key` tells."""
    key, holder = place.path[-1], place.path[:-1]
    if place.model is None:
        return holder, f"expected a list of 2, found one of {len(place.siblings)}"
    valid = list(place.model.model_fields)
    if any(k not in valid and closest(k, valid) == key for k in place.siblings):
        return None
    description = place.model.model_fields[str(key)].description
    return holder, f"missing key {key!r}" + (f": {description}" if description else "")


def _unknown_key(place: Place) -> str:
    key, model = str(place.path[-1]), place.model
    assert model is not None
    forms = telling_keys(model)
    kinds = [k for k in forms if k in place.siblings]
    if key in forms:
        one = "a component is of one kind" if issubclass(model, ComponentBase) else "a model has one source"
        return f"{one}, and this has the keys {' and '.join(map(repr, kinds))}; keep one of them"
    owners = [repr(k) for k, other in forms.items() if key in other.model_fields]
    if owners:
        return f"{key!r} goes with {either(owners)}, and this has {kinds[0]!r}; take it out"
    return f"unknown key {key!r}{suggestion(key, list(model.model_fields), 'valid keys')}"


def _no_form(place: Place) -> Finding:
    """A value that is none of the several forms that may stand there."""
    forms, value = alternatives(place.annotation), place.value
    if not all(is_model(form) for form in forms):
        expected = either(list(dict.fromkeys(map(_form_name, forms))))
        hint = _number_hint(expected, value)
        return place.path, f"expected {expected}, found {found(value)}{hint}"
    key = kind_field(forms[0])
    telling = list(telling_keys(forms[0]))
    kinds = telling if key is None else [_literals(f.model_fields[key].annotation)[0] for f in forms]
    if not isinstance(value, Mapping):
        what = f"one of the keys {', '.join(kinds)}" if key is None else f"a key {key!r}: {either(kinds)}"
        return place.path, f"expected a mapping with {what}, found {found(value)}"
    if key is not None and key in value:
        return (*place.path, key), _no_choice(value[key], kinds)
    names = kinds if key is None else [key]
    typo = next((k for k in value if closest(k, names) and k not in _all_keys(forms)), None)
    if typo is not None:
        return (*place.path, typo), f"unknown key {typo!r}{suggestion(typo, names)}"
    if key is None:
        is_component, is_law = issubclass(forms[0], ComponentBase), issubclass(forms[0], Relative)
        what = "how this is distributed" if is_law else "what to learn from"
        what = "what kind of component this is" if is_component else what
        return place.path, f"nothing says {what}; give one of the keys {', '.join(kinds)}"
    return place.path, f"missing key {key!r}{listing(kinds, 'one of')}"


def _all_keys(forms: Sequence[type[Spec]]) -> set[str]:
    return {key for form in forms for key in form.model_fields}


def _form_name(annotation: Any) -> str:
    literals = _literals(annotation)
    if literals:
        return repr(literals[0])
    origins = {float: "a number", int: "a number", bool: "true or false", str: "text"}
    return origins.get(annotation) or ("a list" if "list" in str(annotation) else "a mapping")


def _literals(annotation: Any) -> list[str]:
    """The words that a choice allows."""
    return [arg for form in alternatives(annotation) for arg in get_args(form) if isinstance(arg, str)]


def _no_choice(value: Any, choices: Sequence[str]) -> str:
    match = closest(value, choices) if isinstance(value, str) else None
    return f"expected {either(choices)}, found {found(value)}" + (
        f"; did you mean {match!r}?" if match else ""
    )


def _wrong_length(context: Mapping[str, Any], value: Any) -> str:
    if "min_length" in context:
        least = context["min_length"]
        return f"expected at least {least} entr{'y' if least == 1 else 'ies'}, found {found(value)}"
    return f"expected a list of {context['max_length']}, found one of {context['actual_length']}"

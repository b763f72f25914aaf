"""Where a key path leads in the vocabulary: which section, list or mapping, and what may stand there.

Error texts and overrides ask this; the answer comes from the annotations of the models in schema.py alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeGuard, Union, get_args, get_origin

from exlinn_fmi.scenario.learning import LEARN_KEYS
from exlinn_fmi.scenario.schema import COMPONENT_KEYS, Scenario
from exlinn_fmi.scenario.spec import Spec, telling_key
from exlinn_fmi.scenario.study import DISTRIBUTION_KEYS
from exlinn_fmi.scenario.words import KeyPath


def alternatives(annotation: Any) -> tuple[Any, ...]:
    """The forms that a value may take, without `Annotated` and `None`."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return alternatives(get_args(annotation)[0])
    if origin in (Union, UnionType):
        return tuple(a for arg in get_args(annotation) if arg is not NoneType for a in alternatives(arg))
    return (annotation,)


def is_model(annotation: Any) -> TypeGuard[type[Spec]]:
    """Whether this is one of the vocabulary's sections."""
    return isinstance(annotation, type) and issubclass(annotation, Spec)


def kind_field(model: type[Spec]) -> str | None:
    """The key whose value tells which of several sections is meant: `signal`, `map` or `preset`."""
    for name, field in model.model_fields.items():
        if get_origin(field.annotation) is Literal and field.is_required():
            return name
    return None


def telling_keys(model: Any) -> Mapping[str, type[Spec]]:
    """The keys one of which tells which of several sections is meant, and what they make; {} if none does."""
    return next(
        (keys for keys in (COMPONENT_KEYS, LEARN_KEYS, DISTRIBUTION_KEYS) if model in keys.values()), {}
    )


def choose(annotation: Any, value: Any) -> Any:
    """The form that a value is meant to have, judging by its kind key or by what it is; None if open."""
    forms = alternatives(annotation)
    return forms[0] if len(forms) == 1 else next((a for a in forms if _meant(a, value)), None)


def _meant(annotation: Any, value: Any) -> bool:
    if is_model(annotation):
        if not isinstance(value, Mapping):
            return False
        if keys := telling_keys(annotation):
            return keys.get(telling_key(dict(value), keys) or "") is annotation
        key = kind_field(annotation)
        return key is None or value.get(key) in get_args(annotation.model_fields[key].annotation)
    if get_origin(annotation) is dict:
        return isinstance(value, Mapping)
    if get_origin(annotation) in (list, tuple):
        return isinstance(value, list)
    return not isinstance(value, Mapping | list)


def below(annotation: Any, key: str | int, value: Any) -> Any:
    """What may stand under `key` of a value; None if nothing may."""
    chosen = choose(annotation, value)
    if is_model(chosen):
        field = chosen.model_fields.get(str(key))
        return None if field is None else field.annotation
    arguments = get_args(chosen)
    if get_origin(chosen) is dict:
        return arguments[1]
    if get_origin(chosen) is list:
        return arguments[0]
    return arguments[key] if isinstance(key, int) and key < len(arguments) else None


def entry(value: Any, key: str | int) -> Any:
    """What stands under a key or index of a value; None if nothing does."""
    if isinstance(value, Mapping):
        return value.get(key)
    return value[key] if isinstance(value, list) and isinstance(key, int) and key < len(value) else None


@dataclass(frozen=True)
class Place:
    """A place in a scenario file.

    Args:
        path: its key path.
        annotation: what may stand here; None where nothing may.
        value: what does; None if nothing does.
        model: the section that has the last key of the path, None where that is a list or free mapping.
        siblings: the value that the last key belongs to.
        is_key: the key itself is meant, not what stands under it.
    """

    path: KeyPath
    annotation: Any
    value: Any
    model: type[Spec] | None = None
    siblings: Any = None
    is_key: bool = False


def unfilled(value: Any, annotation: Any = Scenario, path: KeyPath = ()) -> Iterator[tuple[KeyPath, str]]:
    """Places where a draft of `exlinn init` still says TODO, each with what is wanted there."""
    members = value.items() if isinstance(value, Mapping) else enumerate(value)
    chosen = choose(annotation, value)
    for key, member in members:
        here = (*path, key)
        if "TODO" in (key, member):
            field = chosen.model_fields.get(str(key)) if is_model(chosen) else None
            wanted = f": {field.description}" if field is not None and field.description else ""
            yield here, f"still TODO{wanted}"
        elif isinstance(member, Mapping | list):
            yield from unfilled(member, below(annotation, key, value), here)


def locate(location: Sequence[str | int], data: Any) -> Place:
    """The place that pydantic means by an error's location.

    A location holds more than keys: where a value may have several forms, the name of the one that pydantic
    took comes in between, and ``[key]`` at the end says that the key itself is wrong.

    Args:
        location: `loc` of a pydantic error.
        data: the whole scenario as plain data.
    """
    place, rest = Place((), Scenario, data), list(location)
    while rest:
        if rest == ["[key]"]:
            return replace(place, is_key=True)
        if len(alternatives(place.annotation)) > 1:
            rest.pop(0)
            if not rest:
                break
        key = rest.pop(0)
        chosen = choose(place.annotation, place.value)
        place = Place(
            (*place.path, key),
            below(place.annotation, key, place.value),
            entry(place.value, key),
            chosen if is_model(chosen) else None,
            place.value,
        )
    return place

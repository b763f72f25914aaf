"""The JSON Schema of scenario files, by which editors complete and check them."""

from __future__ import annotations

import re
from typing import Any

from exlinn_fmi.scenario.schema import Scenario


def json_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of scenario files, made from the models in schema.py.

    To write the shipped file anew: ``exlinn schema --out exlinn_fmi/scenario/scenario.schema.json``.
    """
    schema = Scenario.model_json_schema()
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **_plain(schema),
        "title": "exlinn scenario",
    }


def _plain(node: Any) -> Any:
    """A schema as a person would write it, with free names held to their pattern."""
    if isinstance(node, list):
        return [_plain(item) for item in node]
    if not isinstance(node, dict):
        return node
    plain = {key: _plain(value) for key, value in node.items()}
    plain.pop(
        "discriminator", None
    )  # OpenAPI's, not JSON Schema's: the choice is settled by `const` and `required`
    plain.pop("propertyNames", None)
    if "patternProperties" in plain:
        plain["additionalProperties"] = False
    if isinstance(items := plain.get("prefixItems"), list) and all(item == items[0] for item in items):
        plain["items"] = plain.pop("prefixItems")[0]
    if "default" in plain and plain["default"] is None:
        del plain["default"]
    if isinstance(title := plain.get("title"), str) and "properties" in plain:
        plain["title"] = _words(title)
    for value in plain.get("properties", {}).values():
        value.pop("title", None)  # pydantic makes it of the field's name and says nothing with it
        if "const" in value:  # the key that says what a section is
            value.setdefault("description", plain["description"])
    return plain


def _words(class_name: str) -> str:
    """The name of a model in words: ``PythonComponentSpec`` is a python component."""
    return re.sub(r"(?<!^)(?=[A-Z])", " ", class_name.removesuffix("Spec")).lower()

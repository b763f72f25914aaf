"""What all sections of a scenario are made of: their base and the kinds of values they hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag


class Spec(BaseModel):
    """Base of all scenario sections: unknown keys are mistakes, values are never converted silently."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def form(value: Any) -> str:
    """What a value is, in the words of error texts; tells the forms apart that a setting may have."""
    if isinstance(value, bool):
        return "true or false"
    names = {
        int: "a number",
        float: "a number",
        str: "text",
        list: "a list",
        tuple: "a list",
        dict: "a mapping",
        Spec: "a mapping",
    }
    return next((name for kind, name in names.items() if isinstance(value, kind)), "nothing")


Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Band = Annotated[tuple[Positive, Positive], Field(strict=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
VariablePath = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\..+$", examples=["plant.alpha"])]
StartValue = Annotated[
    Annotated[float, Tag("a number")] | Annotated[bool, Tag("true or false")], Discriminator(form)
]
Row = Annotated[
    Annotated[int | float, Tag("a number")] | Annotated[list[int | float], Tag("a list")], Discriminator(form)
]
AnyStart = Annotated[
    Annotated[int | float, Tag("a number")]
    | Annotated[bool, Tag("true or false")]
    | Annotated[str, Tag("text")]
    | Annotated[list[Row], Tag("a list")],
    Discriminator(form),
]


def flat_starts(starts: Mapping[str, Any]) -> dict[str, Any]:
    """Start values by variable: the elements of lists by the names that the elements of arrays have."""
    flat: dict[str, Any] = {}
    for name, value in starts.items():
        if isinstance(value, list):
            for k, row in enumerate(value, 1):
                if isinstance(row, list):
                    flat |= {f"{name}[{k},{j}]": x for j, x in enumerate(row, 1)}
                else:
                    flat[f"{name}[{k}]"] = row
        else:
            flat[name] = value
    return flat


class Bounds(Spec):
    """Lower and upper bound of a variable; leave one out where there is none."""

    min: float | None = Field(None, description="lower bound")
    max: float | None = Field(None, description="upper bound")


def telling_key(value: Any, keys: Iterable[str]) -> str | None:
    """Which of several keys, one of which tells what a section is, a section has."""
    found = value if isinstance(value, dict) else getattr(value, "model_fields_set", ())
    return next((key for key in keys if key in found), None)

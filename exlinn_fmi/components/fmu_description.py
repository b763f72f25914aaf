"""What an FMU says of itself: its model description, as FMPy reads it, in our words."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import fmpy

from exlinn_fmi.components.base import Causality, Variability, Variable, VariableType
from exlinn_fmi.errors import FmuError

_Key = tuple[str, int]
"""Accessor and value reference of a variable."""

_INTEGERS = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_TYPES: dict[str, VariableType] = {
    "Real": "Real",
    "Float32": "Real",
    "Float64": "Real",
    "Integer": "Integer",
    **dict.fromkeys(_INTEGERS, "Integer"),
    "Boolean": "Boolean",
    "Enumeration": "Enumeration",
}


@dataclass(frozen=True)
class FmuDescription:
    """What an FMU says of itself, as far as a Co-Simulation master needs it.

    Args:
        path: the file.
        version: FMI major version.
        identifier: name of the binary.
        token: GUID (FMI 2) or instantiation token (FMI 3).
        variables: its scalar numeric variables; arrays, strings, binaries and clocks are left out.
        accessors: for each variable, the name of its get and set functions less the prefix, e.g. ``Real``.
        references: for each variable, its value reference.
        equal_steps: whether all communication steps must be equally long.
        saves_state: whether its state can be saved and restored.
        once: whether the binary may be instantiated only once per process.
        tool: the tool that must be installed for it to run, None where none is needed.
        log_categories: names of the log categories that it has.
    """

    path: Path
    version: Literal[2, 3]
    identifier: str
    token: str
    variables: tuple[Variable, ...]
    accessors: tuple[str, ...]
    references: tuple[int, ...]
    equal_steps: bool
    saves_state: bool
    once: bool
    tool: str | None
    log_categories: tuple[str, ...]

    @property
    def platform(self) -> str:
        """Name of this machine's folder in ``binaries``."""
        return str(fmpy.platform if self.version == 2 else fmpy.platform_tuple)


def describe(path: Path, model: Any) -> FmuDescription:
    """Our description from FMPy's.

    Raises:
        FmuError: something in it cannot be used.
    """
    use = model.coSimulation
    identifier = use.modelIdentifier or ""
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,199}", identifier):
        raise FmuError(f"{path}: the model identifier {identifier!r} is no C identifier, as FMI demands")
    scalars = [v for v in model.modelVariables if v.type in _TYPES and not v.dimensions]
    names = [v.name for v in scalars]
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise FmuError(f"{path}: two variables are called {twice!r}")
    version: Literal[2, 3] = 2 if model.fmiVersion == "2.0" else 3
    enumeration = "Integer" if version == 2 else "Int64"

    def key(v: Any) -> _Key:
        """Value references of FMI 2 are unique within a type only; aliases share one."""
        return enumeration if v.type == "Enumeration" else v.type, v.valueReference

    inputs = {key(v): v.name for v in reversed(scalars) if v.causality == "input"}
    depends: dict[_Key, tuple[str, ...] | None] = {}
    for unknown in model.outputs:
        said = unknown.dependencies
        direct = None if said is None else dict.fromkeys(inputs[key(d)] for d in said if key(d) in inputs)
        depends[key(unknown.variable)] = None if direct is None else tuple(direct)
    return FmuDescription(
        path=path,
        version=version,
        identifier=identifier,
        token=model.guid or "",
        variables=tuple(_variable(path, v, depends.get(key(v))) for v in scalars),
        accessors=tuple(key(v)[0] for v in scalars),
        references=tuple(key(v)[1] for v in scalars),
        equal_steps=not use.canHandleVariableCommunicationStepSize,
        saves_state=use.canGetAndSetFMUstate,
        once=use.canBeInstantiatedOnlyOncePerProcess,
        tool=(model.generationTool or "the tool that made it") if use.needsExecutionTool else None,
        log_categories=tuple(category.name for category in model.logCategories),
    )


def _variable(path: Path, v: Any, depends_on: tuple[str, ...] | None) -> Variable:
    """One variable in our words.

    Raises:
        FmuError: its start value or range is no number.
    """
    declared = v.declaredType
    causality: Causality = v.causality
    variability: Variability = v.variability
    if v.causality == "calculatedParameter":
        causality = "local"
    elif v.causality == "structuralParameter":
        # It sizes arrays, and could only change in configuration mode, which we do not enter.
        causality, variability = "local", "constant"
    low, high = v.min or getattr(declared, "min", None), v.max or getattr(declared, "max", None)
    if v.type == "Enumeration" and declared is not None and declared.items:
        items = [int(item.value) for item in declared.items]
        low, high = min(items), max(items)
    try:
        return Variable(
            name=v.name,
            causality=causality,
            variability=variability,
            unit=v.unit or getattr(declared, "unit", None),
            type=_TYPES[v.type],
            start=_number(v.start),
            description=v.description or "",
            depends_on=depends_on if causality == "output" else (),
            min=_number(low),
            max=_number(high),
        )
    except ValueError as error:
        raise FmuError(f"{path}: variable {v.name!r} (line {v.sourceline}): {error}") from error


def _number(text: str | int | None) -> float | None:
    """A start value or bound of the XML as a number, booleans as 0 and 1."""
    if text is None:
        return None
    return {"true": 1.0, "false": 0.0}[text] if text in ("true", "false") else float(text)

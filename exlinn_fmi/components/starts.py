"""Start values: which variables take one, and what value each takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from exlinn_fmi.components.base import Number, Variable
from exlinn_fmi.errors import InputError, nearest


def takes_start(variable: Variable) -> bool:
    """Whether a variable can be given a start value: inputs, parameters, and what states one of its own."""
    given = variable.causality in ("input", "parameter") or variable.start is not None
    return given and variable.variability != "constant"


def value_problem(variable: Variable, value: Number) -> str | None:
    """Why a variable does not take a value, None where it does."""
    if not math.isfinite(value):
        return f"expected a finite number, found {value}"
    if variable.type == "Boolean" and value not in (0.0, 1.0):
        return f"is a Boolean: expected true or false, found {value:g}"
    if variable.type in ("Integer", "Enumeration") and value != math.floor(value):
        return f"is of type {variable.type}: expected a whole number, found {value:g}"
    widest = {"int64": (-(2**63), 2**63 - 1), "uint64": (0, 2**64 - 1)}.get(
        variable.wide or "", (-math.inf, math.inf)
    )
    low = widest[0] if variable.min is None else variable.min
    high = widest[1] if variable.max is None else variable.max
    if not low <= value <= high:
        return f"expected {_range(low, high, variable.unit)}, found {value:g}"
    return None


def _range(low: Number, high: Number, unit: str | None) -> str:
    """Bounds in words."""
    suffix = f" {unit}" if unit else ""
    if high == math.inf:
        return f"at least {low:g}{suffix}"
    if low == -math.inf:
        return f"at most {high:g}{suffix}"
    return f"{low:g} … {high:g}{suffix}"


def check_starts(
    component: str, variables: Sequence[Variable], starts: Mapping[str, Number]
) -> dict[int, float]:
    """Start values by index of the variable, rests of wide ones included, all of them checked.

    Args:
        component: name of the component, for the message.
        variables: its variables.
        starts: values by variable name.

    Raises:
        InputError: with every name that is unknown or cannot be set, and every value that is not taken.
    """
    index = {variable.name: k for k, variable in enumerate(variables)}
    values: dict[int, float] = {}
    problems: list[str] = []
    for name, value in starts.items():
        if name not in index:
            settable = [v.name for v in variables if takes_start(v)]
            hint = nearest(name, settable, "variables that take a start value")
            problems.append(f"{component}.{name}: no such variable; {hint}")
            continue
        variable = variables[index[name]]
        if not takes_start(variable):
            why = "a constant" if variable.variability == "constant" else "calculated by the component"
            problems.append(f"{component}.{name}: is {why} and takes no start value")
        elif (problem := value_problem(variable, value)) is not None:
            problems.append(f"{component}.{name}: {problem}")
        else:
            values[index[name]] = float(value)
            if variable.wide is not None and value == int(value):
                values[index[name] + len(variables)] = float(int(value) - int(float(value)))
    if problems:
        raise InputError("\n".join(problems))
    return values

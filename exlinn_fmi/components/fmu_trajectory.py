"""Whole trajectories of a Model Exchange FMU, for who runs thousands of them.

In a co-simulation every communication point costs a few calls of Python. Where inputs are known beforehand
there is no need: integration and sampling of outputs run in compiled code from the first row to the last, and
the solver's steps are as long as the tolerance allows, however dense the rows.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from exlinn_fmi.components.base import Number, Status, Values
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.fmu_events import Stopped
from exlinn_fmi.components.fmu_native import Refused, reference_buffer
from exlinn_fmi.errors import ComponentError, InputError, nearest


def trajectory(
    component: FmuComponent,
    times: ArrayLike,
    outputs: Sequence[str],
    inputs: Mapping[str, ArrayLike] | None = None,
    starts: Mapping[str, Number] | None = None,
) -> Values:
    """Run an FMU through Model Exchange, with Dormand and Prince's method.

    Args:
        component: the FMU, opened with ``FmuSettings("model_exchange", tolerance=…)``.
        times: [s] (r,) ascending times of the rows, the first is the start.
        outputs: names of p continuous variables of type Real.
        inputs: values (r,) of continuous inputs at these times, straight between them; others hold their
            start values.
        starts: start values by name.

    Returns:
        (r, p) the variables at these times.

    Raises:
        InputError: it is not open for Model Exchange, or a name, a start value or a shape does not fit.
        ComponentError: the FMU reports an error or cannot be integrated.

    Warns:
        UserWarning: a function of the FMU returned a warning.
    """
    from exlinn_fmi.components.fmu_exchange import ModelExchange

    rows, given = np.asarray(times, dtype=float), dict(inputs or {})
    if rows.ndim != 1 or len(rows) < 2 or not (np.diff(rows) > 0).all():
        raise InputError(f"{component.name}: the times of a trajectory must ascend, two or more of them")
    table = [np.broadcast_to(np.asarray(values, dtype=float), rows.shape) for values in given.values()]
    columns = np.ascontiguousarray(np.stack(table, axis=1) if table else np.zeros((len(rows), 0)))
    driven, read = _references(component, list(given), "input"), _references(component, outputs, None)
    first = {name: float(values[0]) for name, values in zip(given, columns.T, strict=True)}
    status = component.enter_initialization(rows[0], rows[-1], {**(starts or {}), **first})
    if status < Status.DISCARD:
        status = max(status, component.exit_initialization())
    begun = np.zeros(len(outputs))
    if status < Status.DISCARD:
        indices = np.array([component.index(name) for name in outputs], dtype=np.intp)
        status = max(status, component.get(indices, begun))
    if status >= Status.DISCARD:
        raise ComponentError(component.name, component.message, time=rows[0])
    stepper = component.stepper
    if not isinstance(stepper, ModelExchange):
        raise InputError(f"{component.name}: is open for Co-Simulation; open it for Model Exchange")
    knots = rows if given else rows[[0, -1]]
    try:
        rest = stepper.follow(driven, knots, columns[: len(knots)], read, rows[1:])
    except (Refused, Stopped) as problem:
        component.take_trouble(problem)
        raise ComponentError(component.name, component.message, time=stepper.model.t) from problem
    if component.take_warnings() or status:
        warnings.warn(f"{component.name}: {component.message}", UserWarning, stacklevel=2)
    return np.vstack([begun, rest])


def _references(component: FmuComponent, names: Sequence[str], causality: str | None) -> Values:
    """Value references of continuous variables.

    Raises:
        InputError: a name is none of such a variable.
    """
    d, number = component.description, {v.name: k for k, v in enumerate(component.variables)}

    def fits(k: int) -> bool:
        v = component.variables[k]
        plain = d.accessors[k] in ("Real", "Float64") and d.sizes[k] == 1
        return plain and (causality is None or (v.causality, v.variability) == (causality, "continuous"))

    for name in names:
        if name not in number or not fits(number[name]):
            hint = nearest(name, filter(lambda n: fits(number[n]), number), f"{causality or 'variable'}s")
            raise InputError(f"{component.name}.{name}: no scalar Real of use for a trajectory; {hint}")
    return reference_buffer([d.references[number[name]] for name in names])

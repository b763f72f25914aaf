"""Reference trajectories: what the model does under moving inputs, by CasADi and NumPy, not by the C code.

They travel inside the FMU, and `exlinn export check` runs the FMU against them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.export.model import StateSpaceModel

Array = NDArray[np.float64]

POINTS, SUBSTEPS = 200, 10
"""Communication steps, and internal steps in each."""

INPUTS, OUTPUTS = "reference_in.csv", "reference_out.csv"


@dataclass(frozen=True)
class Reference:
    """A run from the start values.

    Args:
        time: communication points [s], shape (N,).
        inputs: held from each point to the next, shape (N, m).
        outputs: states, derivatives that are outputs, and y at each point, shape (N, k).
        names: of the outputs.
    """

    time: Float[Array, " N"]
    inputs: Float[Array, "N m"]
    outputs: Float[Array, "N k"]
    names: tuple[str, ...]


def reference(model: StateSpaceModel) -> Reference:
    """Run a model under inputs that swing over the middle of their usual range.

    Args:
        model: what is exported.
    """
    n, h = len(model.states), model.solver_step
    time = np.arange(POINTS + 1) * (SUBSTEPS * h)
    inputs = np.zeros((len(time), len(model.inputs)))
    for k, quantity in enumerate(model.inputs):
        low, high = quantity.limits or (-1.0, 1.0)
        swing = 0.3 * (high - low) * np.sin(2 * np.pi * (k + 2) * time / time[-1] + k)
        inputs[:, k] = (low + high) / 2 + swing
    known, rows = np.array([q.start for q in model.known]), []
    for u in inputs:
        known[n : n + len(u)] = u
        rows.append(np.concatenate([known[:n], model.evaluate(known)]))
        for _ in range(SUBSTEPS):
            known[:n] = _runge_kutta(model, known, h)
    names = [q.name for q in (*model.states, *model.unknown)]
    shown = [k for k, name in enumerate(names) if not name.startswith("der(")]
    outputs: Array = np.array(rows, dtype=np.float64)[:, shown]
    return Reference(time.astype(np.float64), inputs, outputs, tuple(names[k] for k in shown))


def _runge_kutta(model: StateSpaceModel, known: Array, h: float) -> Array:
    """States after a step of the classical Runge–Kutta method, inputs held."""
    n, at = len(model.states), known.copy()
    total, slope = np.zeros(n), np.zeros(n)
    for node, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
        at[:n] = known[:n] + node * h * slope
        slope = model.evaluate(at)[:n]
        total = total + weight * slope
    moved: Array = known[:n] + h / 6 * total
    return moved


def reference_files(model: StateSpaceModel) -> dict[str, str]:
    """The two tables as CSV: time and inputs, time and outputs."""
    run = reference(model)
    return {
        INPUTS: _csv(["time", *(q.name for q in model.inputs)], np.column_stack([run.time, run.inputs])),
        OUTPUTS: _csv(["time", *run.names], np.column_stack([run.time, run.outputs])),
    }


def _csv(names: list[str], rows: Array) -> str:
    """A table, numbers rounded to what any platform's mathematical library agrees on."""
    header = ",".join(f'"{name}"' for name in names)
    return "\n".join([header, *(",".join(f"{value:.12g}" for value in row) for row in rows)]) + "\n"

"""Plants and learned models run in this process: RK4 on the forward model (16)."""

from __future__ import annotations

import numpy as np

from exlinn_fmi.components.base import Variable
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import state_units
from exlinn_fmi.mechanics.euler_lagrange import (
    MAX_INTERNAL_STEP,
    LagrangianSystem,
    bind,
    feed_through,
    internal_steps,
)
from exlinn_fmi.mechanics.plant import Plant


class LagrangianComponent(PythonComponent):
    """An extended Lagrangian system stepped with RK4, in equal steps that its fastest pole allows.

    Inputs are the system's inputs; parameters can be set until the run begins. Outputs are the state (which
    takes start values) and the accelerations, then a plant's own outputs, or a bare system's stored energy.

    Args:
        name: name in the scenario.
        plant: a ground-truth plant, or a system such as a learned model.
        max_step: longest integrator step [s]. By default that of an exported FMU, so that the two run
            alike; but it follows the parameters of the run, where an FMU's is found at its build.
    """

    def __init__(self, name: str, plant: Plant | LagrangianSystem, max_step: float | None = None) -> None:
        system = plant.system if isinstance(plant, Plant) else plant
        super().__init__(name, variables_of(plant))
        inputs, states = len(system.input_names), len(system.state_names)
        u, p, y = np.split(self.values, [inputs, inputs + len(system.parameters)])
        x = y[:states]  # the state lives in the first outputs: start values, save and restore see it there
        self._state, self._next, self._h = x, np.zeros(states), np.zeros(1)
        self._start = plant.start if isinstance(plant, Plant) else {}
        self._system, self._parameters, self._given_step = system, p, max_step
        self._rk4 = bind(system.rk4(), (x, u, p, self._h), (self._next,))
        # Writing y over x is harmless: the first outputs are the state itself.
        self._output = bind(plant.output, (x, u, p), (y,))

    def initialize(self, start_time: float, stop_time: float) -> None:
        """Find the longest step that suits the parameters of this run."""
        try:
            self._max_step = self._given_step or self._system.solver_step(self._start, self._parameters)
        except ModelError:
            # Singular at rest, as a learned model may be: it may run from elsewhere, or else say where not.
            self._max_step = MAX_INTERNAL_STEP

    def outputs(self, t: float) -> None:
        """Accelerations and all else that follows from state and inputs."""
        self._output()

    def advance(self, t: float, h: float) -> None:
        """RK4 from t to t + h [s]."""
        steps = internal_steps(h, self._max_step)
        self._h[0] = h / steps
        for _ in range(steps):
            self._rk4()
            self._state[:] = self._next


def variables_of(plant: Plant | LagrangianSystem) -> tuple[Variable, ...]:
    """The variables of a plant or bare system: inputs, parameters, outputs."""
    system = plant.system if isinstance(plant, Plant) else plant
    starts = plant.start if isinstance(plant, Plant) else {}
    states = system.state_names
    if isinstance(plant, Plant):
        given = [(o.name, o.unit, o.description) for o in plant.output_list]
    else:
        given = [(name, unit, "") for name, unit in zip(states, state_units(system.coordinates), strict=True)]
        given += [(c.acceleration, c.acceleration_unit, "") for c in system.coordinates]
        given += [("energy", "J", "stored energy")]
    inputs = [
        Variable(c.input, "input", unit=c.input_unit or None, start=0.0, description=f"acts on {c.name}")
        for c in system.coordinates
        if c.input is not None
    ]
    parameters = [
        Variable(p.name, "parameter", "fixed", p.unit, start=p.value, description=p.description)
        for p in system.parameters
    ]
    outputs = [
        Variable(
            name,
            "output",
            unit=unit,
            start=starts.get(name, 0.0) if name in states else None,
            description=description,
            depends_on=tuple(inputs[k].name for k in depends),
        )
        for (name, unit, description), depends in zip(given, feed_through(plant.output), strict=True)
    ]
    return (*inputs, *parameters, *outputs)

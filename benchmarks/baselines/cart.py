"""The paper's DC motor with cart as an optimal control problem: what the benchmarks of the controller solve.

A learned model with 1×32 tanh units, 30 intervals of 10 ms, |v| ≤ 24 V, |i| ≤ 4 A, the cart on a sine of
150 mm at 0.4 Hz.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from baselines.bench import multisine, paper, trained
from baselines.record import record
from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.mechanics.learned import ModelSpec, Weights, learned_system
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.control import Nmpc, Reference, ScotchYoke
from exlinn_fmi.scenario.control import Weights as Cost
from exlinn_fmi.scenario.learning import Structured
from exlinn_fmi.scenario.signals import Sine
from exlinn_fmi.scenario.spec import Bounds

STEP = 0.01
START = np.array([np.pi / 2, 0.0, 0.0])
CART = Reference(
    coordinate="alpha",
    trajectory=Sine(signal="sine", amplitude=0.15, frequency=0.4, unit="m"),
    through=ScotchYoke(map="scotch_yoke", crank=0.2),
)


@lru_cache
def weights() -> tuple[ModelSpec, Weights]:
    """The learned model: 32 tanh units, from two trajectories of the plant."""
    data = record(PLANT, "v", [paper(), multisine(1)], 10)
    model, _ = trained(data, Structured(preset="structured", hidden=32, iterations=60), 0)
    return model.spec, model.weights


def widened(spec: ModelSpec, given: Weights, factor: int) -> tuple[ModelSpec, Weights]:
    """The same function with that many times the hidden units."""
    wide = {name: np.array(value) for name, value in given.items()}
    for name in ("hidden.weight", "hidden.bias"):
        key = f"lagrangian.{name}"
        wide[key] = np.concatenate([wide[key]] * factor)
    output = wide["lagrangian.output"]
    direct, hidden = output[:, : -spec.hidden], output[:, -spec.hidden :]
    wide["lagrangian.output"] = np.hstack([direct, *[hidden / factor] * factor])
    for name, by in (("friction", np.sqrt(factor)), ("width", 1.0)):
        wide[f"dissipation.{name}"] = np.hstack([wide[f"dissipation.{name}"] / by] * factor)
    return replace(spec, hidden=spec.hidden * factor), wide


class Problem(NamedTuple):
    """A learned model's optimal control problem, and its references."""

    ocp: Ocp
    references: ReferenceGenerator

    def aim(self, time: float, x: NDArray[np.float64], last: References | None = None) -> References:
        """The reference over the horizon that begins at `time` [s]."""
        return self.references.over(time, x, self.references.branch(x), last)


@lru_cache
def problem(horizon: int = 30, factor: int = 1) -> Problem:
    """The problem, with another horizon or a wider network."""
    system = learned_system(*widened(*weights(), factor)).with_inputs({"v"})
    options = Nmpc(
        reference=CART,
        horizon=horizon,
        substeps=1,
        weights=Cost(states=10.0, inputs=1e-3),
        inputs={"v": Bounds(min=-24.0, max=24.0)},
        states={"i": Bounds(min=-4.0, max=4.0)},
    )
    references = ReferenceGenerator(system, options.reference, Path(__file__).parent, STEP, horizon)
    return Problem(Ocp(system, options, STEP, references.states), references)

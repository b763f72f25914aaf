"""Systems and options that several tests of the controller use."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.base import Status
from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.reference import ReferenceGenerator
from exlinn_fmi.control.solver import Solver, make_solver
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.control import Nmpc, Reference, ScotchYoke
from exlinn_fmi.scenario.signals import Constant, Sine
from exlinn_fmi.scenario.spec import Bounds

HERE = Path(__file__).parent
STEP = 0.01

CART = Reference(
    coordinate="alpha",
    trajectory=Sine(signal="sine", amplitude=0.15, frequency=0.4, unit="m"),
    through=ScotchYoke(map="scotch_yoke", crank=0.2),
)
"""±150 mm of the cart at 0.4 Hz."""

LIMITS = {"inputs": {"v": Bounds(min=-24.0, max=24.0)}, "states": {"i": Bounds(min=-4.0, max=4.0)}}


def motor_cart() -> LagrangianSystem:
    """The paper's plant, driven by its voltage alone."""
    return PLANT.system.with_inputs(["v"])


def oscillator() -> LagrangianSystem:
    """A mass on a spring with a damper, pushed by a force: linear, one coordinate."""
    return LagrangianSystem.build(
        (Coordinate("x", "m", input="f", input_unit="N"),),
        lambda q, v, p: 0.5 * v[0] ** 2 - 2.0 * q[0] ** 2,
        lambda v, p: 0.15 * v[0] ** 2,
    )


def levitation() -> LagrangianSystem:
    """A ball of 0.1 kg at x below an electromagnet with L(x) = 0.1 + 0.005/(x + 0.01), driven by u."""
    return LagrangianSystem.build(
        (
            Coordinate("x", "m"),
            Coordinate("Q", "C", "electrical", "cyclic", velocity="i", velocity_unit="A", input="u"),
        ),
        lambda q, v, p: 0.05 * v[0] ** 2 + 0.981 * q[0] + 0.5 * (0.1 + 0.005 / (q[0] + 0.01)) * v[1] ** 2,
        lambda v, p: 5.0 * v[1] ** 2,
    )


def plate_actuator() -> LagrangianSystem:
    """A plate on a spring, pulled by the charge of the capacitor whose gap it closes: no cyclic charge."""
    return LagrangianSystem.build(
        (
            Coordinate("x", "m"),
            Coordinate("Q", "C", "electrical", "line", velocity="i", velocity_unit="A", input="u"),
        ),
        lambda q, v, p: 0.5 * ca.sumsqr(v) - 0.5 * q[0] ** 2 - 0.5 * q[1] ** 2 * (2.0 - q[0]),
        lambda v, p: 0.5 * v[0] ** 2 + 0.5 * v[1] ** 2,
    )


def arm() -> LagrangianSystem:
    """Two pendulums on a spring, both driven."""
    return LagrangianSystem.build(
        (Coordinate("a", "rad", input="ta"), Coordinate("b", "rad", input="tb")),
        lambda q, v, p: (
            0.5 * v[0] ** 2 + 0.5 * v[1] ** 2 + 2.0 * ca.cos(q[0]) + ca.cos(q[1]) - (q[0] - q[1]) ** 2
        ),
        lambda v, p: 0.1 * v[0] ** 2 + 0.1 * v[1] ** 2,
    )


def constant(coordinate: str, value: float) -> Reference:
    """A reference that stays where it is."""
    return Reference(coordinate=coordinate, trajectory=Constant(signal="constant", value=value))


def generator(
    system: LagrangianSystem, reference: Reference = CART, horizon: int = 30, step: float = STEP
) -> ReferenceGenerator:
    return ReferenceGenerator(system, reference, HERE, step, horizon)


def problem(system: LagrangianSystem, kind: str = "sqp", **options: Any) -> tuple[Solver, ReferenceGenerator]:
    """A solver with its references; the backend may follow the kind, as in `sqp/casadi`."""
    kind, _, backend = kind.partition("/")
    settings = Nmpc(**({"reference": CART} | options))
    made = generator(system, settings.reference, settings.horizon or 30)
    ocp = Ocp(system, settings, STEP, made.states)
    return make_solver(ocp, kind, settings.iterations, settings.tolerance, backend or "auto"), made


def controller(system: LagrangianSystem | None = None, step: float = STEP, **options: Any) -> NmpcController:
    """A controller of the motor with cart, or of another system, before its run."""
    settings = Nmpc(**({"reference": CART} | (LIMITS if system is None else {}) | options))
    made = NmpcController("controller", system or motor_cart(), settings, step, HERE)
    made.enter_initialization(0.0, 10.0, {})
    made.exit_initialization()
    return made


def measure(made: NmpcController, *state: float) -> tuple[dict[str, float], Status]:
    """Set the measurements, read all outputs."""
    made.set(made.indices("input"), np.array(state))
    outputs = made.indices("output")
    values = np.zeros(len(outputs))
    status = made.get(outputs, values)
    return {made.variables[k].name: float(x) for k, x in zip(outputs, values, strict=True)}, status


def close_loop(
    made: NmpcController,
    start: NDArray[np.float64],
    duration: float,
    step: float = STEP,
    system: LagrangianSystem | None = None,
) -> dict[str, NDArray[np.float64]]:
    """Control the true motor with cart, or another system, by RK4 at 1 ms; rows at the controller's ticks."""
    system = system or motor_cart()
    plant, p = Batch(system.rk4(round(step / 1e-3)), 1), system.parameter_values
    x, rows = start, []
    for k in range(round(duration / step)):
        outputs, _ = measure(made, *x)
        rows.append(outputs | dict(zip(system.state_names, x, strict=True)))
        made.step(k * step, step)
        u = np.array([outputs[name] for name in system.input_names])
        x = plant(x, u, p, step)[0][0, :, 0].copy()
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}

"""Data for the tests of learning: plants simulated by RK4 under given inputs."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset, Samples
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.learned import ModelSpec, Scales, Weights


def multisine(
    rms: float, band: tuple[float, float], lines: int, offset: float, seed: int, t: NDArray
) -> NDArray:
    """offset + a sum of sines with random phases."""
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, lines)
    frequencies = np.linspace(*band, lines)
    return offset + rms * np.sqrt(2 / lines) * np.sin(2 * np.pi * np.outer(t, frequencies) + phases).sum(
        axis=1
    )


def simulate(
    system: LagrangianSystem, inputs: NDArray, step: float, start: NDArray | None = None, trajectory: int = 0
) -> pd.DataFrame:
    """Run a system by RK4, inputs (rows, m) held over each step; gives a data set's columns, and L, D."""
    rows, nx = inputs.shape[0], len(system.state_names)
    p = system.parameter_values
    x0 = np.zeros(nx) if start is None else start
    roll = system.rk4(2).mapaccum(rows - 1)
    x = np.vstack([x0, np.array(roll(x0, inputs[:-1].T, ca.DM(p), step)).T]) if rows > 1 else x0[None]
    positions = [i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"]
    q, v = np.zeros((rows, system.n)), x[:, len(positions) :]
    q[:, positions] = x[:, : len(positions)]
    a = evaluate(system.forward, q, v, inputs, p)
    frame = pd.DataFrame({"trajectory": trajectory, "time": np.arange(rows) * step})
    frame[system.state_names] = x
    frame[[c.acceleration for c in system.coordinates]] = a
    frame[system.input_names] = inputs
    frame["L"] = evaluate(system.lagrangian, q, v, p)[:, 0]
    frame["D"] = evaluate(system.dissipation, v, p)[:, 0]
    return frame


def motor_cart(offset: float = 2.9, seconds: float = 4.0, seed: int = 1, trajectory: int = 0) -> pd.DataFrame:
    """The paper's plant under a multisine voltage about a mean that turns it through the full circle."""
    from exlinn_fmi.plants.dc_motor_cart import PLANT

    time = np.arange(round(seconds * 500) + 1) * 2e-3
    inputs = np.zeros((len(time), 2))
    inputs[:, 1] = multisine(2.9, (0.1, 5), 20, offset, seed, time)
    return simulate(PLANT.system, inputs, 2e-3, trajectory=trajectory)


MOTOR_CART = (
    Coordinate("alpha", "rad", topology="circle"),
    Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),
)
"""Coordinates of the paper's plant as it is learned: no torque from outside."""


def motor_cart_dataset(seconds: float = 4.0, seed: int = 1) -> Dataset:
    """Two experiments on the paper's plant, forwards and backwards."""
    frames = [motor_cart(sign * 2.9, seconds, seed + k, k) for k, sign in enumerate((1, -1))]
    return Dataset(pd.concat(frames), MOTOR_CART)


SOLENOID = (
    Coordinate("x", "m", topology="line"),
    Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),
)


def solenoid_dataset(seed: int = 1) -> Dataset:
    """A plunger on a spring in a coil, L(x) = l_0 + l_1/(1 + x/a): nothing that a polynomial could hold."""
    system = LagrangianSystem.build(
        SOLENOID,
        lambda q, v, p: (
            0.05 * v[0] ** 2
            + (0.05 + 0.05 / (1 + q[0] / 0.03)) * v[1] ** 2 / 2
            - 1000 * (q[0] - 0.01) ** 2
            + 0.981 * q[0]
        ),
        lambda v, p: 0.4 * v[0] ** 2 + v[1] ** 2,
    )
    time = np.arange(3001) * 1e-3
    inputs = multisine(3.0, (0.3, 8), 25, 3.0, seed, time)[:, None]
    return Dataset(simulate(system, inputs, 1e-3, np.array([0.01, 0, 0])), SOLENOID)


def random_model(
    seed: int, coordinates: tuple[Coordinate, ...], hidden: int = 4
) -> tuple[ModelSpec, Weights]:
    """A structured model with weights, scales and ε drawn at random."""
    random = np.random.default_rng(seed)
    n = len(coordinates)
    line = np.array([c.topology == "line" for c in coordinates])
    scales = Scales(
        time=float(random.uniform(0.1, 10)),
        energy=float(random.uniform(0.1, 10)),
        position=tuple(random.uniform(0.1, 10, n).tolist()),
        centre=tuple(np.where(line, random.uniform(-1, 1, n), 0).tolist()),
        reach=tuple(np.where(line, random.uniform(0.5, 2, n), 1).tolist()),
    )
    epsilon = tuple(random.uniform(0.01, 0.1, n).tolist())
    spec = ModelSpec("structured", coordinates, hidden, scales, epsilon)
    weights = {
        name: np.where(mask, random.standard_normal(mask.shape), 0.0)
        for name, mask in spec.layout.free.items()
    }
    return spec, weights


def random_samples(seed: int, coordinates: tuple[Coordinate, ...], rows: int = 12) -> Samples:
    """Samples drawn at random; cyclic positions are 0."""
    random = np.random.default_rng(seed)
    q, v, a, force = random.standard_normal((4, rows, len(coordinates)))
    q[:, [c.topology == "cyclic" for c in coordinates]] = 0
    return Samples(q, v, a, force)

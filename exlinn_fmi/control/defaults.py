"""Settings that a scenario leaves open: derived from the model's time constants and from its reference.

- **Horizon**: one and a half of the model's slowest response, so that it is seen to settle.
- **Weights**: an input weighs one where it uses half of its range. The referenced state weighs `KEENNESS`
  where it is off by what that moves it within the slowest response, so that units do not matter.
- **Sub-steps** of RK4: its step times the fastest pole stays below `RESOLVED`.
- **Estimator**: sizes of states from the reference and the bounds, sizes of forces from what changes such a
  state within the slowest response, noise and disturbances as shares of these.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.estimator import Direct, Estimator, ExtendedKalman, Noise
from exlinn_fmi.control.moving_horizon import MovingHorizon
from exlinn_fmi.control.ocp import check_names, rk4_sensitivities
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.scenario.control import Estimator as EstimatorSpec
from exlinn_fmi.scenario.control import Nmpc

INTEGRATOR = 1e-2
"""A mode that changes by less than this share over the horizon counts as an integrator, not as slow."""

SIGHT = 1.5
"""Length of the horizon over the slowest response."""

SHORTEST, LONGEST = 10, 100
"""Fewest and most intervals of a horizon that was not given."""

KEENNESS = 100.0
"""Weight of the referenced state over that of the inputs, both in their own sizes."""

ACCURACY = 1e-4
"""Noise of a measurement over the size of the state: that of a good encoder or a 14-bit converter."""

RESOLVED = 0.5
"""Largest step of RK4 over the fastest time constant: right to 3e-4 of that mode in a step."""

UNKNOWN_FORCE = 1e-2
"""What the model does not know of a force in a single sample, over its size."""

WINDOWS = 20
"""How many horizons of the reference are looked at to learn its size."""


@dataclass(frozen=True)
class Sizes:
    """How large things are.

    Args:
        response: slowest response of the model [s], a third of the horizon where there is none.
        state: shape (n,).
        force: generalised force on each coordinate, shape (coordinates,).
        u: half range of each input, or what the reference needs, shape (m,).
    """

    response: float
    state: NDArray[np.float64]
    force: NDArray[np.float64]
    u: NDArray[np.float64]


def completed(options: Nmpc, system: LagrangianSystem, sizes: Sizes, first: References, step: float) -> Nmpc:
    """The settings with horizon and weights filled in where they are open.

    Args:
        options: the settings.
        system: the prediction model.
        sizes: how large things are.
        first: the reference at the beginning.
        step: sampling time [s].
    """
    sight = np.ceil(SIGHT * sizes.response / step - 1e-6)
    horizon = options.horizon or int(np.clip(sight, SHORTEST, LONGEST))
    weights = options.weights
    if options.cost == "tracking" and None in (weights.states, weights.inputs):
        reach = _reach(options, system, sizes, first, step)
        usable = np.isfinite(reach) & (reach > 0.0)
        if usable.any():
            names = [system.state_names[k] for k in np.flatnonzero(usable)]
            states = dict(zip(names, (KEENNESS / reach[usable] ** 2).tolist(), strict=True))
            inputs = dict(zip(system.input_names, (1.0 / sizes.u**2).tolist(), strict=True))
            given = {"states": weights.states, "inputs": weights.inputs}
            derived = {"states": states, "inputs": inputs}
            update = {key: derived[key] for key, value in given.items() if value is None}
            weights = weights.model_copy(update=update)
    return options.model_copy(update={"horizon": horizon, "weights": weights})


def refined(options: Nmpc, system: LagrangianSystem, first: References, step: float) -> Nmpc:
    """The settings with the sub-steps filled in where they are open.

    Args:
        options: the settings.
        system: the prediction model.
        first: the reference at the beginning.
        step: sampling time [s].
    """
    if options.substeps is not None:
        return options
    rates = poles(system, first.x[0], first.u[0])
    fastest = float(np.abs(rates).max()) if np.isfinite(rates).all() else 0.0
    return options.model_copy(update={"substeps": int(np.clip(np.ceil(fastest * step / RESOLVED), 1, 100))})


def measure(
    options: Nmpc, system: LagrangianSystem, generator: ReferenceGenerator, step: float, horizon: int
) -> tuple[Sizes, References]:
    """How large things are, and the reference at the beginning.

    Args:
        options: the controller's settings.
        system: the prediction model.
        generator: its references.
        step: sampling time [s].
        horizon: number of intervals that the generator looks ahead.
    """
    rest = np.zeros(len(system.state_names))
    branch = generator.branch(rest)
    windows = [generator.over(k * horizon * step, rest, branch) for k in range(WINDOWS)]
    first, x = windows[0], np.vstack([w.grid_x for w in windows])
    positions = len(system.state_names) - system.n
    response = response_time(system, at_rest(system, first.x[0]), first.u[0], horizon * step)
    response = response if response is not None else horizon * step / 3
    state = np.abs(x).max(axis=0)
    state[:positions] = np.maximum(np.ptp(x[:, :positions], axis=0) / 2, 0.1 * state[:positions])
    for name, bounds in options.states.items():
        k = system.state_names.index(name) if name in system.state_names else None
        ends = [abs(b) for b in (bounds.min, bounds.max) if b is not None]
        if k is not None and ends and state[k] == 0.0:
            state[k] = max(ends)
    state[state == 0.0] = 1.0
    kept = [i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"]
    state[positions:][kept] = np.maximum(state[positions:][kept], state[:positions] / response)
    q, v = np.zeros(system.n), first.x[0][positions:]
    q[kept] = first.x[0][:positions]
    mass = np.abs(
        np.diagonal(evaluate(system.mass_matrix, q, v, system.parameter_values)[0].reshape(system.n, -1))
    )
    force = mass * state[positions:] / response
    u = np.abs(np.vstack([w.grid_u for w in windows])).max(axis=0)
    for k, name in enumerate(system.input_names):
        bounds_ = options.inputs.get(name)
        if bounds_ is not None and bounds_.min is not None and bounds_.max is not None:
            u[k] = (bounds_.max - bounds_.min) / 2
    u[~(u > 0.0)] = 1.0
    return Sizes(response, state, np.where(np.isfinite(force) & (force > 0.0), force, 1.0), u), first


def estimator(
    options: Nmpc,
    system: LagrangianSystem,
    sizes: Sizes,
    first: References,
    step: float,
    connected: Collection[str] | None,
) -> Estimator:
    """The estimator that the settings ask for.

    Args:
        options: the controller's settings.
        system: the prediction model.
        sizes: how large things are.
        first: the reference at the beginning.
        step: sampling time [s].
        connected: states that something is connected to; all if not given.

    Raises:
        ModelError: the settings name what the model does not have, or nothing is measured.
    """
    spec = options.estimation
    _check(spec, system)
    names = system.state_names
    known = names if connected is None else [name for name in names if name in connected]
    kind = ("none" if len(known) == len(names) else "ekf") if spec.type == "auto" else spec.type
    measured = np.isin(names, known if spec.measured is None else spec.measured)
    if kind == "none":
        # What nothing is connected to keeps its start value.
        return Direct(
            system,
            _noise(spec, system, np.full(len(names), True), sizes, first, []),
            step,
            options.substeps or 1,
        )
    if not measured.any():
        raise ModelError(f"estimator: no state is measured; connect some of {', '.join(names)}")
    noise = _noise(spec, system, measured, sizes, first, spec.disturbances)
    if kind == "mhe":
        return MovingHorizon(
            system, noise, step, options.substeps or 1, spec.window, spec.iterations, options.backend
        )
    steady = (first.x[0], first.u[0]) if spec.gain == "steady" else None
    return ExtendedKalman(system, noise, step, options.substeps or 1, steady)


def at_rest(system: LagrangianSystem, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The state with nothing moving; velocities of cyclic coordinates (currents) stay."""
    rest = x.copy()
    for coordinate in system.coordinates:
        if coordinate.topology != "cyclic":
            rest[system.state_names.index(coordinate.velocity)] = 0.0
    return rest


def response_time(
    system: LagrangianSystem, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " m"], horizon: float
) -> float | None:
    """1/|λ| [s] of the slowest mode of the linearised model that is no integrator; None if there is none.

    Args:
        system: the model.
        x: state (n,).
        u: input (m,).
        horizon: time over which a mode must change to be none [s].
    """
    rates = np.abs(poles(system, x, u))
    seen = rates[rates * horizon > INTEGRATOR]
    return float(1.0 / seen.min()) if len(seen) else None


def poles(
    system: LagrangianSystem, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " m"]
) -> NDArray[np.complex128]:
    """Eigenvalues [1/s] of the model linearised at a state (n,) and input (m,), NaN if that is not finite."""
    A = evaluate(system.state_jacobian, x, u, system.parameter_values)[0].reshape(len(x), len(x))
    if not np.isfinite(A).all():
        return np.full(len(x), np.nan + 0j)
    return np.linalg.eigvals(A).astype(np.complex128)


def _reach(
    options: Nmpc, system: LagrangianSystem, sizes: Sizes, first: References, step: float
) -> NDArray[np.float64]:
    """How far the inputs' half ranges move each referenced state within the slowest response, 0 elsewhere."""
    sensitivities = Batch(rk4_sensitivities(system, options.substeps or 1), 1)
    x, p = at_rest(system, first.x[0]), system.parameter_values
    _, A, B = (part[0].copy() for part in sensitivities(x, first.u[0], p, step))
    moved = np.zeros_like(B)
    for _ in range(max(1, round(sizes.response / step))):
        moved = A @ moved + B
    referenced = [spec.coordinate for spec in options.references.values()]
    reach: NDArray[np.float64] = np.abs(moved) @ sizes.u * np.isin(system.state_names, referenced)
    return reach


def _noise(
    spec: EstimatorSpec,
    system: LagrangianSystem,
    measured: NDArray[np.bool_],
    sizes: Sizes,
    first: References,
    disturbances: Collection[str] | None,
) -> Noise:
    """What an estimator must know of noise; disturbances as many as can be told apart where None."""
    names, coordinates = system.state_names, [c.name for c in system.coordinates]
    share = np.full(len(names), spec.noise if isinstance(spec.noise, float) else ACCURACY)
    measurement = share * sizes.state
    if isinstance(spec.noise, dict):
        for name, deviation in spec.noise.items():
            measurement[names.index(name)] = deviation
    # A sensor without any noise would leave a singular matrix.
    measurement = np.maximum(measurement, 1e-9 * sizes.state)
    chosen = _told_apart(system, measured, sizes, first) if disturbances is None else list(disturbances)
    disturbed = np.array([coordinates.index(name) for name in chosen], dtype=np.intp)
    walk = sizes.force[disturbed]
    if isinstance(spec.disturbances, dict):
        walk = np.array([spec.disturbances[name] for name in chosen])
    return Noise(
        measured=measured,
        measurement=measurement,
        process=np.array([spec.process.get(name, 0.0) for name in names]),
        force=UNKNOWN_FORCE * sizes.force,
        disturbed=disturbed,
        walk=walk,
        first=np.concatenate([sizes.state, sizes.force[disturbed]]),
    )


def _told_apart(
    system: LagrangianSystem, measured: NDArray[np.bool_], sizes: Sizes, first: References
) -> list[str]:
    """Coordinates whose disturbances the measurements tell apart from the state and from each other.

    A constant disturbance can be told from the state where [[A, G], [C, 0]] has full column rank.
    """
    loaded, n = system.loaded(), len(system.state_names)
    x, u, p = (
        ca.SX.sym("x", n),
        ca.SX.sym("u", len(system.input_names)),
        ca.SX.sym("p", len(loaded.parameters)),
    )
    rate = loaded.derivative(x, u, p)
    slopes = ca.Function("slopes", [x, u, p], [ca.densify(ca.jacobian(rate, ca.vertcat(x, p)))])
    point = (at_rest(system, first.x[0]), first.u[0], loaded.parameter_values)
    both = evaluate(slopes, *point)[0].reshape(n, -1) * sizes.response / sizes.state[:, None]
    A, G = both[:, :n] * sizes.state, both[:, -system.n :] * sizes.force
    C = np.eye(n)[measured]
    chosen: list[int] = []
    for c in range(system.n):
        matrix = np.block([[A, G[:, [*chosen, c]]], [C, np.zeros((len(C), len(chosen) + 1))]])
        if np.isfinite(matrix).all() and np.linalg.matrix_rank(matrix, tol=1e-6) == matrix.shape[1]:
            chosen.append(c)
    return [system.coordinates[c].name for c in chosen]


def _check(spec: EstimatorSpec, system: LagrangianSystem) -> None:
    """Refuse names that the model does not have."""
    noise = spec.noise if isinstance(spec.noise, dict) else {}
    for key, given in (("measured", spec.measured or []), ("noise", noise), ("process", spec.process)):
        check_names(f"estimator.{key}", given, system.state_names, "states")
    check_names(
        "estimator.disturbances", spec.disturbances or [], [c.name for c in system.coordinates], "coordinates"
    )

"""What the controller follows: from signals for some quantities to states and inputs over the horizon.

A signal gives the trajectory of a quantity (a cart's position), the kinematics give that of a coordinate
(the motor's angle) with its derivatives, and inverting the model gives the states x* and inputs u* that
go with it, under the constant forces that act besides. States are taken at the nodes of the horizon,
inputs, which are held, in the middle of each interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.inversion import DERIVATIVES, NEARLY, ORDERS, Inverter, invert, steady
from exlinn_fmi.control.trajectory import REACH, branch_of, coordinate_of, derivatives, integral
from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.errors import ModelError, nearest
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.scenario.control import Linear, Reference, ScotchYoke
from exlinn_fmi.scenario.signals import Table


@dataclass(frozen=True)
class References:
    """The reference over one horizon of N intervals, on a grid of half intervals.

    Args:
        time: when the horizon begins [s].
        branch: branch of the kinematics of each trajectory that it was made on.
        quantity: the trajectories' quantities at `time`, shape (r,).
        force: constant generalised force on each coordinate besides the inputs, shape (coordinates,).
        grid_y: referenced positions with their derivatives, shape (2N + 1, r · (ORDERS + 1)).
        grid_x: states, shape (2N + 1, n).
        grid_u: inputs, shape (2N + 1, m).
        grid_z: unknowns of the inversion, shape (2N + 1, k), to start the next one from.
    """

    time: float
    branch: tuple[int, ...]
    quantity: NDArray[np.float64]
    force: NDArray[np.float64]
    grid_y: NDArray[np.float64]
    grid_x: NDArray[np.float64]
    grid_u: NDArray[np.float64]
    grid_z: NDArray[np.float64]

    @property
    def x(self) -> Float[np.ndarray, "nodes n"]:
        """States x* at the nodes, shape (N + 1, n)."""
        return self.grid_x[::2]

    @property
    def u(self) -> Float[np.ndarray, "intervals m"]:
        """Inputs u* in the middle of each interval, shape (N, m)."""
        return self.grid_u[1::2]


class Trajectory:
    """One coordinate that follows a signal.

    Args:
        system: the model.
        spec: what to follow.
        folder: folder of the scenario, which file names start from.
        spacing: distance of the points where it is asked for [s].

    Raises:
        ModelError: the coordinate is unknown, or its kinematics cannot be inverted.
        DataError: the signal cannot be used.
    """

    def __init__(self, system: LagrangianSystem, spec: Reference, folder: Path, spacing: float) -> None:
        positions = [c.name if c.topology != "cyclic" else None for c in system.coordinates]
        velocities = [c.velocity for c in system.coordinates]
        if spec.coordinate not in system.state_names:
            raise ModelError(
                f"coordinate: the model has no state {spec.coordinate!r}; "
                + nearest(spec.coordinate, system.state_names, "states")
            )
        self.velocity = spec.coordinate in velocities
        names = velocities if self.velocity else positions
        self.coordinate = names.index(spec.coordinate)
        if self.velocity and isinstance(spec.through, ScotchYoke):
            raise ModelError(
                f"through: a scotch yoke turns an angle into a position, but {spec.coordinate!r} "
                f"is a velocity; refer to {system.coordinates[self.coordinate].name!r}"
            )
        if isinstance(spec.through, Linear) and spec.through.gain == 0.0:
            raise ModelError("through.gain: 0 cannot be inverted; give a number that is not 0")
        self.through, self._spacing = spec.through, spacing
        self.signal = signal_function(spec.trajectory, folder)
        """The trajectory as given: an error outside the rows of a table that says so."""
        ahead = spec.trajectory
        if isinstance(ahead, Table):
            # The horizon looks beyond the end of every run.
            ahead = ahead.model_copy(update={"outside": "hold"})
        self.ahead = signal_function(ahead, folder)
        self.state = system.state_names.index(spec.coordinate)
        """Index of the referenced state."""
        position = positions[self.coordinate]
        self.position = None if position is None else system.state_names.index(position)

    @property
    def anchored(self) -> bool:
        """Whether the position that goes with it is counted from the measured one."""
        return self.velocity and self.position is not None

    def branch(self, measured: Float[np.ndarray, " n"]) -> int:
        """The branch of the kinematics that a measured state (n,) lies on."""
        return branch_of(self.through, float(measured[self.state]))

    def motion(
        self, begin: float, count: int, measured: Float[np.ndarray, " n"], branch: int
    ) -> Float[np.ndarray, "k o"]:
        """Referenced position and its derivatives at `count` points from `begin` [s] on."""
        spacing = self._spacing
        times = np.asarray(begin + spacing * np.arange(-REACH, count + REACH), dtype=np.float64)
        samples = coordinate_of(self.through, self.ahead(times), branch)
        if not self.velocity:
            return derivatives(samples, spacing, ORDERS).T
        motion = np.zeros((count, ORDERS + 1))
        motion[:, 1:] = derivatives(samples, spacing, ORDERS - 1).T
        if self.position is not None:
            motion[:, 0] = measured[self.position] + integral(motion[:, 1], motion[:, 2], spacing)
        return motion


class ReferenceGenerator:
    """Makes references for a horizon.

    Args:
        system: the model.
        specs: what to follow.
        folder: folder of the scenario, which file names start from.
        step: length of an interval [s].
        horizon: number of intervals.

    Raises:
        ModelError: a coordinate is unknown or named twice, or its kinematics cannot be inverted.
        DataError: a signal cannot be used.
    """

    def __init__(
        self,
        system: LagrangianSystem,
        specs: Reference | Sequence[Reference],
        folder: Path,
        step: float,
        horizon: int,
    ) -> None:
        self._step = step
        self.trajectories: list[Trajectory] = []
        for k, spec in enumerate([specs] if isinstance(specs, Reference) else specs):
            try:
                self.trajectories.append(Trajectory(system, spec, folder, step / 2))
            except ModelError as error:
                at = "reference" if isinstance(specs, Reference) else f"reference[{k}]"
                raise ModelError(f"{at}.{error}") from None
        referenced = [t.coordinate for t in self.trajectories]
        if len(set(referenced)) < len(referenced):
            raise ModelError("reference: two references are for the same coordinate; keep one")
        self.states = [t.state for t in self.trajectories]
        """Indices of the referenced states."""
        self._grid = 2 * horizon + 1
        velocities = [t.velocity for t in self.trajectories]
        self.inversion = invert(system, referenced, velocities)
        """How reference states and inputs are found; `inversion.flat` and `.reason` say what was decided."""
        if self.inversion.static is not None and not self._nearly_flat(system, self.inversion.static):
            self.inversion = steady(system, referenced, velocities, DERIVATIVES)
        self._all = Inverter(self.inversion, self._grid)
        self._next = Inverter(self.inversion, 2)
        self._inputs = len(system.input_names)
        self.still = np.zeros(system.n)
        """No force."""

    def _nearly_flat(self, system: LagrangianSystem, static: ca.Function) -> bool:
        """Whether derivatives of the unknowns hardly change these along the beginning of the reference."""
        rest, count = np.zeros(len(system.state_names)), self._grid
        y, none = self._motion(0.0, 0, count, rest, self.branch(rest)), np.zeros(system.n)
        start = np.zeros((count, len(self.inversion.unknowns)))
        z, solved = Inverter(replace(self.inversion, equations=static), count).find(y, start, none)
        if not solved.all():
            return False
        moved, again = Inverter(self.inversion, count).solve(y, z, none)
        return bool(again.all() and np.abs(moved - z).max() <= NEARLY * np.abs(z).max())

    def check(self, start: float, stop: float) -> None:
        """Refuse a run that a table, told to be an error outside its rows, does not cover.

        Raises:
            DataError: with the table's name and range.
        """
        for trajectory in self.trajectories:
            trajectory.signal(np.array([start, stop]))

    def branch(self, measured: Float[np.ndarray, " n"]) -> tuple[int, ...]:
        """The branch of the kinematics of each trajectory that a measured state (n,) lies on."""
        return tuple(t.branch(measured) for t in self.trajectories)

    def over(
        self,
        time: float,
        measured: Float[np.ndarray, " n"],
        branch: tuple[int, ...],
        previous: References | None = None,
        force: Float[np.ndarray, " c"] | None = None,
    ) -> References:
        """The reference over the horizon that begins at `time` [s].

        Args:
            time: beginning of the horizon [s].
            measured: measured state, shape (n,): where the iteration starts, and where the position of a
                referenced velocity is counted from.
            branch: branch of the kinematics of each trajectory.
            previous: the last reference; one interval later only the horizon's new end is computed.
            force: constant generalised force on each coordinate besides the inputs; none if not given.
        """
        force = self.still if force is None else force
        quantity = np.array([t.ahead(np.array([time]))[0] for t in self.trajectories])
        if (
            previous is None
            or any(t.anchored for t in self.trajectories)
            or previous.branch != branch
            or abs(time - previous.time - self._step) >= 1e-6 * self._step
        ):
            y = self._motion(time, 0, self._grid, measured, branch)
            start = np.concatenate([measured, np.zeros(self._inputs)])[list(self.inversion.unknowns)]
            z, x, u = self._all(y, np.tile(start, (self._grid, 1)), force)
            return References(time, branch, quantity, force, y, x, u, z)
        end = self._motion(time, self._grid - 2, 2, measured, branch)
        y, guess = np.concatenate([previous.grid_y[2:], end]), previous.grid_z
        if np.array_equal(force, previous.force):
            new = self._next(end, guess[-2:], force)
            old = guess, previous.grid_x, previous.grid_u
            z, x, u = (np.concatenate([a[2:], b]) for a, b in zip(old, new, strict=True))
        else:
            z, x, u = self._all(y, np.concatenate([guess[2:], guess[-1:], guess[-1:]]), force)
        return References(time, branch, quantity, force, y, x, u, z)

    def _motion(
        self, time: float, first: int, count: int, measured: Float[np.ndarray, " n"], branch: tuple[int, ...]
    ) -> Float[np.ndarray, "k o"]:
        """Referenced positions and their derivatives at `count` grid points from `first` on."""
        begin = time + self._step / 2 * first
        parts = zip(self.trajectories, branch, strict=True)
        return np.hstack([t.motion(begin, count, measured, b) for t, b in parts])

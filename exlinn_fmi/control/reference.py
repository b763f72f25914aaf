"""What the controller follows: from a signal for one quantity to states and inputs over the horizon.

A signal gives the trajectory of a quantity (a cart's position), the kinematics give that of a coordinate
(the motor's angle) with its derivatives, and inverting the model gives the states x* and inputs u* that
go with it. States are taken at the nodes of the horizon, inputs, which are held, in the middle of each
interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.inversion import ORDERS, Inverter, invert
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
        branch: branch of the kinematics that it was made on.
        quantity: the trajectory's quantity at `time`.
        grid_x: states, shape (2N + 1, n).
        grid_u: inputs, shape (2N + 1, m).
        grid_z: unknowns of the inversion, shape (2N + 1, k), to start the next one from.
    """

    time: float
    branch: int
    quantity: float
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


class ReferenceGenerator:
    """Makes references for a horizon.

    Args:
        system: the model.
        spec: what to follow.
        folder: folder of the scenario, which file names start from.
        step: length of an interval [s].
        horizon: number of intervals.

    Raises:
        ModelError: the coordinate is unknown, or its kinematics cannot be inverted.
        DataError: the signal cannot be used.
    """

    def __init__(
        self, system: LagrangianSystem, spec: Reference, folder: Path, step: float, horizon: int
    ) -> None:
        positions = [c.name if c.topology != "cyclic" else None for c in system.coordinates]
        velocities = [c.velocity for c in system.coordinates]
        if spec.coordinate not in system.state_names:
            raise ModelError(
                f"reference.coordinate: the model has no state {spec.coordinate!r}; "
                + nearest(spec.coordinate, system.state_names, "states")
            )
        self.velocity = spec.coordinate in velocities
        names = velocities if self.velocity else positions
        coordinate = names.index(spec.coordinate)
        if self.velocity and isinstance(spec.through, ScotchYoke):
            raise ModelError(
                f"reference.through: a scotch yoke turns an angle into a position, but {spec.coordinate!r} "
                f"is a velocity; refer to {system.coordinates[coordinate].name!r}"
            )
        if isinstance(spec.through, Linear) and spec.through.gain == 0.0:
            raise ModelError("reference.through.gain: 0 cannot be inverted; give a number that is not 0")
        self._through = spec.through
        self._step, self._horizon = step, horizon
        self._checked_signal = signal_function(spec.trajectory, folder)
        ahead = spec.trajectory
        if isinstance(ahead, Table):
            # The horizon looks beyond the end of every run.
            ahead = ahead.model_copy(update={"outside": "hold"})
        self._signal = signal_function(ahead, folder)
        self.state = system.state_names.index(spec.coordinate)
        """Index of the referenced state."""
        position = positions[coordinate]
        self.position = None if position is None else system.state_names.index(position)
        """Index of the referenced coordinate's position; None where it is cyclic."""
        self.inversion = invert(system, coordinate, self.velocity)
        """How reference states and inputs are found; `inversion.flat` and `.reason` say what was decided."""
        self._grid = 2 * horizon + 1
        self._all = Inverter(self.inversion, self._grid)
        self._next = Inverter(self.inversion, 2)
        self._inputs = len(system.input_names)

    def check(self, start: float, stop: float) -> None:
        """Refuse a run that a table, told to be an error outside its rows, does not cover.

        Raises:
            DataError: with the table's name and range.
        """
        self._checked_signal(np.array([start, stop]))

    def branch(self, measured: Float[np.ndarray, " n"]) -> int:
        """The branch of the kinematics that a measured state (n,) lies on."""
        return branch_of(self._through, float(measured[self.state]))

    def over(
        self,
        time: float,
        measured: Float[np.ndarray, " n"],
        branch: int,
        previous: References | None = None,
    ) -> References:
        """The reference over the horizon that begins at `time` [s].

        Args:
            time: beginning of the horizon [s].
            measured: measured state, shape (n,): where the iteration starts, and where the position of a
                referenced velocity is counted from.
            branch: branch of the kinematics.
            previous: the last reference; one interval later only the horizon's new end is computed.
        """
        quantity = float(self._signal(np.array([time]))[0])
        anchored = self.velocity and self.position is not None
        if (
            previous is not None
            and not anchored
            and previous.branch == branch
            and abs(time - previous.time - self._step) < 1e-6 * self._step
        ):
            y = self._motion(time, self._grid - 2, 2, measured, branch)
            new = self._next(y, previous.grid_z[-2:])
            old = previous.grid_z, previous.grid_x, previous.grid_u
            z, x, u = (np.concatenate([a[2:], b]) for a, b in zip(old, new, strict=True))
        else:
            y = self._motion(time, 0, self._grid, measured, branch)
            start = np.concatenate([measured, np.zeros(self._inputs)])[list(self.inversion.unknowns)]
            z, x, u = self._all(y, np.tile(start, (self._grid, 1)))
        return References(time, branch, quantity, x, u, z)

    def _motion(
        self, time: float, first: int, count: int, measured: Float[np.ndarray, " n"], branch: int
    ) -> Float[np.ndarray, "k o"]:
        """Referenced position and its derivatives at `count` grid points from `first` on."""
        spacing = self._step / 2
        times = np.asarray(time + spacing * np.arange(first - REACH, first + count + REACH), dtype=np.float64)
        samples = coordinate_of(self._through, self._signal(times), branch)
        if not self.velocity:
            return derivatives(samples, spacing, ORDERS).T
        motion = np.zeros((count, ORDERS + 1))
        motion[:, 1:] = derivatives(samples, spacing, ORDERS - 1).T
        if self.position is not None:
            motion[:, 0] = measured[self.position] + integral(motion[:, 1], motion[:, 2], spacing)
        return motion

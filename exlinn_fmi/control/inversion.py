"""Inverting a Lagrangian system along the trajectory of some coordinates: which state and input follow it?

**Flat.** The rows of the inverse model (17) without input must vanish. Given the referenced coordinates and
their derivatives they are equations for the other coordinates: for their velocities where those are cyclic
(the current of a motor), for their positions where not (the charge of an actuator). Where there are as many
of these equations as unknowns z, and they contain no derivative of z, what is referenced is a flat output: z
follows by Newton's method, ż and z̈ by implicit differentiation, exactly, and the rows with input give u.

**Nearly flat.** A learned model may hold derivatives of z that are no more than its error. They are taken
from the equations without them, which is right to the second order of what they do; where they do more than
`NEARLY` the system is not taken for flat.

**Steady.** Any other system is given a rest for each value of the reference: accelerations 0, velocities of
the other coordinates 0 save those of cyclic ones; what remains unknown, with the input, is fitted by least
squares, near the starting point where it is not determined.

Reference: M. Fliess, J. Lévine, P. Martin, P. Rouchon, Flatness and defect of non-linear systems, Int. J.
Control 61 (1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from exlinn_fmi.control.batch import Batch
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol

DERIVATIVES = "the equations without input contain derivatives of the other coordinates"

STARTS = tuple(10.0**-k for k in range(10))
"""Where unknowns are looked for from, one after the other, if not from the guess."""

NEARLY = 1e-3
"""Most that derivatives of the unknowns may change these, over their size, in a system taken for flat."""

ORDERS = 4
"""Highest derivative of the referenced position that an inversion may use."""


@dataclass(frozen=True)
class Inversion:
    """Equations r(y, z) = 0 for the unknowns z at one instant, and what follows from them.

    Args:
        flat: whether the whole state and input follow exactly; if not, they are those of a rest.
        reason: why so, in a sentence.
        equations: (y, z, f) → (r, ∂r/∂z), with y = (q_c, q̇_c, …, up to ORDERS) for each referenced
            coordinate c, one after the other, and f the constant force on each coordinate.
        completion: (y, z, f) → (x, u).
        unknowns: how z reads off a state x and input u: indices into (x, u).
        static: the equations without the derivatives of z, None where they contain none.
    """

    flat: bool
    reason: str
    equations: ca.Function
    completion: ca.Function
    unknowns: tuple[int, ...]
    static: ca.Function | None = None


def invert(system: LagrangianSystem, coordinates: Sequence[int], velocities: Sequence[bool]) -> Inversion:
    """The best inversion there is for a system and the coordinates that are to follow a reference.

    Args:
        system: the model.
        coordinates: indices of the coordinates.
        velocities: whether the velocity of each is referenced rather than its position.
    """
    found = _flat(system, coordinates)
    return found if isinstance(found, Inversion) else steady(system, coordinates, velocities, found)


def _flat(system: LagrangianSystem, referenced: Sequence[int]) -> Inversion | str:
    """The inversion of a flat system, or the reason why it is none."""
    n = system.n
    others = [i for i in range(n) if i not in referenced]
    driven = [i for i in range(n) if system.coordinates[i].input is not None]
    free = [i for i in range(n) if i not in driven]
    if len(free) != len(others):
        return f"{len(free)} equations without input do not determine {len(others)} other coordinates"
    cyclic = {system.coordinates[i].topology == "cyclic" for i in others}
    if len(cyclic) > 1:
        return "some of the other coordinates are cyclic and some are not"
    level = 1 if cyclic == {True} else 0  # which derivative of the other coordinates is the unknown z

    orders = ORDERS + 1
    y, f = ca.SX.sym("y", orders * len(referenced)), ca.SX.sym("f", n)
    z = [ca.SX.sym(f"z{k}", len(others)) for k in range(3)]  # z, ż, z̈
    motion = [ca.SX.zeros(n) for _ in range(3)]  # q, q̇, q̈
    for k in range(3):
        for j, c in enumerate(referenced):
            motion[k][c] = y[j * orders + k]
        for j, i in enumerate(others):
            motion[k][i] = z[k - level][j] if k >= level else 0
    force = _forces(system, motion[0], motion[1], motion[2], f)
    equations = force[free]
    moving = ca.vertcat(z[1], z[2])
    nearly = bool(others) and ca.depends_on(equations, moving)
    static = ca.substitute(equations, moving, ca.SX.zeros(moving.shape)) if nearly else equations
    jacobian = ca.jacobian(static, z[0])
    if ca.sprank(jacobian) < len(others):
        return DERIVATIVES if nearly else "the equations without input do not contain the other coordinates"

    x, u = _state(system, motion[0], motion[1]), force[driven]
    if others:
        # d/dt r(y, z) = 0 and d²/dt² r(y, z) = 0 are linear in ż and z̈, with the same matrix ∂r/∂z.
        rate = ca.vertcat(*(ca.vertcat(part[1:], 0) for part in ca.vertsplit(y, orders)))
        drift = ca.jtimes(static, y, rate)
        slope = drift + jacobian @ z[1]
        curvature = ca.jtimes(slope, y, rate) + ca.jtimes(slope, z[0], z[1])
        z1, z2 = -ca.solve(jacobian, drift), -ca.solve(jacobian, curvature)
        x, u, equations = ca.substitute([x, u, equations], [z[2]], [z2])
        x, u, equations = ca.substitute([x, u, equations], [z[1]], [z1])
    kept = system.state_names
    names = [system.coordinates[i].velocity if level else system.coordinates[i].name for i in others]
    return Inversion(
        True,
        "what is referenced is a flat output of the model",
        ca.Function("equations", [y, z[0], f], [ca.densify(equations), ca.densify(jacobian)]),
        _completion(y, z[0], f, x, u),
        tuple(kept.index(name) for name in names),
        ca.Function("static", [y, z[0], f], [ca.densify(static), ca.densify(jacobian)]) if nearly else None,
    )


def steady(
    system: LagrangianSystem, referenced: Sequence[int], velocities: Sequence[bool], reason: str
) -> Inversion:
    """The inversion that gives a rest for each value of the reference.

    Args:
        system: the model.
        referenced: indices of the coordinates that follow a reference.
        velocities: whether the velocity of each is referenced rather than its position.
        reason: why the system is not taken for flat.
    """
    n, kept, m = system.n, system.state_names, len(system.input_names)
    y, f = ca.SX.sym("y", (ORDERS + 1) * len(referenced)), ca.SX.sym("f", n)
    q, v = ca.SX.zeros(n), ca.SX.zeros(n)
    for j, (c, velocity) in enumerate(zip(referenced, velocities, strict=True)):
        q[c] = y[j * (ORDERS + 1)]
        if velocity:
            v[c] = y[j * (ORDERS + 1) + 1]
    unknown: list[Symbol] = []
    names: list[str] = []
    for i, coordinate in enumerate(system.coordinates):
        if i in referenced:
            continue
        symbol = ca.SX.sym(coordinate.name)
        cyclic = coordinate.topology == "cyclic"
        (v if cyclic else q)[i] = symbol
        unknown.append(symbol)
        names.append(coordinate.velocity if cyclic else coordinate.name)
    u = ca.SX.sym("u", m)
    z = ca.vertcat(*unknown, u)
    residual = _forces(system, q, v, ca.SX.zeros(n), f) - system.input_matrix @ u
    return Inversion(
        False,
        f"steady references: {reason}",
        ca.Function("equations", [y, z, f], [ca.densify(residual), ca.densify(ca.jacobian(residual, z))]),
        _completion(y, z, f, _state(system, q, v), u),
        (*(kept.index(name) for name in names), *(len(kept) + k for k in range(m))),
    )


def _forces(system: LagrangianSystem, q: Symbol, v: Symbol, a: Symbol, f: Symbol) -> Symbol:
    """What the inputs must bring for a motion, the force f helping: (17)."""
    return system.inverse(q, v, a, system.parameter_values) - f


def _state(system: LagrangianSystem, q: Symbol, v: Symbol) -> Symbol:
    """The state column of positions and velocities."""
    kept = [i for i, c in enumerate(system.coordinates) if c.topology != "cyclic"]
    return ca.vertcat(*(q[i] for i in kept), v)  # `q[[]]` would be all of q


def _completion(y: Symbol, z: Symbol, f: Symbol, x: Symbol, u: Symbol) -> ca.Function:
    return ca.Function("completion", [y, z, f], ca.cse([ca.densify(x), ca.densify(u)]))


class Inverter:
    """Solves an inversion at a fixed number of instants at once.

    Args:
        inversion: what to solve.
        count: number of instants.
    """

    ITERATIONS = 30
    TOLERANCE = 1e-11

    def __init__(self, inversion: Inversion, count: int) -> None:
        self._flat = inversion.flat
        self._equations = Batch(inversion.equations, count)
        self._completion = Batch(inversion.completion, count)

    def __call__(
        self, y: Float[np.ndarray, "k o"], guess: Float[np.ndarray, "k z"], force: Float[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "k z"], Float[np.ndarray, "k x"], Float[np.ndarray, "k u"]]:
        """Unknowns, states and inputs along the trajectory.

        Args:
            y: referenced positions and their derivatives, shape (count, references · (ORDERS + 1)).
            guess: start of the iteration, shape (count, unknowns).
            force: constant force on each coordinate.

        Returns:
            z, x and u; where there is no solution z is the guess, and nothing is ever infinite or NaN.
        """
        z, _ = self.find(y, guess, force)
        x, u = (
            np.nan_to_num(r[:, :, 0], nan=0.0, posinf=0.0, neginf=0.0) for r in self._completion(y, z, force)
        )
        return z, x, u

    def find(
        self, y: Float[np.ndarray, "k o"], guess: Float[np.ndarray, "k z"], force: Float[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "k z"], Bool[np.ndarray, " k"]]:
        """As `solve`, and where that finds none from other points; where there is no solution, the guess."""
        z, solved = self.solve(y, guess, force)
        for size in STARTS:
            if solved.all():
                break
            # A guess at rest can be a singular point (force ∝ i² at i = 0), and nanocoulombs are far from 1.
            again, more = self.solve(y, np.full_like(guess, size), force)
            z, solved = np.where((more & ~solved)[:, None], again, z), solved | more
        return np.where(solved[:, None], z, guess), solved

    def solve(
        self, y: Float[np.ndarray, "k o"], guess: Float[np.ndarray, "k z"], force: Float[np.ndarray, " c"]
    ) -> tuple[Float[np.ndarray, "k z"], Bool[np.ndarray, " k"]]:
        """Unknowns by Gauss–Newton with steps of least norm, and where they are a solution.

        Args:
            y: referenced positions and their derivatives, shape (count, references · (ORDERS + 1)).
            guess: start of the iteration, shape (count, unknowns).
            force: constant force on each coordinate.
        """
        z = guess.copy()
        converged = np.full(len(z), z.shape[1] == 0)
        for _ in range(self.ITERATIONS):
            if converged.all():
                break
            result, jacobian = self._equations(y, z, force)
            residual = result[:, :, 0]
            usable = np.isfinite(residual).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
            if not usable.any():
                break
            step = np.zeros_like(z)
            step[usable] = -np.einsum("kij,kj->ki", np.linalg.pinv(jacobian[usable]), residual[usable])
            z += step
            converged = usable & (np.abs(step).max(axis=1) <= self.TOLERANCE * (1.0 + np.abs(z).max(axis=1)))
        if self._flat and z.shape[1]:
            # A step of 0 at a singular point solves nothing.
            residual, _ = self._equations(y, z, force)
            converged &= np.abs(residual).max(axis=(1, 2)) <= 1e-7 * (1.0 + np.abs(y).max(axis=1))
        return z, converged

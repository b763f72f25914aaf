"""Euler–Lagrange: from any extended Lagrangian 𝓛(q, q̇; p) and dissipation D(q̇; p) to the equations of motion.

Everything that has dynamics in this tool, a ground-truth plant or a learned model, is a
`LagrangianSystem`. Its CasADi functions serve simulation, control and C code alike.

References: extended Lagrangian 𝓛 = (T − V) + (W_m − W_e) ± W*; Euler–Lagrange equations (11), where the
paper's (11a) misprints ∂𝓛/∂q as ∂𝓛/∂q̇; forward model (16); inverse model (17).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import (
    Coordinate,
    Parameter,
    check_coordinates,
    input_names,
    state_names,
)

if TYPE_CHECKING:
    from exlinn_fmi.mechanics.learned import Networks

Symbol = Any
"""A CasADi expression; CasADi ships no type information."""

MAX_INTERNAL_STEP = 1e-3
"""Longest integrator step [s] inside a communication step that any system takes."""


def internal_steps(h: float, max_step: float = MAX_INTERNAL_STEP) -> int:
    """Number of equal integrator steps in a communication step.

    A billionth is forgiven, so that 10 ms are ten steps of 1 ms whatever the rounding.

    Args:
        h: communication step [s].
        max_step: longest integrator step [s].
    """
    return max(1, math.ceil(h / max_step - 1e-9))


@dataclass(frozen=True)
class LagrangianSystem:
    """An extended Lagrangian system with n coordinates, m inputs and r parameters.

    All members named below are CasADi functions of columns: q, v = q̇, a = q̈ (n), u (m), p (r), and the
    state x = (positions that are not cyclic, all velocities). A cyclic position does not enter 𝓛; where
    one is needed as an argument any value will do.

    Args:
        coordinates: the generalised coordinates, which also name velocities and inputs.
        lagrangian: (q, v, p) → 𝓛 [J].
        dissipation: (v, p) → D [W], Rayleigh's dissipation function.
        parameters: with their default values, in the order of p.
        networks: where 𝓛 and D are networks, these, for who evaluates them without CasADi.
    """

    coordinates: tuple[Coordinate, ...]
    lagrangian: ca.Function
    dissipation: ca.Function
    parameters: tuple[Parameter, ...] = ()
    networks: Networks | None = field(default=None, compare=False, repr=False)

    @classmethod
    def build(
        cls,
        coordinates: tuple[Coordinate, ...],
        lagrangian: Callable[[Symbol, Symbol, Symbol], Symbol],
        dissipation: Callable[[Symbol, Symbol], Symbol],
        parameters: tuple[Parameter, ...] = (),
    ) -> LagrangianSystem:
        """Make a system from two formulas written with CasADi operations.

        Args:
            coordinates: the generalised coordinates.
            lagrangian: takes symbols q (n), v (n), p (r), gives 𝓛.
            dissipation: takes symbols v (n), p (r), gives D.
            parameters: physical parameters, in the order of p.

        Raises:
            ModelError: two names alike, or 𝓛 depends on a coordinate that is said to be cyclic.
        """
        check_coordinates(coordinates)
        n, r = len(coordinates), len(parameters)
        q, v, p = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("p", r)
        energy = lagrangian(q, v, p)
        for i, c in enumerate(coordinates):
            # A gauge term k·q_j·q̇_i of a cyclic j may stay: only the equations of motion count.
            if c.topology == "cyclic" and ca.depends_on(
                _residual(energy, ca.SX(0), q, v, ca.SX.zeros(n)), q[i]
            ):
                raise ModelError(
                    f"coordinate {c.name!r} is said to be cyclic, but the equations of motion depend on it; "
                    "give it the topology 'line' or 'circle'"
                )
        return cls(
            coordinates,
            ca.Function("L", [q, v, p], [energy], ["q", "v", "p"], ["L"]),
            ca.Function("D", [v, p], [dissipation(v, p)], ["v", "p"], ["D"]),
            parameters,
        )

    def with_inputs(self, names: Collection[str]) -> LagrangianSystem:
        """The same system with these of its inputs alone; on the others no force acts.

        Args:
            names: inputs to keep.
        """
        coordinates = tuple(
            c if c.input in names else replace(c, input=None, input_unit="") for c in self.coordinates
        )
        return replace(self, coordinates=coordinates)

    def bound(self, values: ArrayLike) -> LagrangianSystem:
        """The same system with its parameters fixed, or some of them.

        Args:
            values: of the parameters, shape (r,); NaN where one stays a parameter.
        """
        fixed = np.asarray(values, dtype=float)
        free = np.flatnonzero(np.isnan(fixed)).tolist()

        def full(p: Symbol) -> Symbol:
            return ca.vertcat(*(p[free.index(k)] if k in free else fixed[k] for k in range(len(fixed))))

        return LagrangianSystem.build(
            self.coordinates,
            lambda q, v, p: self.lagrangian(q, v, full(p)),
            lambda v, p: self.dissipation(v, full(p)),
            tuple(self.parameters[k] for k in free),
        )

    def loaded(self) -> LagrangianSystem:
        """The same system under a constant generalised force on every coordinate: n parameters more, all 0.

        A force f is what −fᵀq̇ in the dissipation makes of it in (11), on cyclic coordinates too.
        """
        _, v, _, _, p = self._symbols
        q, force = ca.SX.sym("q", self.n), ca.SX.sym("f", self.n)
        longer = ca.vertcat(p, force)
        loss = self.dissipation(v, p) - ca.dot(force, v)
        return replace(
            self,
            lagrangian=ca.Function("L", [q, v, longer], [self.lagrangian(q, v, p)], ["q", "v", "p"], ["L"]),
            dissipation=ca.Function("D", [v, longer], [loss], ["v", "p"], ["D"]),
            parameters=(
                *self.parameters,
                *(Parameter(f"force_{c.name}", 0.0, c.force_unit, "force") for c in self.coordinates),
            ),
        )

    # ── names and sizes ──────────────────────────────────────────────────────────────────────────────────

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    @property
    def state_names(self) -> list[str]:
        """Names of the state x."""
        return state_names(self.coordinates)

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs u."""
        return input_names(self.coordinates)

    @property
    def parameter_values(self) -> NDArray[np.float64]:
        """Default values of p, shape (r,)."""
        return np.array([p.value for p in self.parameters], dtype=float)

    @property
    def input_matrix(self) -> NDArray[np.float64]:
        """B with F = B u, shape (n, m): which coordinate each input acts on."""
        driven = [i for i, c in enumerate(self.coordinates) if c.input is not None]
        matrix: NDArray[np.float64] = np.eye(self.n)[:, driven]
        return matrix

    # ── the equations of motion ──────────────────────────────────────────────────────────────────────────

    @cached_property
    def _symbols(self) -> tuple[Symbol, Symbol, Symbol, Symbol, Symbol]:
        n = self.n
        return (
            ca.SX.sym("q", n),
            ca.SX.sym("v", n),
            ca.SX.sym("a", n),
            ca.SX.sym("u", len(self.input_names)),
            ca.SX.sym("p", len(self.parameters)),
        )

    @cached_property
    def mass_matrix(self) -> ca.Function:
        """(q, v, p) → ∂²𝓛/∂q̇², shape (n, n)."""
        q, v, _, _, p = self._symbols
        hessian, _ = ca.hessian(self.lagrangian(q, v, p), v)
        return ca.Function("M", [q, v, p], [hessian], ["q", "v", "p"], ["M"])

    @cached_property
    def inverse(self) -> ca.Function:
        """Inverse model (17): (q, v, a, p) → F, the generalised forces that make the accelerations a."""
        q, v, a, _, p = self._symbols
        force = _residual(self.lagrangian(q, v, p), self.dissipation(v, p), q, v, a)
        return ca.Function("inverse", [q, v, a, p], [force], ["q", "v", "a", "p"], ["F"])

    @cached_property
    def forward(self) -> ca.Function:
        """Forward model (16): (q, v, u, p) → a, the accelerations under inputs u (F = B u)."""
        q, v, _, u, p = self._symbols
        rest = _residual(self.lagrangian(q, v, p), self.dissipation(v, p), q, v, ca.SX.zeros(self.n))
        mass = self.mass_matrix(q, v, p)
        acceleration = _solve_blocks(mass, self.input_matrix @ u - rest)
        return ca.Function("forward", [q, v, u, p], [acceleration], ["q", "v", "u", "p"], ["a"])

    @cached_property
    def derivative(self) -> ca.Function:
        """State equation: (x, u, p) → ẋ, from the forward model (16)."""
        _, _, _, u, p = self._symbols
        x = ca.SX.sym("x", len(self.state_names))
        q, v = self.split_state(x)
        kept = [i for i, c in enumerate(self.coordinates) if c.topology != "cyclic"]
        xdot = ca.vertcat(*(v[i] for i in kept), self.forward(q, v, u, p))
        return ca.Function("derivative", [x, u, p], [xdot], ["x", "u", "p"], ["dx"])

    def split_state(self, x: Symbol) -> tuple[Symbol, Symbol]:
        """Positions and velocities (n each) of a state column x; cyclic positions read 0."""
        positions, k = [], 0
        for c in self.coordinates:
            positions.append(0 if c.topology == "cyclic" else x[k])
            k += c.topology != "cyclic"
        return ca.vertcat(*positions), x[k:]

    def rk4(self, substeps: int = 1) -> ca.Function:
        """One step of the classical fourth-order Runge–Kutta method on (16): (x, u, p, h) → x⁺, u held.

        Args:
            substeps: number of equal steps that h is divided into.
        """
        x0, h = ca.SX.sym("x", len(self.state_names)), ca.SX.sym("h")
        _, _, _, u, p = self._symbols
        f, dt, x = self.derivative, h / substeps, x0
        for _ in range(substeps):
            k1 = f(x, u, p)
            k2 = f(x + dt / 2 * k1, u, p)
            k3 = f(x + dt / 2 * k2, u, p)
            k4 = f(x + dt * k3, u, p)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return ca.Function("rk4", [x0, u, p, h], [x], ["x", "u", "p", "h"], ["xn"])

    @cached_property
    def state_jacobian(self) -> ca.Function:
        """(x, u, p) → ∂ẋ/∂x, whose eigenvalues are the poles at that point."""
        _, _, _, u, p = self._symbols
        x = ca.SX.sym("x", len(self.state_names))
        jacobian = ca.densify(ca.jacobian(self.derivative(x, u, p), x))
        return ca.Function("state_jacobian", [x, u, p], [jacobian], ["x", "u", "p"], ["A"])

    def solver_step(self, start: Mapping[str, float], parameters: ArrayLike | None = None) -> float:
        """Longest RK4 step h [s]: |λ| h ≤ 0.01 for every pole λ at a state without inputs, rounded down.

        The method then errs by less than 1e-10 of the state per time constant. In-process components and
        exported FMUs both ask here, so that they run alike.

        Args:
            start: the state by name, 0 where not given.
            parameters: shape (r,); the default values if not given.

        Raises:
            ModelError: ẋ is not finite there.
        """
        p = self.parameter_values if parameters is None else np.asarray(parameters, dtype=float)
        x = np.array([start.get(name, 0.0) for name in self.state_names])
        poles = self.state_jacobian(x, np.zeros(len(self.input_names)), p).full()
        if not np.all(np.isfinite(poles)):
            which = "default" if parameters is None else "these"
            raise ModelError(
                f"the equations are not finite at the start state and {which} parameters; "
                "check the parameters and the start values"
            )
        return longest_step(poles)

    @cached_property
    def output(self) -> ca.Function:
        """(x, u, p) → y = (x, accelerations, stored energy), as a plant's outputs begin."""
        _, _, _, u, p = self._symbols
        x = ca.SX.sym("x", len(self.state_names))
        q, v = self.split_state(x)
        y = ca.densify(ca.vertcat(x, self.forward(q, v, u, p), self.energy(q, v, p)))
        return ca.Function("output", [x, u, p], [y], ["x", "u", "p"], ["y"])

    # ── energy ───────────────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def energy(self) -> ca.Function:
        """Stored energy E = q̇ᵀ∂𝓛/∂q̇ − 𝓛: (q, v, p) → E [J]. Coupling terms linear in q̇ store none."""
        q, v, _, _, p = self._symbols
        lagrangian = self.lagrangian(q, v, p)
        stored = ca.dot(v, ca.gradient(lagrangian, v)) - lagrangian
        return ca.Function("energy", [q, v, p], [stored], ["q", "v", "p"], ["E"])

    @cached_property
    def power(self) -> ca.Function:
        """(v, u, p) → (q̇ᵀF, q̇ᵀ∂D/∂q̇) [W]: supplied and dissipated power; dE/dt is their difference."""
        _, v, _, u, p = self._symbols
        supplied = ca.dot(v, self.input_matrix @ u)
        dissipated = ca.dot(v, ca.gradient(self.dissipation(v, p), v))
        return ca.Function("power", [v, u, p], [supplied, dissipated], ["v", "u", "p"], ["in", "loss"])


def _residual(lagrangian: Symbol, dissipation: Symbol, q: Symbol, v: Symbol, a: Symbol) -> Symbol:
    """d/dt ∂𝓛/∂q̇ − ∂𝓛/∂q + ∂D/∂q̇ with q̈ = a (11), shape (n,)."""
    momentum = ca.gradient(lagrangian, v)
    return (
        ca.jtimes(momentum, v, a)
        + ca.jtimes(momentum, q, v)
        - ca.gradient(lagrangian, q)
        + ca.gradient(dissipation, v)
    )


def _solve_blocks(matrix: Symbol, right: Symbol) -> Symbol:
    """matrix⁻¹ right for a symmetric matrix, solved apart for each block that its sparsity shows."""
    n = matrix.shape[0]
    block_of = list(range(n))
    rows, columns = matrix.sparsity().get_triplet()
    for i, j in zip(rows, columns, strict=True):
        old, new = max(block_of[i], block_of[j]), min(block_of[i], block_of[j])
        block_of = [new if b == old else b for b in block_of]
    solution = [ca.SX(0)] * n
    for block in sorted(set(block_of)):
        members = [i for i in range(n) if block_of[i] == block]
        part = ca.solve(ca.densify(matrix[members, members]), ca.densify(right[members]))
        for k, i in enumerate(members):
            solution[i] = part[k]
    return ca.vertcat(*solution)


def longest_step(jacobian: NDArray[np.float64]) -> float:
    """Longest RK4 step [s] that `LagrangianSystem.solver_step` allows.

    Args:
        jacobian: ∂ẋ/∂x, whose eigenvalues are the poles, shape (k, k).
    """
    fastest = float(np.max(np.abs(np.linalg.eigvals(jacobian))))
    return _round_down(min(MAX_INTERNAL_STEP, 0.01 / fastest if fastest > 0 else MAX_INTERNAL_STEP))


def _round_down(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above `value`."""
    decade = math.floor(math.log10(value) + 1e-9)
    digit = max(d for d in (1, 2, 5) if d <= value / 10.0**decade * (1 + 1e-9))
    return float(f"{digit}e{decade}")


def evaluate(function: ca.Function, *arguments: ArrayLike) -> NDArray[np.float64]:
    """Evaluate a CasADi function of columns on a batch.

    Args:
        function: any function of this module; only its first result is returned.
        arguments: one array per argument, shape (B, k) or, for the same value throughout, (k,).

    Returns:
        Shape (B, k) for column and scalar results, (B, rows, columns) for matrices.
    """
    arrays = [np.atleast_1d(np.asarray(a, dtype=float)) for a in arguments]
    batch = max((a.shape[0] for a in arrays if a.ndim == 2), default=1)
    full = [np.broadcast_to(a, (batch, a.shape[-1])).T for a in arrays]
    rows, columns = function.size_out(0)
    result = function.map(batch)(*full)
    values = np.array((result[0] if isinstance(result, tuple) else result).full())
    if columns == 1:
        return values.T
    return values.reshape(rows, batch, columns).transpose(1, 0, 2)


def bind(
    function: ca.Function, arguments: Sequence[NDArray[np.float64]], results: Sequence[NDArray[np.float64]]
) -> Callable[[], None]:
    """Tie a CasADi function to arrays: each call of what is returned reads and writes them in place.

    About a microsecond a call where a call by value costs a hundred.

    Args:
        function: with dense arguments and results.
        arguments: one contiguous array per argument, kept by the caller.
        results: one contiguous array per result (matrices column by column), kept by the caller.
    """
    buffer: Any
    buffer, evaluate_buffer = function.buffer()
    for k, array in enumerate(arguments):
        if array.size:
            buffer.set_arg(k, array.data)
    for k, array in enumerate(results):
        if array.size:
            buffer.set_res(k, array.data)

    def call(_keep: object = (buffer, arguments, results)) -> None:
        evaluate_buffer()

    return call


def feed_through(function: ca.Function, argument: int = 1) -> list[tuple[int, ...]]:
    """For each row of a function's first result, the entries of one argument that it depends on.

    Args:
        function: e.g. ``system.output``.
        argument: number of the argument, e.g. 1 for the inputs of (x, u, p).
    """
    depends: list[list[int]] = [[] for _ in range(function.size1_out(0))]
    rows, columns = function.jac_sparsity(0, argument).get_triplet()
    for row, column in zip(rows, columns, strict=True):
        depends[row].append(column)
    return [tuple(sorted(d)) for d in depends]

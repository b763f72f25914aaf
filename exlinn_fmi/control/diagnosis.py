"""What can be said of a controller before it runs: warnings, with numbers and advice."""

from __future__ import annotations

import casadi as ca
import numpy as np
from jaxtyping import Float

from exlinn_fmi.control.ocp import FALLBACK_TERMINAL, Ocp
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate

INTEGRATOR = 1e-2
"""A mode that changes by less than this share over the horizon counts as an integrator, not as slow."""


def diagnose(ocp: Ocp, generator: ReferenceGenerator, references: References) -> tuple[str, ...]:
    """Warnings about a controller.

    Args:
        ocp: its optimal control problem.
        generator: its references.
        references: those at the beginning.
    """
    found = [] if generator.inversion.flat else [generator.inversion.reason]
    if not ca.has_conic("hpipm"):
        found.append(
            "this CasADi comes without hpipm: qrqp solves the quadratic programs, several times slower"
        )
    x, u = references.x[0], references.u[0]
    smallest = smallest_inertia(ocp.system, x)
    if not smallest > 0.0:
        found.append(
            f"the model's mass matrix is not positive definite at the start of the reference (eigenvalue "
            f"{smallest:.3g}): predictions may diverge; train again, with other data or `preset: structured`"
        )
    if ocp.terminal == "dare" and not ocp.targets(references).riccati:
        found.append(
            "the Riccati equation has no solution at the reference: "
            f"the terminal cost is {FALLBACK_TERMINAL:g} Q"
        )
    slowest, horizon = response_time(ocp, _at_rest(ocp.system, x), u), ocp.horizon * ocp.step
    if slowest is not None and slowest > horizon:
        found.append(
            f"the horizon of {ocp.horizon} × {ocp.step:g} s = {horizon:g} s cannot see the model's slowest "
            f"response ({slowest:.3g} s): take a step of at least {slowest / ocp.horizon:.2g} s "
            f"or a horizon of at least {int(np.ceil(slowest / ocp.step))}"
        )
    return tuple(found)


def smallest_inertia(system: LagrangianSystem, x: Float[np.ndarray, " n"]) -> float:
    """Smallest eigenvalue of the mass matrix at a state (n,), NaN where that is not finite."""
    state = ca.SX.sym("x", len(x))
    q, v = system.split_state(state)
    mass = ca.Function("mass", [state], [ca.densify(system.mass_matrix(q, v, system.parameter_values))])
    matrix = evaluate(mass, x)[0].reshape(system.n, system.n)
    return float(np.linalg.eigvalsh(matrix)[0]) if np.isfinite(matrix).all() else float("nan")


def response_time(ocp: Ocp, x: Float[np.ndarray, " n"], u: Float[np.ndarray, " m"]) -> float | None:
    """1/|λ| [s] of the slowest mode of the linearised model that is no integrator; None if there is none."""
    A, _ = ocp.linearise_at(x, u, np.zeros(ocp.system.n))
    if not np.isfinite(A).all():
        return None
    multipliers = np.abs(np.linalg.eigvals(A).astype(complex))
    rates = np.abs(np.log(np.linalg.eigvals(A).astype(complex)[multipliers > 0.0])) / ocp.step
    seen = rates[rates * ocp.horizon * ocp.step > INTEGRATOR]
    return float(1.0 / seen.min()) if len(seen) else None


def _at_rest(system: LagrangianSystem, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The state with nothing moving; velocities of cyclic coordinates (currents) stay."""
    rest = x.copy()
    for coordinate in system.coordinates:
        if coordinate.topology != "cyclic":
            rest[system.state_names.index(coordinate.velocity)] = 0.0
    return rest

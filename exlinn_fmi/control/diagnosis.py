"""What can be said of a controller before it runs: warnings, with numbers and advice."""

from __future__ import annotations

import casadi as ca
import numpy as np
from jaxtyping import Float

from exlinn_fmi.control.defaults import at_rest, response_time
from exlinn_fmi.control.estimator import Direct, Estimator, ExtendedKalman, unobservable
from exlinn_fmi.control.ocp import FALLBACK_TERMINAL, Ocp
from exlinn_fmi.control.reference import ReferenceGenerator, References
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate


def diagnose(
    ocp: Ocp, generator: ReferenceGenerator, references: References, estimator: Estimator
) -> tuple[str, ...]:
    """Warnings about a controller.

    Args:
        ocp: its optimal control problem.
        generator: its references.
        references: those at the beginning.
        estimator: what tells the state.
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
    targets = ocp.targets(references)
    if ocp.terminal == "dare" and not targets.riccati:
        without = ", without a terminal set" if ocp.set_weight else ""
        found.append(
            "the Riccati equation has no solution at the reference: "
            f"the terminal cost is {FALLBACK_TERMINAL:g} Q{without}"
        )
    elif ocp.set_weight and targets.level == 0.0:
        found.append(
            "terminal_set: there is none at the start of the reference, which lies on a bound there; "
            "leave room between `reference` and `inputs`, `states`"
        )
    if ocp.set_weight and ocp.limits.rated:
        found.append("terminal_set: the set knows nothing of `rates`")
    horizon = ocp.horizon * ocp.step
    slowest = response_time(ocp.system, at_rest(ocp.system, x), u, horizon)
    if slowest is not None and slowest > horizon:
        found.append(
            f"the horizon of {ocp.horizon} × {ocp.step:g} s = {horizon:g} s cannot see the model's slowest "
            f"response ({slowest:.3g} s): take a step of at least {slowest / ocp.horizon:.2g} s "
            f"or a horizon of at least {int(np.ceil(slowest / ocp.step))}"
        )
    if isinstance(estimator, ExtendedKalman) and not estimator.settled:
        found.append("the estimator has no steady state at the reference: its gain is updated at each sample")
    if not isinstance(estimator, Direct) and (hidden := unobservable(estimator, x, u)):
        found.append(
            f"what is measured does not tell {', '.join(hidden)} at the start of the reference: "
            "measure more, or name fewer `estimator.disturbances`"
        )
    return tuple(found)


def smallest_inertia(system: LagrangianSystem, x: Float[np.ndarray, " n"]) -> float:
    """Smallest eigenvalue of the mass matrix at a state (n,), NaN where that is not finite."""
    state = ca.SX.sym("x", len(x))
    q, v = system.split_state(state)
    mass = ca.Function("mass", [state], [ca.densify(system.mass_matrix(q, v, system.parameter_values))])
    matrix = evaluate(mass, x)[0].reshape(system.n, system.n)
    return float(np.linalg.eigvalsh(matrix)[0]) if np.isfinite(matrix).all() else float("nan")

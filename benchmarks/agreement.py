"""Whether the controller's solver is exact: converged plans against those of other solvers.

    python benchmarks/agreement.py [--quick] [--json FILE]

Random states, bounds, weights and times of the cart's problem (`baselines/cart.py`); tolerance 1e-9 for all:

- `hpipm`: our own CasADi path, whose quadratic programs hpipm solves; `acados` (its SQP with HPIPM) where
  ACADOS_SOURCE_DIR is set; `ipopt` at each hundredth problem.
- `max_dv_…`: largest difference of the applied input [V]; `max_dv_whole_…`: of any input of the plan. Where
  costs differ by more than rounding, there are two minima: they are counted, by who has the lower one.
- `max_exact_step_…`: how far an active-set method (qpOASES), asked for the Gauss–Newton step at a converged
  plan, still moves an input of it [V]; at each hundredth problem, and where ours and hpipm's plans differ by
  more than 1e-4 V.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from baselines.cart import problem

from exlinn_fmi.control.gauss_newton import GaussNewton
from exlinn_fmi.control.ocp import Ocp, Targets
from exlinn_fmi.control.qp import ConicQp
from exlinn_fmi.control.realtime import CompiledGaussNewton
from exlinn_fmi.control.solver import Plan, Solution, SolveStatus, make_solver

SAME = 1e-6
"""Costs that differ by more than this, over their size, are of two minima."""

DIFFERENT = 1e-4
"""Plans that differ by more than this [V] are looked at by the exact method."""


class Peer:
    """How far another solver's plans are from ours.

    Args:
        name: of it, as in the figures.
        solve: its plan, None where it fails.
    """

    def __init__(self, name: str, solve: Callable[..., Plan | None]) -> None:
        self.name, self.solve = name, solve
        self.failures = self.lower = self.higher = 0
        self.first = self.whole = 0.0

    def compare(self, ocp: Ocp, ours: Solution, plan: Plan | None) -> float:
        """Count a plan; returns its largest difference of an input [V], 0 where there is none to compare."""
        if plan is None:
            self.failures += 1
            return 0.0
        mine, other = (cost(ocp, p, ours.targets) for p in (ours, plan))
        gain = (other - mine) / max(1.0, mine)
        if abs(gain) > SAME:
            self.lower += gain > 0.0
            self.higher += gain < 0.0
            return 0.0
        apart = np.abs(ours.u - plan.u)
        self.first, self.whole = max(self.first, apart[0].max()), max(self.whole, apart.max())
        return float(apart.max())

    def figures(self) -> dict[str, float]:
        """What was counted."""
        return {
            f"agree.{self.name}_failures": self.failures,
            f"agree.max_dv_{self.name}": self.first,
            f"agree.max_dv_whole_{self.name}": self.whole,
            f"agree.lower_minima_than_{self.name}": self.lower,
            f"agree.higher_minima_than_{self.name}": self.higher,
        }


def cost(ocp: Ocp, plan: Plan | Solution, targets: Targets) -> float:
    """All that a plan costs."""
    return ocp.cost(plan.x, plan.u, targets) + ocp.penalty(plan.x)


def solved(found: Solution) -> Plan | None:
    """The plan of a solution that is one."""
    return Plan(found.x, found.u) if found.status == SolveStatus.SOLVED else None


class Exact:
    """The Gauss–Newton step at a plan, by qpOASES."""

    def __init__(self, plain: GaussNewton) -> None:
        self._plain, ocp = plain, plain.ocp
        with contextlib.redirect_stdout(io.StringIO()):  # it shows its licence
            self._qp = ConicQp("qpoases", ocp.horizon, ocp.n, ocp.m, ocp.limits.soft)

    def step(self, plan: Plan, targets: Targets) -> float:
        """How far it moves an input [V]."""
        at = self._plain.ocp.linearise(plan.x, plan.u, targets.force)
        qp = self._plain.stage_qp(plan, at, targets, np.zeros(self._plain.ocp.n))
        with contextlib.redirect_stdout(io.StringIO()):
            found = self._qp.solve(qp)
        if not found.solved:
            raise RuntimeError("qpOASES did not solve the quadratic program")
        return float(np.abs(found.du).max())


def draw(ours: CompiledGaussNewton, rng: np.random.Generator) -> None:
    """Put random bounds and a random weight into a problem."""
    ocp, bound, current = ours.ocp, rng.uniform(4.0, 24.0), rng.uniform(1.0, 4.0)
    lim = ocp.limits
    changed = {"u_min": (lim.u_min, -bound), "u_max": (lim.u_max, bound), "x_min": (lim.x_min, -current)}
    changed |= {"x_max": (lim.x_max, current), "R": (ocp.R, 10.0 ** rng.uniform(-4.0, -2.0))}
    for name, (array, value) in changed.items():
        array[:] = value
        ours.kernel.array(name, *array.shape)[:] = array


def agree(quick: bool) -> dict[str, float]:
    """Ours against all others."""
    count = 200 if quick else 10_000
    given, rng = problem.__wrapped__(), np.random.default_rng(0)  # one of its own, since it is changed
    ocp = given.ocp
    ours, plain = (make_solver(ocp, "sqp", 100, 1e-9, backend) for backend in ("compiled", "casadi"))
    assert isinstance(ours, CompiledGaussNewton)
    assert isinstance(plain, GaussNewton)
    exact, failures, checks, steps = Exact(plain), 0, 0, [0.0, 0.0]
    hpipm = Peer("hpipm", lambda x0, aim, _: solved(plain.solve(x0, aim)))
    # Bounds and weights are constants of its problem: it is made anew.
    ipopt = Peer("ipopt", lambda x0, aim, _: solved(make_solver(ocp, "ipopt", 300, 1e-9).solve(x0, aim)))
    others = []
    if os.environ.get("ACADOS_SOURCE_DIR"):
        from baselines.acados import SeparateAcados

        acados = SeparateAcados()
        others.append(Peer("acados", lambda x0, aim, targets: acados.converged(ocp, x0, aim, targets)))
    for k in range(count):
        x0 = rng.uniform([0.2, -5.0, -4.5], [2.9, 5.0, 4.5])
        draw(ours, rng)
        aim = given.aim(rng.uniform(0.0, 2.5), x0)
        mine = ours.solve(x0, aim)
        plan = solved(mine)
        if plan is None:
            failures += 1
            continue
        second = hpipm.solve(x0, aim, mine.targets)
        apart = hpipm.compare(ocp, mine, second)
        for peer in others + [ipopt] * (k % 100 == 0):
            peer.compare(ocp, mine, peer.solve(x0, aim, mine.targets))
        if second is not None and (apart > DIFFERENT or k % 100 == 0):
            checks += 1
            at_both = (exact.step(at, mine.targets) for at in (plan, second))
            steps = [max(pair) for pair in zip(steps, at_both, strict=True)]
    peers = [hpipm, ipopt, *others]
    figures = {
        "agree.problems": count,
        "agree.failures": failures,
        "agree.max_dv_converged": max(peer.first for peer in peers),
        "agree.exact_checks": checks,
        "agree.max_exact_step_ours": steps[0],
        "agree.max_exact_step_hpipm": steps[1],
    }
    for peer in peers:
        figures |= peer.figures()
    return figures


FIGURES: dict[str, Callable[[bool], dict[str, float]]] = {"agree": agree}
"""For `nmpc.py`, which shows them in its table."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer problems")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    given = parser.parse_args()
    found = agree(given.quick)
    for name, value in found.items():
        print(f"{name:<34} {value:10.5g}")
    if given.json:
        given.json.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""The quadratic program of one Gauss–Newton step, stage by stage, and what solves it.

In steps dx_k = x_k − x̄_k, du_k = u_k − ū_k and slacks s_k of the softened bounds of x_{k+1}:

    minimise   Σ ½ dx_kᵀH_x dx_k + g_kᵀdx_k + ½ du_kᵀH_u du_k + r_kᵀdu_k + l₁ᵀs_k + ½ s_kᵀ diag(l₂) s_k
    subject to dx_{k+1} = A_k dx_k + B_k du_k + c_k, dx_0 given, du within bounds,
               low_k − s_k ≤ dx_{k+1} ≤ high_k + s_k (bounded states), s_k ≥ 0.

With bounds on the inputs' rate the last m entries of the state are the inputs of the stage before, and du_k
less these is within bounds as well. It is always feasible. Solvers differ in how they use the stages, not in
what they return.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

INFINITE = 1e6
"""What hpipm takes for no bound; its residuals lose digits in proportion."""

TOLERANCE = 1e-9
"""Residuals to which quadratic programs are solved."""

LARGE = 1e4
"""Programs whose Hessian is larger than this are scaled down to it: rounding grows with it."""

ROUGH = 10.0
"""The same for programs that are too hard to be solved that exactly."""

FEASIBLE = 1e-6
"""Violation of a constraint, over the size of the solution, from which on a solution is none."""


@dataclass(frozen=True)
class StageQp:
    """One quadratic program with N stages, as at the head of this file.

    Args:
        A: shape (N, n, n).
        B: shape (N, n, m).
        c: gaps, shape (N, n).
        dx0: shape (n,).
        H_x: Hessian of the states at nodes 1 … N−1, shape (n, n).
        H_end: Hessian of the states at node N, shape (n, n).
        H_u: Hessian of the inputs, shape (m, m).
        g: gradient of the states, shape (N + 1, n).
        r: gradient of the inputs, shape (N, m).
        u_low: bounds of du, shape (N, m).
        u_high: bounds of du, shape (N, m).
        low: bounds of their dx at nodes 1 … N, shape (N, s).
        high: bounds of their dx at nodes 1 … N, shape (N, s).
        l1: linear penalty, shape (s,).
        l2: quadratic penalty, shape (s,).
        rate_low: bounds of du_k − du_{k−1} from the second stage on, shape (N − 1, m); None for no bounds.
        rate_high: the same from above.
    """

    A: NDArray[np.float64]
    B: NDArray[np.float64]
    c: NDArray[np.float64]
    dx0: NDArray[np.float64]
    H_x: NDArray[np.float64]
    H_end: NDArray[np.float64]
    H_u: NDArray[np.float64]
    g: NDArray[np.float64]
    r: NDArray[np.float64]
    u_low: NDArray[np.float64]
    u_high: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    l1: NDArray[np.float64]
    l2: NDArray[np.float64]
    rate_low: NDArray[np.float64] | None = None
    rate_high: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class QpSolution:
    """Steps that solve a `StageQp`.

    Args:
        dx: shape (N + 1, n).
        du: shape (N, m).
        slack: shape (N, s).
        solved: whether to the tolerance asked for; where not, the rest is not to be used.
        iterations: iterations of the solver, −1 where it does not tell.
        solver: which one it was.
    """

    dx: NDArray[np.float64]
    du: NDArray[np.float64]
    slack: NDArray[np.float64]
    solved: bool
    iterations: int
    solver: str


class QpSolver(ABC):
    """Solves quadratic programs of one shape."""

    @abstractmethod
    def solve(self, qp: StageQp) -> QpSolution:
        """The solution, or one that says it is none."""


class ConicQp(QpSolver):
    """A solver of CasADi: `hpipm` (interior point, Riccati), `qrqp` (active set, sparse), `qpoases`.

    Variables are ordered (u_0, s_0, x_1, u_1, s_1, …, x_N) and constraints stage by stage, the structure that
    hpipm works on. dx_0 is put into the first stage's constants.

    Args:
        plugin: its name.
        N: number of stages.
        n: number of states.
        m: number of inputs.
        soft: indices of the softened states, shape (s,).
        rated: whether the inputs' rate is bounded.
        largest: programs whose Hessian is larger than this are scaled down to it; rounding errors grow with
            it, and may not exceed the residuals that are asked for.

    Raises:
        RuntimeError: CasADi was built without it.
    """

    def __init__(
        self,
        plugin: str,
        N: int,
        n: int,
        m: int,
        soft: Int[np.ndarray, " s"],
        rated: bool = False,
        largest: float = LARGE,
    ) -> None:
        self.plugin, self._largest = plugin, largest
        s = len(soft)
        self._soft = soft
        self._layout = layout = _Layout(N, n, m, soft, rated)
        options: dict[str, Any] = {"error_on_fail": False}
        if plugin == "hpipm":
            residuals = dict.fromkeys(("res_g_max", "res_b_max", "res_d_max", "res_m_max"), TOLERANCE)
            options |= {
                "N": N,
                "nx": [0] + [n] * N,
                "nu": [m + s] * N + [0],
                "ng": [2 * s + m * rated] * N + [0],
                "inf": INFINITE,
                "hpipm": {"mode": "balance", "iter_max": 60} | residuals,
            }
        elif plugin == "qrqp":
            options |= {"print_header": False, "print_iter": False, "print_info": False}
        self._solver = ca.conic("qp", plugin, {"h": layout.h.sparsity, "a": layout.a.sparsity}, options)
        # CasADi keeps the addresses only, and a plugin may read arguments that were never set: set them all.
        names_in, names_out = self._solver.name_in(), self._solver.name_out()
        self._in = {k: np.zeros(max(1, self._solver.nnz_in(k))) for k in names_in}
        self._out = {k: np.zeros(max(1, self._solver.nnz_out(k))) for k in names_out}
        self._buffer: Any
        self._buffer, self._evaluate = self._solver.buffer()
        self._views = [array.data for array in self._out.values()]
        for i, array in enumerate(self._in.values()):
            self._buffer.set_arg(i, array.data)

    def solve(self, qp: StageQp) -> QpSolution:
        """The solution, or one that says it is none."""
        put, at = self._in, self._layout
        constant = qp.c.copy()
        constant[0] += qp.A[0] @ qp.dx0

        scale = 1.0 / max(1.0, np.abs(qp.H_end).max() / self._largest)
        put["h"][:] = scale * at.h.values(
            np.concatenate([qp.H_x.ravel(), qp.H_end.ravel(), qp.H_u.ravel(), qp.l2])
        )
        put["a"][:] = at.a.values(np.concatenate([qp.A.ravel(), qp.B.ravel(), [1.0, -1.0]]))
        put["g"][at.x] = scale * qp.g[1:]
        put["g"][at.u] = scale * qp.r
        put["g"][at.s] = scale * qp.l1
        put["lbx"][at.x], put["ubx"][at.x] = -np.inf, np.inf
        put["lbx"][at.u], put["ubx"][at.u] = qp.u_low, qp.u_high
        put["lbx"][at.s], put["ubx"][at.s] = 0.0, np.inf
        put["lba"][at.gap] = put["uba"][at.gap] = -constant
        # The rows hold A dx + B du ± s, what is missing to dx_{k+1} is the constant.
        put["lba"][at.above], put["uba"][at.above] = -np.inf, qp.high - constant[:, self._soft]
        put["lba"][at.below], put["uba"][at.below] = qp.low - constant[:, self._soft], np.inf
        if qp.rate_low is not None:
            put["lba"][at.rate[1:]], put["uba"][at.rate[1:]] = qp.rate_low, qp.rate_high
            put["lba"][at.rate[:1]], put["uba"][at.rate[:1]] = -np.inf, np.inf
        for cold in ("x0", "lam_x0", "lam_a0"):
            put[cold][:] = 0.0
        for i, view in enumerate(self._views):
            self._buffer.set_res(
                i, view
            )  # plugins use the list of results as work space and leave it changed
        self._evaluate()

        stats = self._buffer.stats()
        z = self._out["x"]
        dx = np.vstack([qp.dx0, z[at.x]])
        solved = bool(stats["success"]) and self._feasible(z)
        # An interior-point solution may be beyond a bound by its tolerance.
        du = np.clip(z[at.u], qp.u_low, qp.u_high)
        return QpSolution(dx, du, z[at.s], solved, int(stats.get("iter_count", -1)), self.plugin)

    def _feasible(self, z: Float[np.ndarray, " k"]) -> bool:
        """Whether bounds and dynamics hold: qrqp has been seen to report success where they did not."""
        if not np.isfinite(z).all():
            return False
        given, A = self._in, self._layout.a
        rows = np.bincount(A.rows, given["a"] * z[A.columns], minlength=len(given["lba"]))
        room = FEASIBLE * (1.0 + np.abs(z).max())
        return bool(
            (given["lbx"] - z <= room).all()
            and (z - given["ubx"] <= room).all()
            and (given["lba"] - rows <= room).all()
            and (rows - given["uba"] <= room).all()
        )


class FallbackQp(QpSolver):
    """A solver, and another one for what the first cannot solve.

    Args:
        first: asked first.
        others: asked one after the other where there is no solution yet.
    """

    def __init__(self, first: QpSolver, *others: QpSolver) -> None:
        self._first, self._others = first, others

    def solve(self, qp: StageQp) -> QpSolution:
        """The first solution that is one, else the last answer."""
        solution = self._first.solve(qp)
        for other in self._others:
            if solution.solved:
                break
            solution = other.solve(qp)
        return solution


def make_qp_solver(N: int, n: int, m: int, soft: Int[np.ndarray, " s"], rated: bool = False) -> QpSolver:
    """The best solver that this CasADi has: hpipm, less exact hpipm, qrqp in this order, or qrqp alone.

    Args:
        N: number of stages.
        n: number of states.
        m: number of inputs.
        soft: indices of the softened states, shape (s,).
        rated: whether the inputs' rate is bounded.
    """
    sparse = ConicQp("qrqp", N, n, m, soft, rated, ROUGH)
    if not ca.has_conic("hpipm"):
        return sparse
    return FallbackQp(*(ConicQp("hpipm", N, n, m, soft, rated, size) for size in (LARGE, ROUGH)), sparse)


@dataclass(frozen=True)
class _Pattern:
    """A sparse matrix whose entries are picked from a list of numbers.

    Args:
        sparsity: the pattern.
        source: for each nonzero, in CasADi's order, its place in the list.
        rows: row of each nonzero.
        columns: column of each nonzero.
    """

    sparsity: ca.Sparsity
    source: NDArray[np.intp]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    def values(self, numbers: Float[np.ndarray, " k"]) -> Float[np.ndarray, " nz"]:
        """The nonzeros, shape (nz,)."""
        picked: NDArray[np.float64] = numbers[self.source]
        return picked


class _Entries:
    """Collects blocks of a sparse matrix."""

    def __init__(self) -> None:
        self._parts: list[tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]] = []

    def block(self, rows: NDArray[np.intp], columns: NDArray[np.intp], source: NDArray[np.intp]) -> None:
        """A full block."""
        r, c = np.meshgrid(rows, columns, indexing="ij")
        self._parts.append((r.ravel(), c.ravel(), np.broadcast_to(source, r.shape).ravel()))

    def diagonal(self, rows: NDArray[np.intp], columns: NDArray[np.intp], source: NDArray[np.intp]) -> None:
        """A diagonal block."""
        self._parts.append((rows, columns, np.broadcast_to(source, rows.shape)))

    def pattern(self, height: int, width: int) -> _Pattern:
        """The matrix."""
        rows, columns, source = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        order = np.lexsort((rows, columns))  # by column, then by row, as CasADi stores
        source, rows, columns = source[order], rows[order], columns[order]
        return _Pattern(
            ca.Sparsity.triplet(height, width, rows.tolist(), columns.tolist()), source, rows, columns
        )


class _Layout:
    """Where everything is: places of variables and constraints, patterns of H and A."""

    def __init__(self, N: int, n: int, m: int, soft: NDArray[np.intp], rated: bool) -> None:
        s, rates = len(soft), m * rated
        self._width, self._height = N * (m + s + n), N * (n + 2 * s + rates)
        first, row = np.arange(N)[:, None] * (m + s + n), np.arange(N)[:, None] * (n + 2 * s + rates)
        self.u = first + np.arange(m)
        self.s = first + m + np.arange(s)
        self.x = first + m + s + np.arange(n)  # x_1 … x_N
        self.gap = row + np.arange(n)
        self.above = row + n + np.arange(s)
        self.below = row + n + s + np.arange(s)
        self.rate = row + n + 2 * s + np.arange(rates)
        self.h = self._hessian(n, m, s)
        self.a = self._constraints(n, m, soft)

    def _hessian(self, n: int, m: int, s: int) -> _Pattern:
        """From the numbers (H_x, H_end, H_u, l2)."""
        H_x = np.arange(n * n).reshape(n, n)
        H_u = 2 * n * n + np.arange(m * m).reshape(m, m)
        l2 = 2 * n * n + m * m + np.arange(s)
        entries = _Entries()
        for k, x in enumerate(self.x):
            entries.block(self.u[k], self.u[k], H_u)
            entries.diagonal(self.s[k], self.s[k], l2)
            entries.block(x, x, H_x if k + 1 < len(self.x) else H_x + n * n)
        return entries.pattern(self._width, self._width)

    def _constraints(self, n: int, m: int, soft: NDArray[np.intp]) -> _Pattern:
        """From the numbers (A, B, 1, −1)."""
        N = len(self.x)
        A = np.arange(N * n * n).reshape(N, n, n)
        B = N * n * n + np.arange(N * n * m).reshape(N, n, m)
        plus = np.array([N * n * (n + m)])
        entries = _Entries()
        for k in range(N):
            for rows, states in ((self.gap[k], np.arange(n)), (self.above[k], soft), (self.below[k], soft)):
                if k:
                    entries.block(rows, self.x[k - 1], A[k, states])
                entries.block(rows, self.u[k], B[k, states])
            entries.diagonal(self.gap[k], self.x[k], plus + 1)
            entries.diagonal(self.above[k], self.s[k], plus + 1)
            entries.diagonal(self.below[k], self.s[k], plus)
            if self.rate.size:
                entries.diagonal(self.rate[k], self.u[k], plus)
                if k:
                    entries.diagonal(self.rate[k], self.x[k - 1, n - m :], plus + 1)
        return entries.pattern(self._height, self._width)

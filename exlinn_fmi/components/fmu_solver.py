"""Dormand and Prince's method over an FMU's own Model Exchange functions, compiled: no Python in the loop.

An evaluation of the model costs the calls into the FMU and next to nothing besides. Inputs are applied inside
the right-hand side, u(t) = u₀ + (t − t₀) du/dt, so that an input that varies over the step is no source of
error. Event indicators are checked after every step and located on the dense output to the last bits of the
time. Events themselves are left to the caller: `integrate` comes back with a code that says why.

References: Hairer, Nørsett and Wanner, *Solving Ordinary Differential Equations I*, 2nd ed., II.4–II.6
(method, step size control, dense output), and *II*, IV.2 (detection of stiffness).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

REACHED, STATE_EVENT, STEP_EVENT, TERMINATE, TOO_MANY_STEPS, NO_PROGRESS, STIFF = range(7)
FAILED = 100
"""What `integrate` returns: a reason, or FAILED · (place of the function in `calls`) + its status."""

INSTANCE, SET_TIME, SET_STATES, GET_DERIVATIVES, GET_INDICATORS, COMPLETED = range(6)
SET_INPUTS, GET_OUTPUTS, VERSION, KEEP, INPUTS, OUTPUTS, FLAGS, WARNED = range(6, 14)
"""Places in `calls`: the instance, addresses of functions, FMI version, whether states are saved, addresses
of the value references of inputs that vary and of outputs that are sampled (0 where the states are), room for
two flags, and a bit for each function that has returned a warning, by its place."""

T, H, STEPS, REJECTED, STIFFNESS, T_INPUT, RTOL = range(7)
"""Places in `clock`: time, next step, counters, steps that looked stiff, time of inputs, tolerance."""

X, ATOL, K1, K2, K3, K4, K5, K6, K7, NEW, STAGE, R2, R3, R4, R5, AT = range(16)
"""Rows of `w`: states and absolute tolerances; rates, states and dense output of the step at hand."""

HERE, THERE, BETWEEN = range(3)
"""Rows of `z`: indicators at the time reached, at the end of the step, and within it."""

VALUE, RATE, NOW = range(3)
"""Rows of `u`: inputs at `clock[T_INPUT]`, their rates of change, and room."""

MOST_STEPS = 100_000
"""Steps in one call before the solver gives up."""

Floats = NDArray[np.float64]


@dataclass
class Model:
    """An FMU as the compiled functions see it, and the room they work in; numba likes few and plain arrays.

    Args:
        calls: (14,) see `INSTANCE` and on.
        clock: (7,) see `T` and on.
        w: [state units] (16, n) see `X` and on.
        z: (3, m) event indicators, see `HERE` and on.
        u: [input units] (3, k) see `VALUE` and on.
        inputs: (k,) value references of the continuous inputs that vary.
        outputs: (p,) value references of the outputs that are sampled.
    """

    calls: NDArray[np.int64]
    clock: Floats
    w: Floats
    z: Floats
    u: Floats
    inputs: NDArray[np.uint32]
    outputs: NDArray[np.uint32]

    @staticmethod
    def make(calls: Any, states: int, indicators: int, rtol: float) -> Model:
        """A model at time 0 of `calls` (10,), without inputs and outputs."""
        none = np.zeros(0, dtype=np.uint32)
        model = Model(
            np.array([*calls, 0, 0, 0, 0], dtype=np.int64),
            np.zeros(7),
            np.zeros((16, states)),
            np.zeros((3, indicators)),
            np.zeros((3, 0)),
            none,
            none,
        )
        model.clock[RTOL] = model.w[ATOL] = rtol
        return model

    def vary(self, inputs: NDArray[np.uint32], values: Floats, rates: Floats) -> None:
        """Let inputs (k,) change from `values` at the time reached, at `rates` [1/s]."""
        self.inputs, self.u = inputs, np.stack([values, rates, np.zeros_like(values)])
        self.calls[INPUTS], self.clock[T_INPUT] = inputs.ctypes.data, self.clock[T]

    def sample(self, outputs: NDArray[np.uint32] | None) -> None:
        """Sample outputs (p,), or the states."""
        self.outputs = np.zeros(0, dtype=np.uint32) if outputs is None else outputs
        self.calls[OUTPUTS] = 0 if outputs is None else outputs.ctypes.data

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What every compiled function takes first."""
        return self.calls, self.clock, self.w, self.z, self.u

    @property
    def t(self) -> float:
        """Time reached [s]."""
        return float(self.clock[T])

    @property
    def x(self) -> Floats:
        """States (n,) at the time reached."""
        states: Floats = self.w[X]
        return states


# ── calls ────────────────────────────────────────────────────────────────────────────────────────────────


@intrinsic
def invoke(_: Any, address: Any, arguments: Any) -> Any:  # pragma: no cover - runs in numba's compiler
    """Call the C function at an address; int64 stands for pointers and size_t, the result is an int."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        unpacked = cgutils.unpack_tuple(builder, values[1])
        kind = ir.FunctionType(ir.IntType(32), [value.type for value in unpacked])
        return builder.call(builder.inttoptr(values[0], kind.as_pointer()), unpacked)

    return types.int32(address, arguments), generate


@njit(cache=True)
def judged(calls: Any, place: int, status: int) -> Any:
    """A status of a function as 0 or a code; a warning is noted."""
    if status == 1:
        calls[WARNED] |= 1 << place
    if status in (0, 1):
        return 0
    return FAILED * place + (status if 0 < status < FAILED else FAILED - 1)


@njit(cache=True)
def apply(calls: Any, clock: Any, w: Any, u: Any, t: float, row: int) -> Any:
    """Give the FMU a time, the states in a row, and inputs where they vary; 0 or a code."""
    instance, n, k = calls[INSTANCE], w.shape[1], u.shape[1]
    code = judged(calls, SET_TIME, invoke(calls[SET_TIME], (instance, t)))
    if code == 0 and n:
        code = judged(calls, SET_STATES, invoke(calls[SET_STATES], (instance, w[row].ctypes.data, n)))
    if code == 0 and k:
        for j in range(k):
            u[NOW, j] = u[VALUE, j] + (t - clock[T_INPUT]) * u[RATE, j]
        values = u[NOW].ctypes.data
        if calls[VERSION] == 2:
            status = invoke(calls[SET_INPUTS], (instance, calls[INPUTS], k, values))
        else:
            status = invoke(calls[SET_INPUTS], (instance, calls[INPUTS], k, values, k))
        code = judged(calls, SET_INPUTS, status)
    return code


@njit(cache=True)
def derivatives(calls: Any, clock: Any, w: Any, u: Any, t: float, row: int, into: int) -> Any:
    """ẋ at t and the states in a row, into another row; 0 or a code."""
    code, n = apply(calls, clock, w, u, t, row), w.shape[1]
    if code == 0 and n:
        status = invoke(calls[GET_DERIVATIVES], (calls[INSTANCE], w[into].ctypes.data, n))
        code = judged(calls, GET_DERIVATIVES, status)
    return code


@njit(cache=True)
def indicators(calls: Any, clock: Any, w: Any, z: Any, u: Any, t: float, row: int, into: int) -> Any:
    """Event indicators at t and the states in a row of `w`, into a row of `z`; 0 or a code."""
    code, m = apply(calls, clock, w, u, t, row), z.shape[1]
    if code == 0 and m:
        status = invoke(calls[GET_INDICATORS], (calls[INSTANCE], z[into].ctypes.data, m))
        code = judged(calls, GET_INDICATORS, status)
    return code


@njit(cache=True)
def switched(z: Any, row: int) -> Any:
    """Whether an indicator has left the domain that it is in HERE, z > 0 or z ≤ 0."""
    for j in range(z.shape[1]):  # noqa: SIM110 - compiled
        if (z[HERE, j] > 0) != (z[row, j] > 0):
            return True
    return False


@njit(cache=True)
def arrive(calls: Any, clock: Any, w: Any, z: Any, u: Any) -> Any:
    """Tell the FMU that a step has ended here; what it wants then is a reason to come back."""
    code = indicators(calls, clock, w, z, u, clock[T], X, HERE)
    if code or not calls[COMPLETED]:
        return code
    calls[FLAGS] = 0
    at = calls.ctypes.data + 8 * FLAGS
    undone = np.int32(calls[KEEP] == 0)
    code = judged(calls, COMPLETED, invoke(calls[COMPLETED], (calls[INSTANCE], undone, at, at + 4)))
    if code:
        return code
    if calls[FLAGS] >> 32:
        return TERMINATE
    return STEP_EVENT if calls[FLAGS] else REACHED


# ── the method ───────────────────────────────────────────────────────────────────────────────────────────


@njit(cache=True)
def attempt(calls: Any, clock: Any, w: Any, u: Any, h: float) -> Any:
    """A step of h with ẋ in row K1: new states in NEW, their rate in K7; 0 or a code."""
    t, n = clock[T], w.shape[1]
    for i in range(n):  # loops, as array expressions would allocate
        w[STAGE, i] = w[X, i] + h / 5 * w[K1, i]
    code = derivatives(calls, clock, w, u, t + h / 5, STAGE, K2)
    if code:
        return code
    for i in range(n):
        w[STAGE, i] = w[X, i] + h * (3 / 40 * w[K1, i] + 9 / 40 * w[K2, i])
    code = derivatives(calls, clock, w, u, t + 3 / 10 * h, STAGE, K3)
    if code:
        return code
    for i in range(n):
        w[STAGE, i] = w[X, i] + h * (44 / 45 * w[K1, i] - 56 / 15 * w[K2, i] + 32 / 9 * w[K3, i])
    code = derivatives(calls, clock, w, u, t + 4 / 5 * h, STAGE, K4)
    if code:
        return code
    for i in range(n):
        slope = 19372 / 6561 * w[K1, i] - 25360 / 2187 * w[K2, i] + 64448 / 6561 * w[K3, i]
        w[STAGE, i] = w[X, i] + h * (slope - 212 / 729 * w[K4, i])
    code = derivatives(calls, clock, w, u, t + 8 / 9 * h, STAGE, K5)
    if code:
        return code
    for i in range(n):
        slope = 9017 / 3168 * w[K1, i] - 355 / 33 * w[K2, i] + 46732 / 5247 * w[K3, i]
        w[STAGE, i] = w[X, i] + h * (slope + 49 / 176 * w[K4, i] - 5103 / 18656 * w[K5, i])
    code = derivatives(calls, clock, w, u, t + h, STAGE, K6)
    if code:
        return code
    for i in range(n):
        slope = 35 / 384 * w[K1, i] + 500 / 1113 * w[K3, i] + 125 / 192 * w[K4, i]
        w[NEW, i] = w[X, i] + h * (slope - 2187 / 6784 * w[K5, i] + 11 / 84 * w[K6, i])
    return derivatives(calls, clock, w, u, t + h, NEW, K7)


@njit(cache=True)
def error_of(w: Any, h: float, rtol: float) -> Any:
    """Estimated error of a step over the tolerance, root mean square."""
    n, total = w.shape[1], 0.0
    for i in range(n):
        e = h * (
            71 / 57600 * w[K1, i]
            - 71 / 16695 * w[K3, i]
            + 71 / 1920 * w[K4, i]
            - 17253 / 339200 * w[K5, i]
            + 22 / 525 * w[K6, i]
            - 1 / 40 * w[K7, i]
        )
        total += (e / (w[ATOL, i] + rtol * max(abs(w[X, i]), abs(w[NEW, i])))) ** 2
    return np.sqrt(total / n) if n else 0.0


@njit(cache=True)
def prepare_dense(w: Any, h: float) -> None:
    """Coefficients of the dense output of the step just made."""
    for i in range(w.shape[1]):
        change = w[NEW, i] - w[X, i]
        slope = h * w[K1, i] - change
        w[R2, i], w[R3, i] = change, slope
        w[R4, i] = change - h * w[K7, i] - slope
        w[R5, i] = h * (
            -12715105075 / 11282082432 * w[K1, i]
            + 87487479700 / 32700410799 * w[K3, i]
            - 10690763975 / 1880347072 * w[K4, i]
            + 701980252875 / 199316789632 * w[K5, i]
            - 1453857185 / 822651844 * w[K6, i]
            + 69997945 / 29380423 * w[K7, i]
        )


@njit(cache=True)
def dense(w: Any, share: float) -> None:
    """States at a share of the step, into row AT."""
    back = 1 - share
    for i in range(w.shape[1]):
        w[AT, i] = w[X, i] + share * (w[R2, i] + back * (w[R3, i] + share * (w[R4, i] + back * w[R5, i])))


@njit(cache=True)
def first_step(calls: Any, clock: Any, w: Any, u: Any, limit: float) -> Any:
    """A step size to begin with, into the clock; 0 or a code (Hairer I, II.4)."""
    n = w.shape[1]
    clock[H] = limit
    if n == 0:
        return 0
    scale = w[ATOL] + clock[RTOL] * np.abs(w[X])
    size, rate = np.sum((w[X] / scale) ** 2), np.sum((w[K1] / scale) ** 2)
    h = 1e-6 if size <= 1e-10 * n or rate <= 1e-10 * n else 0.01 * np.sqrt(size / rate)
    h = min(h, limit)
    w[STAGE] = w[X] + h * w[K1]
    code = derivatives(calls, clock, w, u, clock[T] + h, STAGE, K2)
    bend = np.sum(((w[K2] - w[K1]) / scale) ** 2)
    sharpest = max(np.sqrt(bend / n) / h, np.sqrt(rate / n))
    better = max(1e-6, 1e-3 * h) if sharpest <= 1e-15 else (0.01 / sharpest) ** 0.2
    clock[H] = min(100 * h, better, limit)
    return code


@njit(cache=True)
def note_stiffness(clock: Any, w: Any, h: float) -> None:
    """Count steps whose length stability rather than accuracy bounds (Hairer II, IV.2)."""
    change, apart = 0.0, 0.0
    for i in range(w.shape[1]):
        change += (w[K7, i] - w[K6, i]) ** 2
        apart += (w[NEW, i] - w[STAGE, i]) ** 2
    if apart > 0 and h * h * change > 3.25**2 * apart:
        clock[STIFFNESS] += 1
    else:
        clock[STIFFNESS] = max(clock[STIFFNESS] - 0.2, 0.0)


@njit(cache=True)
def locate(calls: Any, clock: Any, w: Any, z: Any, u: Any, h: float) -> Any:
    """The share of the step after which an indicator has first switched, by bisection, and 0 or a code."""
    t, low, high = clock[T], 0.0, 1.0
    finest = max(4e-16 * max(abs(t), abs(t + h)) / h, 2e-16)
    while high - low > finest:
        middle = 0.5 * (low + high)
        dense(w, middle)
        code = indicators(calls, clock, w, z, u, t + middle * h, AT, BETWEEN)
        if code:
            return high, code
        if switched(z, BETWEEN):
            high = middle
        else:
            low = middle
    return high, 0


@njit(cache=True)
def sample(
    calls: Any, clock: Any, w: Any, u: Any, h: float, share: float, grid: Any, table: Any, row: int
) -> Any:
    """Outputs or states at times up to t + share · h into the table; the next row, and 0 or a code."""
    t, p = clock[T], table.shape[1]
    while row < len(grid) and grid[row] <= t + share * h:
        dense(w, (grid[row] - t) / h)
        if not calls[OUTPUTS]:
            for i in range(p):
                table[row, i] = w[AT, i]
            row += 1
            continue
        code = apply(calls, clock, w, u, grid[row], AT)
        if code:
            return row, code
        at = table[row].ctypes.data
        if calls[VERSION] == 2:
            status = invoke(calls[GET_OUTPUTS], (calls[INSTANCE], calls[OUTPUTS], p, at))
        else:
            status = invoke(calls[GET_OUTPUTS], (calls[INSTANCE], calls[OUTPUTS], p, at, p))
        code = judged(calls, GET_OUTPUTS, status)
        if code:
            return row, code
        row += 1
    return row, 0


@njit(cache=True)
def look_back(
    calls: Any, clock: Any, w: Any, z: Any, u: Any, h: float, grid: Any, table: Any, row: int
) -> Any:
    """After an accepted step: how much of it comes before an event, outputs sampled until then.

    Returns:
        The share of the step, whether there is an event, the next row, and 0 or a code.
    """
    share, event = 1.0, False
    if z.shape[1]:
        code = indicators(calls, clock, w, z, u, clock[T] + h, NEW, THERE)
        if code:
            return share, event, row, code
        event = switched(z, THERE)
    if event or row < len(grid):
        prepare_dense(w, h)
    if event:
        share, code = locate(calls, clock, w, z, u, h)
        if code:
            return share, event, row, code
    row, code = sample(calls, clock, w, u, h, share, grid, table, row)
    return share, event, row, code


@njit(cache=True)
def integrate(
    calls: Any, clock: Any, w: Any, z: Any, u: Any, end: float, grid: Any, table: Any, row: int
) -> Any:
    """Integrate to `end`, or to the first event before.

    Args:
        calls: `Model.arrays` begin; time, states and indicators reached are in them afterwards.
        clock: see `Model`.
        w: see `Model`.
        z: see `Model`.
        u: `Model.arrays` end.
        end: [s] where to.
        grid: [s] (r,) ascending times at which outputs are sampled.
        table: (r, p) gets the samples.
        row: the first row still to be filled.

    Returns:
        Code and next row.
    """
    rejected = False
    code = derivatives(calls, clock, w, u, clock[T], X, K1)
    if code == 0 and not clock[H] > 0:
        code = first_step(calls, clock, w, u, end - clock[T])
    if code:
        return code, row
    for _ in range(MOST_STEPS):
        t = clock[T]
        if t >= end:
            return REACHED, row
        whole = clock[H] * 1.01 >= end - t
        h = end - t if whole else clock[H]
        if not h > 4e-16 * abs(t):
            return NO_PROGRESS, row
        code = attempt(calls, clock, w, u, h)
        # A discarded evaluation, outside the model's domain, is a step too long (FMI 2.0 §3.2.1).
        if code and code % FAILED != 2:
            return code, row
        error = np.inf if code else error_of(w, h, clock[RTOL])
        if not error <= 1:  # also not a number
            clock[H] = h * (max(0.2, 0.9 * error**-0.2) if error < np.inf else 0.2)
            clock[REJECTED] += 1
            rejected = True
            continue
        growth = 10.0 if error < 1e-9 else min(10.0, max(0.2, 0.9 * error**-0.2))
        longer = h * (min(growth, 1.0) if rejected else growth)
        # A step cut short by `end` says little of how long the next may be.
        clock[H] = max(longer, clock[H]) if whole and not rejected else longer
        rejected = False
        note_stiffness(clock, w, h)
        share, event, row, code = look_back(calls, clock, w, z, u, h, grid, table, row)
        if code:
            return code, row
        if share < 1:
            dense(w, share)
        reached, source = (t + share * h, AT) if share < 1 else (end if whole else t + h, NEW)
        w[X] = w[source]
        clock[T] = reached
        clock[STEPS] += 1
        code = arrive(calls, clock, w, z, u)
        if code:
            return code, row
        if event:
            return STATE_EVENT, row
        w[K1] = w[K7]
        if clock[STIFFNESS] >= 15:
            return STIFF, row
    return TOO_MANY_STEPS, row


@njit(cache=True)
def follow(
    calls: Any,
    clock: Any,
    w: Any,
    z: Any,
    u: Any,
    until: float,
    knots: Any,
    values: Any,
    grid: Any,
    table: Any,
    at: Any,
) -> Any:
    """Integrate along inputs that are straight between knots, sampling outputs; stops at an event.

    Args:
        calls: `Model.arrays` begin.
        clock: see `Model`.
        w: see `Model`.
        z: see `Model`.
        u: `Model.arrays` end.
        until: [s] where to, if before the last knot.
        knots: [s] (q,) ascending; the last is where to.
        values: [input units] (q, k) inputs at the knots.
        grid: [s] (r,) ascending times at which outputs are sampled.
        table: (r, p) gets the samples.
        at: (2,) knot and row reached, moved on.

    Returns:
        The code of `integrate`.
    """
    while at[0] < len(knots) - 1:
        k = at[0]
        span = knots[k + 1] - knots[k]
        for j in range(u.shape[1]):
            u[VALUE, j] = values[k, j]
            u[RATE, j] = (values[k + 1, j] - values[k, j]) / span
        clock[T_INPUT] = knots[k]
        end = min(knots[k + 1], until)
        code, at[1] = integrate(calls, clock, w, z, u, end, grid, table, at[1])
        if code or end < knots[k + 1]:
            return code
        at[0] = k + 1
    return REACHED

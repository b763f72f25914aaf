"""The loop of compiled stepping: reads a program of C calls and moves of values, and does it tick by tick.

Importing this imports numba and costs a fraction of a second; the first run on a machine compiles the loop,
which takes seconds, and keeps it in numba's cache. The loop is the same for all graphs: what differs is the
program, a table of numbers that `compiled.py` makes.

Nothing here can run as plain Python (it calls C functions and memory by address), so coverage does not see
it; the tests hold it to the plain stepping, bit by bit.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from inspect import unwrap
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, cfunc, njit, types
from numba.extending import intrinsic

# Acts of a program, in column CODE.
SET, GET, STEP, TABLE, MOVE, TICK, ROW, FINITE, PYTHON = range(9)

# Columns of a program. An act is done at every EVERY-th tick, unless SPAN ticks from there lead beyond the
# end; WHO is a component's number or −1. SET, GET: function, handle, references, count and values are the
# arguments; moves from FIRST to LAST are done before SET and PYTHON, and after GET; CHECKED values from CHECK
# on must be finite after GET and FINITE.
CODE, EVERY, SPAN, WHO, FUNCTION, HANDLE = range(6)
REFERENCES, COUNT, VALUES, COUNTED, FIRST, LAST, CHECK, CHECKED = range(6, 14)
FLAG, EVENT, END, EARLY, REACHED = range(6, 11)  # STEP; EVENT is 0 in FMI 2
WIDTH = 14

# What the loop knows of itself, and what the caller reads and writes.
AT_TICK, AT, UNTIL, FINAL, BASE, RESULT, CLOCK = range(7)
STATES = 7

# What the loop is given: where its arrays lie; their lengths matter no more than their number of columns.
PROGRAM, MOVES, COLUMNS, SIGNALS, ROWS, OWN_STEPS, TIMES, SECONDS, STATE, ACTS, ACROSS = range(11)
ARGUMENTS = 11

# Why the loop returned.
DONE, CALL, STATUS, REFUSED, INFINITE = range(5)
REASONS = 8

# Kinds of moves between memory cells: as they are, from float64 to a type, from a type to float64; or what is
# in the target is scaled by what is read, or that added to it, or held: it is what is read, or is kept there
# where that is not a number. Whole numbers of 64 bits (REST) are stored upon their rest, which is in the
# target already; what is loaded as such is the rest.
FROM, HOLD, SCALE, ADD = 32, 13, 14, 15
TYPES = ("f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "truth1", "truth4")
F8, F4, I1, U1, I2, U2, I4, U4, I8, U8, B1, B4 = range(12)
REST = 8
REST_I8, REST_U8 = I8 + REST, U8 + REST


# ── C calls and memory, by address ───────────────────────────────────────────────────────────────────────

_INT, _DOUBLE = ir.IntType(64), ir.DoubleType()


def _c_function(arguments: str) -> Any:  # pragma: no cover - runs while numba compiles
    """Type and code of a call of ``int f(…)``; pointers, sizes and flags (i) travel in whole registers."""
    kinds = {"i": (types.int64, _INT), "d": (types.float64, _DOUBLE)}
    signature = types.int32(types.int64, *(kinds[a][0] for a in arguments))

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        function = ir.FunctionType(ir.IntType(32), [kinds[a][1] for a in arguments])
        return builder.call(builder.inttoptr(values[0], function.as_pointer()), values[1:])

    return signature, code


def _load_as(kind: Any) -> Any:  # pragma: no cover - runs while numba compiles
    """Type and code of reading a value at an address."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(
            builder.inttoptr(values[0], context.get_data_type(kind).as_pointer()), align=kind.bitwidth // 8
        )

    return kind(types.int64), code


def _store_as(kind: Any) -> Any:  # pragma: no cover - runs while numba compiles
    """Type and code of writing a value to an address."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.store(values[1], builder.inttoptr(values[0], context.get_data_type(kind).as_pointer()))
        return context.get_dummy_value()

    return types.void(types.int64, kind), code


def _as_pointer() -> Any:  # pragma: no cover - runs while numba compiles
    """Type and code of taking an address for a pointer."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.inttoptr(values[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), code


_access2 = intrinsic(lambda context, f, handle, references, count, values: _c_function("iiii"))
_access3 = intrinsic(lambda context, f, handle, references, count, values, again: _c_function("iiiii"))
_step2 = intrinsic(lambda context, f, handle, t, h, flag: _c_function("iddi"))
_step3 = intrinsic(lambda context, f, handle, t, h, flag, event, end, early, reached: _c_function("iddiiiii"))
_pointer = intrinsic(lambda context, at: _as_pointer())
_clock = intrinsic(lambda context, f, which, out: _c_function("ii"))

_get_f8 = intrinsic(lambda context, at: _load_as(types.float64))
_get_f4 = intrinsic(lambda context, at: _load_as(types.float32))
_get_i1 = intrinsic(lambda context, at: _load_as(types.int8))
_get_u1 = intrinsic(lambda context, at: _load_as(types.uint8))
_get_i2 = intrinsic(lambda context, at: _load_as(types.int16))
_get_u2 = intrinsic(lambda context, at: _load_as(types.uint16))
_get_i4 = intrinsic(lambda context, at: _load_as(types.int32))
_get_u4 = intrinsic(lambda context, at: _load_as(types.uint32))
_get_i8 = intrinsic(lambda context, at: _load_as(types.int64))
_get_u8 = intrinsic(lambda context, at: _load_as(types.uint64))
_put_f8 = intrinsic(lambda context, at, value: _store_as(types.float64))
_put_f4 = intrinsic(lambda context, at, value: _store_as(types.float32))
_put_1 = intrinsic(lambda context, at, value: _store_as(types.int8))
_put_2 = intrinsic(lambda context, at, value: _store_as(types.int16))
_put_4 = intrinsic(lambda context, at, value: _store_as(types.int32))
_put_8 = intrinsic(lambda context, at, value: _store_as(types.int64))
_put_u8 = intrinsic(lambda context, at, value: _store_as(types.uint64))


def _compile(function: Callable[..., Any], **options: bool) -> Any:
    """A function as numba compiles it, bare of wrappers that check types while tests run."""
    return njit(unwrap(function), error_model="numpy", **options)


# ── moves of values ──────────────────────────────────────────────────────────────────────────────────────

# Numbers that a type holds, by kind: from LOWEST on, below BEYOND.
LOWEST = (0.0, 0.0, -(2.0**7), 0.0, -(2.0**15), 0.0, -(2.0**31), 0.0, -(2.0**63), 0.0, 0.0, 0.0)
BEYOND = (0.0, 0.0, 2.0**7, 2.0**8, 2.0**15, 2.0**16, 2.0**31, 2.0**32, 2.0**63, 2.0**64, 2.0, 2.0)


def _load(kind: int, at: int) -> float:  # pragma: no cover - compiled
    """The value at an address as float64."""
    if kind == F4:
        return float(_get_f4(at))
    if kind == I1:
        return float(_get_i1(at))
    if kind in (U1, B1):
        return float(_get_u1(at))
    if kind == I2:
        return float(_get_i2(at))
    if kind == U2:
        return float(_get_u2(at))
    if kind in (I4, B4):
        return float(_get_i4(at))
    if kind == U4:
        return float(_get_u4(at))
    if kind == I8:
        return float(_get_i8(at))
    if kind == U8:
        return float(_get_u8(at))
    if kind in (REST_I8, REST_U8):
        bits = _get_i8(at)
        parts = bits >> 11 if kind == REST_I8 else bits >> 11 & (1 << 53) - 1
        above, below = 2048.0 * parts, float(bits & 2047)
        return below - (above + below - above)  # type: ignore[no-any-return]
    return float(_get_f8(at))


def _store(kind: int, value: float, at: int) -> bool:  # pragma: no cover - compiled
    """Put a value into a type; False where it cannot hold it."""
    if kind == F8:
        _put_f8(at, value)
        return True
    if kind == F4:
        _put_f4(at, value)
        return True
    if kind in (REST_I8, REST_U8):
        rest, beyond = _get_i8(at), BEYOND[kind - REST]
        if not (LOWEST[kind - REST] <= value <= beyond and np.floor(value) == value):
            return False
        if value == beyond and rest >= 0:
            return False
        parts = np.floor(value / 2048.0)
        _put_8(at, int(parts) * 2048 + int(value - 2048.0 * parts) + rest)
        return True
    if not (LOWEST[kind] <= value < BEYOND[kind] and np.floor(value) == value):
        return False
    if kind in (I1, U1, B1):
        _put_1(at, int(value))
    elif kind in (I2, U2):
        _put_2(at, int(value))
    elif kind in (I4, U4, B4):
        _put_4(at, int(value))
    elif kind == I8:
        _put_8(at, int(value))
    else:
        _put_u8(at, np.uint64(value))
    return True


_load, _store = _compile(_load), _compile(_store)


EXPONENT = 0x7FF0000000000000
"""Bits of a float64 that are all set where it is not finite."""


def _move(moves: Any, first: int, last: int) -> bool:  # pragma: no cover - compiled
    """Carry values from cell to cell; False at the first that its type cannot hold."""
    for m in range(first, last):
        kind, source, target = moves[m, 0], moves[m, 1], moves[m, 2]
        if kind == F8:
            _put_f8(target, _get_f8(source))
        elif kind >= FROM:
            _put_f8(target, _load(kind - FROM, source))
        elif kind == SCALE:
            _put_f8(target, _get_f8(target) * _get_f8(source))
        elif kind == ADD:
            _put_f8(target, _get_f8(target) + _get_f8(source))
        elif kind == HOLD:
            if np.isnan(_get_f8(source)):
                _put_f8(source, _get_f8(target))
            _put_f8(target, _get_f8(source))
        elif not _store(kind, _get_f8(source), target):
            return False
    return True


def _finite(first: int, count: int) -> bool:  # pragma: no cover - compiled
    """Whether all values from an address on are finite, by their bits: that takes a fraction of the time."""
    bits, found = carray(_pointer(first), count, np.int64), 0
    for m in range(count):
        found |= (bits[m] & EXPONENT ^ EXPONENT) - 1  # negative only where all bits of the exponent are set
    return found >= 0


_move, _finite = _compile(_move), _compile(_finite)

# ── the loop ─────────────────────────────────────────────────────────────────────────────────────────────


def _run(
    program: Any,
    moves: Any,
    columns: Any,
    signals: Any,
    table: Any,
    own_steps: Any,
    span: Any,
    seconds: Any,
    state: Any,
) -> int:  # pragma: no cover - compiled
    """Do a program from `state[AT]` in tick `state[AT_TICK]` until tick `state[UNTIL]`, or until told.

    Args:
        program: (acts, WIDTH) int64, see the columns above.
        moves: (moves, 3) int64: kind, address read, address written.
        columns: where the columns of a row are in `signals`.
        signals: the signal vector; its first entry is the time.
        table: rows, from tick `state[BASE]` on.
        own_steps: (acts, 2) step, and time that it is behind [s].
        span: start time and step [s].
        seconds: time spent by component number, where `state[CLOCK]` is the address of clock_gettime.
        state: see above.

    Returns:
        Why it ended, and `REASONS` times the number of the act that needs the caller if it is not DONE; the
        loop goes on with the one after it.
    """
    tick, at, until, final, clock = state[AT_TICK], state[AT], state[UNTIL], state[FINAL], state[CLOCK]
    base, now = state[BASE], np.zeros(2, np.int64)
    t = span[0] + tick * span[1]
    acts = len(program)
    reason, result = DONE, 0
    if clock:
        _clock(clock, 1, now.ctypes.data)
    before = 1e9 * now[0] + now[1]
    while tick < until or at > 0:
        while at < acts:
            code = program[at, CODE]
            every = program[at, EVERY]
            if every != 1 and (tick % every or tick + program[at, SPAN] > final):
                at += 1
                continue
            if code == SET:
                if not _move(moves, program[at, FIRST], program[at, LAST]):
                    reason = REFUSED
                elif program[at, COUNTED]:
                    result = _access3(
                        program[at, FUNCTION],
                        program[at, HANDLE],
                        program[at, REFERENCES],
                        program[at, COUNT],
                        program[at, VALUES],
                        program[at, COUNTED],
                    )
                else:
                    result = _access2(
                        program[at, FUNCTION],
                        program[at, HANDLE],
                        program[at, REFERENCES],
                        program[at, COUNT],
                        program[at, VALUES],
                    )
            elif code == GET:
                if program[at, COUNTED]:
                    result = _access3(
                        program[at, FUNCTION],
                        program[at, HANDLE],
                        program[at, REFERENCES],
                        program[at, COUNT],
                        program[at, VALUES],
                        program[at, COUNTED],
                    )
                else:
                    result = _access2(
                        program[at, FUNCTION],
                        program[at, HANDLE],
                        program[at, REFERENCES],
                        program[at, COUNT],
                        program[at, VALUES],
                    )
                _move(moves, program[at, FIRST], program[at, LAST])
                if not result and not _finite(program[at, CHECK], program[at, CHECKED]):
                    reason = INFINITE
            elif code == STEP:
                if program[at, EVENT]:
                    result = _step3(
                        program[at, FUNCTION],
                        program[at, HANDLE],
                        t - own_steps[at, 1],
                        own_steps[at, 0],
                        program[at, FLAG],
                        program[at, EVENT],
                        program[at, END],
                        program[at, EARLY],
                        program[at, REACHED],
                    )
                    if not result and (_get_u1(program[at, END]) or _get_u1(program[at, EARLY])):
                        reason = STATUS
                else:
                    result = _step2(
                        program[at, FUNCTION],
                        program[at, HANDLE],
                        t - own_steps[at, 1],
                        own_steps[at, 0],
                        program[at, FLAG],
                    )
            elif code == MOVE:
                _move(moves, program[at, FIRST], program[at, LAST])
            elif code == TABLE:
                for m in range(program[at, COUNT]):
                    _put_f8(program[at, VALUES] + 8 * m, _get_f8(program[at, REFERENCES] + 8 * m))
                program[at, REFERENCES] += 8 * program[at, COUNT]
                if not _finite(program[at, VALUES], program[at, COUNT]):
                    reason = INFINITE
            elif code == TICK:
                tick += 1
                t = span[0] + tick * span[1]
                signals[0] = t
            elif code == ROW:
                row = (tick if program[at, EVERY] == 1 else tick // program[at, EVERY]) - base
                for m in range(len(columns)):
                    table[row, m] = signals[columns[m]]
            elif code == FINITE:
                if not _finite(program[at, CHECK], program[at, CHECKED]):
                    reason = INFINITE
            else:
                _move(moves, program[at, FIRST], program[at, LAST])
                reason = CALL
            if clock:
                _clock(clock, 1, now.ctypes.data)
                after = 1e9 * now[0] + now[1]
                if program[at, WHO] >= 0 and reason != CALL:
                    seconds[program[at, WHO]] += 1e-9 * (after - before)
                before = after
            if result or reason:
                state[AT_TICK], state[AT], state[RESULT] = tick, at + 1, result
                return (reason or STATUS) + REASONS * at  # type: ignore[no-any-return]
            at += 1
        at = 0
    state[AT_TICK], state[AT] = tick, at
    return DONE


_loop = _compile(_run)


def _entry(context: int) -> int:  # pragma: no cover - compiled
    """`_run` with its arguments read from memory: a call from Python costs no more than one of C then."""
    where = carray(_pointer(context), ARGUMENTS, np.int64)
    return _loop(  # type: ignore[no-any-return]
        carray(_pointer(where[PROGRAM]), (where[ACTS], WIDTH), np.int64),
        carray(_pointer(where[MOVES]), (where[ACTS], 3), np.int64),
        carray(_pointer(where[COLUMNS]), where[ACROSS], np.uint64),
        carray(_pointer(where[SIGNALS]), where[ACROSS], np.float64),
        carray(_pointer(where[ROWS]), (where[ACTS], where[ACROSS]), np.float64),
        carray(_pointer(where[OWN_STEPS]), (where[ACTS], 2), np.float64),
        carray(_pointer(where[TIMES]), 2, np.float64),
        carray(_pointer(where[SECONDS]), where[ACTS], np.float64),
        carray(_pointer(where[STATE]), STATES, np.int64),
    )


@cache
def load() -> Callable[[int], int]:
    """The compiled loop as a C function: it takes the address of its arguments and gives why it ended.

    Other threads of Python run while it does.
    """
    signature, entry = types.int64(types.int64), unwrap(_entry)
    try:
        function = cfunc(signature, cache=True)(entry)
    except RuntimeError:  # there is no folder to keep it in
        function = cfunc(signature)(entry)
    call: Callable[[int], int] = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64)(function.address)
    call.compiled = function  # type: ignore[attr-defined]  # which owns the code
    return call

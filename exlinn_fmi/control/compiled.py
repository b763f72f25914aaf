"""The compiled kernel from Python: build it once, give it a problem, call it without creating anything.

`Kernel` holds one problem in one block of memory, whose arrays are numpy views: what is written there the
kernel reads. A tick is `prepare` (before the measurement is there), `feedback` (with it), `finish` and
`shift`; or `solve`. Structured networks are evaluated by the kernel itself, from their weights; any other
model is brought to C by CasADi, compiled once for all, and called by the kernel.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.control.ocp import Ocp
from exlinn_fmi.control.pack import pack_networks
from exlinn_fmi.errors import InputError, RunError
from exlinn_fmi.toolchain import cached_library

FLAGS = (
    "-std=c99",
    "-O3",
    "-ffp-contract=fast",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wno-psabi",
)
"""Fused multiply-add is more exact than what it stands for, and nothing here is compared bit by bit."""

EXPORT = "__declspec(dllexport)" if sys.platform == "win32" else '__attribute__((visibility("default")))'
"""What makes a function of the kernel one that Python finds."""

INTEGERS = frozenset({"softened", "on", "slew", "state"})
"""Arrays of the kernel that hold integers."""

MOST_INPUTS, MOST_STATES = 16, 64
"""What the kernel has room for."""

MOST_INSTRUCTIONS = 50_000
"""Generated functions longer than this take a compiler minutes."""


class Head(ctypes.Structure):
    """`nmpc` of kernel/nmpc.h."""

    _fields_ = [
        *((name, ctypes.c_longlong) for name in ("states", "inputs", "horizon", "softened")),
        *((name, ctypes.c_longlong) for name in ("parameters", "rated")),
        *((name, ctypes.c_longlong) for name in ("substeps", "most", "real_time", "dare", "paper")),
        *(
            (name, ctypes.c_longlong)
            for name in ("status", "reason", "iterations", "rounds", "method", "riccati")
        ),
        *(
            (name, ctypes.c_double)
            for name in (
                "step",
                "tolerance",
                "terminal",
                "set_weight",
                "level",
                "kkt",
                "cost",
                "slack",
                "allowed",
            )
        ),
        ("extend", ctypes.c_longlong),
    ]


class _Model(ctypes.Structure):
    """`nmpc_model` of kernel/nmpc.h."""

    _fields_ = [
        ("integers", ctypes.c_void_p),
        ("numbers", ctypes.c_void_p),
        ("function", ctypes.c_void_p),
        ("integer_work", ctypes.c_longlong),
        ("work", ctypes.c_longlong),
    ]


def kernel_sources() -> dict[str, bytes]:
    """The kernel's C sources by file name; `nmpc.c` includes the others."""
    folder = resources.files("exlinn_fmi.control") / "kernel"
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name.endswith((".c", ".h"))}


class Kernel:
    """One optimal control problem in the compiled kernel.

    Args:
        ocp: the problem.
        iterations: most iterations in a solve.
        tolerance: KKT tolerance.
        real_time: one iteration in a solve that has a plan to start from.

    Attributes:
        head: sizes, options and results, see kernel/nmpc.h.

    Raises:
        InputError: there is no C compiler, or the problem is too large.
        RunError: the compiler failed.
    """

    def __init__(self, ocp: Ocp, iterations: int, tolerance: float, real_time: bool) -> None:
        if ocp.m > MOST_INPUTS or ocp.n > MOST_STATES:
            raise InputError(
                f"the compiled solver has room for {MOST_STATES} states and {MOST_INPUTS} inputs"
            )
        self._library = load(kernel_sources(), "nmpc.c", "-fvisibility=hidden", f"-DNMPC_API={EXPORT}")
        self._library.nmpc_size.restype = ctypes.c_size_t
        self._library.nmpc_array.restype = ctypes.c_void_p
        self.packed = pack_networks(ocp.system)
        """The model's networks as integers and numbers, None where it is a generated function."""
        self._model, self._keep = make_model(self.packed, lambda: ocp.sensitivities)
        options = Head(
            states=ocp.n,
            inputs=ocp.m,
            horizon=ocp.horizon,
            softened=len(ocp.limits.soft),
            parameters=len(ocp.system.parameters) + ocp.system.n,
            rated=ocp.limits.rated,
            substeps=ocp.substeps,
            most=iterations,
            real_time=real_time,
            dare=ocp.terminal == "dare",
            paper=ocp.paper,
            step=ocp.step,
            tolerance=tolerance,
            terminal=0.0 if ocp.terminal == "dare" else ocp.terminal,
            set_weight=ocp.set_weight,
            allowed=ocp.limits.back_off,
        )
        size = self._library.nmpc_size(ctypes.byref(options), ctypes.byref(self._model))
        block = np.zeros(size + 8)
        self.size = size
        """Doubles in the block."""
        self._block = block[-block.ctypes.data % 64 // 8 :][:size]
        self.head = Head.from_buffer(self._block.data)
        ctypes.memmove(ctypes.byref(self.head), ctypes.byref(options), ctypes.sizeof(Head))
        self._call = ctypes.byref(self.head), ctypes.byref(self._model)
        for name in ("prepare", "feedback", "finish", "shift", "solve", "linearise", "program"):
            getattr(self._library, f"nmpc_{name}").restype = None
        self._prepare, self._feedback = self._library.nmpc_prepare, self._library.nmpc_feedback
        self._finish, self._shift = self._library.nmpc_finish, self._library.nmpc_shift
        N, n, m, lim = ocp.horizon, ocp.n, ocp.m, ocp.limits
        self.x0, self.u_last = self.array("x0", n), self.array("u_last", m)
        """Measured state (n,), and the input (m,) that was applied last, for bounds on the rate."""
        self.x_ref, self.u_ref = self.array("x_ref", N + 1, n), self.array("u_ref", N, m)
        """References as given, (N + 1, n) and (N, m)."""
        self.x, self.u = self.array("x", N + 1, n), self.array("u", N, m)
        """The plan, (N + 1, n) and (N, m)."""
        self.on, self.slew = self.array("on", N, m), self.array("slew", N, m)
        self.state = self.array("state", N, len(lim.soft))
        """What each input, its rate and each softened state does: the next program is started from that."""
        self.x_to, self.u_to = self.array("x_to", N + 1, n), self.array("u_to", N, m)
        """What is aimed at: the references within bounds, (N + 1, n) and (N, m)."""
        self.P_end = self.array("P_end", n, n)
        """Terminal weight."""
        self.p = self.array("parameters", len(ocp.system.parameters) + ocp.system.n)
        """Parameters of the prediction: the model's own, then the force on each coordinate."""
        self.p[:] = ocp.parameters(np.zeros(ocp.system.n))
        fixed: dict[str, NDArray[Any]] = {
            "Q": ocp.Q,
            "R": ocp.R,
            "u_min": lim.u_min,
            "u_max": lim.u_max,
            "u_step": lim.u_step,
        }
        fixed |= {"x_min": lim.x_min, "x_max": lim.x_max, "span": lim.span, "softened": lim.soft}
        for name, value in (fixed | {"price": ocp.l1, "price2": ocp.l2}).items():
            self.array(name, *value.shape)[:] = value

    def array(self, name: str, *shape: int) -> NDArray[Any]:
        """The kernel's array of that name, as a view of that shape."""
        address = self._library.nmpc_array(*self._call, name.encode())
        first = (address - self._block.ctypes.data) // 8
        view = self._block[first : first + int(np.prod(shape))].reshape(shape)
        return view.view(np.int64) if name in INTEGERS else view

    def prepare(self) -> None:
        """Linearise at the plan, lay out the references and factor: all that needs no measurement."""
        self._prepare(*self._call)

    def feedback(self) -> None:
        """With the measurement in `x0`: solve the quadratic program, step on; `u[0]` is to be applied."""
        self._feedback(*self._call)

    def finish(self) -> None:
        """KKT residual, cost and violation of the plan."""
        self._finish(*self._call)

    def shift(self) -> None:
        """Move the plan on by one interval."""
        self._shift(*self._call)

    def solve(self, planned: bool) -> None:
        """From `x0` and the plan, or without one, to a solution."""
        self._library.nmpc_solve(*self._call, ctypes.c_int(planned))

    def linearise(self) -> None:
        """Linearise at the plan: arrays `next`, `A` and `B`."""
        self._library.nmpc_linearise(*self._call)

    def program(self) -> None:
        """Solve the quadratic program in the arrays `A` to `l2`."""
        self._library.nmpc_program(*self._call)


def load(sources: Mapping[str, bytes], main: str, *more: str) -> ctypes.CDLL:
    """A library for this processor, or where the compiler does not know how to ask for that, for any.

    Args:
        sources: file names and contents.
        main: the one that is compiled.
        more: flags besides those of all libraries.

    Raises:
        InputError: there is no C compiler.
        RunError: the compiler failed.
    """
    try:
        file = cached_library(sources, main, (*FLAGS, "-march=native", *more))
    except RunError:
        file = cached_library(sources, main, (*FLAGS, *more))
    return ctypes.CDLL(str(file))


def make_model(
    packed: tuple[NDArray[np.int64], NDArray[np.float64]] | None, interval: Callable[[], ca.Function]
) -> tuple[_Model, list[object]]:
    """The model as compiled code takes it, and what has to live as long.

    Args:
        packed: its networks, if it is made of some.
        interval: else the function that says where an interval ends, with its derivatives.

    Raises:
        InputError: there is no C compiler, or the function is too long for it.
        RunError: the compiler failed.
    """
    if packed is not None:
        integers, numbers = packed
        return _Model(integers=integers.ctypes.data, numbers=numbers.ctypes.data), [integers, numbers]
    function = interval()
    if function.n_instructions() > MOST_INSTRUCTIONS:
        raise InputError(f"the model is too long to be compiled ({function.n_instructions()} instructions)")
    generator = ca.CodeGenerator("model.c", {"with_header": False, "casadi_int": "long long int"})
    generator.add(function)
    library = load({"model.c": generator.dump().encode()}, "model.c")
    entry = ctypes.cast(getattr(library, function.name()), ctypes.c_void_p).value
    made = _Model(
        function=entry,
        integer_work=function.sz_iw(),
        work=function.sz_w(),
    )
    return made, [library]

"""An NMPC controller with its estimator as an FMU: the same kernel, and in C what is Python around it.

Signals, kinematics and the inversion of the model make the reference in C as well, so that the FMU runs as
long as it is asked to.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from exlinn_fmi.control import trajectory
from exlinn_fmi.control.compiled import Head, Kernel, kernel_sources
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.control.estimator import Direct, ExtendedKalman, sensitivities
from exlinn_fmi.control.inversion import Inversion
from exlinn_fmi.control.realtime import CompiledGaussNewton
from exlinn_fmi.control.reference import Trajectory
from exlinn_fmi.data.excitation import SAME_TIME, signal_function
from exlinn_fmi.errors import ModelError
from exlinn_fmi.export.c_code import c_array
from exlinn_fmi.export.model import Quantity, Role, StateSpaceModel
from exlinn_fmi.scenario.control import Linear, Nmpc, ScotchYoke
from exlinn_fmi.scenario.signals import (
    Chirp,
    Constant,
    Multisine,
    Prbs,
    Ramp,
    Signal,
    Sine,
    Step,
    Table,
)

TIMES = ("solve_time", "feedback_time")
"""Outputs of a controller in process that its FMU does not have."""

KINDS = ("SINES", "RAMP", "CHIRP", "CYCLE", "TABLE")


def controller_model(
    controller: NmpcController,
    options: Nmpc,
    folder: Path,
    identifier: str,
    description: str = "",
    closed: bool = False,
) -> StateSpaceModel:
    """What an FMU of a controller is made from.

    Args:
        controller: as it would run in process.
        options: its settings.
        folder: folder of the scenario, which file names start from.
        identifier: name of the FMU.
        description: one line.
        closed: whether the prediction model is inside as well, as the plant; its states are outputs then,
            whose start values can be set.

    Raises:
        ModelError: it has a part that there is no C code for; the message says which and what to do.
    """
    parts = controller.parts
    if not isinstance(parts.solver, CompiledGaussNewton):
        raise ModelError(
            f"solver {options.solver!r} ({parts.solver.backend}): only the compiled `rti` and `sqp` become "
            f"an FMU; {parts.solver.reason or 'choose one of them'}"
        )
    if not isinstance(parts.estimator, Direct | ExtendedKalman):
        raise ModelError("estimator `mhe`: there is no C code for it; choose `ekf` or `none`")
    inversion = parts.generator.inversion
    if not inversion.flat:
        raise ModelError(f"reference: {inversion.reason}; only flat references become an FMU")
    ocp, name = parts.ocp, identifier
    given = [v for v in controller.variables if v.causality == "input"]
    told = [v for v in controller.variables if v.causality == "output" and v.name not in TIMES]
    role: Role = "state" if closed else "input"
    inputs = tuple(Quantity(v.name, v.unit or "", v.description or "", role=role) for v in given)
    outputs = tuple(Quantity(v.name, v.unit or "", v.description or "", sampled=True) for v in told)
    z = ca.SX.sym("z", len(inputs))
    every = ca.Function("equations", [z], [ca.DM.ones(len(outputs), len(inputs)) @ z])
    functions = {
        "sample": sensitivities(ocp.system, ocp.substeps),
        "inversion": inversion.equations,
        "completion": inversion.completion,
    }
    if closed:
        functions["rate"] = ocp.system.derivative
    packed = parts.solver.kernel.packed
    if packed is None:
        functions["interval"] = ocp.sensitivities
    generator = ca.CodeGenerator(
        f"{name}_equations.c", {"casadi_int": "long long int", "with_header": False, "with_export": False}
    )
    renamed = [_renamed(f, f"{name}_{key}") for key, f in functions.items()]
    for function in renamed:
        generator.add(function)
    code = {file: text.decode() for file, text in kernel_sources().items()}
    code |= {
        "equations.c": generator.dump(),
        "model.h": f"#define CLOSED {int(closed)}\n#define PLANT_STEP {ocp.system.solver_step({})!r}\n"
        + _sizes(controller, parts.solver.kernel, renamed, inversion)
        + _weights(controller)
        + _estimator(controller)
        + _followed(controller, options, folder)
        + _prediction(packed, ocp.sensitivities, name),
    }
    return StateSpaceModel(
        identifier,
        description or "nonlinear model predictive controller",
        (),
        inputs,
        (),
        (),
        outputs,
        every,
        0.0,
        sample=parts.step,
        code=code,
    )


def _renamed(function: ca.Function, name: str) -> ca.Function:
    """The same function of another name."""
    arguments = function.sx_in()
    return ca.Function(name, arguments, function.call(arguments))


def _enum(values: dict[str, int]) -> str:
    return f"enum {{ {', '.join(f'{name} = {int(value)}' for name, value in values.items())} }};\n"


def _doubles(name: str, values: ArrayLike) -> str:
    """An array that has one element at least, in numbers that C reads: infinity by its name."""
    flat = [float(v) for v in np.ravel(np.asarray(values, dtype=float))] or [0.0]
    if all(np.isfinite(flat)):
        return c_array(name, flat)
    texts = [repr(v) if np.isfinite(v) else f"{'-' * (v < 0)}INFINITY" for v in flat]
    return f"static const double {name}[] = {{{', '.join(texts)}}};\n"


def _integers(name: str, values: Sequence[Any], kind: str = "int") -> str:
    return c_array(name, [int(v) for v in values] or [0], kind)


def _sizes(
    controller: NmpcController, kernel: Kernel, functions: list[ca.Function], inversion: Inversion
) -> str:
    """Numbers that the arrays are declared with."""
    parts = controller.parts
    ocp, estimator = parts.ocp, parts.estimator
    kalman = isinstance(estimator, ExtendedKalman)
    steady = isinstance(estimator, ExtendedKalman) and estimator.fixed is not None
    sizes = {
        "N_X": ocp.n,
        "N_U": ocp.m,
        "N_Q": ocp.system.n,
        "N_D": estimator.d,
        "N_P": len(ocp.system.parameters),
        "HORIZON": ocp.horizon,
        "N_SOFT": len(ocp.limits.soft),
        "N_REFERENCED": len(parts.generator.trajectories),
        "N_UNKNOWN": len(inversion.unknowns),
        "SOLVER_SIZE": -(-kernel.size // 8) * 8,
        "N_ARG": max(4, *(f.sz_arg() for f in functions)),
        "N_RES": max(3, *(f.sz_res() for f in functions)),
        "N_IW": max(1, *(f.sz_iw() for f in functions)),
        "N_W": max(1, *(f.sz_w() for f in functions)),
        "LATE": parts.late,
        "STEADY": steady,
        "STALE": parts.listener.stale or 0,
    }
    head = ", ".join(
        f".{name} = {getattr(kernel.head, name)!r}"
        for name in (entry[0] for entry in Head._fields_)
        if name
        not in (
            "status",
            "reason",
            "iterations",
            "rounds",
            "method",
            "riccati",
            "level",
            "kkt",
            "cost",
            "slack",
        )
    )
    return (
        "/* As many lanes as every processor has: the solver's memory is laid out for no more. */\n"
        "#if defined(__GNUC__)\n#define LANES 2\n#endif\n"
        '#define NMPC_API static\n#include "nmpc.h"\n\n'
        f"#define KALMAN {int(kalman)}\n#define TERMINAL_SET {int(ocp.set_weight > 0.0)}\n"
        f"#define SLOW {int(parts.slow)}\n#define PI 3.141592653589793\n"
        f"{_enum(sizes)}\nstatic const double SAMPLE = {parts.step!r}, SAME_TIME = {SAME_TIME!r};\n"
        f"static const nmpc HEAD_START = {{{head}}};\n\n"
    )


def _weights(controller: NmpcController) -> str:
    """Weights and bounds."""
    parts = controller.parts
    ocp = parts.ocp
    lim = ocp.limits
    arrays = {
        "Q_WEIGHT": ocp.Q,
        "R_WEIGHT": ocp.R,
        "U_MIN": lim.u_min,
        "U_MAX": lim.u_max,
        "U_STEP": lim.u_step,
        "X_MIN": lim.x_min,
        "X_MAX": lim.x_max,
        "SPAN": lim.span,
        "PRICE": ocp.l1,
        "PRICE_2": ocp.l2,
        "SAFE": parts.safe,
        "TIMEOUT": np.inf if parts.listener.timeout is None else parts.listener.timeout,
        "PARAMETERS": ocp.system.parameter_values,
    }
    return "".join(_doubles(k, v) for k, v in arrays.items()) + _integers("SOFT", list(lim.soft), "long long")


def _estimator(controller: NmpcController) -> str:
    """What the estimator knows."""
    estimator = controller.parts.estimator
    noise = estimator.noise
    fixed = estimator.fixed if isinstance(estimator, ExtendedKalman) else None
    arrays = {
        "MEASUREMENT": noise.measurement,
        "PROCESS": noise.process,
        "FORCE": noise.force,
        "WALK": noise.walk,
        "FIRST": noise.first,
        "TURN": np.nan_to_num(estimator.turn),
        "STEADY_COVARIANCE": np.zeros(1) if fixed is None else fixed,
    }
    text = "".join(_doubles(name, values) for name, values in arrays.items())
    return text + _integers("MEASURED", list(noise.measured)) + _integers("DISTURBED", list(noise.disturbed))


def _prediction(packed: tuple[ArrayLike, ArrayLike] | None, interval: ca.Function, name: str) -> str:
    """What the kernel predicts with: networks as numbers, or generated code."""
    if packed is not None:
        integers, numbers = packed
        return (
            _integers("MODEL_INTEGERS", list(np.ravel(integers)), "long long")
            + _doubles("MODEL_NUMBERS", numbers)
            + "#define MODEL_INTERVAL NULL\nenum { N_INTEGER_WORK = 0, N_WORK = 0 };\n"
        )
    return (
        "#define MODEL_INTEGERS NULL\n#define MODEL_NUMBERS NULL\n"
        f"#define MODEL_INTERVAL {name}_interval\n"
        f"nmpc_function {name}_interval;\n"
        f"enum {{ N_INTEGER_WORK = {interval.sz_iw()}, N_WORK = {interval.sz_w()} }};\n"
    )


# ── the reference ────────────────────────────────────────────────────────────────────────────────────────


def _followed(controller: NmpcController, options: Nmpc, folder: Path) -> str:
    """What is followed, and the tables of numerical differentiation."""
    generator = controller.parts.generator
    text = _enum({name: k for k, name in enumerate(KINDS)}) + _enum({"SAME": 0, "LINE": 1, "YOKE": 2})
    text += (
        "typedef struct { int kind, count; const double *numbers; } Signal;\n"
        "typedef struct { Signal signal; int through; double gain, offset; int velocity, state, position; } "
        "Followed;\n"
    )
    rows = []
    for k, (spec, followed) in enumerate(
        zip(options.references.values(), generator.trajectories, strict=True)
    ):
        kind, count, numbers = _signal(spec.trajectory, folder)
        text += _doubles(f"SIGNAL_{k}", numbers)
        rows.append(f"{{{{{kind}, {count}, SIGNAL_{k}}}, {_through(followed)}}}")
    text += f"static const Followed FOLLOWED[] = {{{', '.join(rows)}}};\n"
    text += _integers("UNKNOWNS", list(generator.inversion.unknowns))
    text += (
        f"static const double BIAS = {trajectory.BIAS!r}, SMOOTH = {trajectory.SMOOTH!r}, "
        f"PARABOLIC = {trajectory.PARABOLIC!r};\n"
    )
    kernels, parabola = np.array(trajectory.KERNELS), trajectory.PARABOLA
    return text + _table("KERNELS", kernels) + _table("PARABOLA", parabola)


def _table(name: str, values: np.ndarray) -> str:
    """An array of several dimensions."""
    flat = ", ".join(float(v).hex() for v in np.ravel(values))
    return f"static const double {name}{''.join(f'[{n}]' for n in values.shape)} = {{{flat}}};\n"


def _through(followed: Trajectory) -> str:
    """Kinematics, and which state is followed."""
    through = followed.through
    kinds = {
        type(None): ("SAME", 1.0, 0.0),
        Linear: ("LINE", getattr(through, "gain", 1.0), getattr(through, "offset", 0.0)),
        ScotchYoke: ("YOKE", getattr(through, "crank", 1.0), getattr(through, "margin", 0.0)),
    }
    kind, gain, offset = kinds[type(through)]
    position = -1 if followed.position is None else followed.position
    return f"{kind}, {gain!r}, {offset!r}, {int(followed.velocity)}, {followed.state}, {position}"


def _signal(spec: Signal, folder: Path) -> tuple[str, int, list[float]]:
    """A signal as `signal_at` of controller.c reads it: kind, count and numbers."""
    turn = 2 * np.pi
    match spec:
        case Constant():
            return "SINES", 0, [spec.value, 0.0]
        case Sine():
            return "SINES", 1, [spec.offset, spec.amplitude, turn * spec.frequency, spec.phase]
        case Multisine():
            omega = turn * np.linspace(*spec.band, spec.lines)
            phase = np.random.default_rng(spec.seed).uniform(0.0, turn, spec.lines)
            factor = spec.rms * np.sqrt(2.0 / spec.lines)
            return "SINES", spec.lines, [spec.offset, factor, *np.column_stack([omega, phase]).ravel()]
        case Step():
            return "TABLE", 2, [1.0, -1e300, spec.time, spec.before, spec.after]
        case Ramp():
            length = np.inf if spec.stop is None else max(0.0, spec.stop - spec.start)
            return "RAMP", 0, [spec.offset, spec.slope, spec.start, length]
        case Chirp():
            low, high = spec.band
            logarithmic = float(spec.method == "logarithmic" and low != high)
            return "CHIRP", 0, [spec.offset, spec.amplitude, low, high, spec.duration, logarithmic]
        case Prbs():
            period = 2**spec.order - 1
            levels = signal_function(spec, folder)(spec.hold * (np.arange(period) + 0.5))
            return "CYCLE", period, [spec.hold, *levels]
        case Table():
            import pandas as pd

            table = pd.read_csv(folder / spec.file)
            columns = [table["time"].to_numpy(float), table[spec.column].to_numpy(float)]
            return "TABLE", len(table), [float(spec.interpolation == "hold"), *np.concatenate(columns)]

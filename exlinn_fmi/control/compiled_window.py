"""The passes of moving horizon estimation, compiled: window/window.c, on networks or generated code."""

from __future__ import annotations

import ctypes
from importlib import resources

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.control.compiled import EXPORT, kernel_sources, load, make_model
from exlinn_fmi.control.estimator import Estimator, Window, sensitivities
from exlinn_fmi.control.moving_horizon import Moments, Passes
from exlinn_fmi.control.pack import pack_networks


class _Estimator(ctypes.Structure):
    """`estimator` of window/window.c."""

    _fields_ = [
        *((name, ctypes.c_longlong) for name in ("states", "inputs", "coordinates", "disturbances")),
        *((name, ctypes.c_longlong) for name in ("parameters", "substeps")),
        ("step", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("actuated", "disturbed", "own", "measurement")),
        *((name, ctypes.c_void_p) for name in ("turn", "force", "added")),
    ]


class CompiledPasses(Passes):
    """The passes in compiled code, which keeps nothing from call to call.

    Args:
        estimator: whose samples and measurements they are.
        substeps: RK4 steps in a sample.
        window: largest number of samples.

    Raises:
        InputError: there is no C compiler, or the model is too large.
        RunError: the compiler failed.
    """

    def __init__(self, estimator: Estimator, substeps: int, window: int) -> None:
        system, noise, step = estimator.system, estimator.noise, estimator.step
        source = resources.files("exlinn_fmi.control") / "window" / "window.c"
        sources = kernel_sources() | {"window.c": source.read_bytes()}
        self._library = load(sources, "window.c", "-fvisibility=hidden", f"-DNMPC_API={EXPORT}")
        packed = pack_networks(system, range(system.n))
        model, kept = make_model(packed, lambda: sensitivities(system, substeps))
        arrays: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {
            "actuated": np.array([k for k, c in enumerate(system.coordinates) if c.input], np.int64),
            "disturbed": noise.disturbed.astype(np.int64),
            "own": np.concatenate([system.parameter_values, np.zeros(system.n)]),
            "measurement": np.where(noise.measured, noise.measurement**2, -1.0),
            "turn": np.ascontiguousarray(estimator.turn),
            "force": np.ascontiguousarray(noise.force),
            "added": np.concatenate([noise.process**2, noise.walk**2]) * step,
        }
        head = _Estimator(
            states=estimator.n,
            inputs=len(system.input_names),
            coordinates=system.n,
            disturbances=estimator.d,
            parameters=len(arrays["own"]),
            substeps=substeps,
            step=step,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        self._keep = head, model, kept, arrays
        self._call = ctypes.byref(head), ctypes.byref(model)
        self._library.window_size.restype = ctypes.c_size_t
        size = self._library.window_size(*self._call, ctypes.c_longlong(window))
        block = np.zeros(size + 8)
        self._work = block[-block.ctypes.data % 64 // 8 :][:size]
        self._library.window_carry.restype = self._library.window_smooth.restype = None

    def carried(
        self,
        moments: Moments,
        y: Float[np.ndarray, " n"],
        point: Float[np.ndarray, " z"],
        u: Float[np.ndarray, " m"],
    ) -> Moments:
        """As `Passes.carried`."""
        mean, P = moments[0].copy(), moments[1].copy()
        self._library.window_carry(*self._call, *map(_address, (point, u, y, mean, P, self._work)))
        return mean, P

    def smoothed(
        self, window: Window, y: Float[np.ndarray, " n"], iterations: int
    ) -> tuple[Float[np.ndarray, "k z"], Moments]:
        """As `Passes.smoothed`."""
        points, measured = window.points.copy(), np.vstack([window.y, y])
        mean, P = window.arrival[0].copy(), window.arrival[1].copy()
        sizes = ctypes.c_longlong(len(points)), ctypes.c_longlong(iterations)
        arrays = points, window.u, measured, mean, P, self._work
        self._library.window_smooth(*self._call, *sizes, *map(_address, arrays))
        return points, (mean, P)


def _address(array: NDArray[np.float64]) -> ctypes.c_void_p:
    """Of an array that is laid out row by row."""
    assert array.flags.c_contiguous
    assert array.dtype == np.float64
    return ctypes.c_void_p(array.ctypes.data)

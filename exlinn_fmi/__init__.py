"""Physics-faithful learned models, nonlinear MPC and co-simulation for plants given as FMUs or data.

The public interface; each name is imported when it is first used, so that `import exlinn_fmi` is quick.

    from exlinn_fmi import Run, run
    work = Run.open(Path("scenarios/dcwc_tracking.yaml"))
    print(run(work)["control.rmse_x_m"])
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from exlinn_fmi.components.base import Component, Status, Variable
    from exlinn_fmi.components.python import PythonComponent
    from exlinn_fmi.errors import ExlinnError, InputError, RunError, ScenarioError
    from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter
    from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
    from exlinn_fmi.mechanics.plant import Energies, Output, Plant
    from exlinn_fmi.pipeline import collect, report, run, simulate, train
    from exlinn_fmi.workspace import Run

_HOME = {
    "Component": "components.base",
    "Coordinate": "mechanics.coordinates",
    "Energies": "mechanics.plant",
    "ExlinnError": "errors",
    "InputError": "errors",
    "LagrangianSystem": "mechanics.euler_lagrange",
    "Output": "mechanics.plant",
    "Parameter": "mechanics.coordinates",
    "Plant": "mechanics.plant",
    "PythonComponent": "components.python",
    "Run": "workspace",
    "RunError": "errors",
    "ScenarioError": "errors",
    "Status": "components.base",
    "Variable": "components.base",
    "collect": "pipeline",
    "report": "pipeline",
    "run": "pipeline",
    "simulate": "pipeline",
    "train": "pipeline",
}

__all__ = [
    "Component",
    "Coordinate",
    "Energies",
    "ExlinnError",
    "InputError",
    "LagrangianSystem",
    "Output",
    "Parameter",
    "Plant",
    "PythonComponent",
    "Run",
    "RunError",
    "ScenarioError",
    "Status",
    "Variable",
    "collect",
    "report",
    "run",
    "simulate",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__

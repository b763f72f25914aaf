"""Model Exchange in checkpoints: state of the FMU, solver and events through bytes into a fresh instance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from reference_fmus import reference

from exlinn_fmi.components.fmu import FmuComponent, FmuSettings
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.recorder import Recorder, select
from exlinn_fmi.cosim.stepping import Plain
from exlinn_fmi.scenario.signals import Sine

TICKS = 40
SINE = Sine(signal="sine", amplitude=8.0, frequency=0.7, phase=0.2)


class Run:
    """A run from tick 0, or from a saved state on."""

    def __init__(
        self, path: Path, solver: str, driven: str | None, step: float, state: dict | None = None
    ) -> None:
        self.step = step
        model = FmuComponent("m", path, FmuSettings("model_exchange", solver, 1e-8))
        graph = Graph(
            {"s": SignalSource("s", SINE, Path()), "m": model}, [("s.y", f"m.{driven}")] if driven else []
        )
        recorded = select(graph.components, ["*"])
        self.plan = Plan(graph, list(graph.components.values()), recorded, [1, 1], TICKS, step, False)
        self.recorder = Recorder(["time", *map(graph.path, recorded)], {}, TICKS)
        self.plan.initialize(0.0, TICKS * step, {})
        if state is None:
            self.plan.propagate(0, 0.0)
            self.recorder.record(0, self.plan.signals, self.plan.columns)
        else:
            self.plan.restore(state)

    def rows(self, first: int, until: int) -> bytes:
        """Step, and give the rows after `first`."""
        Plain(self.plan, self.recorder, 0.0, self.step).run(first, until)
        return self.recorder.table[first + 1 : until + 1].tobytes()

    def end(self) -> None:
        """Close everything."""
        for component in self.plan.components:
            component.close()


MODELS = [
    ("BouncingBall", None, 0.11),
    ("Stair", None, 0.21),
    ("VanDerPol", None, 0.25),
    ("Switch", "load", 0.07),
    ("DCMotorCart", "v", 0.01),
]


@pytest.mark.parametrize("solver", ["auto", "dop853", "lsoda", "bdf", "radau"])
@pytest.mark.parametrize(("name", "driven", "step"), MODELS)
def test_a_run_that_is_cut_goes_on_to_the_last_bit(
    root: Path, tmp_path: Path, name: str, driven: str | None, step: float, solver: str
) -> None:
    path = root / "fmus" / f"{name}.fmu" if name == "DCMotorCart" else reference(tmp_path, name, 2)
    whole = Run(path, solver, driven, step)
    expected = whole.rows(0, TICKS)
    whole.end()
    assert len(np.unique(whole.recorder.table[:, 1:])) > 5
    width = len(expected) // TICKS
    for cut in (1, 7, 16, 25, 33, 39):
        first = Run(path, solver, driven, step)
        assert first.rows(0, cut) == expected[: cut * width]
        state = first.plan.save()
        first.end()
        second = Run(path, solver, driven, step, state)
        assert second.rows(cut, TICKS) == expected[cut * width :]
        second.end()

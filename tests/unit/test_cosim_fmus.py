"""What the master does with abilities of FMUs: states on disk, derivatives, inputs that go on in lines."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cosim_helpers import graph

from exlinn_fmi.components.base import Component
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.isolated import isolated_fmu
from exlinn_fmi.cosim.adaptive import AdaptiveOptions
from exlinn_fmi.cosim.extrapolation import ExtrapolationOptions
from exlinn_fmi.cosim.loops import LoopOptions
from exlinn_fmi.cosim.master import Master, Trajectories
from exlinn_fmi.cosim.store import Store
from exlinn_fmi.errors import Interrupted

PLANT = Path(__file__).parents[2] / "fmus" / "DCMotorCart.fmu"
WIRES = ("a.alpha_dot > b.v", "b.alpha_dot > a.v")
STARTS = {"a": {"alpha_dot": 3.0, "l": 2.5}, "b": {"i": 1.0}}
Make = Callable[[str], Component]


def here(name: str) -> Component:
    return FmuComponent(name, PLANT)


def apart(name: str) -> Component:
    return isolated_fmu(name, PLANT, timeout=60.0, memory=None)


def master(*wires: str, make: Make = here, step: float = 0.01, **options: object) -> Master:
    return Master(graph([make("a"), make("b")], *wires), 0.0, 1.0, step, **options)


def run(*wires: str, **options: object) -> Trajectories:
    result = master(*wires, **options).run(STARTS)
    assert result.error is None
    return result


@pytest.mark.parametrize("make", [here, apart])
@pytest.mark.parametrize("compiled", [False, True])
def test_fmus_go_on_from_a_checkpoint_to_the_last_bit(tmp_path: Path, make: Make, compiled: bool):
    expected = run(*WIRES).frame
    asked = iter([False, True])
    options = {"make": make, "compiled": compiled}
    first = master(*WIRES, **options).run(STARTS, None, lambda: next(asked), Store(tmp_path, every=1e9))
    assert isinstance(first.error, Interrupted)
    assert 1 < len(first.frame) < 101
    second = master(*WIRES, **options).run(STARTS, store=Store(tmp_path, every=1e9, resume=True))
    assert second.error is None
    assert second.frame.to_numpy().tobytes() == expected.to_numpy().tobytes()


def test_newton_takes_the_directional_derivatives_of_fmus(monkeypatch: pytest.MonkeyPatch):
    asked = []
    ask = FmuComponent.directional_derivative
    monkeypatch.setattr(
        FmuComponent, "directional_derivative", lambda self, *given: asked.append(given) or ask(self, *given)
    )
    # Each voltage is the other motor's current rate: i' = (v − r i − …)/l, so the loop has gain 0.4.
    result = run("a.i_dot > b.v", "b.i_dot > a.v", loops=LoopOptions())
    assert len(asked) >= 2
    frame = result.frame
    np.testing.assert_allclose(frame["a.v"], frame["b.i_dot"], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(frame["b.v"], frame["a.i_dot"], rtol=1e-8, atol=1e-8)
    assert result.statistics["loop_passes"] <= 3 * len(frame)


@pytest.mark.parametrize(
    ("wires", "options"),
    [
        (("a.i_dot > b.v", "b.i_dot > a.v"), {"loops": LoopOptions("newton")}),
        (WIRES, {"extrapolation": ExtrapolationOptions(2, smooth=True)}),
        (WIRES, {"extrapolation": ExtrapolationOptions(1), "own_steps": {"b": 0.02}}),
    ],
)
def test_algorithms_are_alike_in_compiled_stepping(wires: tuple[str, ...], options: dict):
    plain, fast = (run(*wires, compiled=compiled, **options) for compiled in (False, True))
    assert fast.statistics["stepping"] == "compiled"
    assert fast.frame.to_numpy().tobytes() == plain.frame.to_numpy().tobytes()


def test_lines_into_fmus_are_of_second_order():
    exact = run(*WIRES, step=1e-4, compiled=True, extrapolation=ExtrapolationOptions(2)).frame["a.alpha_dot"]

    def error(step: float, order: int) -> float:
        frame = run(*WIRES, step=step, extrapolation=ExtrapolationOptions(order)).frame
        return float(np.abs(frame["a.alpha_dot"] - exact[:: round(step / 1e-4)].to_numpy()).max())

    assert np.log2(error(0.02, 1) / error(0.01, 1)) > 1.7
    assert error(0.01, 1) < error(0.01, 0) / 10


def test_fmus_go_back_for_adaptive_steps():
    exact = run(*WIRES, step=1e-4, compiled=True, extrapolation=ExtrapolationOptions(2)).frame["a.alpha_dot"]
    result = run(*WIRES, step=0.05, adaptive=AdaptiveOptions(1e-4))
    assert np.abs(result.frame["a.alpha_dot"] - exact[::500].to_numpy()).max() < 1e-2
    assert result.statistics["communication_steps"] > 40

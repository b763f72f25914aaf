"""Adaptive communication steps and extrapolated inputs beside closed forms and orders of convergence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cosim_helpers import Gain, Integrator, graph
from scipy.linalg import expm

from exlinn_fmi.components.base import Component, Indices, Status, Values, Variable
from exlinn_fmi.components.links import Converted
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.cosim.adaptive import AdaptiveOptions
from exlinn_fmi.cosim.extrapolation import ExtrapolationOptions, _polynomial
from exlinn_fmi.cosim.master import Master, Trajectories
from exlinn_fmi.cosim.store import Store
from exlinn_fmi.errors import InputError, Interrupted
from exlinn_fmi.scenario.signals import Step

SPRING, DAMPING = 4.0, 0.3
WIRES = ("a.x > b.other", "b.x > a.other")


class Mass(PythonComponent):
    """m ẍ = −k x − d ẋ + c (other − x), exact for an input that is held, or goes on in a straight line."""

    variables = (
        Variable("other", "input", unit="m"),
        Variable("x", "output", unit="m", start=0.0),
        Variable("v", "output", unit="m/s", start=0.0),
    )

    def __init__(self, name: str, lines: bool = False) -> None:
        super().__init__(name)
        self.lines, self.slope, self.jumps, self.end = lines, 0.0, 0.0, 0.0
        self.matrix = np.zeros((4, 4))  # x, v, input, slope of the input
        self.matrix[0, 1] = self.matrix[2, 3] = 1.0
        self.matrix[1] = [-1.0 - SPRING, -DAMPING, SPRING, 0.0]

    @property
    def takes_input_derivatives(self) -> bool:
        return self.lines

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        self.slope = float(derivatives[0])
        return Status.OK

    def advance(self, t: float, h: float) -> None:
        self.jumps = max(self.jumps, abs(self["other"] - self.end) * (t > 0.05))
        self.end = self["other"] + h * self.slope
        new = expm(h * self.matrix) @ [self["x"], self["v"], self["other"], self.slope]
        self["x"], self["v"], self.slope = new[0], new[1], 0.0


def exact(t: np.ndarray) -> np.ndarray:
    """Position of the first of two masses, x = 1 at the start."""
    one = np.array([[0.0, 1.0], [-1.0 - SPRING, -DAMPING]])
    other = np.array([[0.0, 0.0], [SPRING, 0.0]])
    both = np.block([[one, other], [other, one]])
    return np.array([(expm(time * both) @ [1.0, 0.0, 0.0, 0.0])[0] for time in t])


def run(step: float, lines: bool = False, stop: float = 4.0, **options: object) -> Trajectories:
    parts = [Mass("a", lines), Mass("b", lines)]
    result = Master(graph(parts, *WIRES), 0.0, stop, step, **options).run({"a": {"x": 1.0}})
    assert result.error is None
    return result


def error(result: Trajectories) -> float:
    return float(np.abs(result.frame["a.x"] - exact(result.frame["time"].to_numpy())).max())


# ── adaptive steps ───────────────────────────────────────────────────────────────────────────────────────


def test_a_tighter_tolerance_gives_a_smaller_error():
    errors = [error(run(0.1, adaptive=AdaptiveOptions(tolerance))) for tolerance in (1e-3, 1e-4, 1e-5)]
    assert errors[0] > 2.5 * errors[1] > 2.5**2 * errors[2]
    assert errors[2] < 5e-3
    assert error(run(0.1)) > 20 * errors[1]


def test_rows_are_those_of_the_step_and_statistics_count_what_lies_between():
    result = run(0.1, adaptive=AdaptiveOptions(1e-4))
    np.testing.assert_allclose(result.frame["time"], 0.1 * np.arange(41))
    told = result.statistics
    assert told["stepping"] == "adaptive"
    assert told["communication_steps"] > 80
    assert told["shortest_step"] < 0.05
    assert told["inexact_steps"] == 0


def test_a_loose_tolerance_takes_the_longest_steps():
    told = run(0.1, adaptive=AdaptiveOptions(10.0)).statistics
    assert (told["communication_steps"], told["rejected_steps"]) == (80, 0)
    assert told["shortest_step"] == pytest.approx(0.05)


def test_tolerances_count_by_variable():
    loose = AdaptiveOptions(1e-4, {"*": 1e3})
    assert run(0.1, adaptive=loose).statistics["communication_steps"] == 80
    one = AdaptiveOptions(10.0, {"a.x": 1e-6})
    assert run(0.1, adaptive=one).statistics["communication_steps"] > 400


def test_steps_are_short_at_a_jump_alone():
    parts: list[Component] = [
        SignalSource("s", Step(signal="step", time=1.03, after=1.0), Path()),
        Mass("a"),
        Mass("b"),
    ]
    options = AdaptiveOptions(1e-3, {"*.v": 1e9}, min_step=1e-4)
    wires = ("s.y > a.other", "a.x > b.other")
    result = Master(graph(parts, *wires), 0.0, 3.0, 0.1, adaptive=options).run()
    assert result.error is None
    assert result.statistics["shortest_step"] < 2e-3
    # Where the jump is met, the step response is exact to where it began: within the shortest steps.
    response = expm((3.0 - 1.03) * parts[1].matrix) @ [0, 0, 1.0, 0]
    assert result.frame["a.x"].iloc[-1] == pytest.approx(response[0], abs=2e-3)


def test_a_step_that_may_not_be_shorter_is_kept_and_counted():
    told = run(0.1, adaptive=AdaptiveOptions(1e-9, min_step=0.02)).statistics
    assert told["inexact_steps"] > 0
    assert told["shortest_step"] == pytest.approx(0.025)


def test_extrapolation_makes_adaptive_steps_longer():
    held = run(0.2, adaptive=AdaptiveOptions(1e-5))
    line = run(0.2, adaptive=AdaptiveOptions(1e-5), extrapolation=ExtrapolationOptions(1))
    assert line.statistics["communication_steps"] < held.statistics["communication_steps"] / 4
    assert error(line) < 1e-3


def test_controllers_keep_to_their_ticks():
    controller = Gain("c", -2.0, 1.0, sampled=True)
    master = Master(
        graph([Mass("a"), controller], "a.x > c.u", "c.y > a.other"),
        0.0,
        1.0,
        0.1,
        adaptive=AdaptiveOptions(1e-6),
    )
    result = master.run()
    assert [c for c in controller.calls if c.startswith("step")] == [
        f"step {0.1 * k:.9g} 0.1" for k in range(10)
    ]
    assert len(result.frame) == 11


def test_components_that_cannot_go_back_are_named():
    master = Master(graph([Mass("a"), Integrator("stuck")]), 0.0, 1.0, 0.1, adaptive=AdaptiveOptions())
    with pytest.raises(InputError, match="adaptive: stuck cannot save and restore"):
        master.run()


def test_a_shortest_step_that_leaves_no_choice_is_refused():
    with pytest.raises(InputError, match=r"min_step 0\.09 s leaves no choice; .* 0\.05 s"):
        run(0.1, adaptive=AdaptiveOptions(min_step=0.09))


def test_tolerances_of_what_is_not_there_are_refused():
    with pytest.raises(InputError, match=r"nothing fits 'a\.y'"):
        run(0.1, adaptive=AdaptiveOptions(tolerances={"a.y": 1.0}))


@pytest.mark.parametrize("options", [{}, {"extrapolation": ExtrapolationOptions(2, True)}])
def test_an_adaptive_run_goes_on_from_a_checkpoint_alike(tmp_path: Path, options: dict):
    def master() -> Master:
        options_ = {"adaptive": AdaptiveOptions(1e-4), **options}
        return Master(graph([Mass("a"), Mass("b")], *WIRES), 0.0, 2.0, 0.1, **options_)

    starts = {"a": {"x": 1.0}}
    expected = master().run(starts)
    asked = iter([*[False] * 7, True])
    first = master().run(starts, should_stop=lambda: next(asked), store=Store(tmp_path, every=1e9))
    assert isinstance(first.error, Interrupted)
    second = master().run(starts, store=Store(tmp_path, every=1e9, resume=True))
    assert second.frame.to_numpy().tobytes() == expected.frame.to_numpy().tobytes()
    assert second.statistics["communication_steps"] == expected.statistics["communication_steps"]


# ── extrapolation ────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("order", "lines", "expected"), [(0, False, 1), (1, False, 2), (2, False, 2), (1, True, 2), (2, True, 2)]
)
def test_errors_shrink_with_the_order(order: int, lines: bool, expected: int):
    options = {"extrapolation": ExtrapolationOptions(order)}
    coarse, fine = (error(run(step, lines, **options)) for step in (0.02, 0.01))
    assert np.log2(coarse / fine) == pytest.approx(expected, abs=0.25)


def test_lines_are_better_than_means_and_parabolas_better_than_lines():
    errors = [error(run(0.05, lines, extrapolation=ExtrapolationOptions(order)))
              for order, lines in ((0, False), (1, False), (2, False))]  # fmt: skip
    assert errors[0] > 5 * errors[1]
    assert errors[1] > 1.5 * errors[2]


@pytest.mark.parametrize("smooth", [False, True])
def test_smooth_inputs_do_not_jump(smooth: bool):
    parts = [Mass("a", lines=True), Mass("b", lines=True)]
    options = ExtrapolationOptions(1, smooth)
    result = Master(graph(parts, *WIRES), 0.0, 4.0, 0.02, extrapolation=options).run({"a": {"x": 1.0}})
    assert (max(part.jumps for part in parts) < 1e-12) == smooth
    assert error(result) < 0.02


def test_what_is_sampled_is_held():
    parts = [Mass("a"), Gain("c", -2.0, 1.0, sampled=True)]
    wires = ("a.x > c.u", "c.y > a.other")
    held = Master(graph(parts, *wires), 0.0, 1.0, 0.1).run()
    same = Master(graph(parts, *wires), 0.0, 1.0, 0.1, extrapolation=ExtrapolationOptions(2)).run()
    assert held.frame.equals(same.frame)


def test_inputs_that_are_converted_on_the_way_are_converted_once():
    parts = [Mass("a"), Mass("b")]
    wrapped = Converted(Mass("b"), {0: (-2.0, 0.1)})
    options = {"extrapolation": ExtrapolationOptions(1)}
    expected, found = (
        Master(graph([parts[0], b], "a.x > b.other"), 0.0, 1.0, 0.1, **options).run({"a": {"x": 1.0}})
        for b in (parts[1], wrapped)
    )
    assert found.error is None
    given = -2.0 * expected.frame["b.other"] + 0.1
    np.testing.assert_allclose(found.frame["b.other"], given, atol=1e-15)
    # Linear in the input: with −2 u + 0.1 in place of u, x = −2 x(u) + 0.1 x(1), where x(1) is held.
    held = Master(graph([Mass("b")]), 0.0, 1.0, 0.1).run({"b": {"other": 1.0}}).frame["b.x"]
    np.testing.assert_allclose(found.frame["b.x"], -2.0 * expected.frame["b.x"] + 0.1 * held, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_polynomials_are_met_exactly(count: int):
    coefficients = np.array([0.7, -2.0, 3.0])[:count]
    times = [0.0, 0.3, 0.5][:count]
    value = np.polynomial.Polynomial(coefficients)
    h, last = 0.2, times[-1]
    end, mean = _polynomial([(t, np.array([value(t)])) for t in times], h)
    area = value.integ()
    assert end[0] == pytest.approx(value(last + h), abs=1e-12)
    assert mean[0] == pytest.approx((area(last + h) - area(last)) / h, abs=1e-12)

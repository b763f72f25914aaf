"""Algebraic loops beside their solutions, by every solver, and what is said where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from cosim_helpers import Gain, Integrator, Small, Source, run
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Indices, Status, Values, Variable
from exlinn_fmi.cosim.loops import SOLVERS, LoopOptions
from exlinn_fmi.errors import ComponentError, InputError, LoopError


class Function(Small):
    """y = function(u), w = t u, with direct feed-through, and its derivative where one is given."""

    def __init__(
        self,
        name: str,
        function: Callable[[float], float],
        derivative: Callable[[float], float] | None = None,
        start: float = 0.0,
    ) -> None:
        through = ("u",)
        super().__init__(
            name,
            Variable("u", "input", start=start),
            Variable("y", "output", depends_on=through),
            Variable("seen", "output", depends_on=through),
        )
        self.function, self.derivative, self.asked = function, derivative, 0

    def react(self) -> None:
        self["y"], self["seen"] = self.function(self["u"]), self["u"]

    @property
    def gives_directional_derivatives(self) -> bool:
        return self.derivative is not None

    def directional_derivative(self, unknowns: Indices, knowns: Indices, seed: Values) -> Values:
        self.asked += 1
        slopes = {1: self.derivative(self["u"]), 2: 1.0}
        return np.array([slopes[int(k)] * seed[0] for k in unknowns])


LOOP = ("a.y > b.u", "b.y > a.u")
COS = 0.7390851332151607
"""cos x = x."""


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("known", [False, True])
def test_a_nonlinear_loop_is_solved(solver: str, known: bool):
    parts = [
        Function("a", math.cos, (lambda u: -math.sin(u)) if known else None),
        Function("b", lambda u: u, (lambda u: 1.0) if known else None),
    ]
    result = run(parts, *LOOP, loops=LoopOptions(solver, 1e-12, 200))
    assert result.error is None
    np.testing.assert_allclose(result.frame[["a.y", "b.y", "a.u", "b.u"]], COS, atol=1e-11)
    assert (parts[0].asked > 0) == (known and solver == "newton")
    assert result.statistics["loop_passes"] > 0
    assert result.statistics["loop_residual"] <= 1e-12


@pytest.mark.parametrize("solver", ["newton", "anderson", "aitken"])
def test_a_loop_whose_passes_run_away_is_solved_all_the_same(solver: str):
    # y = 3 − 2 u and u = y: the fixed point 1 repels.
    parts = [Gain("a", -2.0, 3.0), Gain("b")]
    result = run(parts, *LOOP, loops=LoopOptions(solver))
    np.testing.assert_allclose(result.frame["a.y"], 1.0, atol=1e-8)


def test_newton_needs_one_pass_per_point_on_a_linear_loop_that_moves():
    parts = [Source("s", lambda t: t), Sum("a"), Gain("b", 0.5)]
    result = run(parts, "s.y > a.v", "a.y > b.u", "b.y > a.u", loops=LoopOptions())
    np.testing.assert_allclose(result.frame["a.y"], 2 * result.frame["time"], atol=1e-12)
    assert result.statistics["loop_passes"] == 10


class Sum(Small):
    """y = u + v."""

    def __init__(self, name: str) -> None:
        through = ("u", "v")
        super().__init__(
            name, Variable("u", "input"), Variable("v", "input"), Variable("y", "output", depends_on=through)
        )

    def react(self) -> None:
        self["y"] = self["u"] + self["v"]


def test_what_follows_from_a_loop_belongs_to_its_solution():
    parts = [
        Source("s", lambda t: 1 + t),
        Sum("a"),
        Gain("b", 0.5),
        Gain("after", 3.0),
        Integrator("state"),
    ]
    wires = ("s.y > a.v", "a.y > b.u", "b.y > a.u", "b.y > after.u", "after.y > state.u")
    frame = run(parts, *wires, loops=LoopOptions()).frame
    np.testing.assert_allclose(frame["after.y"], 3 * (1 + frame["time"]), rtol=1e-12)
    np.testing.assert_allclose(frame["state.u"], 3 * (1 + frame["time"]), rtol=1e-12)
    # The integrator was stepped with it too: Σ h · 3 (1 + t).
    np.testing.assert_allclose(
        frame["state.y"][1:], np.cumsum(0.1 * 3 * (1 + frame["time"]))[:-1], rtol=1e-12
    )


@given(
    st.lists(st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3), min_size=3, max_size=3),
    st.lists(st.floats(-5, 5), min_size=3, max_size=3),
    st.sampled_from(SOLVERS),
)
@settings(max_examples=40, deadline=None)
def test_coupled_linear_loops_are_solved(matrix: list[list[float]], offset: list[float], solver: str):
    """x = A x + b, spread over three components with three inputs each."""

    class Row(Small):
        def __init__(self, name: str, row: list[float], offset: float) -> None:
            inputs = [Variable(f"u{k}", "input") for k in range(3)]
            super().__init__(name, *inputs, Variable("y", "output", depends_on=("u0", "u1", "u2")))
            self.row, self.offset = row, offset

        def react(self) -> None:
            self["y"] = float(np.dot(self.row, self.values[:3])) + self.offset

    parts = [Row(f"r{k}", matrix[k], offset[k]) for k in range(3)]
    wires = [f"r{a}.y > r{b}.u{a}" for a in range(3) for b in range(3)]
    result = run(parts, *wires, stop=0.1, loops=LoopOptions(solver, 1e-11, 400))
    assert result.error is None
    found = result.frame[[f"r{k}.y" for k in range(3)]].to_numpy()[-1]
    np.testing.assert_allclose(found, np.linalg.solve(np.eye(3) - matrix, offset), atol=1e-8)


def test_only_components_in_the_loop_are_passed_around():
    parts = [Source("s", lambda t: 1.0), Function("a", math.cos), Gain("b"), Gain("after", 2.0)]
    run(parts, *LOOP, "b.y > after.u", loops=LoopOptions("fixed-point", iterations=99), stop=0.1)
    assert parts[0].calls.count("get") == 3  # in initialisation and at two points
    assert parts[1].calls.count("get") > 20
    assert parts[3].calls.count("get") <= 6


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_loop_without_a_solution_is_an_error_that_names_it(solver: str):
    parts = [Function("a", lambda u: u + 1 + u * u), Gain("b")]
    result = run(parts, *LOOP, loops=LoopOptions(solver, iterations=30))
    assert isinstance(result.error, LoopError)
    text = str(result.error)
    assert text.startswith("algebraic loop a.u — a.y — b.u — b.y at t = 0 s: no solution found by")
    assert "loops.solver" in text
    assert len(result.frame) == 0


def test_a_derivative_of_one_around_a_loop_is_an_error():
    parts = [Function("a", lambda u: u + 1, lambda u: 1.0), Function("b", lambda u: u, lambda u: 1.0)]
    assert "the derivative around the loop is 1" in str(run(parts, *LOOP, loops=LoopOptions()).error)


def test_the_loop_that_fits_worst_is_named():
    good = [Function("a", math.cos), Gain("b")]
    bad = [Function("c", lambda u: u + 1), Gain("d")]
    wires = (*LOOP, "c.y > d.u", "d.y > c.u")
    result = run([*good, *bad], *wires, loops=LoopOptions("fixed-point"))
    assert "algebraic loop c.u — c.y — d.u — d.y" in str(result.error)


def test_a_component_that_fails_in_a_pass_says_so_itself():
    class Root(Function):
        def get(self, indices: Indices, values: Values) -> Status:
            if self["u"] < 0:
                self.message = "negative"
                return Status.ERROR
            return super().get(indices, values)

    result = run([Root("a", lambda u: -1 - u), Gain("b")], *LOOP, loops=LoopOptions("fixed-point"))
    assert isinstance(result.error, ComponentError)
    assert "negative" in str(result.error)


def test_several_rates_are_solved_where_they_meet():
    parts = [Source("s", lambda t: t), Sum("a"), Gain("b", 0.5)]
    wires = ("s.y > a.v", "a.y > b.u", "b.y > a.u")
    frame = run(parts, *wires, loops=LoopOptions(), own_steps={"b": 0.2}).frame
    np.testing.assert_allclose(frame["a.y"][::2], 2 * frame["time"][::2], atol=1e-9)
    np.testing.assert_allclose(frame["a.y"][1::2], frame["time"][1::2] + frame["b.y"][1::2], atol=1e-9)


def test_unknown_solver_is_refused():
    with pytest.raises(InputError, match=r"loops: there is no solver 'newtn'; did you mean 'newton'\?"):
        run([Integrator("a")], loops=LoopOptions("newtn"))


def test_without_loops_nothing_changes():
    parts = [Integrator("a", 1.0), Integrator("b")]
    plain = run(parts, *LOOP)
    solved = run(parts, *LOOP, loops=LoopOptions())
    assert plain.frame.equals(solved.frame)
    assert "loop_passes" not in solved.statistics

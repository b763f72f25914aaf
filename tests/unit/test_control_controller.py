"""The controller as a component: contract, fallbacks, warnings."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from control_helpers import CART, STEP, arm, constant, controller, measure, motor_cart, oscillator

from exlinn_fmi.components.base import Status
from exlinn_fmi.control.solver import Plan, Solution, Solver, SolveStatus, Stats
from exlinn_fmi.errors import DataError, InputError, ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.scenario.control import Linear, Reference, Weights
from exlinn_fmi.scenario.signals import Table

START = (np.pi / 2, 0.0, 0.0)


class Failing(Solver):
    """A solver that fails at the ticks it is told to."""

    def __init__(self, inner: Solver, ticks: set[int]) -> None:
        self.inner, self.ticks, self.count = inner, ticks, -1

    def solve(self, x0, references, guess=None, applied=None):
        self.count += 1
        if self.count in self.ticks:
            return Solution(references.x, references.u, SolveStatus.FAILED, Stats(message="told to fail"))
        return self.inner.solve(x0, references, guess, applied)


def untimed(outputs: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in outputs.items() if not name.endswith("_time")}


def failing(ticks: set[int], **options):
    made = controller(**options)
    made._solver = Failing(made._solver, ticks)
    return made


# ── contract ─────────────────────────────────────────────────────────────────────────────────────────────


def test_variables_are_states_then_inputs_then_how_they_came_about():
    made = controller()
    assert [v.name for v in made.variables if v.causality == "input"] == ["alpha", "alpha_dot", "i"]
    assert [v.name for v in made.variables if v.causality == "output"] == [
        "v",
        "reference",
        "reference_alpha",
        "reference_alpha_dot",
        "reference_i",
        "estimate_alpha",
        "estimate_alpha_dot",
        "estimate_i",
        "disturbance_alpha",
        "disturbance_Q",
        "cost",
        "stage_cost",
        "cost_disturbance",
        "solve_status",
        "missing",
        "iterations",
        "kkt",
        "solve_time",
        "feedback_time",
        "fallbacks",
        "slack",
    ]
    units = {v.name: v.unit for v in made.variables}
    assert (units["alpha"], units["i"], units["v"], units["reference"]) == ("rad", "A", "V", "m")
    assert made.variables[made.index("v")].depends_on == ("alpha", "alpha_dot", "i")
    assert made.sampled


@pytest.mark.parametrize(
    ("reference", "unit"),
    [
        (constant("x", 0.0), "m"),
        (constant("x", 0.0).model_copy(update={"through": Linear(map="linear")}), None),
        (CART.model_copy(update={"trajectory": constant("x", 0.0).trajectory}), "m"),
    ],
)
def test_unit_of_the_reference_is_taken_from_where_it_is_known(reference, unit):
    made = controller(motor_cart() if reference.coordinate == "alpha" else oscillator(), reference=reference)
    assert made.variables[made.index("reference")].unit == unit


def test_outputs_answer_the_measurements_of_the_same_tick():
    made = controller(weights=Weights(states=10.0, inputs=1e-3))
    one, _ = measure(made, *START)
    other, _ = measure(made, np.pi / 2, -4.0, 0.0)
    again, _ = measure(made, *START)
    assert one["v"] != other["v"]
    assert one["v"] == again["v"]


def test_one_tick_is_solved_once():
    made = failing(set())
    for _ in range(3):
        measure(made, *START)
    made.step(0.0, STEP)
    assert made._solver.count == 0


def test_reading_measurements_back_solves_nothing():
    made = failing(set())
    made.set(made.indices("input"), np.array(START))
    values = np.zeros(3)
    assert made.get(made.indices("input"), values) == Status.OK
    np.testing.assert_array_equal(values, START)
    assert made._solver.count == -1


def test_reference_outputs_are_those_of_the_tick():
    made = controller()
    measure(made, *START)
    for k in range(3):
        made.step(k * STEP, STEP)
    outputs, _ = measure(made, *START)
    x = 0.15 * np.sin(2 * np.pi * 0.4 * 0.03)
    assert outputs["reference"] == pytest.approx(x)
    assert outputs["reference_alpha"] == pytest.approx(np.arccos(x / 0.2))


def test_branch_is_decided_by_the_first_measurement_and_kept():
    made = controller()
    outputs, _ = measure(made, 2 * np.pi + 1.5, 0.0, 0.0)
    assert outputs["reference_alpha"] == pytest.approx(2.5 * np.pi)
    made.step(0.0, STEP)
    outputs, _ = measure(made, 3 * np.pi + 0.1, 0.0, 0.0)
    assert 2 * np.pi < outputs["reference_alpha"] < 3 * np.pi


class Watched(Solver):
    """A solver that notes what it is asked for."""

    def __init__(self, inner: Solver) -> None:
        self.inner, self.asked = inner, []

    def prepare(self, references, guess, applied=None):
        self.asked.append(("prepare", references.time, guess))
        self.inner.prepare(references, guess, applied)

    def feedback(self, x0):
        self.asked.append(("feedback",))
        return self.inner.feedback(x0)

    def solve(self, x0, references, guess=None, applied=None):
        self.asked.append(("solve",))
        return self.inner.solve(x0, references, guess, applied)


def test_a_tick_is_prepared_when_the_one_before_is_done_and_needs_feedback_alone():
    made = controller()
    made._solver = watched = Watched(made._solver)
    first, _ = measure(made, *START)
    made.step(0.0, STEP)
    assert [asked[0] for asked in watched.asked] == ["solve", "prepare"]
    _, time, guess = watched.asked[-1]
    assert time == STEP
    system = motor_cart()
    expected = evaluate(system.rk4(), list(START), [first["v"]], system.parameter_values, [STEP])[0]
    np.testing.assert_allclose(guess.x[0], expected, atol=1e-12)  # where the measurement is expected
    outputs, _ = measure(made, *expected)
    assert [asked[0] for asked in watched.asked] == ["solve", "prepare", "feedback"]
    assert 0.0 < outputs["feedback_time"] < outputs["solve_time"]
    # Where the measurement is as expected, feedback is a whole iteration.
    other = controller()
    measure(other, *START)
    other.step(0.0, STEP)
    other._memory = replace(other._memory, coming=None)
    assert outputs["v"] == pytest.approx(measure(other, *expected)[0]["v"], abs=1e-9)


def test_a_measurement_that_changes_within_a_tick_is_answered_as_if_it_had_come_first():
    answers = []
    for before in (None, (1.4, 2.0, 1.0)):
        made = controller()
        measure(made, *START)
        made.step(0.0, STEP)
        if before:
            measure(made, *before)
        answers.append(untimed(measure(made, 1.5, 0.3, 0.2)[0]))
    assert answers[0] == answers[1]


def test_nothing_is_prepared_before_the_state_is_known():
    made = controller()
    made._solver = watched = Watched(made._solver)
    measure(made, np.nan, 0.0, 0.0)
    made.step(0.0, STEP)
    measure(made, *START)
    assert [asked[0] for asked in watched.asked] == ["solve", "solve"]


def test_a_restored_state_goes_on_as_the_saved_one_did():
    made = controller()
    measure(made, *START)
    made.step(0.0, STEP)
    saved = made.save_state()
    assert made.can_save_state
    first = [measure(made, 1.5, 0.3, 0.2)[0]]
    made.step(STEP, STEP)
    first.append(measure(made, 1.4, 0.5, 0.4)[0])
    made.restore_state(saved)
    second = [measure(made, 1.5, 0.3, 0.2)[0]]
    made.step(STEP, STEP)
    second.append(measure(made, 1.4, 0.5, 0.4)[0])
    for one, other in zip(first, second, strict=True):
        assert untimed(one) == untimed(other)


def test_a_second_run_is_as_the_first():
    made = controller()
    first = measure(made, *START)[0]
    made.step(0.0, STEP)
    measure(made, 1.0, 1.0, 1.0)
    made.enter_initialization(0.0, 1.0, {})
    second = measure(made, *START)[0]
    assert first["v"] == second["v"]
    made.close()
    made.close()


def test_start_values_are_measurements():
    made = controller()
    made.enter_initialization(0.0, np.inf, {"alpha": 1.2})
    values = np.zeros(1)
    made.get(np.array([0]), values)
    assert values == [1.2]


def test_unknown_start_value_is_refused():
    with pytest.raises(InputError, match=r"components.controller.start.alhpa: .* did you mean 'alpha'"):
        controller().enter_initialization(0.0, 1.0, {"alhpa": 1.0})


def test_a_table_too_short_for_the_run_is_refused_before_it(tmp_path):
    table = tmp_path / "path.csv"
    table.write_text("time,y\n0,0\n1,0.1\n")
    signal = Table(signal="table", file=str(table), column="y", outside="error")
    made = controller(
        oscillator(),
        reference=Reference(coordinate="x", trajectory=signal.model_copy(update={"outside": "hold"})),
    )
    made.enter_initialization(0.0, 2.0, {})
    with pytest.raises(DataError):
        controller(oscillator(), reference=Reference(coordinate="x", trajectory=signal))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"safe_input": {"w": 1.0}}, r"^components.controller.nmpc.safe_input: the model has no 'w'"),
        ({"weights": Weights(states={"w": 1.0})}, r"^components.controller.nmpc.weights.states"),
        ({"reference": constant("w", 0.0)}, r"^components.controller.nmpc.reference.coordinate"),
    ],
)
def test_wrong_settings_are_refused_with_their_place(options, message):
    with pytest.raises(ModelError, match=message):
        controller(**options)


# ── fallbacks ────────────────────────────────────────────────────────────────────────────────────────────


def test_a_failed_solve_goes_on_with_the_shifted_plan():
    made = failing({1, 2})
    good = measure(made, *START)[0]
    plan = made._following.plan
    made.step(0.0, STEP)
    for k in (1, 2):
        outputs, status = measure(made, 1.5, 0.1 * k, 0.0)
        assert status == Status.WARNING
        assert outputs["v"] == plan.u[k - 1, 0]
        assert outputs["solve_status"] == 2
        assert outputs["fallbacks"] == k
        assert outputs["cost"] == good["cost"]
        assert "told to fail; went on with the last plan" in made.message
        made.step(k * STEP, STEP)
    outputs, status = measure(made, *START)
    assert (outputs["solve_status"], outputs["fallbacks"], status) == (0, 2, Status.OK)


def test_without_a_plan_the_safe_input_is_applied():
    made = failing({0}, safe_input={"v": 3.0})
    outputs, status = measure(made, *START)
    assert (outputs["v"], status) == (3.0, Status.WARNING)
    assert "applied the safe input" in made.message


def test_after_the_last_planned_input_the_safe_one_is_applied():
    made = failing(set(range(1, 9)), horizon=4, safe_input={"v": 3.0})
    measure(made, *START)
    plan = made._following.plan.u[:3, 0]
    applied = []
    for k in range(6):
        made.step(k * STEP, STEP)
        applied.append(measure(made, 1.5, 0.01 * k, 0.0)[0]["v"])
    np.testing.assert_array_equal(applied, [*plan, 3.0, 3.0, 3.0])


def test_the_safe_input_is_kept_within_bounds():
    assert measure(failing({0}, safe_input={"v": 99.0}), *START)[0]["v"] == 24.0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_measurement_that_is_not_finite_is_predicted_and_spreads_nowhere(value):
    made = controller()
    first, _ = measure(made, *START)
    made.step(0.0, STEP)
    outputs, status = measure(made, 1.5, value, 0.0)
    assert status == Status.WARNING
    assert (outputs["solve_status"], outputs["missing"], outputs["fallbacks"]) == (0, 1, 0)
    assert np.isfinite(list(outputs.values())).all()
    system = motor_cart()
    expected = evaluate(system.rk4(), list(START), [first["v"]], system.parameter_values, [STEP])[0]
    assert outputs["estimate_alpha_dot"] == pytest.approx(expected[1])
    assert outputs["estimate_alpha"] == 1.5
    assert made.message == "t = 0.01 s: measurement of alpha_dot is not finite"
    made.step(STEP, STEP)
    outputs, status = measure(made, 1.49, 0.1, 0.0)
    assert (outputs["solve_status"], outputs["missing"], status) == (0, 0, Status.OK)


def test_a_first_measurement_that_is_not_finite_decides_no_branch():
    made = controller()
    outputs, status = measure(made, np.nan, 0.0, 0.0)
    assert (outputs["v"], status) == (0.0, Status.WARNING)
    made.step(0.0, STEP)
    outputs, _ = measure(made, 5.0, 0.0, 0.0)
    assert np.pi < outputs["reference_alpha"] < 2 * np.pi


def test_an_iteration_limit_is_a_warning_with_the_plan_applied():
    made = controller(solver="sqp", iterations=1)
    outputs, status = measure(made, 0.5, 3.0, 0.0)
    assert (outputs["solve_status"], outputs["fallbacks"], status) == (1, 0, Status.WARNING)
    assert "after 1 iterations" in made.message


def test_the_input_is_always_within_bounds():
    class Beyond(Failing):
        def solve(self, x0, references, guess=None, applied=None):
            plan = Plan(references.x, np.full_like(references.u, 1e3))
            return Solution(plan.x, plan.u, SolveStatus.SOLVED, Stats())

    made = controller()
    made._solver = Beyond(made._solver, set())
    assert measure(made, *START)[0]["v"] == 24.0


def test_a_tick_that_nobody_reads_is_solved_all_the_same():
    made = failing(set())
    made.set(made.indices("input"), np.array(START))
    made.step(0.0, STEP)
    assert made._solver.count == 0


# ── warnings ─────────────────────────────────────────────────────────────────────────────────────────────


def test_good_settings_have_no_warnings():
    assert controller().warnings == ()


def test_a_horizon_that_cannot_see_the_slowest_response_is_told_with_numbers():
    (warning,) = controller(step=1e-3, horizon=30).warnings
    # At rest the linearised motor has |λ|² = (r b + k²)/(l J) with J = 0.14 kg m².
    assert "30 × 0.001 s = 0.03 s" in warning
    assert f"({1 / np.sqrt(3.5 / 0.14):.3g} s)" in warning
    assert "a step of at least 0.0067 s or a horizon of at least 200" in warning


def test_an_integrator_is_no_slow_response():
    glider = LagrangianSystem.build(
        (Coordinate("x", "m", input="f"),), lambda q, v, p: 0.5 * v[0] ** 2, lambda v, p: 0.0 * v[0]
    )
    assert controller(glider, reference=constant("x", 0.0)).warnings == ()


def test_steady_references_are_told():
    assert any("steady references" in w for w in controller(arm(), reference=constant("a", 0.0)).warnings)


def test_a_mass_matrix_that_is_not_positive_definite_is_told_and_the_run_goes_on():
    odd = LagrangianSystem.build(
        (Coordinate("x", "m", input="f"),),
        lambda q, v, p: -0.5 * v[0] ** 2 + q[0] ** 2,
        lambda v, p: 0.1 * v[0] ** 2,
    )
    made = controller(odd, reference=constant("x", 0.0))
    assert any("not positive definite" in w and "eigenvalue -1)" in w for w in made.warnings)
    assert measure(made, 0.1, 0.0)[0]["solve_status"] == 0


def test_a_model_that_is_not_finite_is_told_and_falls_back():
    broken = LagrangianSystem.build(
        (Coordinate("x", "m", input="f"),),
        lambda q, v, p: 0.5 * ca.sqrt(q[0] - 1) * v[0] ** 2,
        lambda v, p: 0.1 * v[0] ** 2,
    )
    made = controller(broken, reference=constant("x", 0.0), safe_input={"f": 0.5})
    assert any("eigenvalue nan" in w for w in made.warnings)
    outputs, status = measure(made, 0.0, 0.0)
    assert (outputs["f"], outputs["solve_status"], status) == (0.5, 2, Status.WARNING)


def test_a_riccati_equation_without_solution_is_told():
    lost = LagrangianSystem.build(
        (Coordinate("a", "rad", input="t"), Coordinate("b", "rad")),
        lambda q, v, p: 0.5 * ca.sumsqr(v) - 10.0 * ca.cos(q[1]),
        lambda v, p: 0.0 * v[0],
    )
    made = controller(lost, reference=constant("b", 0.1))
    assert any("the terminal cost is 10 Q" in w for w in made.warnings)


def test_a_casadi_without_hpipm_is_told(monkeypatch):
    monkeypatch.setattr(ca, "has_conic", lambda name: False)
    made = controller()
    assert any("without hpipm" in w for w in made.warnings)
    assert measure(made, *START)[0]["solve_status"] == 0

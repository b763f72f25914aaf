"""Metrics of a closed loop from recorded rows: known answers on trajectories made of formulas."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from results_helpers import UNITS, scenario_text, trajectories
from ruamel.yaml import YAML

from exlinn_fmi.results.metrics import control_loops, control_metrics, outside, quantity
from exlinn_fmi.scenario.schema import Scenario
from exlinn_fmi.scenario.spec import Bounds


def scenario(text: str | None = None) -> Scenario:
    return Scenario.model_validate(YAML(typ="safe").load(text or scenario_text(control=True)))


@pytest.fixture(scope="module")
def frame() -> pd.DataFrame:
    return trajectories()


@pytest.fixture(scope="module")
def metrics(frame: pd.DataFrame) -> dict[str, float]:
    return control_metrics(frame, scenario(), UNITS)


def test_tracking_error_is_that_of_the_output_named_in_metrics(metrics: dict[str, float]) -> None:
    assert metrics["control.rmse_x_m"] == pytest.approx(1e-5, rel=1e-2)
    assert metrics["control.max_error_x_m"] == pytest.approx(np.sqrt(2) * 1e-5, rel=1e-2)


def test_reference_held_between_samples_is_no_error() -> None:
    coarse = trajectories(period=0.1)
    text = scenario_text(control=True).replace("step: 0.01", "step: 0.1")
    assert control_metrics(coarse, scenario(text), UNITS)["control.rmse_x_m"] < 1.1e-5


def test_errors_before_settling_are_left_out(frame: pd.DataFrame) -> None:
    late = frame.copy()
    late.loc[late["time"] < 1.999, "plant.x"] += 1.0
    assert control_metrics(late, scenario(), UNITS)["control.rmse_x_m"] < 2e-5
    late.loc[late["time"] < 2.0005, "plant.x"] += 1.0
    assert control_metrics(late, scenario(), UNITS)["control.max_error_x_m"] > 0.9


def test_no_tracking_error_where_all_rows_are_before_settling(frame: pd.DataFrame) -> None:
    metrics = control_metrics(frame[frame["time"] < 1.5], scenario(), UNITS)
    assert "control.rmse_x_m" not in metrics
    assert "control.violations" in metrics


def test_solver_effort_is_taken_at_the_samples(metrics: dict[str, float], frame: pd.DataFrame) -> None:
    solve = 1e3 * frame["controller.solve_time"].to_numpy()[::10]
    assert metrics["control.solve_ms_median"] == pytest.approx(np.median(solve))
    assert metrics["control.solve_ms_p99"] == pytest.approx(np.percentile(solve, 99))
    assert metrics["control.solve_ms_max"] == pytest.approx(solve.max())
    assert metrics["control.cost_mean"] == pytest.approx(frame["controller.cost"][::10].mean())
    assert metrics["control.iterations_mean"] == 1
    assert metrics["control.fallbacks"] == 0


def test_fallbacks_are_the_last_count(frame: pd.DataFrame) -> None:
    counted = frame.assign(**{"controller.fallbacks": np.floor(frame["time"] / 3)})
    assert control_metrics(counted, scenario(), UNITS)["control.fallbacks"] == 3


def test_input_power_is_that_of_the_controllers_output(
    metrics: dict[str, float], frame: pd.DataFrame
) -> None:
    voltage = frame["controller.v"].to_numpy()[::10]
    assert metrics["control.input_rms"] == pytest.approx(np.sqrt(np.mean(voltage**2)))


def test_a_run_within_bounds_has_no_violation(metrics: dict[str, float]) -> None:
    assert metrics["control.violations"] == 0


def test_every_row_outside_a_bound_counts_also_before_settling(frame: pd.DataFrame) -> None:
    beyond = frame.copy()
    beyond.loc[3:7, "plant.v"] = 24.1
    beyond.loc[9, "plant.i"] = -4.01
    metrics = control_metrics(beyond, scenario(), UNITS)
    assert metrics["control.violations"] == 6
    assert metrics["control.worst_violation"] == pytest.approx(0.1 / 48)


def test_solver_tolerance_is_no_violation(frame: pd.DataFrame) -> None:
    touching = frame.copy()
    touching.loc[3:7, "plant.v"] = 24 + 4e-5
    metrics = control_metrics(touching, scenario(), UNITS)
    assert metrics["control.violations"] == 0
    assert "control.worst_violation" not in metrics


def test_violations_are_left_out_where_a_bounded_state_was_not_recorded(frame: pd.DataFrame) -> None:
    assert "control.violations" not in control_metrics(frame.drop(columns="plant.i"), scenario(), UNITS)


def test_the_controllers_own_column_stands_in_for_a_plant_input(frame: pd.DataFrame) -> None:
    metrics = control_metrics(frame.drop(columns="plant.v"), scenario(), UNITS)
    assert metrics["control.violations"] == 0


@pytest.mark.parametrize("column", [c for c in trajectories(stop=0.01) if c != "time"])
def test_a_missing_column_costs_only_its_metrics(
    column: str, frame: pd.DataFrame, metrics: dict[str, float]
) -> None:
    fewer = control_metrics(frame.drop(columns=column), scenario(), UNITS)
    assert fewer.items() <= metrics.items()
    assert len(fewer) >= len(metrics) - 4


def with_costs(frame: pd.DataFrame, cost: list[float], change: float = 0.0) -> pd.DataFrame:
    """A run whose cost at the first samples is that, each with a first term of 1."""
    rows = frame.iloc[: 10 * len(cost)].copy()
    held = np.repeat(cost, 10)
    more = {"cost": held, "stage_cost": np.ones(len(held)), "cost_disturbance": np.full(len(held), change)}
    return rows.assign(**{f"controller.{name}": values for name, values in more.items()})


def test_a_cost_that_falls_by_its_first_term_falls_as_it_should(frame: pd.DataFrame) -> None:
    falling = with_costs(frame, [9.0, 8.0, 7.0, 6.0, 5.0])
    assert control_metrics(falling, scenario(), UNITS)["control.decrease"] == 1.0


def test_a_cost_that_falls_by_less_is_counted_unless_a_disturbance_explains_it(frame: pd.DataFrame) -> None:
    costs = [9.0, 8.5, 7.5, 9.0, 8.0]
    assert control_metrics(with_costs(frame, costs), scenario(), UNITS)["control.decrease"] == 0.5
    disturbed = with_costs(frame, costs, change=3.0)
    assert control_metrics(disturbed, scenario(), UNITS)["control.decrease"] == 1.0


def test_the_share_of_plans_that_end_in_the_terminal_set_is_told_where_there_is_one(
    frame: pd.DataFrame,
) -> None:
    assert "control.terminal_inside" not in control_metrics(frame, scenario(), UNITS)
    ends = np.repeat([3.0, 2.0, 1.0, 0.0], 10)
    rows = frame.iloc[: len(ends)].assign(
        **{"controller.terminal_cost": ends, "controller.terminal_level": 1.0}
    )
    assert control_metrics(rows, scenario(), UNITS)["control.terminal_inside"] == 0.5


def test_the_time_between_measurement_and_input_is_told_where_it_is_known(frame: pd.DataFrame) -> None:
    assert not [name for name in control_metrics(frame, scenario(), UNITS) if "feedback" in name]
    timed = frame.assign(**{"controller.feedback_time": 2e-4})
    metrics = control_metrics(timed, scenario(), UNITS)
    assert metrics["control.feedback_ms_median"] == pytest.approx(0.2)
    assert metrics["control.feedback_ms_p99"] == pytest.approx(0.2)


def test_solves_longer_than_the_sampling_time_miss_their_deadline(frame: pd.DataFrame) -> None:
    late = frame.copy()
    late.loc[20:49, "controller.solve_time"] = 0.011  # three samples
    metrics = control_metrics(late, scenario(), UNITS)
    assert metrics["control.deadline_misses"] == 3
    assert control_metrics(frame, scenario(), UNITS)["control.deadline_misses"] == 0


def test_a_run_that_failed_at_once_has_no_metrics(frame: pd.DataFrame) -> None:
    assert control_metrics(frame.head(0), scenario(), UNITS) == {}


def test_a_scenario_without_controller_or_simulation_has_no_metrics(frame: pd.DataFrame) -> None:
    assert control_metrics(frame, scenario(scenario_text(simulate=True)), UNITS) == {}
    assert control_loops(scenario(scenario_text(learn=True))) == []


def test_without_a_named_output_the_measured_coordinate_follows_the_reference() -> None:
    text = scenario_text(control=True).replace("  output: plant.x\n", "")
    direct = text.replace("        through: {map: scotch_yoke, crank: 0.2}\n", "")
    assert control_loops(scenario(direct))[0].outputs == {"reference": "plant.alpha"}
    assert control_loops(scenario(text))[0].outputs == {}


def test_several_controllers_are_told_apart_by_name(frame: pd.DataFrame) -> None:
    data = YAML(typ="safe").load(scenario_text(control=True))
    data["components"]["second"] = data["components"]["controller"]
    data["components"]["other"] = {"plant": "dc_motor_cart"}
    data["connections"] |= {"other.i": "second.i", "second.v": ["other.v"], "second.w": "other.w"}
    both = frame.rename(columns={"controller.cost": "second.cost"}).assign(
        **{"second.v": frame["controller.v"], "second.w": 2.0}
    )
    metrics = control_metrics(both, Scenario.model_validate(data), UNITS)
    assert metrics["control.controller.rmse_x_m"] == pytest.approx(1e-5, rel=1e-2)
    assert "control.second.rmse_x_m" not in metrics
    assert "control.second.cost_mean" in metrics
    assert metrics["control.second.input_rms_w"] == 2
    assert "control.rmse_x_m" not in metrics


def test_diagnostics_are_no_plant_inputs() -> None:
    text = scenario_text(control=True).replace(
        "  controller.v: plant.v\n",
        "  controller.v: plant.v\n  controller.cost: plant.a\n  controller.reference_i: plant.b\n",
    )
    assert dict(control_loops(scenario(text))[0].inputs) == {"v": "plant.v"}


@pytest.mark.parametrize(
    ("path", "unit", "expected"),
    [
        ("plant.x", "m", "x_m"),
        ("plant.alpha_dot", "rad/s", "alpha_dot_rad_s"),
        ("plant.body.w[1]", "rad/s", "body_w_1_rad_s"),
        ("plant.ratio", "1", "ratio"),
        ("plant.ratio", "", "ratio"),
    ],
)
def test_quantities_are_named_with_their_unit(path: str, unit: str, expected: str) -> None:
    assert quantity(path, unit) == expected


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3), st.floats(-2, 3))
def test_a_value_is_outside_only_beyond_its_bounds(low: float, span: float, where: float) -> None:
    value = np.array([low + where * span])
    found = bool(outside(value, Bounds(min=low, max=low + span))[0])
    if 1e-5 < where < 1 - 1e-5:
        assert not found
    if where < -1e-5 or where > 1 + 1e-5:
        assert found


def test_one_sided_and_absent_bounds() -> None:
    values = np.array([-5.0, 0.0, 5.0, np.nan])
    assert outside(values, Bounds(min=0.0)).tolist() == [True, False, False, True]
    assert outside(values, Bounds(max=1.0)).tolist() == [False, False, True, True]
    assert outside(values, Bounds()).tolist() == [False, False, False, True]

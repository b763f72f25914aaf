"""What the charts show, from data to panels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from results_helpers import UNITS, evaluation, make_run, trajectories, write_learning, write_trajectories

from exlinn_fmi.results.charts import charts, learning_chart, training_chart, trajectory_chart
from exlinn_fmi.results.panels import Chart, Panel, decimate
from exlinn_fmi.results.tables import Table, read_run
from exlinn_fmi.results.typography import readable, typeset


def panels_of(
    folder: Path, frame: pd.DataFrame | None = None, name: str = "fig4_control"
) -> dict[str, Panel]:
    write_trajectories(folder, frame)
    (chart,) = [c for c in charts(read_run(folder)) if c.name == name]
    return {panel.name: panel for panel in chart.panels}


def roles(panel: Panel) -> list[str]:
    return [line.role for line in panel.lines]


# ── which charts ─────────────────────────────────────────────────────────────────────────────────────────


def test_a_whole_run_has_learning_training_and_control(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True, learn=True)
    write_learning(folder)
    write_trajectories(folder)
    assert [c.name for c in charts(read_run(folder))] == ["fig3_learning", "training", "fig4_control"]


def test_a_run_without_controller_has_an_overview(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    write_trajectories(folder)
    assert [c.name for c in charts(read_run(folder))] == ["trajectories"]


def test_a_run_that_left_nothing_has_no_charts(tmp_path: Path) -> None:
    assert charts(read_run(make_run(tmp_path, control=True))) == []


def test_each_of_several_controllers_has_its_own_chart(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    file = folder / "scenario.yaml"
    text = file.read_text()
    start, end = text.index("  controller:\n"), text.index("connections:")
    second = text[start:end].replace("controller:", "second:")
    file.write_text(text[:end] + second + text[end:])
    write_trajectories(folder, trajectories(1).assign(**{"second.cost": 1.0}))
    names = [c.name for c in charts(read_run(folder))]
    assert names == ["fig4_control_controller", "fig4_control_second"]


def test_a_controller_of_which_nothing_was_recorded_has_no_chart(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    write_trajectories(
        folder, pd.DataFrame({"time": [0.0, 0.01], "plant.x": [0.0, 0.0]}).drop(columns="plant.x")
    )
    assert charts(read_run(folder)) == []


def test_a_history_without_losses_or_an_evaluation_without_pairs_has_no_chart() -> None:
    assert training_chart(pd.DataFrame({"iteration": [0, 1], "damping": [1.0, 0.1]})) is None
    assert training_chart(pd.DataFrame({"iteration": [0], "loss": [np.nan]})) is None
    assert learning_chart(Table(pd.DataFrame({"time": [0.0], "i": [0.0]}))) is None
    assert trajectory_chart(Table(pd.DataFrame({"time": [0.0]}))) is None


# ── learning ─────────────────────────────────────────────────────────────────────────────────────────────


def test_measured_and_learned_stand_together_with_their_difference() -> None:
    frame, units = evaluation(error=1e-6)
    chart = learning_chart(Table(frame, units))
    assert chart is not None
    assert [p.label for p in chart.panels] == [
        "alpha_dot [rad/s]",
        "i [A]",
        "alpha_ddot [rad/s²]",
        "i_dot [A/s]",
        "L [J]",
        "D [W]",
    ]
    strip = chart.panels[1].strip
    assert strip is not None
    assert chart.panels[1].strip_label == "error [µA]"
    assert np.allclose(strip.y, 1e6 * (frame["i_learned"] - frame["i"]))


def test_lines_that_the_eye_can_tell_apart_have_no_strip() -> None:
    chart = learning_chart(Table(*evaluation(error=5.0)))
    assert chart is not None
    assert all(panel.strip is None for panel in chart.panels)


def test_a_diverged_model_does_not_flatten_the_measurement(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    frame = write_learning(folder, diverges=True)
    panels = {p.name: p for p in charts(read_run(folder))[0].panels}
    limits = panels["i"].limits
    assert limits is not None
    assert limits[1] < 2.1 * frame["i"].max()
    assert panels["i"].note == "learned out of sight from 0.801 s"
    assert panels["alpha_dot"].note == "learned out of sight from 1.001 s"
    assert panels["L"].strip is not None


def test_losses_of_zero_leave_a_gap_in_the_logarithmic_axis() -> None:
    chart = training_chart(
        pd.DataFrame({"epoch": [0, 1, 2], "loss": [1.0, 0.0, 0.1], "validation_loss": 1.0})
    )
    assert chart is not None
    assert chart.panels[0].log
    assert np.isnan(chart.panels[0].lines[0].y[1])
    assert roles(chart.panels[0]) == ["main", "model"]


# ── control ──────────────────────────────────────────────────────────────────────────────────────────────


def test_control_shows_cost_input_output_states_and_effort(tmp_path: Path) -> None:
    panels = panels_of(make_run(tmp_path, control=True))
    assert list(panels) == ["cost J", "v", "x", "alpha", "alpha_dot", "i", "solve time"]
    assert roles(panels["x"]) == ["main", "reference"]
    assert roles(panels["alpha_dot"]) == ["main"]
    assert panels["cost J"].log
    assert panels["v"].lines[0].held


def test_control_shows_what_is_estimated_and_not_measured(tmp_path: Path) -> None:
    frame = trajectories()
    frame["controller.estimate_alpha"] = frame["plant.alpha"]
    frame["controller.estimate_w"] = frame["controller.reference_w"] = frame["plant.alpha_dot"]
    frame["controller.disturbance_alpha"] = 0.1
    frame["controller.disturbance_Q"] = 0.0
    panels = panels_of(make_run(tmp_path, control=True), frame)
    assert [name for name in panels if "estimated" in name or "disturbance" in name] == [
        "w (estimated)",
        "disturbance of alpha",
    ]
    assert roles(panels["w (estimated)"]) == ["main", "reference"]


def test_tracking_error_is_drawn_where_the_reference_is_fresh(tmp_path: Path) -> None:
    strip = panels_of(make_run(tmp_path, control=True))["x"].strip
    assert strip is not None
    assert strip.x.size == 1001
    assert np.abs(strip.y).max() == pytest.approx(14.14, rel=1e-2)  # µm


def test_a_start_beside_the_reference_does_not_hide_the_error_after_it(tmp_path: Path) -> None:
    frame = trajectories()
    frame["plant.x"] += 0.1 * np.exp(-20 * frame["time"])
    panel = panels_of(make_run(tmp_path, control=True), frame)["x"]
    assert panel.strip_label == "error [µm]"
    assert panel.strip is not None
    assert panel.strip_limits is not None
    assert 14 < panel.strip_limits[1] < 30
    assert panel.strip.y.max() > 1e4


def test_bounds_out_of_sight_are_said_and_near_ones_drawn(tmp_path: Path) -> None:
    frame = trajectories()
    frame["plant.i"] *= 3
    panels = panels_of(make_run(tmp_path, control=True), frame)
    assert roles(panels["v"]) == ["main"]
    assert panels["v"].note == "bounds −24 … 24 V"
    assert roles(panels["i"]) == ["main", "bound", "bound"]


def test_a_one_sided_bound_is_said(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    file = folder / "scenario.yaml"
    text = file.read_text().replace(
        "i: {min: -4.0, max: 4.0}", "i: {max: 4.0}, alpha: {min: -1.5}, alpha_dot: {}"
    )
    file.write_text(text)
    panels = panels_of(folder)
    assert panels["i"].note == "bound ≤ 4 A"
    assert panels["alpha"].note == "bound ≥ −1.5 rad"
    assert panels["alpha_dot"].note == ""


def test_what_of_a_solve_is_after_the_measurement_is_shown_beside_all_of_it(tmp_path: Path) -> None:
    frame = trajectories(stop=1)
    frame["controller.feedback_time"] = 2e-4
    panel = panels_of(make_run(tmp_path, control=True), frame)["solve time"]
    assert [line.label for line in panel.lines] == ["in all", "after the measurement"]
    assert panel.lines[1].y == pytest.approx(0.2)


def test_slow_solves_are_set_against_the_sampling_time(tmp_path: Path) -> None:
    frame = trajectories(stop=1)
    frame["controller.solve_time"] *= 6
    panel = panels_of(make_run(tmp_path, control=True), frame)["solve time"]
    assert roles(panel) == ["main", "bound"]
    assert panel.lines[1].y.tolist() == [10, 10]
    assert panel.note == "sampling time 10 ms"


def test_a_state_that_is_the_output_is_shown_once(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    file = folder / "scenario.yaml"
    file.write_text(file.read_text().replace("output: plant.x", "output: plant.alpha"))
    assert list(panels_of(folder)) == ["cost J", "v", "alpha", "alpha_dot", "i", "solve time"]


def test_a_run_cut_short_before_its_second_sample_is_shown(tmp_path: Path) -> None:
    panels = panels_of(make_run(tmp_path, control=True), trajectories().iloc[1:8].reset_index(drop=True))
    assert list(panels) == ["v", "x", "alpha", "alpha_dot", "i"]
    assert roles(panels["x"]) == ["main"]


# ── overview ─────────────────────────────────────────────────────────────────────────────────────────────


def test_variables_of_one_unit_share_a_panel() -> None:
    chart = trajectory_chart(Table(trajectories(stop=0.1), UNITS))
    assert chart is not None
    shown = {p.unit: [line.label for line in p.lines] for p in chart.panels}
    assert shown["m"] == ["plant.x", "controller.reference"]


def test_a_connected_input_is_drawn_as_the_output_that_drives_it(tmp_path: Path) -> None:
    frame = trajectories(stop=0.1)
    connection = [("controller.v", "plant.v"), ("gone.y", "plant.i")]
    for columns, hidden in ((frame, True), (frame.drop(columns="controller.v"), False)):
        chart = trajectory_chart(Table(columns, UNITS), connection)
        assert chart is not None
        shown = [line.label for panel in chart.panels for line in panel.lines]
        assert ("plant.v" not in shown) == hidden
        assert "plant.i" in shown


def test_what_finds_no_room_is_named() -> None:
    frame = pd.DataFrame({"time": [0.0, 1.0]} | {f"c.v{k}": [0.0, 1.0] for k in range(80)})
    chart = trajectory_chart(Table(frame))
    assert chart is not None
    assert len(chart.panels) == 12
    assert "c.v72, c.v73" in chart.note
    assert "c.v71" not in chart.note


def test_small_numbers_are_shown_in_a_multiple_of_their_unit(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    write_trajectories(folder, trajectories(stop=0.1))
    (chart,) = charts(read_run(folder))
    (panel,) = [p for p in chart.panels if p.lines[0].label == "controller.solve_time"]
    assert panel.unit == "ms"
    assert panel.lines[0].y.max() == pytest.approx(1.6, rel=0.1)


def test_rounding_errors_of_a_constant_are_not_magnified(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    time = np.arange(10.0)
    write_trajectories(folder, pd.DataFrame({"time": time, "plant.i": 20 + 1e-14 * time}))
    limits = charts(read_run(folder))[0].panels[0].limits
    assert limits is not None
    assert limits[1] - limits[0] > 0.01


# ── numbers and words ────────────────────────────────────────────────────────────────────────────────────


@given(
    arrays(float, st.integers(0, 3000), elements=st.floats(-1e6, 1e6) | st.just(np.nan)),
    st.integers(8, 500),
)
def test_decimation_keeps_peaks_and_gaps_in_bounds(y: np.ndarray, most: int) -> None:
    kept = decimate(y, most)
    assert np.all(np.diff(kept) > 0)
    if len(y) <= most:
        assert len(kept) == len(y)
        return
    assert len(kept) <= 1.2 * most + 8
    assert kept[-1] == len(y) - 1
    if np.isfinite(y).any():
        assert np.nanmax(y[kept]) == np.nanmax(y)
        assert np.nanmin(y[kept]) == np.nanmin(y)
    assert np.isnan(y[kept]).any() == np.isnan(y).any()


@pytest.mark.parametrize(
    ("size", "unit", "expected"),
    [
        (7.7e-6, "m", "µm"),
        (0.02, "V", "mV"),
        (3.0, "A", "A"),
        (2e4, "Pa", "kPa"),
        (1e-4, "N.m", "µN.m"),
        (0.002, "kg", "10⁻³ kg"),
        (1e-7, "m2", "10⁻⁹ m2"),
        (1e-5, "", "10⁻⁶"),
        (0.0, "A", "A"),
        (np.inf, "A", "A"),
        (1e-30, "A", "fA"),
    ],
)
def test_multiples_of_units(size: float, unit: str, expected: str) -> None:
    factor, multiple = readable(size, unit)
    assert multiple == expected
    if 1e-15 < size < 1e9:
        assert 0.999 <= size * factor < 1000


@pytest.mark.parametrize(
    ("unit", "expected"),
    [("rad/s2", "rad/s²"), ("kg.m2", "kg·m²"), ("s-1", "s⁻¹"), ("10⁻⁶", "10⁻⁶"), ("1", "1"), ("A", "A")],
)
def test_units_are_typeset(unit: str, expected: str) -> None:
    assert typeset(unit) == expected


def test_a_chart_spans_all_its_lines(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    write_trajectories(folder, trajectories(stop=2.5))
    chart: Chart = charts(read_run(folder))[0]
    assert chart.span == (0.0, 2.5)

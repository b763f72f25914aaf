"""Measured data become a data set: units, gaps, grids, filters, held-out files; unusable ones are refused."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from measured_helpers import COLUMNS, COORDINATES, load, load_frame, recording, write

from exlinn_fmi.data.dataset import load_dataset, save_dataset
from exlinn_fmi.data.faults import plateaus
from exlinn_fmi.data.measured import held_out, resample, unwrap
from exlinn_fmi.errors import DataError
from exlinn_fmi.scenario.learning import Measured, Resample

# ── from file to model ───────────────────────────────────────────────────────────────────────────────────


def test_columns_become_the_quantities_they_are_mapped_to(tmp_path):
    frame = recording()
    data = load_frame(tmp_path, frame).frame
    for name, column in {"alpha": "phi", "alpha_dot": "alpha_dot", "i": "i", "v": "u"}.items():
        np.testing.assert_allclose(data[name], frame[column], rtol=1e-14)


def test_accelerations_are_estimated_from_velocities(tmp_path):
    data = load_frame(tmp_path, recording()).frame
    exact = -20 * np.sin(5 * data["time"])
    np.testing.assert_allclose(data["alpha_ddot"], exact, atol=1e-8 * 20)


def test_an_acceleration_that_is_measured_is_taken(tmp_path):
    data = load_frame(tmp_path, recording().assign(alpha_ddot=7.0)).frame
    assert (data["alpha_ddot"] == 7.0).all()


def test_a_missing_velocity_is_estimated_from_the_position_and_that_is_said(tmp_path):
    frame = recording()
    data = load_frame(tmp_path, frame.drop(columns="alpha_dot"))
    np.testing.assert_allclose(data.frame["alpha_dot"], frame["alpha_dot"], atol=1e-7)
    assert "alpha_dot is not in the files: estimated from the position" in data.notes


def test_a_velocity_that_only_one_file_lacks_is_estimated_there(tmp_path):
    write(tmp_path, a=recording(), b=recording(phase=1.0).drop(columns="alpha_dot"))
    notes = load(tmp_path, files=["a.csv", "b.csv"]).notes
    assert "alpha_dot is not in b.csv: estimated from the position" in notes


def test_a_velocity_that_is_mapped_must_be_there(tmp_path):
    with pytest.raises(DataError, match=r"run.csv: no column 'omega'; the columns are: time, phi"):
        load_frame(tmp_path, recording(), columns={**COLUMNS, "alpha_dot": "omega"})


def test_units_are_converted_to_those_of_the_model(tmp_path):
    frame = recording()
    raw = pd.DataFrame(
        {
            "t_ms": 1e3 * frame["time"],
            "deg": np.degrees(frame["phi"]),
            "n": frame["alpha_dot"] * 60 / (2 * np.pi),
            "mA": 1e3 * frame["i"],
            "counts": (frame["u"] + 2.5) / 0.005,
        }
    )
    columns = {
        "alpha": {"column": "deg", "unit": "deg"},
        "alpha_dot": {"column": "n", "unit": "rpm"},
        "i": {"column": "mA", "unit": "mA"},
        "v": {"column": "counts", "scale": 0.005, "offset": -2.5, "unit": "V"},
    }
    data = load_frame(tmp_path, raw, columns=columns, time={"column": "t_ms", "unit": "ms"})
    for name, column in {
        "time": "time",
        "alpha": "phi",
        "alpha_dot": "alpha_dot",
        "i": "i",
        "v": "u",
    }.items():
        np.testing.assert_allclose(data.frame[name], frame[column], atol=1e-12)
    assert data.units["alpha"] == "rad"


def test_an_angle_sensor_that_begins_anew_after_a_turn_is_unwrapped(tmp_path):
    frame = recording()
    wrapped = frame.assign(phi=np.mod(frame["phi"], 2 * np.pi))
    data = load_frame(tmp_path, wrapped)
    np.testing.assert_allclose(data.frame["alpha"], frame["phi"], atol=1e-12)


@given(st.floats(-1e3, 1e3), st.floats(-100, 100), st.sampled_from(["rad", "deg", "rev"]))
@settings(max_examples=30, deadline=None)
def test_unwrapping_undoes_wrapping_up_to_whole_turns(start, speed, unit):
    turn = {"rad": 2 * np.pi, "deg": 360.0, "rev": 1.0}[unit]
    angle = (start + speed * np.linspace(0, 1, 500)) * turn / (2 * np.pi)
    undone = unwrap(np.mod(angle, turn), unit)
    turns = (undone - angle) / turn
    np.testing.assert_allclose(turns, np.round(turns[0]), atol=1e-9)


def test_time_begins_at_zero_in_every_file(tmp_path):
    frame = recording()
    data = load_frame(tmp_path, frame.assign(time=frame["time"] + 1234.5))
    assert data.frame["time"].iloc[0] == 0.0
    np.testing.assert_allclose(data.frame["time"], frame["time"], atol=1e-9)


def test_without_a_time_column_a_fixed_step_serves(tmp_path):
    frame = recording()
    data = load_frame(tmp_path, frame.drop(columns="time"), step=2e-3)
    np.testing.assert_allclose(data.frame["time"], frame["time"], atol=1e-12)


def test_a_unit_that_cannot_be_converted_is_refused(tmp_path):
    columns = {**COLUMNS, "alpha": {"column": "phi", "unit": "mm"}}
    with pytest.raises(DataError, match="phi: no conversion from 'mm' to 'rad'; give `scale`"):
        load_frame(tmp_path, recording(), columns=columns)


# ── held out ─────────────────────────────────────────────────────────────────────────────────────────────


def test_files_of_the_test_are_held_out_whole(tmp_path):
    write(tmp_path, a=recording(), b=recording(phase=1), c=recording(phase=2))
    data = load(tmp_path, files=["a.csv", "b.csv"], test=["c.csv"])
    assert (data.training.trajectories, data.held_out) == ([0, 1], (2,))
    np.testing.assert_allclose(data.tests[0].frame["alpha"], recording(phase=2)["phi"])


@given(st.integers(0, 1000), st.integers(1, 6))
@settings(max_examples=40, deadline=None)
def test_the_draw_of_held_out_files_divides_all_files_by_the_seed(seed, count):
    files = [f"{k}.csv" for k in range(7)]
    data = Measured(files=files, hold_out=count)
    training, tests = held_out(data, seed)
    assert sorted(training + tests) == files
    assert len(tests) == count
    assert held_out(data, seed) == (training, tests)


def test_another_seed_holds_out_other_files():
    data = Measured(files=[f"{k}.csv" for k in range(7)], hold_out=1)
    assert len({tuple(held_out(data, seed)[1]) for seed in range(30)}) > 3


def test_that_no_file_is_held_out_is_said(tmp_path):
    assert any("no file is held out" in note for note in load_frame(tmp_path, recording()).notes)


def test_what_was_held_out_and_noted_is_kept_on_disk(tmp_path):
    write(tmp_path, a=recording(), b=recording(phase=1).drop(columns="alpha_dot"))
    data = load(tmp_path, files=["a.csv"], test=["b.csv"])
    save_dataset(tmp_path, data)
    again = load_dataset(tmp_path)
    assert (again.held_out, again.notes) == (data.held_out, data.notes)
    assert again.notes


# ── gaps, jitter, grids ──────────────────────────────────────────────────────────────────────────────────


def test_after_a_gap_a_new_trajectory_begins_and_the_largest_gap_is_told(tmp_path):
    frame = recording()
    data = load_frame(tmp_path, frame.drop(index=[*range(500, 550), *range(1000, 1200)]))
    assert data.trajectories == [0, 1, 2]
    (note,) = [note for note in data.notes if "no rows for" in note]
    assert note.startswith("run.csv:952: no rows for 0.402 s before this one (the largest of 2 gaps)")
    assert [len(part) for _, part in data.frame.groupby("trajectory")] == [500, 450, 801]


def test_a_held_out_file_with_a_gap_is_held_out_in_all_its_parts(tmp_path):
    write(tmp_path, a=recording(phase=1), b=recording().drop(index=range(500, 600)))
    assert load(tmp_path, files=["a.csv"], test=["b.csv"]).held_out == (1, 2)


def test_parts_between_gaps_that_are_too_short_are_left_out(tmp_path):
    frame = recording().drop(index=[*range(500, 550), *range(555, 600)])
    data = load_frame(tmp_path, frame)
    assert data.trajectories == [0, 1]
    assert any("1 part of less than 9 rows left out" in note for note in data.notes)


def test_a_clock_that_jitters_leads_to_a_regular_grid_and_is_told_of(tmp_path):
    frame = recording()
    t = frame["time"] + 4e-4 * np.random.default_rng(0).uniform(-1, 1, len(frame))
    shaken = recording().assign(
        time=t, phi=2 * t + 0.8 * np.sin(5 * t), alpha_dot=2 + 4 * np.cos(5 * t), u=np.sin(6 * t)
    )
    data = load_frame(tmp_path, shaken)
    steps = np.diff(data.frame["time"])
    np.testing.assert_allclose(steps, 2e-3, rtol=2e-3)
    assert steps.max() - steps.min() < 1e-12
    exact = 2 * (data.frame["time"] + t[0]) + 0.8 * np.sin(5 * (data.frame["time"] + t[0]))
    np.testing.assert_allclose(data.frame["alpha"], exact, atol=1e-9)
    (note,) = [note for note in data.notes if "steps from" in note]
    assert re.search(r"run.csv: steps from 0.0012\d+ to 0.0027\d+ s \(the largest at run.csv:\d+\)", note)


def test_a_step_without_a_short_form_is_kept(tmp_path):
    step = 1 / 512.3456789
    frame = recording().assign(time=lambda f: f["time"] / 2e-3 * step)
    frame = frame.assign(alpha_dot=lambda f: f["alpha_dot"] * 2e-3 / step).drop(index=700)
    assert np.diff(load_frame(tmp_path, frame).frame["time"])[0] == pytest.approx(step, rel=1e-3)


def test_gaps_that_leave_no_part_long_enough_are_an_error(tmp_path):
    frame = recording()
    with pytest.raises(DataError, match=r"run.csv: no part without gaps keeps 9 rows or more"):
        load_frame(tmp_path, frame[frame.index % 20 < 8])


def test_a_lost_row_is_interpolated(tmp_path):
    data = load_frame(tmp_path, recording().drop(index=700))
    assert data.trajectories == [0]
    np.testing.assert_allclose(data.frame["alpha"], recording()["phi"], atol=1e-8)


def test_a_grid_that_is_asked_for_is_not_told_of(tmp_path):
    data = load_frame(tmp_path, recording().drop(index=700), resample=2e-3)
    assert not any("resampled" in note for note in data.notes)


@pytest.mark.parametrize("step", [1e-3, 2e-3, 3e-3, 4e-3, 1e-2])
def test_resampling_keeps_a_smooth_signal(tmp_path, step):
    data = load_frame(tmp_path, recording(), resample=step).frame
    np.testing.assert_allclose(np.diff(data["time"]), step, rtol=1e-9)
    inner = data[(data["time"] > 0.2) & (data["time"] < 3.8)]
    exact = 2.0 * inner["time"] + 0.8 * np.sin(5 * inner["time"])
    np.testing.assert_allclose(inner["alpha"], exact, atol=2e-6)


def test_a_coarser_grid_does_not_fold_frequencies_that_it_cannot_hold():
    t = 1e-3 * np.arange(4001)
    hum = np.sin(2 * np.pi * 95 * t)  # on a grid of 10 ms it would look like 5 Hz
    frame = pd.DataFrame({"time": t, "x": np.sin(2 * np.pi * t) + hum})
    coarse = resample(frame, Resample(step=1e-2), ())
    inner = coarse.iloc[20:-20]
    np.testing.assert_allclose(inner["x"], np.sin(2 * np.pi * inner["time"]), atol=1e-3)


def test_inputs_that_were_held_stay_held_on_a_finer_grid():
    t = 1e-2 * np.arange(50)
    frame = pd.DataFrame({"time": t, "x": t**2, "u": np.arange(50.0)})
    fine = resample(frame, Resample(step=2e-3, inputs="hold"), ["u"])
    np.testing.assert_array_equal(fine["u"], np.arange(len(fine)) // 5)


def test_linear_interpolation_is_linear():
    frame = pd.DataFrame({"time": [0.0, 1.0, 2.0], "x": [0.0, 1.0, 4.0]})
    fine = resample(frame, Resample(step=0.5, interpolation="linear"), ())
    np.testing.assert_allclose(fine["x"], [0, 0.5, 1, 2.5, 4])


def test_rows_nearly_at_one_time_do_not_magnify_their_noise():
    random = np.random.default_rng(1)
    t = np.sort(np.concatenate([1e-2 * np.arange(200), 1e-2 * np.arange(50, 60) + 1e-6]))
    frame = pd.DataFrame({"time": t, "x": np.sin(t) + 1e-2 * random.standard_normal(len(t))})
    fine = resample(frame, Resample(step=1e-2), ())
    assert np.abs(fine["x"] - np.sin(fine["time"])).max() < 0.05


def test_a_low_pass_takes_noise_out_and_leaves_the_phase(tmp_path):
    frame = recording(4001, 1e-3)
    random = np.random.default_rng(0)
    noisy = frame.assign(i=frame["i"] + 0.05 * random.standard_normal(len(frame)))
    data = load_frame(tmp_path, noisy, filter={"type": "low-pass", "cutoff": 20}).frame
    exact = np.cos(7 * data["time"]) + 0.3 * np.sin(23 * data["time"])
    error = (data["i"] - exact)[100:-100]
    assert error.std() < 0.05 / 3
    assert data["time"].iloc[0] == pytest.approx(0.025)  # half a period of the cut-off, where it settles


def test_a_cut_off_above_what_the_sampling_holds_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"run.csv: the filter's cut-off, 300 Hz, is not below .* 250 Hz"):
        load_frame(tmp_path, recording(), filter={"type": "low-pass", "cutoff": 300})


def test_a_cut_off_that_leaves_nothing_of_a_part_is_refused(tmp_path):
    with pytest.raises(
        DataError, match=r"run.csv: a part of 50 rows is too short for a filter with cut-off 5"
    ):
        load_frame(tmp_path, recording(50), filter={"type": "low-pass", "cutoff": 5})


def test_estimates_know_the_noise_whatever_is_done_afterwards(tmp_path):
    frame = recording(4001, 1e-3)
    frame["alpha_dot"] += 0.05 * np.random.default_rng(0).standard_normal(len(frame))
    plain = load_frame(tmp_path, frame).frame

    def error(**settings):
        data = load_frame(tmp_path, frame, **settings).frame.query("0.3 < time < 3.7")
        return (data["alpha_ddot"] + 20 * np.sin(5 * data["time"])).std()

    assert error(resample=2.5e-4) < 1.1 * error()
    assert error(filter={"type": "low-pass", "cutoff": 40}) < 1.1 * error()
    assert plain["alpha_ddot"].std() == pytest.approx(20 / np.sqrt(2), rel=0.02)


# ── unusable data ────────────────────────────────────────────────────────────────────────────────────────


def with_cell(row: int, column: str, cell: str) -> pd.DataFrame:
    frame = recording().astype(object)
    frame.loc[row, column] = cell
    return frame


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (with_cell(9, "i", ""), "run.csv:11: column 'i': found nothing, expected a finite number"),
        (with_cell(9, "i", "nan"), "run.csv:11: column 'i': found 'nan', expected a finite number"),
        (with_cell(9, "phi", "ERR"), "run.csv:11: column 'phi': found 'ERR', expected a finite number"),
        (with_cell(9, "u", "inf"), "run.csv:11: column 'u': found 'inf', expected a finite number"),
        (recording().assign(i=lambda f: f["i"].where(f.index < 1500)),
         "run.csv:1502: column 'i' ends here, 501 rows before the others"),
        (recording().sort_index(ascending=False), "run.csv:3: column 'time': 3.998 s after 4 s; time goes"),
        (recording().iloc[[*range(900), *range(500, 1400)]],
         "run.csv:902: column 'time': 1 s after 1.798 s; time goes backwards: make a file of its own"),
        (recording().assign(time=lambda f: f["time"].round(2)), "take out rows that are there twice, or, if"),
        (recording(8), "run.csv: 8 rows, expected at least 9"),
        (recording(15), "run.csv: 15 rows in all, expected at least 20; record for longer"),
        (recording().assign(i=0.25), "run.csv: 'i' is 0.25 in all rows, so nothing can be learned of it"),
        (recording().assign(phi=1.0), "'alpha' is 1 in all rows"),
        (recording().assign(u=0.0), "run.csv: 'v' is 0 in all rows, so the model's scale stays open"),
        (recording().drop(columns="u"), "run.csv: no column 'u'; the columns are: time, phi, alpha_dot, i"),
        (recording().drop(columns="i"), "run.csv: no column 'i'"),
        (recording().drop(columns="time"), "run.csv: no column 'time'"),
        (recording().rename(columns={"phi": "phi_m"}), "no column 'phi'; did you mean 'phi_m'?"),
        (recording().iloc[:0], "run.csv: no rows below the column names"),
        (recording().assign(alpha_dot=lambda f: np.degrees(f["alpha_dot"])), r"(deg for rad?)"),
        (recording().assign(alpha_dot=lambda f: -f["alpha_dot"]), "'alpha_dot' is -1 times the derivative"),
        (recording().assign(time=lambda f: 1e3 * f["time"]), "(a factor of 1000?)"),
        (recording().assign(alpha_dot=lambda f: f["i"]), "has nothing to do with the derivative of 'alpha'"),
    ],
)  # fmt: skip
def test_unusable_data_are_refused_with_file_and_row(tmp_path, frame, message):
    with pytest.raises(DataError, match=re.escape(message)):
        load_frame(tmp_path, frame)


def test_a_coordinate_that_only_its_noise_moves_is_not_excited(tmp_path):
    noise = 1e-3 * np.random.default_rng(0).standard_normal(2001)
    with pytest.raises(DataError, match=r"'i' varies only 1(\.\d)? times .* it is not excited"):
        load_frame(tmp_path, recording().assign(i=noise))


def test_a_file_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(DataError, match=r"run.csv: cannot be read \(No such file"):
        load(tmp_path)


def test_every_file_that_is_at_fault_is_named(tmp_path):
    write(tmp_path, a=with_cell(3, "i", "x"), b=recording(), c=recording(5))
    with pytest.raises(DataError) as caught:
        load(tmp_path, files=["a.csv", "b.csv", "c.csv"])
    assert [line.split(":")[0] for line in str(caught.value).splitlines()] == ["a.csv", "c.csv"]


def test_a_test_file_with_the_numbers_of_a_training_file_is_refused(tmp_path):
    write(tmp_path, a=recording(), b=recording())
    with pytest.raises(DataError, match=r"b.csv: held out, but its numbers are those of a.csv"):
        load(tmp_path, files=["a.csv"], test=["b.csv"])


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_file_is_read_or_refused_but_never_ends_in_a_bug(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    text = recording(40).to_csv(index=False)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        length = data.draw(st.sampled_from([0, 1, 3, 40, 400]))
        new = data.draw(
            st.sampled_from(["", ",", ";", "\n", '"', "x", "-", "nan", "1e999", "\0", "#", "\t", "é", "9"])
        )
        text = text[:at] + new + text[at + length :]
        if not text:
            break
    (folder / "run.csv").write_text(text, "utf-8")
    try:
        frame = load(folder).frame
    except DataError:
        return
    assert np.isfinite(frame.to_numpy()).all()


# ── doubtful data ────────────────────────────────────────────────────────────────────────────────────────


def notes_on(folder, frame) -> list[str]:
    return [note for note in load_frame(folder, frame).notes if "no file is held out" not in note]


def test_good_data_are_not_doubted(tmp_path):
    assert notes_on(tmp_path, recording()) == []


def test_a_saturated_input_is_told_of_with_its_row(tmp_path):
    frame = recording().assign(u=lambda f: f["u"].clip(-24, 6))
    (note,) = notes_on(tmp_path, frame)
    row = int(re.match(r"run.csv:(\d+): 'v' stays at its extreme, 6, for \d+ rows", note)[1])
    assert frame["u"].iloc[row - 2] == 6 > frame["u"].iloc[row - 3]


def test_a_saturated_sensor_is_told_of(tmp_path):
    (note,) = notes_on(tmp_path, recording().assign(i=lambda f: f["i"].clip(-0.9, 2)))
    assert "'i' stays at its extreme, -0.9" in note


def test_a_velocity_that_is_somewhat_off_is_told_of(tmp_path):
    (note,) = notes_on(tmp_path, recording().assign(alpha_dot=lambda f: 1.3 * f["alpha_dot"]))
    assert note.startswith("'alpha_dot' is 1.3 times the derivative of 'alpha'; give the `unit`")


def test_a_noisy_velocity_is_still_a_derivative(tmp_path):
    noise = np.random.default_rng(0).standard_normal(2001)
    assert notes_on(tmp_path, recording().assign(alpha_dot=lambda f: f["alpha_dot"] + 0.25 * noise)) == []


def test_weak_excitation_is_told_of(tmp_path):
    noise = 0.15 * np.random.default_rng(0).standard_normal(2001)
    (note,) = notes_on(tmp_path, recording().assign(i=lambda f: f["i"] + noise))
    assert re.match(r"'i' varies only [45](\.\d)? times as much as its noise", note)


def test_a_part_of_the_circle_that_is_not_visited_is_told_of(tmp_path):
    frame = recording().assign(
        phi=lambda f: np.sin(5 * f["time"]), alpha_dot=lambda f: 5 * np.cos(5 * f["time"])
    )
    (note,) = notes_on(tmp_path, frame)
    assert note == "alpha covers 33% of the circle in training: elsewhere the model is a guess"


def test_a_quantity_that_stands_still_in_one_file_is_told_of(tmp_path):
    write(tmp_path, a=recording(), b=recording(phase=1).assign(i=0.0))
    assert "b.csv: 'i' is 0 in all its rows" in load(tmp_path, files=["a.csv", "b.csv"]).notes


def test_a_constant_input_is_told_of(tmp_path):
    assert notes_on(tmp_path, recording().assign(u=4.0)) == [
        "run.csv: 'v' is 4 in all rows; vary it to learn more"
    ]


# ── plateaus ─────────────────────────────────────────────────────────────────────────────────────────────

TIME = 1e-3 * np.arange(5000)
WAVE = 10 * np.sin(2 * np.pi * 1.3 * TIME)
NOISE = np.random.default_rng(3).standard_normal(len(TIME))


@pytest.mark.parametrize(
    "values",
    [
        WAVE,
        WAVE + 0.1 * NOISE,
        np.round(WAVE),
        np.round(WAVE, 1),
        np.round(WAVE + 0.3 * NOISE),
        np.where(WAVE > 0, 24.0, -24.0),
        np.where(WAVE > 0, 24.0, -24.0) + 0.1 * NOISE,
        np.repeat(NOISE[:100], 50),
        np.zeros(5000),
        NOISE,
        np.cumsum(NOISE),
        TIME,
    ],
    ids=[
        "sine", "noisy sine", "coarse encoder", "encoder", "noisy encoder", "two levels", "two noisy levels",
        "staircase", "constant", "white noise", "random walk", "ramp",
    ],
)  # fmt: skip
def test_signals_that_are_not_cut_off_have_no_plateau(values):
    assert plateaus(values) == []


@pytest.mark.parametrize("limit", [0.99, 0.9, 0.7, 0.4])
@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_signals_that_are_cut_off_have_one(limit, noise, sign):
    cut = sign * np.minimum(WAVE, 10 * limit) + noise * NOISE
    if noise and limit == 0.99:
        assert plateaus(cut) == []  # hidden in the noise
        return
    (found,) = plateaus(cut)
    assert found.level == pytest.approx(sign * 10 * limit, abs=0.3)
    assert found.share == pytest.approx(np.mean(10 * limit <= WAVE), abs=0.002 + 0.05 * (noise > 0))


def test_coordinates_of_the_tests_are_those_of_the_data(tmp_path):
    assert load_frame(tmp_path, recording()).coordinates == COORDINATES

"""Data sets: what they hold, how they are split and saved, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.data.dataset import (
    Dataset,
    estimate_missing,
    load_dataset,
    required_columns,
    save_dataset,
    split,
)
from exlinn_fmi.data.doubts import audit
from exlinn_fmi.errors import DataError
from exlinn_fmi.mechanics.coordinates import Coordinate

COORDINATES = (
    Coordinate("alpha", "rad", topology="circle"),
    Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),
)


def frame(rows: int = 40, trajectories: int = 2) -> pd.DataFrame:
    time = np.tile(np.arange(rows) * 0.01, trajectories)
    return pd.DataFrame(
        {
            "trajectory": np.repeat(np.arange(trajectories), rows),
            "time": time,
            "alpha": np.sin(time),
            "alpha_dot": np.cos(time),
            "i": time**2,
            "alpha_ddot": -np.sin(time),
            "i_dot": 2 * time,
            "v": np.cos(3 * time),
            "L": 1.0,
        }
    )


DATA = Dataset(frame(), COORDINATES, {"L": "J"})


def test_required_columns_come_in_the_order_of_the_contract() -> None:
    assert required_columns(COORDINATES) == list(frame().columns[:-1])


def test_arrays_have_no_cyclic_position_and_no_force_without_input() -> None:
    samples = DATA.arrays
    assert not samples.q[:, 1].any()
    assert not samples.F[:, 0].any()
    assert (samples.q[:, 0] == DATA.frame["alpha"]).all()
    assert (samples.a[:, 1] == DATA.frame["i_dot"]).all()
    assert (samples.F[:, 1] == DATA.frame["v"]).all()


def test_units_are_those_of_the_coordinates_and_of_further_columns() -> None:
    assert DATA.units["alpha_ddot"] == "rad/s2"
    assert DATA.units["i_dot"] == "A/s"
    assert DATA.units["L"] == "J"


def test_select_keeps_whole_trajectories() -> None:
    part = DATA.select([1])
    assert part.trajectories == [1]
    assert len(part) == 40


# ── split ────────────────────────────────────────────────────────────────────────────────────────────────


@settings(max_examples=50, deadline=None)
@given(
    st.integers(2, 60), st.integers(1, 4), st.floats(0.05, 0.95), st.integers(1, 12), st.integers(0, 2**31)
)
def test_split_gives_every_row_to_one_side(
    rows: int, trajectories: int, fraction: float, blocks: int, seed: int
) -> None:
    data = Dataset(frame(rows, trajectories).assign(row=np.arange(rows * trajectories)), COORDINATES)
    train, validation = split(data, fraction, blocks, seed)
    assert len(train) > 0
    assert len(validation) > 0
    both = np.concatenate([train.frame["row"], validation.frame["row"]])
    assert sorted(both) == list(range(rows * trajectories))


def test_split_takes_its_share_of_each_trajectory() -> None:
    _, validation = split(DATA.select([0, 1]), 0.8, 10, seed=3)
    again = validation.frame["time"].groupby(np.arange(len(validation)) // 8).nunique()
    assert len(validation) == 16
    assert (again == 8).all()


def test_parts_of_a_split_are_without_gaps() -> None:
    for part in split(DATA, 0.7, 10, seed=1):
        steps = part.frame.groupby("trajectory")["time"].diff().dropna()
        assert steps.to_numpy() == pytest.approx(0.01)


def test_split_is_the_same_for_the_same_seed_only() -> None:
    first, again, other = (split(DATA, 0.8, 10, seed)[1].frame for seed in (5, 5, 6))
    assert first.equals(again)
    assert not first.equals(other)


def test_one_row_cannot_be_split() -> None:
    with pytest.raises(DataError, match="found 1 rows, expected at least 2"):
        split(Dataset(frame(1, 1), COORDINATES), 0.8, 10, 0)


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_saved_data_set_reads_back_equal(tmp_path: Path) -> None:
    written = save_dataset(tmp_path, DATA)
    loaded = load_dataset(tmp_path)
    assert {p.name for p in written} == {"dataset.csv", "dataset.parquet", "dataset.meta.json"}
    assert loaded.frame.equals(DATA.frame)
    assert loaded.coordinates == COORDINATES
    assert loaded.units == DATA.units


def test_a_data_set_without_its_coordinates_is_refused(tmp_path: Path) -> None:
    save_dataset(tmp_path, DATA)
    (tmp_path / "dataset.meta.json").write_text("{}")
    with pytest.raises(DataError, match="no coordinates can be read"):
        load_dataset(tmp_path)


# ── missing columns ──────────────────────────────────────────────────────────────────────────────────────


def test_missing_accelerations_are_estimated_for_each_trajectory_apart() -> None:
    columns = {name: column for name, column in frame().items() if name not in ("alpha_ddot", "i_dot")}
    data = Dataset.from_columns(columns, COORDINATES)
    assert data.frame["alpha_ddot"].to_numpy() == pytest.approx(DATA.frame["alpha_ddot"].to_numpy(), abs=1e-8)
    assert data.frame["i_dot"].to_numpy() == pytest.approx(DATA.frame["i_dot"].to_numpy(), abs=1e-8)


def test_missing_velocity_and_acceleration_are_estimated_from_the_position() -> None:
    columns = {n: c for n, c in frame(400, 1).items() if n not in ("alpha_dot", "alpha_ddot", "trajectory")}
    data = Dataset.from_columns(columns, COORDINATES)
    time = data.frame["time"].to_numpy()
    assert data.frame["alpha_dot"].to_numpy() == pytest.approx(np.cos(time), abs=1e-8)
    assert data.frame["alpha_ddot"].to_numpy() == pytest.approx(-np.sin(time), abs=1e-6)


@pytest.mark.parametrize(("between", "linear"), [("hold", False), ("linear", True)])
@pytest.mark.parametrize("order", [1, 2])
def test_the_input_beside_an_estimated_acceleration_is_what_acted_in_its_window(
    between: str, linear: bool, order: int
) -> None:
    # m ẍ = u and l i̇ = u, integrated exactly: only the same filter over the input gives masses to the digits.
    random, h = np.random.default_rng(0), 0.01
    u = random.standard_normal((200, 2))
    later = np.vstack([u[1:], u[-1:]]) if linear else u
    v = np.vstack([np.zeros(2), np.cumsum(h * (u + later)[:-1] / 2, axis=0)])
    x = np.concatenate([[0.0], np.cumsum(h * v[:-1, 0] + h**2 * (2 * u + later)[:-1, 0] / 6)])
    rows = {
        "trajectory": 0,
        "time": np.arange(200) * h,
        "x": x / 2,
        "i": v[:, 1] / 3,
        "F": u[:, 0],
        "v": u[:, 1],
    }
    columns = pd.DataFrame(rows | ({"x_dot": v[:, 0] / 2} if order == 1 else {}))
    coordinates = (Coordinate("x", "m", input="F", input_unit="N"), COORDINATES[1])
    samples = Dataset(estimate_missing(columns, coordinates, between), coordinates).arrays
    assert 2 * samples.a[:, 0] == pytest.approx(samples.F[:, 0], abs=1e-8)
    assert 3 * samples.a[:, 1] == pytest.approx(samples.F[:, 1], abs=1e-9)


def test_recorded_forces_and_measured_accelerations_are_left_alone() -> None:
    assert (DATA.recorded_forces == DATA.arrays.F).all()
    columns = {name: column for name, column in frame().items() if name != "i_dot"}
    data = Dataset.from_columns(columns, COORDINATES)
    assert (data.recorded_forces[:, 1] == frame()["v"]).all()
    assert "v_matched" in data.select([0]).frame


def test_a_missing_current_cannot_be_estimated() -> None:
    columns = {name: column for name, column in frame().items() if name != "i"}
    with pytest.raises(DataError, match="'i' is missing and cannot be estimated, because 'Q' is cyclic"):
        Dataset.from_columns(columns, COORDINATES)


def test_too_short_a_trajectory_is_named() -> None:
    columns = {name: column for name, column in frame(5).items() if name != "i_dot"}
    with pytest.raises(DataError, match="column 'i' of trajectory 0: found 5 rows"):
        Dataset.from_columns(columns, COORDINATES)


# ── bad data ─────────────────────────────────────────────────────────────────────────────────────────────


def test_a_missing_column_is_named() -> None:
    with pytest.raises(DataError, match="column 'v' is missing; found trajectory, time"):
        Dataset(frame().drop(columns="v"), COORDINATES)


def test_time_is_needed() -> None:
    with pytest.raises(DataError, match="column 'time' is missing"):
        Dataset.from_columns({"alpha": [1.0]}, COORDINATES)


def test_lengths_that_differ_are_refused() -> None:
    with pytest.raises(DataError, match="column 'alpha' has 3 rows, expected 2 as in 'time'"):
        Dataset.from_columns({"time": [0.0, 1.0], "alpha": [0.0, 1.0, 2.0]}, COORDINATES)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_is_named_with_its_row(value: float) -> None:
    bad = frame()
    bad.loc[[7, 9], "i"] = value
    with pytest.raises(DataError, match=r"column 'i', row 7 \(the first is 0\): .* 2 such rows"):
        Dataset(bad, COORDINATES)


def test_text_is_no_number() -> None:
    with pytest.raises(DataError, match=r"column 'v' holds .*, expected numbers"):
        Dataset(frame().assign(v="1"), COORDINATES)


@pytest.mark.parametrize("step", [0.0, -0.02])
def test_time_that_does_not_increase_is_named_with_its_row(step: float) -> None:
    bad = frame()
    bad.loc[12, "time"] = bad.loc[11, "time"] + step
    with pytest.raises(DataError, match=r"column 'time', row 12 .* time must increase"):
        Dataset(bad, COORDINATES)


def test_rows_of_a_trajectory_stand_together() -> None:
    bad = frame().assign(trajectory=[0] * 20 + [1] * 20 + [0] * 40)
    bad["time"] = np.arange(80.0)
    with pytest.raises(DataError, match="rows of trajectory 0 do not stand together"):
        Dataset(bad, COORDINATES)


def test_excited_data_are_accepted() -> None:
    audit(DATA)


def test_too_few_rows_are_refused() -> None:
    with pytest.raises(DataError, match="trajectory 0: 10 rows in all, expected at least 20"):
        audit(Dataset(frame(10, 1), COORDINATES))


def test_a_constant_column_is_refused() -> None:
    with pytest.raises(DataError, match=r"'alpha' is 0.5 in all rows, so nothing can be learned"):
        audit(Dataset(frame().assign(alpha=0.5), COORDINATES))


def test_data_without_any_input_are_refused() -> None:
    with pytest.raises(DataError, match=r"'v' is 0 in all rows, so the model's scale stays open"):
        audit(Dataset(frame().assign(v=0.0), COORDINATES))

"""Signals over time: closed forms, spectra, and that a jump comes at its communication point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from exlinn_fmi.data.excitation import maximum_length_sequence, signal_function
from exlinn_fmi.errors import DataError
from exlinn_fmi.scenario.signals import Signal

SPECS = {
    "constant": {"value": 3.0},
    "step": {"time": 0.3, "before": 1.0, "after": 2.0},
    "ramp": {"slope": 2.0, "start": 1.0, "stop": 3.0, "offset": 0.5},
    "sine": {"amplitude": 2.0, "frequency": 0.5, "phase": 0.1, "offset": 1.0},
    "multisine": {"rms": 2.0, "band": [0.1, 5.0], "lines": 25, "offset": 1.0, "seed": 3},
    "chirp": {"amplitude": 2.0, "band": [0.5, 5.0], "duration": 4.0, "offset": 1.0},
    "prbs": {"amplitude": 2.0, "hold": 0.1, "order": 5, "offset": 1.0, "seed": 3},
}


def function(signal: str, folder: Path = Path(), **changes: object):
    spec = {"signal": signal, **SPECS.get(signal, {}), **changes}
    return signal_function(TypeAdapter(Signal).validate_python(spec), folder)


def at(signal: str, times: list[float], **changes: object) -> list[float]:
    return function(signal, **changes)(np.array(times)).tolist()


# ── closed forms ─────────────────────────────────────────────────────────────────────────────────────────


def test_a_constant_is_constant() -> None:
    assert at("constant", [-1.0, 0.0, 1e6]) == [3.0, 3.0, 3.0]


def test_a_step_happens_at_its_time() -> None:
    assert at("step", [0.0, 0.2999, 0.3, 0.4]) == [1.0, 1.0, 2.0, 2.0]


def test_a_ramp_rises_between_start_and_stop() -> None:
    assert at("ramp", [0.0, 1.0, 2.0, 3.0, 9.0]) == [0.5, 0.5, 2.5, 4.5, 4.5]


def test_a_ramp_without_stop_goes_on() -> None:
    assert at("ramp", [1001.0], stop=None) == [2000.5]


def test_a_ramp_that_stops_before_it_starts_stays() -> None:
    assert at("ramp", [0.0, 9.0], stop=0.5) == [0.5, 0.5]


def test_a_sine_follows_its_formula() -> None:
    times = [0.0, 0.3, 17.0]
    assert at("sine", times) == pytest.approx([1 + 2 * np.sin(np.pi * t + 0.1) for t in times])


def test_a_linear_chirp_sweeps_its_band() -> None:
    t = np.linspace(0.0, 3.99, 200)
    cycles = 0.5 * t + 4.5 * t**2 / 8  # its derivative goes from 0.5 to 5 Hz in 4 s
    assert np.allclose(function("chirp")(t), 1 + 2 * np.sin(2 * np.pi * cycles), atol=1e-12)


def test_a_logarithmic_chirp_follows_its_formula() -> None:
    t, k = 2.0, np.log(10.0)
    cycles = 0.5 * 4 / k * (np.exp(k * t / 4) - 1)
    assert at("chirp", [t], method="logarithmic") == pytest.approx([1 + 2 * np.sin(2 * np.pi * cycles)])


def test_a_logarithmic_chirp_of_one_frequency_is_a_sine() -> None:
    value = at("chirp", [0.3], method="logarithmic", band=[2.0, 2.0])
    assert value == pytest.approx([1 + 2 * np.sin(2 * np.pi * 2 * 0.3)])


def test_a_chirp_starts_again_after_its_duration() -> None:
    assert at("chirp", [0.7, 4.7, -3.3]) == pytest.approx(at("chirp", [0.7]) * 3)


# ── multisine ────────────────────────────────────────────────────────────────────────────────────────────


def spectrum(values: np.ndarray) -> np.ndarray:
    return 2 * np.abs(np.fft.rfft(values)) / len(values)


def test_a_multisine_has_equal_lines_in_its_band_and_nothing_else() -> None:
    times = np.arange(10_000) * 1e-3  # 10 s: bins of 0.1 Hz
    lines = spectrum(function("multisine", band=[0.5, 5.0], lines=10, offset=0.0)(times))
    present = np.flatnonzero(lines > 1e-6)
    assert (present * 0.1).tolist() == pytest.approx(np.linspace(0.5, 5.0, 10).tolist())
    assert lines[present] == pytest.approx(np.full(10, 2.0 * np.sqrt(2 / 10)))


def test_a_multisine_has_the_rms_and_mean_asked_for() -> None:
    values = function("multisine", band=[0.5, 5.0], lines=10)(np.arange(10_000) * 1e-3)
    assert values.mean() == pytest.approx(1.0)
    assert values.std() == pytest.approx(2.0)


def test_seeds_give_different_multisines() -> None:
    assert at("multisine", [0.1], seed=1) != at("multisine", [0.1], seed=2)


def test_an_empty_band_is_refused() -> None:
    with pytest.raises(DataError, match=r"band 5 … 5 Hz holds no 25 different frequencies"):
        function("multisine", band=[5.0, 5.0])


def test_a_multisine_of_one_line_is_a_sine_of_the_lower_frequency() -> None:
    values = function("multisine", band=[2.0, 3.0], lines=1, offset=0.0)(np.arange(1000) * 1e-3)
    assert np.flatnonzero(spectrum(values) > 1e-6).tolist() == [2]


# ── PRBS ─────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("order", [*range(3, 17), 20])
def test_a_register_runs_through_all_its_contents(order: int) -> None:
    bits = maximum_length_sequence(order, 1)
    windows = np.zeros(len(bits), dtype=np.int64)
    for k in range(order):
        windows = 2 * windows + np.roll(bits, -k).astype(np.int64)
    assert np.unique(windows).tolist() == list(range(1, 2**order))


@pytest.mark.parametrize("order", [3, 7, 10])
def test_a_maximum_length_sequence_is_uncorrelated_with_its_shifts(order: int) -> None:
    levels = 2 * maximum_length_sequence(order, 5) - 1
    n = len(levels)
    correlation = [float(levels @ np.roll(levels, k)) for k in range(n)]
    assert correlation == [float(n)] + [-1.0] * (n - 1)


def test_a_prbs_holds_each_level_and_repeats_after_its_period() -> None:
    times = (np.arange(31) + 0.5) * 0.1
    values = function("prbs")(times)
    assert set(values) == {-1.0, 3.0}
    for shift in (-0.04, 0.04, 3.1, -31.0):
        assert (function("prbs")(times + shift) == values).all()


def test_a_seed_shifts_the_prbs() -> None:
    times = (np.arange(31) + 0.5) * 0.1
    patterns = {tuple(function("prbs", seed=seed)(times)) for seed in range(8)}
    assert len(patterns) > 4


# ── evaluation ───────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("signal", list(SPECS))
@given(data=st.data())
def test_a_signal_does_not_depend_on_the_pieces_it_is_evaluated_in(signal: str, data: st.DataObject) -> None:
    f = function(signal)
    times = np.array(data.draw(st.lists(st.floats(-10, 100), max_size=40)))
    cut = data.draw(st.integers(0, len(times)))
    pieces = np.concatenate([f(times[:cut]), f(times[cut:])])
    assert np.array_equal(pieces, f(times))
    assert all(f(times[k : k + 1])[0] == pieces[k] for k in range(len(times)))


def test_a_long_multisine_is_evaluated_in_blocks_with_the_same_values() -> None:
    f = function("multisine", lines=10_000, band=[0.1, 50.0])
    times = np.linspace(0, 1, 100)
    assert np.array_equal(f(times), np.concatenate([f(times[k : k + 1]) for k in range(100)]))


@given(
    tick=st.integers(0, 10**6),
    h=st.sampled_from([1e-4, 1e-3, 0.01, 0.1, 1 / 3, 0.7]),
    start=st.sampled_from([0.0, -5.0, 0.1, 1e4]),
)
def test_a_step_comes_at_its_tick_whatever_the_rounding(tick: int, h: float, start: float) -> None:
    # The user writes the time in decimal; the master computes start + k·h.
    f = function("step", time=float(f"{start + tick * h:.15g}"))
    before, there = f(np.array([start + (tick - 1) * h, start + tick * h]))
    assert (before, there) == (1.0, 2.0)


@given(tick=st.integers(0, 10**6), h=st.sampled_from([1e-3, 0.1, 0.3]), factor=st.integers(1, 20))
def test_a_prbs_changes_at_ticks_whatever_the_rounding(tick: int, h: float, factor: int) -> None:
    f = function("prbs", hold=h * factor)
    held = f(np.array([tick * h, (tick // factor * factor) * h]))
    assert held[0] == held[1]


# ── tables ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def table(tmp_path: Path):
    def make(text: str, **changes: object):
        (tmp_path / "table.csv").write_text(text)
        return function("table", tmp_path, **{"file": "table.csv", "column": "v", **changes})

    return make


ROWS = "time, v\n0.1, 1\n0.2, 3\n0.4, -1\n"


def test_a_table_is_interpolated_between_rows(table) -> None:
    assert table(ROWS)(np.array([0.1, 0.15, 0.2, 0.3])) == pytest.approx([1.0, 2.0, 3.0, 1.0])


def test_a_table_may_hold_each_row(table) -> None:
    f = table(ROWS, interpolation="hold")
    assert f(np.array([0.0, 0.15, 0.1 + 0.1 - 1e-16, 0.3, 9.0])).tolist() == [1.0, 1.0, 3.0, 3.0, -1.0]


def test_a_table_holds_its_ends_outside(table) -> None:
    assert table(ROWS)(np.array([-5.0, 5.0])).tolist() == [1.0, -1.0]


@pytest.mark.parametrize("time", [0.05, 0.41])
def test_a_table_that_is_not_to_be_left_names_the_time(table, time: float) -> None:
    f = table(ROWS, outside="error")
    message = rf"table\.csv: no value at t = {time} s, the rows go from 0\.1 to 0\.4 s"
    with pytest.raises(DataError, match=message):
        f(np.array([0.2, time]))


def test_a_table_that_is_not_to_be_left_reaches_its_last_row(table) -> None:
    f = table(ROWS, outside="error")
    assert f(np.array([0.1 - 1e-17, 0.4, 0.1 + 3 * 0.1])).tolist() == [1.0, -1.0, -1.0]


def test_booleans_in_a_table_are_0_and_1(table) -> None:
    assert table("time,v\n0,True\n1,False\n")(np.array([0.0, 1.0])).tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,w\n0,1\n", r"no column 'v'; the columns are: time, w"),
        ("time,V\n0,1\n", r"no column 'v'"),
        ("t,v\n0,1\n", r"no column 'time'"),
        ("time,v\n", r"no rows below the column names"),
        ("", r"not a CSV table \(No columns to parse"),
        (
            "time,v\n0,1\n1,2\n1,3\n",
            r"row 3 \(counted below the column names\): time 1 s does not come after 1 s",
        ),
        ("time,v\n0,1\n2,2\n1,3\n", r"row 3 .*: time 1 s does not come after 2 s"),
        ("time,v\n0,1\n1,\n2,3\n", r"row 2 .*, column 'v': found nothing or nan, expected a finite number"),
        ("time,v\n0,1\n1,nan\n", r"row 2 .*, column 'v'"),
        ("time,v\n0,1\n1,inf\n", r"row 2 .*, column 'v': found inf"),
        ("time,v\n0,one\n", r"row 1 .*, column 'v': found 'one'"),
        ("time,v\nzero,1\n", r"row 1 .*, column 'time': found 'zero'"),
    ],
)
def test_a_table_that_is_no_signal_is_refused(table, text: str, message: str) -> None:
    with pytest.raises(DataError, match=rf"table\.csv: {message}"):
        table(text)


def test_a_missing_column_is_told_with_the_nearest(table) -> None:
    with pytest.raises(DataError, match=r"no column 'voltge'; did you mean 'voltage'\?"):
        table("time,voltage\n0,1\n", column="voltge")


def test_a_missing_table_is_told_with_the_nearest_file(table, tmp_path: Path) -> None:
    table(ROWS)
    with pytest.raises(DataError, match=r"tabel\.csv: no such file; did you mean 'table\.csv'\?"):
        function("table", tmp_path, file="tabel.csv", column="v")
    with pytest.raises(DataError, match="there are no CSV files there"):
        function("table", tmp_path, file="nowhere/table.csv", column="v")


def test_a_binary_file_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_bytes(bytes(range(128, 256)))
    with pytest.raises(DataError, match="not a CSV table"):
        function("table", tmp_path, file="table.csv", column="v")

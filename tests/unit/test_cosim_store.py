"""Runs on disk: rows that stream, checkpoints that a run goes on from to the last bit, and pacing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cosim_helpers import Integrator, graph
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Component, Variable
from exlinn_fmi.components.packing import pack, unpack
from exlinn_fmi.components.python import PythonComponent
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.cosim import store as store_module
from exlinn_fmi.cosim.loops import LoopOptions
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.cosim.store import RowFile, Store
from exlinn_fmi.errors import InputError, Interrupted, StorageError
from exlinn_fmi.scenario.signals import Multisine


class Filter(PythonComponent):
    """A lag with a memory beside its variables; y = x + 0.3 u has direct feed-through."""

    variables = (Variable("u", "input"), Variable("y", "output", depends_on=("u",)))

    def initialize(self, start_time: float, stop_time: float) -> None:
        self.x, self.past = 0.1, [0.0, 0.0]

    def outputs(self, t: float) -> None:
        self["y"] = self.x + 0.3 * self["u"] - 0.1 * self.past[0]

    def advance(self, t: float, h: float) -> None:
        self.past = [self.past[1], self.x]
        self.x += h * (self["u"] - np.sin(self.x))

    def get_state(self) -> object:
        return {"x": self.x, "past": (self.past, None, np.arange(2))}

    def set_state(self, state: dict) -> None:
        self.x, self.past = state["x"], state["past"][0]


class Saved(Integrator):
    can_save_state = can_serialize_state = True

    def save_state(self) -> object:
        return self.values.copy()

    def restore_state(self, state: object) -> None:
        self.values[:] = state

    def serialize_state(self, state: object) -> bytes:
        return pack(state)

    def deserialize_state(self, data: bytes) -> object:
        return unpack(data)


def make(**options: object) -> Master:
    parts: list[Component] = [
        SignalSource("s", Multisine(signal="multisine", rms=1, band=(0.1, 5)), Path()),
        Filter("a"),
        Filter("b"),
        Saved("i"),
    ]
    wires = ("s.y > i.u", "a.y > b.u", "b.y > a.u")
    return Master(graph(parts, *wires), 0.0, 2.0, 0.01, **options)


OPTIONS = [
    {},
    {"algorithm": "gauss-seidel"},
    {"loops": LoopOptions("newton")},
    {"record_every": 7},
    {"own_steps": {"b": 0.03}},
]


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("at", [0, 1, 123, 199])
def test_a_run_that_goes_on_from_a_checkpoint_ends_alike(tmp_path: Path, at: int, options: dict):
    expected = make(**options).run().frame
    asked = iter([*[False] * at, True])
    folder = tmp_path / "part"
    first = make(**options).run(should_stop=lambda: next(asked), store=Store(folder, every=1e9, key="k"))
    assert isinstance(first.error, Interrupted)
    assert "--resume goes on from there" in str(first.error)
    second = make(**options).run(store=Store(folder, every=1e9, key="k", resume=True))
    assert second.error is None
    assert second.frame.to_numpy().tobytes() == expected.to_numpy().tobytes()
    assert second.statistics["steps"] == (len(expected) - 1) * options.get("record_every", 1)


def test_rows_after_the_last_checkpoint_are_made_again(tmp_path: Path):
    expected = make().run().frame
    asked = iter([*[False] * 100, True])
    make().run(should_stop=lambda: next(asked), store=Store(tmp_path, every=1e9))
    with (tmp_path / "rows.f64").open("ab") as stream:  # as of a run that was killed later
        stream.write(b"\1" * 1001)
    frame = make().run(store=Store(tmp_path, every=1e9, resume=True)).frame
    assert frame.to_numpy().tobytes() == expected.to_numpy().tobytes()


def test_components_that_cannot_be_saved_are_named_before_the_run(tmp_path: Path):
    class Odd(Filter):
        def get_state(self) -> object:
            return object()

    parts = [Odd("odd"), Filter("good"), Integrator("i")]
    master = Master(graph(parts), 0.0, 1.0, 0.1)
    with pytest.raises(
        InputError, match=r"checkpoint: not all components .*odd: .*a object.*; i: it has no way"
    ):
        master.run(store=Store(tmp_path, every=1.0))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "there is no checkpoint to go on from"),
        (b"{", "cannot be read"),
        (b"{}", "cannot be read"),
        (pack({"key": "other"}), "is of a run with other settings"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path: Path, content: bytes | None, said: str):
    if content is not None:
        (tmp_path / "checkpoint.json").write_bytes(content)
    with pytest.raises(InputError, match=said):
        make().run(store=Store(tmp_path, key="k", resume=True))


def test_streamed_rows_are_those_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(store_module.RowFile, "block", 16)
    expected = make().run().frame
    result = make().run(store=Store(tmp_path, always=True))
    assert result.frame.to_numpy().tobytes() == expected.to_numpy().tobytes()
    assert np.concatenate(list(result.rows.blocks())).tobytes() == expected.to_numpy().tobytes()
    assert max(map(len, result.rows.blocks())) == 16


@pytest.mark.parametrize("every", [1, 3])
def test_a_frame_of_many_rows_is_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int):
    expected = make(record_every=every).run().frame
    monkeypatch.setattr(store_module, "FULL_FRAME", 8 * 8 * 60)
    monkeypatch.setattr(store_module, "THINNED_FRAME", 8 * 8 * 50)
    monkeypatch.setattr(store_module.RowFile, "block", 16)
    result = make(record_every=every).run(store=Store(tmp_path))
    n = -(-len(expected) // 50)
    assert result.frame.equals(expected[::n].reset_index(drop=True))
    assert result.rows.rows == len(expected)


def test_few_rows_stay_in_memory(tmp_path: Path):
    assert make().run(store=Store(tmp_path / "part")).rows is None
    assert not (tmp_path / "part").exists()


def test_a_full_disk_ends_the_run_with_the_rows_so_far(tiny_disk: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(store_module.RowFile, "block", 100)
    result = Master(graph([Integrator("a")]), 0.0, 1000.0, 0.1).run(store=Store(tiny_disk / "p", always=True))
    assert isinstance(result.error, StorageError)
    assert "No space left on device" in str(result.error)
    assert len(result.frame) > 1000


def test_rows_that_cannot_be_written_are_explained(tmp_path: Path):
    (tmp_path / "p").write_text("")
    with pytest.raises(StorageError, match="could not be written"):
        RowFile(tmp_path / "p" / "rows.f64", 3)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


@given(VALUES)
@settings(deadline=None)
def test_values_come_back_as_they_were(value: object):
    assert unpack(pack(value)) == value


def test_arrays_come_back_to_the_last_bit():
    for array in (
        np.array([0.1, np.nan, -np.inf, -0.0]),
        np.arange(6, dtype="i2").reshape(2, 3),
        np.float32(3),
    ):
        back = unpack(pack({"a": [array]}))["a"][0]
        assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())
    with pytest.raises(NotImplementedError, match="a set"):
        pack([{1}])


# ── pacing ───────────────────────────────────────────────────────────────────────────────────────────────


def test_a_paced_run_takes_its_time_and_misses_nothing():
    result = Master(graph([Integrator("a")]), 0.0, 1.0, 0.1).run(pace=5.0)
    assert 0.2 <= result.statistics["seconds"] < 2.0
    assert len(result.frame) == 11


def test_deadlines_that_are_missed_are_counted():
    class Slow(Integrator):
        def step(self, t: float, h: float) -> object:
            if abs(t - 0.5) < 1e-9:
                import time

                time.sleep(0.1)
            return super().step(t, h)

    result = Master(graph([Slow("a"), Integrator("b")]), 0.0, 1.0, 0.1).run(pace=2.0)
    told = result.statistics
    assert told["missed_deadlines"] >= 1
    assert told["worst_delay"] >= 0.05 - 1e-3
    assert told["first_delay_at"] is not None
    assert told["late_steps"]["a"] >= 1
    assert told["longest_step"]["a"] >= 0.1
    rows = result.frame
    assert list(rows)[-3:] == ["timing.delay", "timing.a", "timing.b"]
    assert {result.units[name] for name in list(rows)[-3:]} == {"s"}
    assert rows["timing.a"][6] >= 0.1  # the step from 0.5 to 0.6 s
    assert told["worst_delay"] == rows["timing.delay"].max()
    assert told["longest_step"]["b"] == rows["timing.b"].max()
    assert told["late_steps"]["a"] == np.count_nonzero(rows["timing.a"] > 0.05)


def test_a_component_of_longer_steps_may_take_longer():
    class Slow(Integrator):
        def step(self, t: float, h: float) -> object:
            import time

            time.sleep(0.01)
            return super().step(t, h)

    def late(own: float) -> int:
        made = Master(graph([Slow("a")]), 0.0, 200.0, 50.0, {"a": own}).run(pace=1e4)
        return made.statistics["late_steps"]["a"]

    assert late(50.0) == 4  # 5 ms are left for each
    assert Master(graph([Slow("a")]), 0.0, 2.0, 1.0).run(pace=2.0).statistics["late_steps"]["a"] == 0


def test_a_row_tells_the_worst_since_the_one_before():
    class Slow(Integrator):
        def step(self, t: float, h: float) -> object:
            import time

            time.sleep(0.05 * (round(t) == 4))
            return super().step(t, h)

    rows = Master(graph([Slow("a")]), 0.0, 12.0, 1.0, record_every=3).run(pace=1e3).frame
    assert len(rows) == 5
    assert np.argmax(rows["timing.a"]) == 2
    assert rows["timing.a"][2] >= 0.05


def test_a_run_without_pace_has_no_timing():
    result = Master(graph([Integrator("a")]), 0.0, 1.0, 0.1).run()
    assert not [name for name in result.frame if name.startswith("timing")]
    assert "late_steps" not in result.statistics


def test_paced_rows_stream_to_disk_as_well(tmp_path: Path):
    store = Store(tmp_path, None, "key", resume=False, always=True)
    result = Master(graph([Integrator("a")]), 0.0, 1.0, 0.1).run(store=store, pace=100.0)
    assert list(result.frame)[-2:] == ["timing.delay", "timing.a"]
    assert np.all(result.frame["timing.a"][1:] > 0.0)


def test_a_paced_run_can_be_stopped_while_it_waits():
    asked = iter([False, False, True, True])
    result = Master(graph([Integrator("a")]), 0.0, 1000.0, 100.0).run(
        should_stop=lambda: next(asked), pace=1.0
    )
    assert isinstance(result.error, Interrupted)
    assert result.statistics["seconds"] < 10

"""Values of all types, arrays with structural parameters, clocks, and FMI 1.0, on FMUs of our own sources."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from fmu_helpers import Driver, probe
from hypothesis import given
from hypothesis import strategies as st
from reference_fmus import TYPES, feedthrough, reference, slave
from test_reference_fmus import ball

from exlinn_fmi.components.base import Status
from exlinn_fmi.components.fmu import FmuComponent, FmuSettings, read_variables
from exlinn_fmi.components.texts import handle, text
from exlinn_fmi.components.wide import fits, joined, rest_of
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.describe import describe
from exlinn_fmi.errors import FmuError, InputError, ScenarioError
from exlinn_fmi.pipeline import simulate
from exlinn_fmi.scenario.schema import FmuComponent as Spec
from exlinn_fmi.workspace import Run


@pytest.fixture
def opened() -> Iterator:
    """Opens an FMU, closed at the end."""
    with ExitStack() as stack:

        def open_(path: Path, **structure: float) -> Driver:
            component = FmuComponent("it", path, FmuSettings(structure=structure))
            return Driver(stack.enter_context(closing(component)))

        yield open_


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FMU without Event Mode that passes whole numbers through."""
    return probe(tmp_path_factory.mktemp("whole"), version=3)


# ── all types ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("kind", TYPES)
def test_numbers_of_every_type_pass_through(tmp_path: Path, opened, kind: str) -> None:
    driver = opened(feedthrough(tmp_path)).begin(h=0.1, stop=1.0)
    for value in (1.0, 0.0) if kind == "Boolean" else (100.0, 3.0):
        assert driver.set(**{f"{kind}_in": value}) == Status.OK
        assert driver.get(f"{kind}_out") == [value]


def test_texts_and_binaries_pass_through(tmp_path: Path, opened) -> None:
    driver = opened(feedthrough(tmp_path)).begin(
        h=0.1, stop=1.0, String_in=handle("größe"), Binary_in=handle("0aff")
    )
    assert [text(x) for x in driver.get("String_out", "Binary_out")] == ["größe", b"\x0a\xff"]
    driver.set(String_in=handle("then"), Binary_in=handle(b"\0\1\0"))
    driver.run(1)
    assert [text(x) for x in driver.get("String_out", "Binary_out")] == ["then", b"\0\1\0"]


def test_elements_of_a_text_array_are_set_one_by_one(tmp_path: Path, opened) -> None:
    driver = opened(feedthrough(tmp_path)).begin(h=0.1, stop=1.0, **{"names[2]": handle("second")})
    assert [text(x) for x in driver.get("names_out[2]", "names_out[1]")] == ["second", "p"]


LARGE = {"Int64": (2**63 - 1, -(2**63), 2**53 + 1, -(2**62) - 3, 7), "UInt64": (2**64 - 1, 2**63 + 1, 7)}


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("kind", "value"), [(kind, value) for kind in LARGE for value in LARGE[kind]])
def test_whole_numbers_of_64_bits_are_given_connected_and_recorded_exactly(
    tmp_path: Path, whole: Path, kind: str, value: int, compiled: bool, algorithm: str
) -> None:
    graph = Graph({name: FmuComponent(name, whole) for name in "ab"}, [(f"a.{kind}_out", f"b.{kind}_in")])
    master = Master(graph, 0.0, 0.3, 0.1, compiled=compiled, algorithm=algorithm)
    result = master.run({"a": {f"{kind}_in": value}})
    assert result.error is None
    assert result.statistics["stepping"] == ("compiled" if compiled else "plain")
    for column in (f"a.{kind}_in", f"a.{kind}_out", f"b.{kind}_in", f"b.{kind}_out"):
        assert result.frame[column].dtype == kind.lower()
        assert result.frame[column].tolist() == [value] * 4


def test_a_real_input_is_given_the_nearest_of_a_large_whole_number(tmp_path: Path, opened) -> None:
    parts = {name: FmuComponent(name, feedthrough(tmp_path)) for name in "ab"}
    result = Master(Graph(parts, [("a.Int64_out", "b.u[1]")]), 0.0, 0.1, 0.1).run(
        {"a": {"Int64_in": 2**53 + 1}}
    )
    assert result.frame["b.u[1]"].tolist() == [2.0**53] * 2
    assert result.frame["a.Int64_out"].tolist() == [2**53 + 1] * 2


EXACT = """
name: exact
components:
  a:
    fmu: Probe.fmu
    isolate: ISOLATE
    start: {Int64_in: 9223372036854775807, UInt64_in: 18446744073709551615}
  b: {fmu: Probe.fmu, isolate: ISOLATE}
connections: {a.Int64_out: b.Int64_in, a.UInt64_out: b.UInt64_in}
simulate: {stop: 0.4, step: 0.1, stream: STREAM}
events:
  - {on: b.UInt64_in, set: 5, at: 0.1, until: 0.2}
  - {on: b.Int64_in, hold: true, at: 0.2}
"""


@pytest.mark.parametrize(("isolate", "stream"), [("false", "true"), ("true", "false")])
def test_large_numbers_of_a_scenario_are_exact_in_its_files(
    tmp_path: Path, whole: Path, isolate: str, stream: str
) -> None:
    (tmp_path / "Probe.fmu").write_bytes(whole.read_bytes())
    file = tmp_path / "exact.yaml"
    file.write_text(EXACT.replace("ISOLATE", isolate).replace("STREAM", stream))
    work = Run.open(file, tmp_path / "run")
    simulate(work)
    most, bits = 2**63 - 1, 2**64 - 1
    for table in (
        pd.read_parquet(work.folder / "trajectories.parquet"),
        pd.read_csv(work.folder / "trajectories.csv"),
    ):
        assert table["b.Int64_out"].tolist() == [most] * 5
        assert table["b.UInt64_out"].tolist() == [bits, 5, bits, bits, bits]
        assert table["b.UInt64_out"].dtype == np.uint64


def test_a_number_beyond_its_type_is_told(tmp_path: Path, whole: Path) -> None:
    (tmp_path / "Probe.fmu").write_bytes(whole.read_bytes())
    file = tmp_path / "exact.yaml"
    file.write_text(EXACT.replace("9223372036854775807", "9223372036854775808").replace("ISOLATE", "false"))
    with pytest.raises(ScenarioError, match=r"start.Int64_in: expected -9.22337e\+18 … 9.22337e\+18"):
        Run.open(file, tmp_path / "run")


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**64 - 1))
def test_a_whole_number_is_what_its_two_parts_make(signed: int, unsigned: int) -> None:
    for kind, value in (("int64", signed), ("uint64", unsigned)):
        number = np.array([value], dtype=kind)
        nearest, rest = number.astype(float), rest_of(number)
        assert fits(nearest, rest, kind).all()
        assert joined(nearest, rest, kind).tolist() == [value]
        assert rest[0] == value - int(nearest[0])


def test_texts_are_connected(tmp_path: Path) -> None:
    parts = [(tmp_path / name) for name in ("a", "b")]
    for part in parts:
        part.mkdir()
    graph = {p.name: FmuComponent(p.name, feedthrough(p)) for p in parts}
    master = Master(Graph(graph, [("a.String_out", "b.String_in")]), 0.0, 1.0, 0.1)
    seen = []
    get = graph["b"].get

    def watch(indices: np.ndarray, values: np.ndarray) -> Status:
        status = get(indices, values)
        one = np.zeros(1)
        get(np.array([graph["b"].index("String_out")], dtype=np.intp), one)
        seen.append(text(one[0]))
        return status

    graph["b"].get = watch  # type: ignore[method-assign]
    result = master.run({"a": {"String_in": handle("hello"), "Binary_in": handle(b"\0\xff")}})
    assert result.error is None
    assert seen[-1] == "hello"
    assert result.frame["b.String_in"].tolist() == ["hello"] * 11
    assert result.frame["a.Binary_out"].tolist() == [b"\0\xff"] * 11
    with pytest.raises(InputError, match="types do not fit, String into Real"):
        Graph(graph, [("a.String_out", "b.u[1]")])


# ── arrays ───────────────────────────────────────────────────────────────────────────────────────────────


def test_a_state_space_model_of_the_sizes_asked_for_follows_its_matrices(tmp_path: Path, opened) -> None:
    a = np.array([[-1.0, 0.5, 0.0], [0.0, -2.0, 0.25], [0.1, 0.0, -0.5]])
    b, c, d = np.array([[1.0], [0.0], [2.0]]), np.array([[1.0, -1.0, 3.0]]), np.array([[0.5]])
    spec = Spec(
        fmu="x",
        start={"m": 1, "n": 3, "r": 1, "A": a.tolist(), "B": b.tolist(), "C": c.tolist(), "D": d.tolist()}
        | {"x0": [1.0, 2.0, 3.0]},
    )
    driver = opened(feedthrough(tmp_path), **spec.starts()).begin(h=0.01, stop=1.0, **spec.starts())
    x = np.array([1.0, 2.0, 3.0])
    for k in range(50):
        u = np.array([np.sin(0.1 * k)])
        driver.set(**{"u[1]": u[0]})
        assert driver.get("y[1]", "x[1]", "x[3]") == pytest.approx([*(c @ x + d @ u), x[0], x[2]], abs=1e-12)
        # Clocks tick within the step: it is taken in parts, each an Euler step of its own.
        ends = [
            t
            for t in [0.05 + 0.1 * j for j in range(10)]
            if 0.01 * k < t - 1e-9 and t < 0.01 * (k + 1) - 1e-9
        ]
        for start, end in zip([0.01 * k, *ends], [*ends, 0.01 * (k + 1)], strict=True):
            x = x + (end - start) * (a @ x + b @ u)
        driver.run(1)


def test_elements_of_an_array_keep_what_was_set_before(tmp_path: Path, opened) -> None:
    driver = opened(feedthrough(tmp_path)).begin(h=0.1, stop=1.0)
    driver.set(**{"u[1]": 5.0})
    driver.set(**{"u[2]": 7.0})
    assert driver.get("u[1]", "u[2]") == [5.0, 7.0]


def test_sizes_that_the_fmu_refuses_are_told(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match="does not take the structural parameters: fmi3SetUInt64"):
        FmuComponent("it", feedthrough(tmp_path), FmuSettings(structure={"n": 9.0}))


def test_structural_parameters_decide_on_the_variables(tmp_path: Path) -> None:
    names = {
        v.name for v in read_variables(feedthrough(tmp_path), settings=FmuSettings(structure={"n": 1.0}))
    }
    assert {"A[1,1]", "B[1,2]", "x[1]"} <= names
    assert not {"A[1,2]", "x[2]"} & names


# ── clocks ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("step", [0.05, 0.1, 1.0])
def test_periodic_and_countdown_clocks_tick_when_they_should(tmp_path: Path, opened, step: float) -> None:
    driver = opened(feedthrough(tmp_path)).begin(h=step, stop=4.0)
    driver.run(round(2.0 / step))
    # Ticks at 0.05, 0.15, …, 1.95; each fifth starts a countdown: 0.45 → 0.7, 0.95 → 1.2, 1.45 → 1.7.
    assert driver.get("ticks", "counted") == [20.0, 3.0]


# ── FMI 1.0 ──────────────────────────────────────────────────────────────────────────────────────────────


def test_an_fmi1_slave_integrates_and_passes_its_types_through(tmp_path: Path, opened) -> None:
    driver = opened(slave(tmp_path)).begin(h=0.1, stop=1.0, gain=3.0, on=True, n=-4, label=handle("x"))
    driver.set(u=2.0)
    driver.run(5)
    assert driver.get("x", "gain", "n", "on") == pytest.approx([3.0, 3.0, -4.0, 1.0], abs=1e-12)
    assert text(driver.get("label")[0]) == "x"
    assert "minus_x" not in {v.name for v in driver.component.variables}
    assert not driver.component.can_save_state


def test_an_fmi1_slave_runs_under_the_master_in_both_ways_of_stepping(tmp_path: Path) -> None:
    frames = []
    for compiled in (False, True):
        master = Master(
            Graph({"it": FmuComponent("it", slave(tmp_path))}, []), 0.0, 1.0, 0.1, compiled=compiled
        )
        result = master.run({"it": {"u": 1.0}})
        assert result.error is None
        frames.append(result.frame)
    assert frames[0].equals(frames[1])
    assert frames[0]["it.x"].iloc[-1] == pytest.approx(2.0)


def test_an_error_of_an_fmi1_slave_comes_with_its_words(tmp_path: Path, opened) -> None:
    driver = opened(slave(tmp_path, "FAULT=3")).begin(h=0.1, stop=1.0)
    driver.run(5)
    assert driver.step() == Status.ERROR
    assert driver.component.message == "fmiDoStep returned fmiError: the bearing is hot"


# ── what exlinn info says, and states as bytes ───────────────────────────────────────────────────────────


def test_info_shows_uses_capabilities_arrays_and_clocks(tmp_path: Path) -> None:
    said = describe(feedthrough(tmp_path))
    assert "co_simulation: steps of any length, Event Mode" in said
    assert "array A[2,2]" in said
    assert "clock tick: input, constant, every 0.1 s from 0.05 s on" in said
    assert "clock countdown: input, countdown" in said
    assert "structural parameters, which size arrays: m, n, r" in said
    assert "'00ff'" in said
    said = describe(reference(tmp_path, "BouncingBall", 2))
    assert "model_exchange: saves its state, serialises it" in said
    assert "2 continuous states, 1 event indicators" in said


@pytest.mark.parametrize("kind", ["co_simulation", "model_exchange"])
def test_a_state_goes_on_from_bytes_in_another_instance(tmp_path: Path, kind: str) -> None:
    path = reference(tmp_path, "BouncingBall", 2)
    ends = []
    with (
        closing(FmuComponent("a", path, FmuSettings(kind))) as one,
        closing(FmuComponent("b", path, FmuSettings(kind))) as two,
    ):
        first, second = Driver(one).begin(h=0.1, stop=4.0), Driver(two).begin(h=0.1, stop=4.0)
        first.run(8)
        assert one.can_serialize_state
        data = one.serialize_state(one.save_state())
        two.restore_state(two.deserialize_state(data))
        second.ticks = 8
        for driver in (first, second):
            driver.run(10)
            ends.append(driver.get("h", "v"))
    assert ends[0] == ends[1]


# ── through scenario files ───────────────────────────────────────────────────────────────────────────────

SCENARIO = """
name: types
components:
  ball: {fmu: ball/Model.fmu, interface: model_exchange, tolerance: 1e-9, isolate: ISOLATE}
  all:
    fmu: all/Model.fmu
    isolate: ISOLATE
    start: {m: 1, n: 3, r: 1, x0: [1, 2, 3], C: [[1, 2, 4]], u: [0], String_in: text, Binary_in: 0aff}
connections:
  ball.h: "all.u[1]"
simulate: {stop: 1, step: 0.1}
"""


@pytest.mark.parametrize("isolate", ["false", "true"])
def test_a_scenario_sizes_arrays_gives_texts_and_asks_for_model_exchange(
    tmp_path: Path, isolate: str
) -> None:
    for name, make in (("ball", lambda f: reference(f, "BouncingBall", 2)), ("all", feedthrough)):
        (tmp_path / name).mkdir()
        make(tmp_path / name)
    file = tmp_path / "s.yaml"
    file.write_text(SCENARIO.replace("ISOLATE", isolate))
    work = Run.open(file, tmp_path / "run")
    simulate(work)
    frame = pd.read_csv(work.folder / "trajectories.csv")
    assert frame["ball.h"].to_numpy() == pytest.approx([ball(0.1 * k)[0] for k in range(11)], abs=1e-7)
    assert frame["all.u[1]"].equals(frame["ball.h"])
    assert frame["all.y[1]"].iloc[0] == 1 * 1 + 2 * 2 + 4 * 3
    assert not [name for name in frame if "String" in name or "Binary" in name]
    table = pd.read_parquet(work.folder / "trajectories.parquet")
    assert table["all.String_out"].tolist() == ["text"] * 11
    assert table["all.Binary_out"].tolist() == [b"\x0a\xff"] * 11
    told = pd.read_csv(work.folder / "trajectories.texts.csv", dtype=str)
    assert ["0.0", "all.String_out", "text"] in told.to_numpy().tolist()
    assert ["0.0", "all.Binary_in", "0aff"] in told.to_numpy().tolist()
    assert len(told) == 8  # once each: nothing changes


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("String_in: text", "String_in: 3", "expected text, found 3"),
        ("u: [0]", "u: [a]", r"start\.u.*expected a number.*found text 'a'"),
        ("x0: [1, 2, 3]", "x0: [1, 2, 3, 4]", r"no variable 'x0\[4\]'"),
        ('"all.u[1]"', "all.String_in", "type mismatch"),
        ("m: 1", "m: 1.5", "expected a whole number"),
        ("interface: model_exchange", "interface: model", "co_simulation"),
    ],
)
def test_what_does_not_fit_in_a_scenario_is_told(tmp_path: Path, old: str, new: str, message: str) -> None:
    for name, make in (("ball", lambda f: reference(f, "BouncingBall", 2)), ("all", feedthrough)):
        (tmp_path / name).mkdir()
        make(tmp_path / name)
    file = tmp_path / "s.yaml"
    file.write_text(SCENARIO.replace("ISOLATE", "false").replace(old, new))
    with pytest.raises(ScenarioError, match=message):
        Run.open(file, tmp_path / "run")


def test_a_model_that_chatters_is_told(tmp_path: Path) -> None:
    path = reference(tmp_path, "Switch", 2)
    with closing(FmuComponent("it", path, FmuSettings("model_exchange"))) as component:
        driver = Driver(component).begin(h=0.5, stop=2.0, band=0.0)
        while (status := driver.step()) == Status.OK and driver.ticks < 4:
            pass
    assert status == Status.ERROR
    assert "the model chatters" in component.message or "makes no progress" in component.message

"""Compiled stepping is plain stepping to the last bit: values, rows, warnings, errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from cosim_helpers import Gain, Integrator, Lag
from fmu_helpers import probe
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Component
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.links import Converted
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.cosim.graph import Graph, _fits
from exlinn_fmi.cosim.master import Master, Trajectories
from exlinn_fmi.errors import ComponentError, Interrupted
from exlinn_fmi.scenario.signals import Chirp, Constant, Multisine, Prbs, Ramp, Signal, Sine, Step, Table

PLANT = Path(__file__).parents[2] / "fmus" / "DCMotorCart.fmu"
SIGNALS: list[Signal] = [
    Constant(signal="constant", value=2.0),
    Step(signal="step", time=0.3, after=-1.0),
    Ramp(signal="ramp", slope=0.7, start=0.1, stop=0.55),
    Sine(signal="sine", amplitude=3.0, frequency=1.3, phase=0.2),
    Multisine(signal="multisine", rms=2.0, band=(0.1, 9.0), seed=3),
    Chirp(signal="chirp", amplitude=1.0, band=(0.5, 20.0), duration=0.7, method="logarithmic"),
    Prbs(signal="prbs", amplitude=1.0, hold=0.07, seed=2),
    Table(signal="table", file="t.csv", column="y"),
]


@pytest.fixture(scope="module")
def probes(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Our strict FMUs by FMI version, and a table for signals beside them."""
    folder = tmp_path_factory.mktemp("probes")
    (folder / "t.csv").write_text("time,y\n0,1\n0.13,2.5\n0.9,-3\n")
    found = {}
    for version in (2, 3):
        (folder / str(version)).mkdir()
        found[version] = probe(folder / str(version), version=version)
    return found


def both(
    make: Callable[[], Sequence[Component]], connections: Sequence[tuple[str, str]] = (), **options: object
) -> tuple[Trajectories, Trajectories]:
    """A run of plain and one of compiled stepping, found to be the same."""
    stop = options.pop("stop", 1.0)
    runs = []
    for compiled in (False, True):
        graph = Graph({c.name: c for c in make()}, connections)
        runs.append(Master(graph, 0.0, stop, 0.01, compiled=compiled, **options).run())
    plain, fast = runs
    assert (plain.statistics["stepping"], fast.statistics["stepping"]) == ("plain", "compiled")
    assert list(fast.frame) == list(plain.frame)
    assert fast.frame.to_numpy().tobytes() == plain.frame.to_numpy().tobytes()
    assert str(fast.error) == str(plain.error)
    assert type(fast.error) is type(plain.error)
    assert fast.statistics["warnings"] == plain.statistics["warnings"]
    return plain, fast


@st.composite
def graphs(draw: st.DrawFn) -> tuple[list[str], list[int], list[tuple[int, int, int, int]], dict, dict]:
    """Kinds of components, own steps, connections as numbers to be wrapped, conversions, options."""
    kinds = draw(st.lists(st.sampled_from(["fmu2", "fmu3", "lag", "gain", "signal"]), min_size=1, max_size=5))
    kinds[draw(st.integers(0, len(kinds) - 1))] = draw(st.sampled_from(["fmu2", "fmu3"]))
    every = draw(st.lists(st.sampled_from([1, 1, 1, 2, 3]), min_size=len(kinds), max_size=len(kinds)))
    number = st.integers(0, 1000)
    wires = draw(st.lists(st.tuples(number, number, number, number), max_size=12))
    options = {
        "algorithm": draw(st.sampled_from(["jacobi", "gauss-seidel"])),
        "record_every": draw(st.sampled_from([1, 1, 4])),
        "profile": draw(st.booleans()),
    }
    number = st.sampled_from([1.0, -0.0, 0.0, 0.1, -3.0, 1e-300, 1e300])
    conversions = draw(
        st.dictionaries(st.integers(0, 4), st.dictionaries(st.integers(0, 9), st.tuples(number, number)))
    )
    return kinds, every, wires, conversions, options


@given(graphs(), st.integers(0, len(SIGNALS) - 1))
@settings(max_examples=60, deadline=None)
def test_any_graph_is_stepped_alike(probes: dict[int, Path], drawn: tuple, signal: int):
    kinds, every, wires, conversions, options = drawn

    def make() -> list[Component]:
        makers: dict[str, Callable[[str], Component]] = {
            "fmu2": lambda name: FmuComponent(name, probes[2]),
            "fmu3": lambda name: FmuComponent(name, probes[3]),
            "lag": Lag,
            "gain": lambda name: Gain(name, -0.7, 0.2, sampled=True),
            "signal": lambda name: SignalSource(name, SIGNALS[signal], probes[2].parent.parent),
        }
        made = [makers[kind](f"c{k}") for k, kind in enumerate(kinds)]
        return [Converted(c, reals(c, conversions[k])) if k in conversions else c for k, c in enumerate(made)]

    def reals(component: Component, found: dict) -> dict:
        """Whole numbers would be refused before the first step."""
        return {
            k: v
            for k, v in found.items()
            if k < len(component.variables) and component.variables[k].type == "Real"
        }

    components = make()
    ports = {
        causality: [[v for v in c.variables if v.causality == causality] for c in components]
        for causality in ("output", "input")
    }
    connections: dict[str, str] = {}
    for a, b, o, i in wires:
        source, target = a % len(components), b % len(components)
        if not ports["input"][target]:
            continue
        head = ports["input"][target][i % len(ports["input"][target])]
        tails = [v for v in ports["output"][source] if _fits(v, head)]
        if tails:
            connections[f"c{target}.{head.name}"] = f"c{source}.{tails[o % len(tails)].name}"
    for component in components:
        component.close()
    own_steps = {f"c{k}": 0.01 * n for k, n in enumerate(every)}
    pairs = [(source, target) for target, source in connections.items()]
    both(make, pairs, own_steps=own_steps, stop=0.5, **options)


@pytest.mark.parametrize("version", [2, 3])
def test_a_converted_component_is_stepped_in_compiled_code(probes: dict[int, Path], version: int):
    def make() -> list[Component]:
        source, target = (FmuComponent(name, probes[version]) for name in ("a", "b"))
        conversions = dict(
            zip(map(target.index, names), [(1 / 3, -0.1), (2.0, 1.0), (-1.0, 1.0)], strict=True)
        )
        return [source, Converted(target, conversions)]

    number, truth = (
        (["n_in", "n_out"], ["on", "off"])
        if version == 2
        else ([f"{kind}_in", f"{kind}_out"] for kind in ("Int16", "Boolean"))
    )
    names = ["u", number[0], truth[0]]
    pairs = [
        ("a.y", "b.u"),
        ("b.y", "a.u"),
        (f"a.{number[1]}", f"b.{number[0]}"),
        (f"a.{truth[1]}", f"b.{truth[0]}"),
    ]
    for algorithm in ("jacobi", "gauss-seidel"):
        components = make()
        assert all(component.native() is not None for component in components)
        for component in components:
            component.close()
        plain, _ = both(make, pairs, algorithm=algorithm)
        assert plain.error is None
        y, u = (plain.frame[name].to_numpy() for name in ("a.y", "b.u"))
        assert (u == y * (1 / 3) + -0.1).all()


def test_what_a_conversion_makes_of_a_value_is_refused_alike(probes: dict[int, Path]):
    def make() -> list[Component]:
        target = FmuComponent("b", probes[2])
        return [FmuComponent("c", probes[2]), Converted(target, {target.index("n_in"): (0.5, 0.5)})]

    plain, _ = both(make, [("c.n_out", "b.n_in"), ("b.n_out", "c.n_in")])
    assert "n_in is of type Integer: cannot be 2.5" in str(plain.error)


def test_a_plant_of_ours_under_a_python_controller_is_stepped_alike():
    def make() -> list[Component]:
        return [FmuComponent("plant", PLANT), Gain("control", -2.0, 3.0, sampled=True)]

    _, fast = both(make, [("plant.i", "control.u"), ("control.y", "plant.v")], stop=5.0)
    assert fast.error is None
    assert len(fast.frame) == 501


@pytest.mark.parametrize(
    ("version", "define", "said"),
    [
        (2, "FAULT=fmi2Discard", "the FMU asks to end the simulation"),
        (2, "FAULT=fmi2Error", "the bearing is hot"),
        (2, "FAULT=fmi2Fatal", "the bearing is hot"),
        (3, "FAULT_END", "the FMU asks to end the simulation"),
        (3, "FAULT_EARLY", "the FMU returned early"),
    ],
)
def test_a_step_that_fails_ends_the_run_alike(tmp_path: Path, version: int, define: str, said: str):
    file = probe(tmp_path, define, version=version)
    _, fast = both(lambda: [FmuComponent("p", file), Integrator("i")], [("p.x", "i.u")])
    assert isinstance(fast.error, ComponentError)
    assert said in str(fast.error)
    assert len(fast.frame) == 50


def test_warnings_of_steps_are_counted_alike(tmp_path: Path):
    file = probe(tmp_path, "FAULT=fmi2Warning")
    _, fast = both(lambda: [FmuComponent("p", file), Integrator("i")], [("p.x", "i.u")])
    assert fast.error is None
    assert fast.statistics["warnings"]["p"]["count"] == 51


@pytest.mark.parametrize("define", ["FAULT_NAN", "SET_STATUS=fmi2Warning", "GET_STATUS=fmi2Warning"])
def test_not_a_number_and_warnings_of_get_and_set_are_told_alike(tmp_path: Path, define: str):
    file = probe(tmp_path, define)
    _, fast = both(lambda: [FmuComponent("p", file), Integrator("i")], [("p.y", "i.u"), ("i.y", "p.u")])
    assert ("p.y at t = 0.5 s" in str(fast.error)) == (define == "FAULT_NAN")


def test_a_value_that_its_type_cannot_hold_is_refused_alike(probes: dict[int, Path]):
    # Two feed-throughs of Int8 and one of UInt8 in a ring: a Boolean that is one, then numbers that overflow.
    def make() -> list[Component]:
        return [FmuComponent("a", probes[3]), FmuComponent("b", probes[2])]

    _, fast = both(make, [("b.n_out", "a.Int8_in"), ("a.Int8_out", "b.n_in")], stop=3.0)
    assert "is of type Integer: cannot be 128" in str(fast.error)


def test_a_failing_python_component_ends_the_run_alike(probes: dict[int, Path]):
    from test_cosim_master import Faulty, explode

    def make() -> list[Component]:
        return [FmuComponent("p", probes[2]), Faulty("bad", "step", explode, at=0.3)]

    _, fast = both(make, [("p.x", "bad.u")])
    assert "no root" in str(fast.error)
    assert len(fast.frame) == 31


def test_a_user_who_stops_the_run_keeps_the_rows_so_far(probes: dict[int, Path]):
    asked = iter([False, True])
    graph = Graph({"p": FmuComponent("p", probes[2])}, [])
    result = Master(graph, 0.0, 10.0, 0.01, compiled=True).run(should_stop=lambda: next(asked))
    assert isinstance(result.error, Interrupted)
    assert result.frame["time"].to_numpy().tobytes() == (np.arange(len(result.frame)) * 0.01).tobytes()
    assert 1 < len(result.frame) < 1000


def test_compiled_stepping_is_chosen_where_it_pays(probes: dict[int, Path]):
    def stepping(stop: float) -> str:
        graph = Graph({"p": FmuComponent("p", probes[2])}, [])
        return Master(graph, 0.0, stop, 0.01).run().statistics["stepping"]

    assert stepping(1.0) == "plain"
    assert stepping(3e3) == "compiled"


def test_a_paced_run_tells_the_time_of_compiled_calls_and_of_those_from_python(probes: dict[int, Path]):
    graph = Graph({"p": FmuComponent("p", probes[2]), "i": Integrator("i")}, [])
    result = Master(graph, 0.0, 1.0, 0.01, compiled=True).run(pace=100.0)
    assert result.statistics["stepping"] == "compiled"
    assert np.all(result.frame[["timing.p", "timing.i"]].to_numpy()[1:] > 0.0)
    assert np.all(result.frame["p.x"].notna())


def test_without_functions_to_call_stepping_is_plain():
    graph = Graph({"i": Integrator("i")}, [])
    assert Master(graph, 0.0, 1.0, 0.1, compiled=True).run().statistics["stepping"] == "plain"


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=9))
@settings(deadline=None)
def test_values_are_found_finite_by_their_bits(values: list[float]):
    from exlinn_fmi.cosim import kernel

    array = np.array(values + [-np.nan] * (len(values) == 8), dtype=float)
    found = kernel._finite(array.ctypes.data, len(array))
    assert found == np.isfinite(array).all()


def test_the_loop_is_compiled_where_it_cannot_be_kept(monkeypatch: pytest.MonkeyPatch):
    from exlinn_fmi.cosim import kernel

    def refuse(signature: object, cache: bool = False) -> object:
        if cache:
            raise RuntimeError("no locator available")
        return lambda function: type("Compiled", (), {"address": 1})()

    monkeypatch.setattr(kernel, "cfunc", refuse)
    assert kernel.load.__wrapped__().compiled.address == 1

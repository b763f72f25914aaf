"""Events in compiled stepping: as in plain stepping to the last bit, wherever a run is cut in two."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cosim_helpers import Lag
from fmu_helpers import probe
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Component
from exlinn_fmi.components.events import MONITOR, with_events
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.links import Converted
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.cosim.compiled import Compiled
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.loops import LoopOptions
from exlinn_fmi.cosim.master import Master, Trajectories
from exlinn_fmi.cosim.plan import Plan
from exlinn_fmi.cosim.recorder import Recorder, select
from exlinn_fmi.cosim.stepping import Plain, Stepper
from exlinn_fmi.scenario.events import Event
from exlinn_fmi.scenario.signals import Sine

STEP = 0.01
SINE = Sine(signal="sine", amplitude=3.0, frequency=1.3, phase=0.2)
CONNECTIONS = [("s.y", "a.u"), ("a.y", "b.u"), ("b.x", "l.u"), ("a.n_out", "b.n_in"), ("a.off", "b.on")]
PLACES = ["s.y", "a.u", "a.x", "a.y", "a.trim", "a.n_in", "a.n_out", "b.u", "b.x", "b.trim", "b.n_in", "b.on"]
"""Connected inputs, outputs, parameters, and inputs that nothing is connected to."""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return probe(tmp_path_factory.mktemp("probe"))


def parts(path: Path, events: list[Event]) -> dict[str, Component]:
    a, b = FmuComponent("a", path), FmuComponent("b", path)
    made = [SignalSource("s", SINE, Path()), a, b, Lag("l")]
    touched = with_events({c.name: c for c in made}, events, 1, STEP)
    return touched | {"b": Converted(touched["b"], {b.index("u"): (-0.3, 0.1)})}


def run(path: Path, events: list[Event], compiled: bool, **options: object) -> Trajectories:
    graph = Graph(parts(path, events), CONNECTIONS)
    return Master(graph, 0.0, 0.6, STEP, compiled=compiled, **options).run()


def assert_same(path: Path, events: list[Event], **options: object) -> Trajectories:
    plain, fast = (run(path, events, compiled, **options) for compiled in (False, True))
    if len(plain.frame):  # else they have not come as far as stepping
        assert fast.statistics["stepping"] == "compiled"
    assert fast.frame.to_numpy().tobytes() == plain.frame.to_numpy().tobytes()
    assert str(fast.error) == str(plain.error)
    assert fast.statistics["warnings"] == plain.statistics["warnings"]
    return plain


@st.composite
def events(draw: st.DrawFn) -> Event:
    """An event that is told by a time; its number fits whole numbers and truth values."""
    times = st.sampled_from([0.0, 0.005, 0.07, 0.1, 0.29, 0.31, 0.59])
    span = draw(st.sampled_from([{}, {"until": 0.42}, {"duration": 0.01}, {"duration": 0.2}]))
    kind = draw(st.sampled_from(["set", "add", "scale", "hold", "disconnect", "freeze", "freeze"]))
    at = {"at": draw(times), **span}
    if kind == "freeze":
        return Event.model_validate({"on": draw(st.sampled_from("ab")), "freeze": True, **at})
    on = draw(st.sampled_from(PLACES))
    real = on.rpartition(".")[2] not in ("n_in", "n_out", "on")
    numbers = [-0.0, 0.3, -2.0, 7.1] if real else [0.0, 1.0]
    value = True if kind in ("hold", "disconnect") else draw(st.sampled_from(numbers))
    return Event.model_validate({"on": on, kind: value, **at})


OPTIONS = {
    "algorithm": st.sampled_from(["jacobi", "gauss-seidel"]),
    "own_steps": st.dictionaries(st.sampled_from("abls"), st.sampled_from([0.02, 0.03, 0.1])),
    "record_every": st.sampled_from([1, 1, 3]),
}


@given(st.lists(events(), min_size=1, max_size=5), st.fixed_dictionaries(OPTIONS))
@settings(max_examples=80, deadline=None)
def test_any_events_do_the_same_in_compiled_code(path: Path, drawn: list[Event], options: dict) -> None:
    assert_same(path, drawn, **options)


def event(**keys: object) -> Event:
    return Event.model_validate(keys)


STEADY = [
    event(on="a.u", at=0.1, add=0.5),
    event(on="a.y", at=0.2, duration=0.1, hold=True),
    event(on="b.trim", at=0.15, set=2.0),
    event(on="b", at=0.3, duration=0.07, freeze=True),
]


def test_components_that_events_touch_are_stepped_in_compiled_code(path: Path) -> None:
    components = parts(path, STEADY)
    for component in components.values():
        component.enter_initialization(0.0, 1.0, {})
        component.exit_initialization()
    assert components["a"].native() is not None
    assert components["b"].native() is not None
    for component in components.values():
        component.close()
    frame = assert_same(path, STEADY).frame
    assert frame["b.x"].diff().abs()[31:37].max() == 0
    assert frame[f"{MONITOR}.{frame.columns[-1].split('.', 1)[1]}"].sum() == 7


@pytest.mark.parametrize(
    "what", [{"noise": 0.1, "at": 0.1}, {"add": 1.0, "when": {"variable": "s.y", "above": 1.0}}]
)
def test_what_needs_python_at_each_point_has_it(path: Path, what: dict) -> None:
    assert_same(path, [event(on="a.u", **what), event(on="b.u", at=0.2, scale=2.0)])


def test_solved_loops_see_events_at_their_time(path: Path) -> None:
    assert_same(path, STEADY, loops=LoopOptions(solver="anderson"))


def test_a_faulty_value_is_refused_alike(path: Path) -> None:
    for place in ("b.n_in", "a.n_in"):  # connected or not
        plain = assert_same(path, [event(on=place, at=0.2, add=0.5)])
        assert "n_in is of type Integer" in str(plain.error)


PLANT = Path(__file__).parents[2] / "fmus" / "DCMotorCart.fmu"
FAULTS = [
    event(on="a.v", at=0.1, add=0.5),
    event(on="a.alpha_dot", at=0.2, duration=0.1, hold=True),
    event(on="b.tau_ext", at=0.15, set=0.02),
    event(on="b", at=0.3, duration=0.07, freeze=True),
    event(on="b.i", at=0.05, until=0.4, delay=0.03),
]


@pytest.mark.parametrize("kinds", [(Compiled, Plain), (Plain, Compiled), (Compiled, Compiled)])
@pytest.mark.parametrize("events", [FAULTS[:4], FAULTS])
def test_a_run_that_is_cut_goes_on_to_the_same_bits(
    kinds: tuple[type[Stepper], type[Stepper]], events: list[Event]
) -> None:
    """As checkpoints do it: all state through bytes into fresh components, whoever steps."""
    ticks = 60

    def begin(state: dict | None) -> tuple[Plan, Recorder]:
        made = [SignalSource("s", SINE, Path()), FmuComponent("a", PLANT), FmuComponent("b", PLANT)]
        parts = with_events({c.name: c for c in made}, events, 1, STEP)
        parts["b"] = Converted(parts["b"], {made[2].index("v"): (-0.3, 0.1)})
        graph = Graph(parts, [("s.y", "a.v"), ("a.alpha_dot", "b.v"), ("b.i", "a.tau_ext")])
        recorded = select(graph.components, ["*"])
        plan = Plan(graph, list(parts.values()), recorded, [1] * len(parts), ticks, STEP, True)
        recorder = Recorder(["time", *map(graph.path, recorded)], {}, ticks)
        plan.initialize(0.0, ticks * STEP, {})
        if state is None:
            plan.propagate(0, 0.0)
            recorder.record(0, plan.signals, plan.columns)
        else:
            plan.restore(state)
        return plan, recorder

    def step(kind: type[Stepper], plan: Plan, recorder: Recorder, first: int, until: int) -> None:
        kind(plan, recorder, 0.0, STEP, *[False] * (kind is Compiled)).run(first, until)

    def end(plan: Plan) -> None:
        for component in plan.components:
            component.close()

    whole, rows = begin(None)
    step(Plain, whole, rows, 0, ticks)
    end(whole)
    assert np.isfinite(rows.table).all()
    for cut in (5, 10, 15, 20, 25, 30, 33, 37, 45):
        one, first = begin(None)
        step(kinds[0], one, first, 0, cut)
        state = one.save()
        end(one)
        other, second = begin(state)
        step(kinds[1], other, second, cut, ticks)
        end(other)
        assert first.table[: cut + 1].tobytes() == rows.table[: cut + 1].tobytes()
        assert second.table[cut + 1 :].tobytes() == rows.table[cut + 1 :].tobytes()

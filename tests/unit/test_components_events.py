"""Events and faults, against what they must give in closed form."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pandas as pd
import pytest
from cosim_helpers import Gain, Integrator, Lag, Small, Source
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Component, Status, Variable
from exlinn_fmi.components.effects import Effect, Schedule
from exlinn_fmi.components.events import with_events
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.scenario.events import Event

STEP = 0.1


def event(**keys: object) -> Event:
    return Event.model_validate(keys)


def run(
    parts: list[Component], connections: list[str], *events: Event, stop: float = 2.0, **options: object
) -> pd.DataFrame:
    """The trajectories, all recorded."""
    components = with_events({c.name: c for c in parts}, events, options.pop("seed", 1), STEP)
    pairs = [tuple(map(str.strip, c.split(">"))) for c in connections]
    starts = options.pop("starts", None)
    record = ["*", "a.gain"] if any(isinstance(c, Integrator) for c in parts) else ["*"]
    result = Master(Graph(components, pairs), 0.0, stop, STEP, record=record, **options).run(starts)
    assert result.error is None, result.error
    return result.frame


def sine(t: float) -> float:
    return math.sin(3 * t)


def signal(*events: Event, function=sine, stop: float = 2.0, seed: int = 1) -> tuple[np.ndarray, ...]:
    """Times, what a source gives, and what others see of it."""

    def seen(*what: Event) -> pd.DataFrame:
        frame = run([Source("s", function), Gain("g")], ["s.y > g.u"], *what, stop=stop, seed=seed)
        assert (frame["s.y"] == frame["g.u"]).all()
        assert (frame["g.y"] == frame["g.u"]).all()
        return frame

    true = seen()
    return true["time"].to_numpy(), true["s.y"].to_numpy(), seen(*events)["g.u"].to_numpy()


def during(times: np.ndarray, begin: float, end: float) -> np.ndarray:
    return (times > begin - 1e-9) & (times < end - 1e-9)


# ── signals ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        ({"set": 0.25}, lambda y: 0.25 + 0 * y),
        ({"add": 0.5}, lambda y: y + 0.5),
        ({"scale": -2.0}, lambda y: -2 * y),
        ({"scale": 0.0}, lambda y: 0 * y),
    ],
)
@pytest.mark.parametrize("end", [{"until": 1.2}, {"duration": 0.7}])
def test_a_value_is_changed_while_the_event_lasts(effect: dict, expected, end: dict) -> None:
    times, true, seen = signal(event(on="s.y", at=0.5, **end, **effect))
    on = during(times, 0.5, 1.2)
    assert on.sum() == 7
    assert seen[~on].tolist() == true[~on].tolist()
    assert seen[on] == pytest.approx(expected(true[on]), abs=1e-15)


def test_an_event_without_end_lasts_to_the_end() -> None:
    times, true, seen = signal(event(on="s.y", at=0.5, add=1.0))
    assert seen == pytest.approx(true + (times > 0.49))


def test_events_on_one_variable_follow_one_another_in_their_order() -> None:
    both = event(on="s.y", at=0.0, add=1.0), event(on="s.y", at=0.0, scale=3.0)
    _, true, seen = signal(*both)
    assert seen == pytest.approx(3 * (true + 1))
    _, true, seen = signal(*reversed(both))
    assert seen == pytest.approx(3 * true + 1)


def test_hold_keeps_the_last_value_before() -> None:
    times, true, seen = signal(event(on="s.y", at=0.5, until=1.0, hold=True))
    on = during(times, 0.5, 1.0)
    assert seen[~on].tolist() == true[~on].tolist()
    assert set(seen[on]) == {sine(4 * STEP)}


def test_hold_from_the_start_keeps_the_first_value() -> None:
    _, _, seen = signal(event(on="s.y", at=0.0, hold=True), function=lambda t: 2.0 + t)
    assert set(seen) == {2.0}


@pytest.mark.parametrize("delay", [0.1, 0.3, 0.25])
def test_delay_gives_the_value_of_before(delay: float) -> None:
    times, _, seen = signal(event(on="s.y", at=0.0, delay=delay), function=lambda t: 1.0 + 2.0 * t)
    expected = 1.0 + 2.0 * np.maximum(times - delay, 0.0)
    assert seen == pytest.approx(expected, abs=1e-12)


def test_a_delay_knows_what_was_before_it_began() -> None:
    times, true, seen = signal(event(on="s.y", at=1.0, until=1.5, delay=0.4))
    on = during(times, 1.0, 1.5)
    assert seen[on] == pytest.approx([sine(t - 0.4) for t in times[on]], abs=1e-12)
    assert seen[~on].tolist() == true[~on].tolist()


def test_whole_numbers_are_delayed_without_values_between() -> None:
    class Counter(Small):
        is_sampled = True

        def __init__(self) -> None:
            super().__init__("c", Variable("n", "output", "discrete", type="Integer"))

        def react(self) -> None:
            self["n"] = round(self.time / STEP)

    frame = run([Counter()], [], event(on="c.n", at=0.0, delay=0.25))
    assert frame["c.n"].tolist() == [max(0, k - 3) for k in range(21)]


def test_drop_loses_as_many_samples_as_it_says_and_holds_the_last() -> None:
    times, true, seen = signal(event(on="s.y", at=1.0, drop=0.3), function=lambda t: t, stop=400.0)
    on = times > 0.95
    lost = seen != true
    assert not lost[~on].any()
    share = lost[on].mean()
    assert abs(share - 0.3) < 4 * math.sqrt(0.3 * 0.7 / on.sum())
    delivered = np.maximum.accumulate(np.where(lost, -1.0, true))
    assert seen.tolist() == delivered.tolist()


def test_all_samples_can_be_lost() -> None:
    times, _, seen = signal(event(on="s.y", at=0.5, drop=1.0), function=lambda t: t)
    assert seen == pytest.approx(np.minimum(times, 0.4))


def test_noise_is_gaussian_and_white() -> None:
    _, true, seen = signal(event(on="s.y", at=0.0, noise=0.5), stop=500.0)
    noise = (seen - true) / 0.5
    n = len(noise)
    assert abs(noise.mean()) < 4 / math.sqrt(n)
    assert abs(noise.std() - 1) < 4 / math.sqrt(2 * n)
    assert abs((noise**4).mean() - 3) < 4 * math.sqrt(96 / n)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 4 / math.sqrt(n)


def test_a_seed_gives_the_same_run_and_another_seed_another() -> None:
    noisy = event(on="s.y", at=0.0, noise=0.5), event(on="s.y", at=0.0, drop=0.5)
    runs = [signal(*noisy, seed=seed)[2].tolist() for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


def test_two_noises_are_independent() -> None:
    parts = [Source("s", sine), Source("r", sine)]
    two = event(on="s.y", at=0.0, noise=1.0), event(on="r.y", at=0.0, noise=1.0)
    frame = run(parts, [], *two, stop=200.0)
    one, other = (frame[f"{name}.y"] - frame["time"].map(sine) for name in "sr")
    assert abs(np.corrcoef(one, other)[0, 1]) < 4 / math.sqrt(len(one))


# ── inputs, parameters, components ───────────────────────────────────────────────────────────────────────


def test_an_input_is_changed_for_its_component_alone_and_recorded_as_it_came() -> None:
    parts = [Source("s", lambda t: 1.0), Integrator("a"), Integrator("b")]
    frame = run(parts, ["s.y > a.u", "s.y > b.u"], event(on="a.u", at=1.0, scale=3.0))
    assert frame["a.u"].tolist() == [1.0] * 10 + [3.0] * 11
    assert set(frame["b.u"]) == {1.0}
    assert frame["a.y"].iloc[-1] == pytest.approx(1.0 + 3.0)
    assert frame["b.y"].iloc[-1] == pytest.approx(2.0)


def test_a_disconnected_input_has_its_start_value() -> None:
    parts = [Source("s", lambda t: 1.0), Integrator("a")]
    off = event(on="a.u", at=0.5, until=1.0, disconnect=True)
    frame = run(parts, ["s.y > a.u"], off, starts={"a": {"u": -2.0}})
    assert frame["a.u"].tolist() == [1.0] * 5 + [-2.0] * 5 + [1.0] * 11
    assert frame["a.y"].iloc[-1] == pytest.approx(0.5 - 1.0 + 1.0)


def test_an_input_that_nothing_is_connected_to_can_be_set() -> None:
    kick = event(on="a.u", at=0.5, until=1.0, set=4.0)
    frame = run([Integrator("a")], [], kick, starts={"a": {"u": 1.0}})
    assert frame["a.y"].iloc[-1] == pytest.approx(0.5 + 4 * 0.5 + 1.0)


def test_a_parameter_is_replaced_and_put_back() -> None:
    parts = [Source("s", lambda t: 1.0), Integrator("a", gain=2.0)]
    frame = run(parts, ["s.y > a.u"], event(on="a.gain", at=0.5, until=1.0, set=-1.0))
    assert np.diff(frame["a.y"]) == pytest.approx([0.2] * 5 + [-0.1] * 5 + [0.2] * 10)


def test_a_parameter_is_scaled_from_its_start_value() -> None:
    parts = [Source("s", lambda t: 1.0), Integrator("a")]
    frame = run(parts, ["s.y > a.u"], event(on="a.gain", at=1.0, scale=0.5), starts={"a": {"gain": 4.0}})
    assert frame["a.y"].iloc[-1] == pytest.approx(4.0 + 2.0)


def test_a_frozen_component_stands_still_and_goes_on_from_there() -> None:
    parts = [Source("s", lambda t: 1.0), Integrator("a"), Lag("b")]
    frame = run(parts, ["s.y > a.u", "a.y > b.u"], event(on="a", at=0.5, until=1.0, freeze=True))
    y = frame["a.y"].to_numpy()
    assert y[5:11] == pytest.approx([0.5] * 6)
    assert y[-1] == pytest.approx(1.5)


def test_the_clock_of_a_frozen_source_stands_still() -> None:
    frame = run([Source("s", lambda t: t)], [], event(on="s", at=0.5, until=1.0, freeze=True))
    assert frame["s.y"].tolist() == pytest.approx(
        [*(0.1 * k for k in range(6)), *[0.5] * 5, *(0.6 + 0.1 * k for k in range(10))]
    )


# ── crossings ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("order", ["first", "last"])
@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_what_waits_for_a_crossing_begins_at_the_next_communication_point(order: str, algorithm: str) -> None:
    parts = [Source("s", lambda t: 1.0), Integrator("a"), Gain("g")]
    if order == "last":
        parts.reverse()
    when = event(on="s.y", when={"variable": "a.y", "above": 0.55}, duration=0.4, set=-1.0, name="turn")
    frame = run(parts, ["s.y > a.u", "a.y > g.u"], when, algorithm=algorithm)
    # a.y is 0.6 at t = 0.6, so u is -1 from 0.7 on for 0.4 s.
    assert frame["s.y"].tolist() == [1.0] * 7 + [-1.0] * 4 + [1.0] * 10
    assert frame["events.turn"].tolist() == [0.0] * 7 + [1.0] * 4 + [0.0] * 10


def test_below_is_a_crossing_as_well_and_happens_once() -> None:
    when = event(on="s.y", when={"variable": "g.u", "below": -0.5}, duration=0.1, set=9.0)
    _, true, seen = signal(when, stop=6.0)
    first = np.flatnonzero(true < -0.5)[0]
    assert np.flatnonzero(seen == 9.0).tolist() == [first + 1]


# ── the record ───────────────────────────────────────────────────────────────────────────────────────────


def test_the_record_tells_what_was_active() -> None:
    parts = [Source("s", sine)]
    events = event(on="s.y", at=0.5, duration=0.5, add=1.0), event(on="s.y", at=1.0, noise=0.0, name="quiet")
    frame = run(parts, [], *events)
    assert frame["events.add_s_y"].tolist() == [0.0] * 5 + [1.0] * 5 + [0.0] * 11
    assert frame["events.quiet"].tolist() == [0.0] * 10 + [1.0] * 11
    assert list(frame.columns)[-2:] == ["events.add_s_y", "events.quiet"]


def test_names_are_made_of_what_events_do_and_are_never_the_same() -> None:
    events = [
        event(on="s.y[1]", at=0, add=1.0),
        event(on="s.y[1]", at=1, add=2.0),
        event(on="s", at=1, freeze=True),
    ]
    frame = run([Small("s", Variable("y[1]", "output"))], [], *events)
    assert [c for c in frame.columns if c.startswith("events.")] == [
        "events.add_s_y_1_",
        "events.add_s_y_1__2",
        "events.freeze_s",
    ]


def test_without_events_nothing_is_wrapped() -> None:
    parts = {"a": Integrator("a")}
    assert with_events(parts, [], 0, STEP) == parts


# ── undoing ──────────────────────────────────────────────────────────────────────────────────────────────


class Undoable(Integrator):
    """An integrator whose state can be saved."""

    @property
    def can_save_state(self) -> bool:
        return True

    def save_state(self) -> object:
        return self.values.copy(), self.time

    def restore_state(self, state: object) -> None:
        values, self.time = state
        self.values[:] = values

    def serialize_state(self, state: object) -> bytes:
        return pickle.dumps(state)

    def deserialize_state(self, data: bytes) -> object:
        return pickle.loads(data)


@given(
    anew=st.booleans(),
    back=st.integers(1, 6),
    at=st.integers(0, 12),
    effect=st.sampled_from(
        [{"hold": True}, {"drop": 0.5}, {"delay": 0.25}, {"noise": 1.0}, {"set": 2.0}, {"freeze": True}]
    ),
)
@settings(max_examples=60, deadline=None)
def test_a_run_that_is_undone_and_done_again_is_the_same(
    back: int, at: int, effect: dict, anew: bool
) -> None:
    target = "a" if "freeze" in effect else "a.y"
    waiting = event(on="a.u", when={"variable": "a.y", "above": 0.5}, scale=-1.0)
    components = with_events(
        {"a": Undoable("a")}, [event(on=target, at=0.35, until=1.05, **effect), waiting], 3, STEP
    )
    parts = list(components.values())
    y, u = np.array([1]), np.array([0])
    states, seen = {}, []
    for part in parts:
        part.enter_initialization(0.0, 2.0, {})
        part.exit_initialization()

    def point(k: int) -> None:
        value, flags = np.zeros(1), np.zeros(2)
        states[k] = [part.save_state() for part in parts]
        parts[0].set(u, np.array([math.cos(k)]))
        parts[0].get(y, value)
        parts[1].get(np.array([0, 1]), flags)
        seen.append((k, value[0], *flags))
        for part in parts:
            assert part.step(k * STEP, STEP) == Status.OK

    for k in range(14):
        point(k)
    again = max(0, min(at, 13) - back)
    for part, state in zip(parts, states[again], strict=True):
        part.restore_state(part.deserialize_state(part.serialize_state(state)) if anew else state)
    first, seen[:] = seen[again:], []
    for k in range(again, 14):
        point(k)
    assert seen == first


def test_a_second_run_begins_without_memory_of_the_first() -> None:
    events = (
        event(on="s.y", at=1.0, hold=True),
        event(on="s.y", when={"variable": "s.y", "above": 0.9}, add=1.0),
    )
    components = with_events({"s": Source("s", sine)}, events, 0, STEP)
    master = Master(Graph(components, []), 0.0, 2.0, STEP)
    first, second = (master.run().frame for _ in range(2))
    pd.testing.assert_frame_equal(first, second)


def test_random_numbers_are_uniform() -> None:
    schedule = Schedule([event(on="a.b", at=0, noise=1.0)], 5, STEP)
    pairs = np.array([schedule.uniforms(0, k * STEP) for k in range(4000)])
    assert 0 < pairs.min() < pairs.max() < 1
    assert np.abs(pairs.mean(axis=0) - 0.5).max() < 4 / math.sqrt(12 * 4000)
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 4 / math.sqrt(4000)


def test_effects_begin_and_end_exactly_at_communication_points() -> None:
    schedule = Schedule([event(on="a.b", at=0.3, until=0.7, set=1.0)], 0, STEP)
    effect = Effect(schedule, 0, True)
    t, seen = 0.0, []
    for _ in range(10):
        seen.append(effect(t, 0.0))
        t += STEP  # with the rounding of a sum
    assert seen == [0, 0, 0, 1, 1, 1, 1, 0, 0, 0]

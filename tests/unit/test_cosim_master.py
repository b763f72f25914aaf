"""The master beside known discrete solutions, its times, its statuses and how it ends."""

from __future__ import annotations

import numpy as np
import pytest
from cosim_helpers import Faulty, Gain, Integrator, Lag, Source, graph, run
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Status
from exlinn_fmi.cosim import watch as watch_module
from exlinn_fmi.cosim.master import Master, Trajectories, count_every, count_ticks
from exlinn_fmi.errors import ComponentError, InputError, Interrupted, SolverError

COUPLED = ("a.y > b.u", "b.y > a.u")


def oscillator() -> list[Integrator]:
    """ẋ₁ = x₂, ẋ₂ = −x₁ in two components."""
    return [Integrator("a", start=1.0), Integrator("b", start=0.5, gain=-1.0)]


def column(result: Trajectories, name: str) -> np.ndarray:
    assert result.error is None
    return result.frame[name].to_numpy()


# ── known discrete solutions ─────────────────────────────────────────────────────────────────────────────


def test_jacobi_on_two_integrators_is_explicit_euler():
    result = run(oscillator(), *COUPLED, stop=2.0)
    x, y = 1.0, 0.5
    for a, b in zip(column(result, "a.y"), column(result, "b.y"), strict=True):
        assert (a, b) == (x, y)
        x, y = x + 0.1 * (1.0 * y), y + 0.1 * (-1.0 * x)


def test_gauss_seidel_on_two_integrators_is_symplectic_euler():
    result = run(oscillator(), *COUPLED, stop=2.0, algorithm="gauss-seidel")
    x, y = 1.0, 0.5
    for a, b in zip(column(result, "a.y"), column(result, "b.y"), strict=True):
        assert (a, b) == (x, y)
        x = x + 0.1 * (1.0 * y)
        y = y + 0.1 * (-1.0 * x)


def test_order_of_the_scenario_decides_who_is_first_in_gauss_seidel():
    result = run(oscillator()[::-1], *COUPLED, stop=2.0, algorithm="gauss-seidel")
    x, y = 1.0, 0.5
    for a, b in zip(column(result, "a.y"), column(result, "b.y"), strict=True):
        assert (a, b) == (x, y)
        y = y + 0.1 * (-1.0 * x)
        x = x + 0.1 * (1.0 * y)


def test_gauss_seidel_refreshes_through_a_static_gain():
    components = [Integrator("a", start=1.0), Gain("g", 2.0), Integrator("b")]
    result = run(components, "a.y > g.u", "g.y > b.u", "b.y > a.u", algorithm="gauss-seidel")
    x, y = 1.0, 0.0
    for a, b in zip(column(result, "a.y"), column(result, "b.y"), strict=True):
        assert (a, b) == (x, y)
        x = x + 0.1 * (1.0 * y)
        y = y + 0.1 * (1.0 * (2.0 * x))


def test_gauss_seidel_holds_what_sampled_components_give():
    components = [Source("s", lambda t: t), Integrator("a")]
    expected = column(run(components, "s.y > a.u"), "a.y")
    assert column(run(components, "s.y > a.u", algorithm="gauss-seidel"), "a.y").tolist() == expected.tolist()


def test_gauss_seidel_holds_what_sampled_components_took():
    loop = ("a.y > c.u", "c.y > a.u")
    components = [Integrator("a", start=1.0), Gain("c", -1.0, sampled=True)]
    expected = column(run(components, *loop), "a.y")
    result = run(components, *loop, algorithm="gauss-seidel")
    assert column(result, "a.y").tolist() == expected.tolist()
    assert column(result, "c.u").tolist() == expected.tolist()


def test_held_source_into_first_order_lag_has_its_closed_form():
    result = run([Source("s", lambda t: 3.0), Lag("p", 0.5)], "s.y > p.u", stop=2.0)
    t = result.frame["time"]
    np.testing.assert_allclose(column(result, "p.y"), 3 * (1 - np.exp(-t / 0.5)), rtol=0, atol=1e-14)


@pytest.mark.parametrize("states", [True, False])
def test_sampled_controller_acts_without_delay(states: bool):
    # y⁺ = a y + (1 − a) k (r − y), with and without the plant saying that y is a state.
    result = run([Gain("c", -4.0, 4.0, sampled=True), Lag("p", 0.5, states=states)], "p.y > c.u", "c.y > p.u")
    a = np.exp(-0.1 / 0.5)
    pole = a - (1 - a) * 4
    expected = 0.8 * (1 - pole ** np.arange(11))
    np.testing.assert_allclose(column(result, "p.y"), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(column(result, "c.y"), 4 * (1 - expected), rtol=0, atol=1e-14)


def test_rates_in_a_row_belong_to_the_inputs_in_that_row():
    result = run([Gain("c", -4.0, 4.0, sampled=True), Lag("p", 0.5)], "p.y > c.u", "c.y > p.u")
    frame = result.frame
    assert column(result, "p.rate").tolist() == ((frame["p.u"] - frame["p.y"]) / 0.5).tolist()


def test_algebraic_loop_is_delayed_by_one_step_from_the_first_row_on():
    # y_a = 0.5 u_a + 1 and y_b = u_b with u_a one point late: y_k = 0.5 y_{k−1} + 1, y of initialisation 1.
    result = run([Gain("a", 0.5, 1.0), Gain("b")], "a.y > b.u", "b.y > a.u", stop=0.5)
    expected = [2 - 2.0**-k for k in range(1, 7)]
    assert column(result, "a.y").tolist() == expected
    assert column(result, "b.u").tolist() == expected
    assert column(result, "a.u").tolist() == [
        1.0 if k == 0 else e for k, e in enumerate([1.0, *expected[:-1]])
    ]


def test_start_of_an_input_is_what_a_delayed_connection_begins_from():
    components = [Gain("a", 0.5, start=8.0), Gain("b", start=8.0)]
    result = run(components, "a.y > b.u", "b.y > a.u", stop=0.1)
    assert column(result, "a.u").tolist()[0] == 4.0


# ── rows and times ───────────────────────────────────────────────────────────────────────────────────────


def test_first_row_is_at_the_start_and_the_last_at_the_stop():
    result = Master(graph([Source("s", lambda t: t)]), 2.0, 3.0, 0.25).run()
    assert column(result, "time").tolist() == [2.0, 2.25, 2.5, 2.75, 3.0]
    assert column(result, "s.y").tolist() == [2.0, 2.25, 2.5, 2.75, 3.0]


def test_row_after_a_step_is_labelled_with_its_end():
    result = run([Source("s", lambda t: 1.0), Integrator("a")], "s.y > a.u", step=0.5)
    assert column(result, "a.y").tolist() == [0.0, 0.5, 1.0]


def test_times_are_multiples_and_not_sums():
    result = Master(graph([Integrator("a")]), 0.0, 1e3, 0.1, record=["a.gain"]).run()
    assert column(result, "time").tobytes() == (0.1 * np.arange(10_001)).tobytes()


def test_a_million_ticks_end_at_the_stop():
    ticks = count_ticks(0.0, 1e3, 1e-3)
    assert ticks == 1_000_000
    assert 0.0 + ticks * 1e-3 == 1e3


@given(st.integers(1, 10**7), st.sampled_from([1e-3, 0.1, 1 / 3, 7e-5, 2.5]), st.floats(-10, 10))
def test_ticks_are_counted_right_in_spite_of_rounding(n: int, step: float, start: float):
    assert count_ticks(start, start + n * step, step) == n


def test_stop_between_two_steps_is_refused_with_the_nearest_ones():
    with pytest.raises(InputError, match=r"stop 1\.05 s is no whole number .* nearest: 1 s or 1\.1 s"):
        count_ticks(0.0, 1.05, 0.1)
    with pytest.raises(InputError, match=r"nearest: 0\.1 s"):
        count_ticks(0.0, 0.05, 0.1)


@pytest.mark.parametrize(
    ("times", "text"),
    [
        ((0.0, 0.0, 0.1), "does not lie after start"),
        ((1.0, 0.0, 0.1), "does not lie after start"),
        ((0.0, 1.0, 0.0), "a step above 0"),
        ((0.0, np.inf, 0.1), "expected finite times"),
    ],
)
def test_impossible_times_are_refused(times: tuple[float, float, float], text: str):
    with pytest.raises(InputError, match=text):
        count_ticks(*times)


def test_two_runs_are_identical():
    master = Master(graph(oscillator(), *COUPLED), 0.0, 5.0, 0.01, algorithm="gauss-seidel")
    first, second = master.run(), master.run()
    assert first.frame.to_numpy().tobytes() == second.frame.to_numpy().tobytes()


def test_unknown_algorithm_is_refused():
    with pytest.raises(
        InputError, match=r"algorithm: there is no 'gauss_seidel'; did you mean 'gauss-seidel'\?"
    ):
        run([Integrator("a")], algorithm="gauss_seidel")


def test_start_values_reach_their_components():
    result = run([Integrator("a"), Integrator("b")], starts={"b": {"y": 4.0, "u": 2.0}}, stop=0.1)
    assert column(result, "b.y").tolist() == [4.0, 4.2]
    assert column(result, "a.y").tolist() == [0.0, 0.0]


def test_initial_values_pass_through_connections_during_initialisation():
    seen = []
    listener = Gain("b", start=7.0)
    listener.exit_initialization = lambda: seen.append(listener["u"]) or Status.OK
    run([Integrator("a", start=3.0), listener], "a.y > b.u")
    assert seen == [3.0]


# ── several rates ────────────────────────────────────────────────────────────────────────────────────────


def test_component_with_its_own_step_takes_part_at_its_own_ticks_only():
    slow = Integrator("slow")
    result = run(
        [Source("s", lambda t: t), slow], "s.y > slow.u", stop=0.6, step=0.1, own_steps={"slow": 0.3}
    )
    assert [c for c in slow.calls if c.startswith("step")] == ["step 0 0.3", "step 0.3 0.3"]
    np.testing.assert_allclose(column(result, "slow.u"), [0, 0, 0, 0.3, 0.3, 0.3, 0.6], atol=1e-15)
    np.testing.assert_allclose(column(result, "slow.y"), [0, 0, 0, 0, 0, 0, 0.09], atol=1e-15)


def test_fast_plant_under_a_slow_controller_has_its_closed_form():
    components = [Gain("c", -4.0, 4.0, sampled=True), Lag("p", 0.5)]
    result = run(
        components, "p.y > c.u", "c.y > p.u", stop=2.0, step=0.01, own_steps={"c": 0.1}, record=["p.y"]
    )
    a = np.exp(-0.1 / 0.5)
    expected = 0.8 * (1 - (a - (1 - a) * 4) ** np.arange(21))
    np.testing.assert_allclose(column(result, "p.y")[::10], expected, rtol=0, atol=1e-13)


def test_an_own_step_that_would_pass_the_stop_is_not_made():
    slow = Integrator("slow")
    run([slow], stop=0.5, step=0.1, own_steps={"slow": 0.3})
    assert [c for c in slow.calls if c.startswith("step")] == ["step 0 0.3"]


def test_gauss_seidel_does_not_refresh_across_rates():
    components = oscillator()
    options = {"stop": 1.0, "own_steps": {"b": 0.5}}
    jacobi = run(components, *COUPLED, **options).frame
    seidel = run(components, *COUPLED, **options, algorithm="gauss-seidel").frame
    assert jacobi.equals(seidel)


@pytest.mark.parametrize("own_step", [0.15, 0.05, 1e-9])
def test_own_step_that_is_no_multiple_is_refused(own_step: float):
    with pytest.raises(InputError, match=r"component 'a': its step .* no multiple .* nearest: 0\.1 s"):
        run([Integrator("a")], own_steps={"a": own_step})


def test_own_step_must_be_finite():
    with pytest.raises(InputError, match="expected a finite time above 0"):
        count_every("a", np.inf, 0.1)


def test_own_step_of_nobody_is_refused_with_the_nearest_name():
    with pytest.raises(InputError, match=r"own step: no component 'plamt'; did you mean 'plant'\?"):
        run([Integrator("plant")], own_steps={"plamt": 0.1})


# ── failure ──────────────────────────────────────────────────────────────────────────────────────────────


def refuse(component: Faulty) -> Status:
    component.message = "out of range"
    return Status.ERROR


def explode(component: Faulty) -> Status:
    raise ValueError("no root")


def spoil(component: Faulty) -> Status:
    component["y"] = np.nan
    return Status.OK


def faulty_run(method: str, fault, at: float = 0.0, **options: object):
    healthy, bad = Integrator("good"), Faulty("bad", method, fault, at)
    result = run([healthy, bad], "bad.y > good.u", "good.y > bad.u", **options)
    assert (healthy.closed, bad.closed) == (1, 1)
    return result


@pytest.mark.parametrize(
    ("method", "what", "rows"),
    [
        ("enter", "initialisation", 0),
        ("exit", "the end of initialisation", 0),
        ("set", "setting inputs", 0),
        ("get", "reading outputs", 0),
        ("step", "the step", 1),
    ],
)
def test_error_status_ends_the_run_and_names_component_and_time(method: str, what: str, rows: int):
    result = faulty_run(method, refuse)
    assert isinstance(result.error, ComponentError)
    assert str(result.error) == f"bad at t = 0 s: {what} ended with status ERROR: out of range"
    assert len(result.frame) == rows


@pytest.mark.parametrize("method", ["enter", "exit", "set", "get", "step"])
def test_exception_of_a_component_becomes_an_error_that_names_the_place(method: str):
    result = faulty_run(method, explode)
    assert isinstance(result.error, ComponentError)
    assert str(result.error).startswith("bad at t = 0 s: ValueError: no root (test_cosim_master.py:")
    assert isinstance(result.error.__cause__, ValueError)


def test_rows_before_a_failing_step_are_kept():
    result = faulty_run("step", refuse, at=0.5)
    assert result.error.time == pytest.approx(0.5)
    np.testing.assert_allclose(result.frame["time"], [0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert np.isfinite(result.frame.to_numpy()).all()
    assert result.statistics["steps"] == 5


def test_value_that_is_not_finite_names_component_variable_and_time():
    def lose(component: Faulty) -> Status:
        component["y"] = np.inf
        component.time = 99.0
        return Status.OK

    result = faulty_run("step", lose, at=0.3)
    assert isinstance(result.error, ComponentError)
    assert (result.error.component, result.error.variable) == ("bad", "y")
    assert str(result.error) == "bad.y at t = 0.4 s: the value is inf, expected a finite number"
    assert len(result.frame) == 4


def test_nan_is_never_passed_on():
    good = Integrator("good")
    bad = Faulty("bad", "step", spoil, at=0.3)
    assert run([good, bad], "bad.y > good.u").error is not None
    assert np.isfinite(good["u"])


def test_nan_in_gauss_seidel_is_found_before_it_is_passed_on():
    result = faulty_run("step", spoil, at=0.3, algorithm="gauss-seidel")
    assert result.error.variable == "y"


def test_value_whose_square_overflows_is_finite():
    result = run([Integrator("a", start=1e200)])
    assert column(result, "a.y").tolist() == [1e200] * 11


@pytest.mark.parametrize("status", [Status.DISCARD, Status.FATAL, 17])
def test_any_other_status_ends_the_run(status: int):
    result = faulty_run("step", lambda component: status)
    assert getattr(status, "name", "17") in str(result.error)
    assert "no text" in str(result.error)


def test_run_error_of_a_component_is_kept_as_it_is():
    def give_up(component: Faulty) -> Status:
        raise SolverError("no plan")

    assert isinstance(faulty_run("get", give_up, at=0.3).error, SolverError)
    assert isinstance(faulty_run("step", give_up, at=0.3).error, SolverError)
    assert isinstance(faulty_run("enter", give_up).error, SolverError)


def test_input_error_at_initialisation_is_raised_and_all_are_closed():
    def complain(component: Faulty) -> Status:
        raise InputError("no such start value")

    good, bad = Integrator("good"), Faulty("bad", "enter", complain)
    with pytest.raises(InputError, match="no such start value"):
        run([good, bad])
    assert (good.closed, bad.closed) == (1, 1)


def test_start_values_of_nobody_are_refused_and_all_are_closed():
    plant = Integrator("plant")
    with pytest.raises(InputError, match=r"start values: no component 'plan'; did you mean 'plant'\?"):
        run([plant], starts={"plan": {"y": 1.0}})
    assert plant.closed == 1


def test_warnings_are_counted_and_the_first_is_told():
    def warn(component: Faulty) -> Status:
        component.message = f"clipped at {component.time:.1f}"
        return Status.WARNING

    result = faulty_run("step", warn, at=0.0)
    assert result.error is None
    told = {"count": 10, "first": "the step at t = 0 s: clipped at 0.0"}
    assert result.statistics["warnings"] == {"bad": told}


def test_failure_to_close_is_a_warning_and_the_others_are_closed():
    bad, good = Faulty("bad", "close", explode), Integrator("good")
    result = run([bad, good])
    assert result.error is None
    assert good.closed == 1
    assert result.statistics["warnings"]["bad"]["first"] == "closing failed: ValueError: no root"


def test_run_that_ends_well_closes_each_component_once():
    components = oscillator()
    run(components, *COUPLED)
    assert [c.closed for c in components] == [1, 1]


# ── being stopped ────────────────────────────────────────────────────────────────────────────────────────


def test_stop_request_keeps_the_rows_so_far():
    plant = Integrator("a")
    asked = iter([False, False, True])
    result = Master(graph([plant]), 0.0, 1.0, 0.1).run(should_stop=lambda: next(asked))
    assert isinstance(result.error, Interrupted)
    assert str(result.error) == "stopped by the user at t = 0.2 s; the rows so far are kept"
    assert len(result.frame) == 3
    assert plant.closed == 1


def test_interrupt_inside_a_component_keeps_the_rows_so_far():
    def interrupt(component: Faulty) -> Status:
        raise KeyboardInterrupt

    result = faulty_run("step", interrupt, at=0.5)
    assert isinstance(result.error, Interrupted)
    assert len(result.frame) == 6


def test_second_interrupt_ends_the_run_at_once_with_all_closed():
    asked = []

    def interrupt(component: Faulty) -> Status:
        asked.append(True)
        raise KeyboardInterrupt

    plant = Faulty("a", "step", interrupt, at=0.5)
    with pytest.raises(KeyboardInterrupt):
        Master(graph([plant]), 0.0, 1.0, 0.1).run(should_stop=lambda: bool(asked))
    assert plant.closed == 1


def test_stop_request_after_the_last_row_changes_nothing():
    result = Master(graph([Integrator("a")]), 0.0, 0.1, 0.1).run(should_stop=iter([False]).__next__)
    assert result.error is None


# ── progress and statistics ──────────────────────────────────────────────────────────────────────────────


def test_progress_is_told_seldom_and_at_the_end(monkeypatch: pytest.MonkeyPatch):
    clock = iter(np.arange(10**6) * 1e-3)
    monkeypatch.setattr(watch_module.time, "perf_counter", lambda: next(clock))
    told: list[tuple[float, float]] = []
    master = Master(graph([Integrator("a")]), 0.0, 10.0, 0.01)
    master.run(progress=lambda fraction, t: told.append((fraction, t)))
    assert told[0] == (0.0, 0.0)
    assert told[-1] == (1.0, 10.0)
    assert len(told) == pytest.approx(1001e-3 / 0.1, abs=3)
    assert told == sorted(told)


def test_statistics_tell_steps_and_real_time_factor():
    statistics = run([Integrator("a")]).statistics
    assert statistics["steps"] == 10
    assert statistics["real_time_factor"] == pytest.approx(1.0 / statistics["seconds"])
    assert "component_seconds" not in statistics


def test_profile_tells_the_time_of_each_component_and_changes_nothing_else():
    plain = run(oscillator(), *COUPLED)
    timed = run(oscillator(), *COUPLED, profile=True)
    assert plain.frame.equals(timed.frame)
    seconds = timed.statistics["component_seconds"]
    assert set(seconds) == {"a", "b"}
    assert 0 < sum(seconds.values()) < timed.statistics["seconds"]


def test_profile_passes_on_messages_and_states():
    from exlinn_fmi.cosim.profile import Timed

    inner = Integrator("a")
    inner.message = "x"
    inner.save_state = lambda: inner.values.copy()
    inner.restore_state = lambda state: inner.values.__setitem__(slice(None), state)
    timed = Timed(inner)
    assert (timed.message, timed.sampled, timed.can_save_state) == ("x", False, False)
    state = timed.save_state()
    inner["y"] = 5.0
    timed.restore_state(state)
    assert inner["y"] == 0.0


# ── laws ─────────────────────────────────────────────────────────────────────────────────────────────────


@given(st.permutations(range(4)), st.lists(st.floats(-1, 1), min_size=4, max_size=4))
@settings(max_examples=20, deadline=None)
def test_jacobi_does_not_depend_on_the_order_of_components(order: list[int], starts: list[float]):
    """A ring of integrators and a gain: nobody sees who stands first."""
    connections = ("i0.y > i1.u", "i1.y > g.u", "g.y > i2.u", "i2.y > i0.u")

    def solve(order: list[int]) -> np.ndarray:
        parts = [*(Integrator(f"i{k}", starts[k]) for k in range(3)), Gain("g", starts[3])]
        result = run([parts[k] for k in order], *connections, record=["i0.y", "i1.y", "i2.y", "g.y"])
        return result.frame.to_numpy()

    assert solve(order).tobytes() == solve([0, 1, 2, 3]).tobytes()

"""FMUs as components: values of every type, calling sequence, statuses, state; with strict probe FMUs."""

from __future__ import annotations

import gc
import math
import weakref
from pathlib import Path

import numpy as np
import pytest
from fmu_helpers import TYPES_3, Driver, description_2, probe
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components import cache
from exlinn_fmi.components.base import Status
from exlinn_fmi.components.fmu import FmuComponent, read_variables
from exlinn_fmi.components.texts import text
from exlinn_fmi.errors import ComponentError, FmuError, InputError


@pytest.fixture
def probe2(tmp_path: Path):
    """A driver of the FMI 2 probe."""
    component = FmuComponent("probe", probe(tmp_path))
    yield Driver(component)
    component.close()


@pytest.fixture
def probe3(tmp_path: Path):
    """A driver of the FMI 3 probe."""
    component = FmuComponent("probe", probe(tmp_path, version=3))
    yield Driver(component)
    component.close()


@pytest.fixture
def trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The calls that the FMI 2 probe received."""
    file = tmp_path / "trace"
    monkeypatch.setenv("PROBE_TRACE", str(file))
    return lambda: file.read_text().split("\n")[:-1]


def faulty(tmp_path: Path, *defines: str, version: int = 2) -> Driver:
    return Driver(FmuComponent("probe", probe(tmp_path, *defines, version=version))).begin()


def until_trouble(driver: Driver) -> Status:
    for _ in range(20):
        status = driver.step()
        if status != Status.OK:
            return status
    raise AssertionError("no trouble came")


# ── values ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("version", [2, 3])
def test_an_integrator_with_gain_follows_its_closed_form(tmp_path: Path, version: int) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path, version=version))).begin(h=0.1, gain=3.0, x=-1.0)
    driver.set(u=2.0)
    driver.run(7)
    assert driver.get("x", "y") == pytest.approx([-1 + 0.7 * 2, -1 + 0.7 * 2 + 3 * 2], abs=1e-14)


def test_outputs_follow_inputs_at_once(probe2: Driver) -> None:
    probe2.begin()
    for u in (1.0, -4.0):
        probe2.set(u=u)
        assert probe2.get("y") == [2 * u]


def test_outputs_can_be_read_during_initialization(probe2: Driver) -> None:
    probe2.component.enter_initialization(0.0, 1.0, {"u": 4.0})
    assert probe2.get("y") == [8.0]


def test_values_of_several_types_are_read_in_the_order_asked_for(probe2: Driver) -> None:
    probe2.begin(u=1.5, n_in=41, mode_in=2, on=True)
    assert probe2.get("off", "n_out", "y", "mode_out", "u", "on") == [0.0, 42.0, 3.0, 2.0, 1.5, 1.0]


def test_values_of_several_types_are_set_in_one_call(probe2: Driver) -> None:
    probe2.begin()
    assert probe2.set(on=0, u=2.5, mode_in=2, n_in=-3) == Status.OK
    assert probe2.get("off", "n_out", "y", "mode_out") == [1.0, -2.0, 5.0, 2.0]


@pytest.mark.parametrize("kind", [*TYPES_3, "mode"])
def test_every_fmi3_type_goes_through_unchanged(probe3: Driver, kind: str) -> None:
    probe3.begin()
    for value in (1.0, 0.0) if kind == "Boolean" else (3.0, 100.0):
        probe3.set(**{f"{kind}_in": value})
        assert probe3.get(f"{kind}_out") == [value]


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_integers_pass_exactly_or_are_refused(data: st.DataObject, shared_probe3: Driver) -> None:
    bits, sign = data.draw(st.sampled_from([8, 16, 32, 64])), data.draw(st.sampled_from(["Int", "UInt"]))
    value = data.draw(st.integers(-(2**53), 2**53))
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if sign == "Int" else (0, 2**bits - 1)
    status = shared_probe3.set(**{f"{sign}{bits}_in": float(value)})
    assert (status == Status.OK) == (low <= value <= high)
    if status == Status.OK:
        assert shared_probe3.get(f"{sign}{bits}_out") == [value]


@pytest.fixture(scope="module")
def shared_probe3(tmp_path_factory: pytest.TempPathFactory):
    component = FmuComponent("probe", probe(tmp_path_factory.mktemp("shared"), version=3))
    yield Driver(component).begin()
    component.close()


@pytest.mark.parametrize(
    ("name", "value"), [("n_in", 1.5), ("mode_in", math.nan), ("on", 0.5), ("on", 2.0), ("n_in", 3e9)]
)
def test_a_value_that_the_type_cannot_hold_is_an_error_naming_it(
    probe2: Driver, name: str, value: float
) -> None:
    probe2.begin()
    assert probe2.set(u=1.0, **{name: value}) == Status.ERROR
    assert name in probe2.component.message
    assert f"{value:g}" in probe2.component.message


def test_float32_is_rounded(probe3: Driver) -> None:
    probe3.begin()
    probe3.set(Float32_in=0.1)
    assert probe3.get("Float32_out") == [float(np.float32(0.1))]


def test_a_nan_is_handed_on(tmp_path: Path) -> None:
    driver = faulty(tmp_path, "FAULT_NAN")
    driver.run(5)
    assert math.isnan(driver.get("y")[0])


# ── variables ────────────────────────────────────────────────────────────────────────────────────────────


def test_variables_carry_what_the_model_description_says(tmp_path: Path) -> None:
    found = {v.name: v for v in read_variables(probe(tmp_path))}
    assert (found["u"].causality, found["u"].unit, found["u"].start) == ("input", "m/s", 0.0)
    assert (found["x"].unit, found["x"].depends_on) == ("m", ())
    assert found["y"].depends_on == ("u",)
    assert found["n_out"].depends_on is None
    assert (found["gain"].variability, found["gain"].min, found["gain"].max) == ("fixed", 0.0, 10.0)
    assert (found["mode_in"].type, found["mode_in"].min, found["mode_in"].max) == ("Enumeration", 1.0, 2.0)
    assert (found["on"].type, found["on"].start) == ("Boolean", 1.0)
    assert (found["doubled"].causality, found["doubled"].start) == ("local", None)


def test_arrays_are_taken_apart_and_texts_are_variables(tmp_path: Path) -> None:
    found = {v.name: v for v in read_variables(probe(tmp_path, version=3))}
    assert {"time", "size", "y", "mode_out", "vector[1]", "vector[2]", "vector[3]"} <= set(found)
    assert found["label"].type == "String"
    assert text(found["label"].start) == "a"


def test_an_fmi3_alias_is_the_same_variable(probe3: Driver) -> None:
    probe3.begin()
    probe3.set(speed=2.0)
    assert probe3.get("u", "y") == [2.0, 4.0]


def test_a_structural_parameter_is_not_changed_once_the_fmu_is_open(probe3: Driver) -> None:
    with pytest.raises(InputError, match=r"probe\.size: sizes arrays and is 3 since the FMU was opened"):
        probe3.begin(size=4)


# ── start values ─────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ({"gian": 1.0}, r"probe\.gian: no such variable; did you mean 'gain'"),
        ({"on": 0.5}, r"probe\.on: is a Boolean: expected true or false, found 0\.5"),
        ({"n_in": 1.5}, r"probe\.n_in: is of type Integer: expected a whole number, found 1\.5"),
        ({"mode_in": 3.0}, r"probe\.mode_in: expected 1 … 2, found 3"),
        ({"gain": 11.0}, r"probe\.gain: expected 0 … 10, found 11"),
        ({"pi": 3.0}, r"probe\.pi: is a constant and takes no start value"),
        ({"doubled": 3.0}, r"probe\.doubled: is calculated by the component"),
        ({"y": 3.0}, r"probe\.y: is calculated by the component"),
    ],
)
def test_a_start_value_that_is_not_taken_is_refused(probe2: Driver, starts: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        probe2.begin(**starts)


def test_all_wrong_start_values_are_told_at_once(probe2: Driver) -> None:
    with pytest.raises(InputError) as error:
        probe2.begin(gian=1.0, on=0.5)
    assert len(str(error.value).splitlines()) == 2


# ── the calling sequence ─────────────────────────────────────────────────────────────────────────────────


def test_the_calls_of_a_run_come_in_the_order_of_the_standard(tmp_path: Path, trace) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path))).begin(gain=1.0)
    driver.run(3)
    driver.component.close()
    assert trace() == [
        "Instantiate",
        "SetupExperiment",
        "EnterInitializationMode",
        "ExitInitializationMode",
        "Terminate",
        "FreeInstance",
    ]


@pytest.mark.parametrize("version", [2, 3])
def test_a_second_run_begins_afresh(tmp_path: Path, version: int) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path, version=version)))
    for _ in range(2):
        driver.begin(x=1.0)
        driver.set(u=1.0)
        driver.run(5)
        assert driver.get("x") == pytest.approx([1.5])
    driver.begin()
    assert driver.get("x", "u") == [0.0, 0.0]


def test_an_fmu_that_may_be_instantiated_once_is_reset(tmp_path: Path, trace) -> None:
    path = probe(tmp_path, description=description_2(once="true"))
    driver = Driver(FmuComponent("probe", path)).begin()
    driver.run(2)
    driver.begin()
    driver.run(2)
    driver.component.close()
    assert trace().count("Instantiate") == 1
    assert trace().count("Reset") == 1


def test_an_instance_that_was_never_run_is_freed_without_terminate(tmp_path: Path, trace) -> None:
    FmuComponent("probe", probe(tmp_path)).close()
    assert trace() == ["Instantiate", "FreeInstance"]


def test_a_failed_instance_is_freed_without_terminate(tmp_path: Path, trace) -> None:
    driver = faulty(tmp_path, "FAULT=fmi2Error")
    until_trouble(driver)
    driver.component.close()
    assert trace()[-2:] == ["ExitInitializationMode", "FreeInstance"]


def test_after_a_fatal_status_nothing_is_called(tmp_path: Path, trace) -> None:
    driver = faulty(tmp_path, "FAULT=fmi2Fatal")
    assert until_trouble(driver) == Status.FATAL
    driver.component.close()
    assert trace()[-1] == "ExitInitializationMode"


def test_a_failed_instance_can_run_again(tmp_path: Path) -> None:
    driver = faulty(tmp_path, "FAULT=fmi2Error")
    until_trouble(driver)
    driver.begin()
    driver.run(4)


def test_inputs_and_tunable_parameters_can_be_set_during_a_run(probe2: Driver) -> None:
    probe2.begin()
    assert probe2.set(u=1.0, trim=0.5) == Status.OK
    assert probe2.get("y") == [2.5]


@pytest.mark.parametrize("name", ["gain", "x", "y", "pi"])
def test_what_is_fixed_during_a_run_cannot_be_set(probe2: Driver, name: str) -> None:
    probe2.begin()
    assert probe2.set(**{name: 1.0}) == Status.ERROR
    assert probe2.component.message == f"{name} cannot be set while stepping"


def test_equal_steps_are_demanded_where_the_fmu_needs_them(tmp_path: Path) -> None:
    path = probe(tmp_path, description=description_2(variable_step="false"))
    component = FmuComponent("probe", path)
    Driver(component).begin()
    assert component.step(0.0, 0.1) == Status.OK
    assert component.step(0.1, 0.1 + 1e-16) == Status.OK
    assert component.step(0.2, 0.05) == Status.ERROR
    assert component.message == "takes equal communication steps only: had 0.1 s, now 0.05 s"
    Driver(component).begin()
    assert component.step(0.0, 0.05) == Status.OK


def test_two_instances_of_one_fmu_do_not_touch_each_other(tmp_path: Path) -> None:
    path = probe(tmp_path)
    one, two = (Driver(FmuComponent(name, path)).begin() for name in ("one", "two"))
    one.set(u=1.0)
    one.run(3)
    two.run(1)
    assert one.get("x") == pytest.approx([0.3])
    assert two.get("x") == [0.0]


# ── trouble ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("define", "status", "word"),
    [
        ("FAULT=fmi2Error", Status.ERROR, "fmi2Error"),
        ("FAULT=fmi2Fatal", Status.FATAL, "fmi2Fatal"),
        ("FAULT=fmi2Warning", Status.WARNING, "fmi2Warning"),
        ("FAULT=fmi2Pending", Status.ERROR, "fmi2Pending"),
        ("FAULT=17", Status.ERROR, "the unknown status 17"),
    ],
)
def test_a_status_comes_with_the_words_of_the_fmu(
    tmp_path: Path, define: str, status: Status, word: str
) -> None:
    driver = faulty(tmp_path, define)
    assert until_trouble(driver) == status
    assert driver.ticks == 5
    message = driver.component.message
    assert message == f"fmi2DoStep returned {word}: the bearing is hot at t = 0.5 s"


def test_a_wish_to_end_is_a_discarded_step(tmp_path: Path) -> None:
    driver = faulty(tmp_path, "FAULT=fmi2Discard")
    assert until_trouble(driver) == Status.DISCARD
    assert driver.component.message == "fmi2DoStep returned fmi2Discard: the FMU asks to end the simulation"


@pytest.mark.parametrize(
    ("define", "words"), [("FAULT_END", "asks to end the simulation"), ("FAULT_EARLY", "returned early")]
)
def test_an_fmi3_step_that_ends_or_returns_early_is_discarded(
    tmp_path: Path, define: str, words: str
) -> None:
    driver = faulty(tmp_path, define, version=3)
    assert until_trouble(driver) == Status.DISCARD
    assert words in driver.component.message
    assert "t = 0.5 s" in driver.component.message


def test_an_error_in_the_wrong_place_is_reported_in_the_fmus_words(tmp_path: Path) -> None:
    driver = faulty(tmp_path, "FAULT=fmi2Error")
    until_trouble(driver)
    component = driver.component
    assert component.exit_initialization() == Status.ERROR
    assert "ExitInitializationMode is not allowed while failed" in component.message


@pytest.mark.parametrize(("word", "status"), [("Warning", Status.WARNING), ("Discard", Status.DISCARD)])
def test_a_status_of_set_and_get_is_reported_and_the_values_pass(
    tmp_path: Path, word: str, status: Status
) -> None:
    path = probe(tmp_path, f"SET_STATUS=fmi2{word}", f"GET_STATUS=fmi2{word}")
    component = FmuComponent("probe", path)
    driver = Driver(component).begin()
    assert driver.set(u=3.0, n_in=1) == status
    assert component.message == f"fmi2SetReal returned fmi2{word}"
    values = np.zeros(2)
    assert component.get(np.array([component.index("n_out"), component.index("y")]), values) == status
    assert component.message == f"fmi2GetReal returned fmi2{word}"
    assert values.tolist() == [2.0, 6.0]


def test_an_fmu_that_refuses_a_start_value_is_reported(tmp_path: Path) -> None:
    component = FmuComponent("probe", probe(tmp_path, "SET_STATUS=fmi2Error"))
    assert component.enter_initialization(0.0, 1.0, {"gain": 1.0}) == Status.ERROR
    assert component.message == "fmi2SetReal returned fmi2Error"


def test_an_error_in_one_fmu_is_not_laid_at_the_door_of_another(tmp_path: Path) -> None:
    path = probe(tmp_path, "FAULT=fmi2Error")
    one, two = (Driver(FmuComponent(name, path)).begin() for name in ("one", "two"))
    until_trouble(one)
    two.run(1)
    assert two.component.message == ""


def test_a_refusal_to_instantiate_carries_the_reason(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match=r"refuses to be instantiated: no licence for \{probe\}$"):
        FmuComponent("probe", probe(tmp_path, "REFUSE"))


def test_an_fmu_that_needs_a_tool_says_so_when_it_cannot_run(tmp_path: Path) -> None:
    path = probe(tmp_path, "REFUSE", description=description_2(needs_tool="true"))
    with pytest.raises(FmuError, match="it says that it needs Probe maker on this machine"):
        FmuComponent("probe", path)


def test_a_binary_that_lacks_a_function_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match=r"lacks a function of FMI 2: .*fmi2GetStringStatus"):
        FmuComponent("probe", probe(tmp_path, "LACKING"))


# ── state ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("version", [2, 3])
def test_a_restored_state_gives_the_same_future(tmp_path: Path, version: int) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path, version=version))).begin()
    driver.set(u=1.0)
    driver.run(3)
    assert driver.component.can_save_state
    state, ticks = driver.component.save_state(), driver.ticks
    futures = []
    for _ in range(2):
        driver.component.restore_state(state)
        driver.ticks = ticks
        driver.run(4)
        futures.append(driver.get("x", "y"))
    assert futures[0] == futures[1] == pytest.approx([0.7, 2.7])


def test_saved_states_are_freed_with_their_objects(tmp_path: Path, trace) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path))).begin()
    for _ in range(3):
        driver.component.save_state()
    gc.collect()
    driver.component.close()
    assert trace()[-1] == "FreeInstance"


def test_a_state_of_an_earlier_run_is_not_freed_in_a_later_one(tmp_path: Path, trace) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path))).begin()
    state = driver.component.save_state()
    driver.begin()
    with pytest.raises(ComponentError, match="of an earlier run"):
        driver.component.restore_state(state)
    del state
    gc.collect()
    driver.component.close()
    assert "ILLEGAL" not in trace()


def test_a_state_that_cannot_be_saved_is_a_component_error(tmp_path: Path) -> None:
    driver = faulty(tmp_path, "REFUSE_STATE")
    with pytest.raises(ComponentError, match=r"probe: saving the state failed: .*GetFMUstate is not allowed"):
        driver.component.save_state()


def test_a_state_that_cannot_be_restored_is_a_component_error(tmp_path: Path) -> None:
    driver = faulty(tmp_path, "REFUSE_RESTORE")
    state = driver.component.save_state()
    with pytest.raises(ComponentError, match="probe: restoring the state failed"):
        driver.component.restore_state(state)


# ── the folder ───────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Names of the folders in a cache of this test alone, and whether nobody uses any of them."""
    monkeypatch.setenv("EXLINN_CACHE", str(tmp_path / "cache"))

    def look() -> tuple[int, bool]:
        found = list((tmp_path / "cache").iterdir())
        return len(found), all(cache._evict(folder) for folder in found)

    return look


def test_closing_gives_the_folder_back_and_may_be_done_twice(tmp_path: Path, folders) -> None:
    component = FmuComponent("probe", probe(tmp_path))
    assert folders() == (1, False)
    component.close()
    component.close()
    assert folders() == (1, True)


def test_a_component_that_is_dropped_frees_its_instance_and_folder(tmp_path: Path, folders, trace) -> None:
    driver = Driver(FmuComponent("probe", probe(tmp_path))).begin()
    dropped = weakref.ref(driver.component)
    del driver
    assert dropped() is None
    assert trace()[-2:] == ["Terminate", "FreeInstance"]
    assert folders() == (1, True)


@pytest.mark.parametrize("define", ["REFUSE", "LACKING"])
def test_a_component_that_cannot_be_made_gives_its_folder_back(tmp_path: Path, folders, define: str) -> None:
    with pytest.raises(FmuError):
        FmuComponent("probe", probe(tmp_path, define))
    assert folders() == (1, True)


def test_a_closed_component_cannot_crash_the_process(probe2: Driver) -> None:
    probe2.begin()
    probe2.component.close()
    for call in (probe2.step, lambda: probe2.set(u=1.0), lambda: probe2.get("y")):
        with pytest.raises((TypeError, AttributeError)):
            call()

"""What FMI 2.0 asks of our FMUs, tried on the paper's plant: parameters, state, modes and refusals."""

from __future__ import annotations

import re
from collections.abc import Iterator
from ctypes import c_double, c_int, c_void_p
from pathlib import Path

import numpy as np
import pytest
from export_helpers import Instance, instance
from fmpy.fmi1 import FMICallException

from exlinn_fmi.export import export_plant
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.plants import plant

PLANT = plant("dc_motor_cart")
SYSTEM = PLANT.system
STATES = SYSTEM.state_names
DEFAULTS = SYSTEM.parameter_values
X0 = {"alpha": 0.7, "alpha_dot": -1.5, "i": 0.4}
MS = 1e-3


def paper_input(steps: int, h: float = MS) -> dict[str, np.ndarray]:
    """The paper's voltage v = 2 (0.5 sin 2t + 2), held over each step."""
    return {"v": 2 * (0.5 * np.sin(2 * h * np.arange(steps)) + 2)}


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh build."""
    return export_plant(PLANT, tmp_path_factory.mktemp("fmu") / "fresh.fmu")


@pytest.fixture
def cs(fmu: Path) -> Iterator[Instance]:
    with instance(fmu) as made:
        yield made


@pytest.fixture
def me(fmu: Path) -> Iterator[Instance]:
    with instance(fmu, "me") as made:
        yield made


def refused(made: Instance, message: str, call: object, *arguments: object) -> None:
    """The call ends with fmi2Error and the log says why."""
    with pytest.raises(FMICallException) as caught:
        call(*arguments)  # type: ignore[operator]
    assert caught.value.status == 3
    assert re.search(message, made.log[-1]), made.log


# ── parameters and instances ─────────────────────────────────────────────────────────────────────────────


def test_parameters_set_before_the_start_act(cs: Instance) -> None:
    cs.start({**X0, "r": 8.0, "m_c": 2.0})
    states = cs.run(STATES, MS, paper_input(1000))
    p = DEFAULTS.copy()
    p[[q.name for q in SYSTEM.parameters].index("r")] = 8.0
    p[[q.name for q in SYSTEM.parameters].index("m_c")] = 2.0
    u = np.vstack([np.zeros(1000), paper_input(1000)["v"]])
    expected = SYSTEM.rk4(1).mapaccum(1000)(list(X0.values()), u, p, MS).full().T
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-11)


def test_parameters_can_be_tuned_between_steps(cs: Instance) -> None:
    cs.start(X0)
    cs.run(STATES, MS, paper_input(1))
    cs.set("k_e", 0.5)
    i, tau_e = cs.get("i", "tau_e")
    assert tau_e == 0.5 * i


def test_solver_step_divides_the_communication_step(cs: Instance) -> None:
    cs.start({**X0, "solver_step": 0.004})
    states = cs.run(STATES, 0.01, {"v": np.array([5.0])})
    expected = SYSTEM.rk4(3)(list(X0.values()), [0.0, 5.0], DEFAULTS, 0.01).full().T
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-14)


def test_reset_brings_the_start_values_back(cs: Instance) -> None:
    cs.start({**X0, "r": 8.0})
    cs.run(STATES, MS, paper_input(10))
    cs.fmu.reset()
    cs.start()
    assert cs.get("r", *STATES) == [5.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(cs.run(STATES, MS, paper_input(1)).shape, (1, 3))


def test_two_instances_do_not_disturb_each_other(fmu: Path, cs: Instance) -> None:
    cs.start(X0)
    with instance(fmu, name="other") as other:
        other.start({"alpha": 2.0, "l": 0.5})
        mixed = []
        for k in range(100):
            mixed.append(cs.run(STATES, MS, {"v": np.array([5.0])}, first=k)[0])
            other.run(STATES, MS, {"v": np.array([-9.0])}, first=k)
    with instance(fmu) as alone:
        alone.start(X0)
        np.testing.assert_array_equal(alone.run(STATES, MS, {"v": np.full(100, 5.0)}), mixed)


# ── FMU state ────────────────────────────────────────────────────────────────────────────────────────────


def test_restored_state_continues_bit_for_bit(cs: Instance) -> None:
    names = [v.name for v in PLANT.output_list]
    cs.start({**X0, "b_m": 0.7})
    cs.run(STATES, MS, paper_input(50))
    saved = cs.fmu.getFMUState()
    onward = cs.run(names, MS, paper_input(100), first=50)
    cs.set("b_m", 0.1)
    cs.fmu.setFMUState(saved)
    np.testing.assert_array_equal(cs.run(names, MS, paper_input(100), first=50), onward)
    cs.fmu.freeFMUState(saved)


def test_serialised_state_continues_bit_for_bit_in_another_instance(fmu: Path, cs: Instance) -> None:
    names = [v.name for v in PLANT.output_list]
    cs.start({**X0, "b_m": 0.7})
    cs.run(STATES, MS, paper_input(50))
    saved = cs.fmu.getFMUState()
    data = cs.fmu.serializeFMUState(saved)
    cs.fmu.freeFMUState(saved)
    onward = cs.run(names, MS, paper_input(100), first=50)
    with instance(fmu, name="other") as other:
        restored = other.fmu.deSerializeFMUstate(data)
        other.fmu.setFMUState(restored)
        np.testing.assert_array_equal(other.run(names, MS, paper_input(100), first=50), onward)
        other.fmu.freeFMUState(restored)


def test_foreign_bytes_are_no_state(cs: Instance) -> None:
    refused(cs, "not a state of this build of DCMotorCart", cs.fmu.deSerializeFMUstate, b"x" * 1000)


# ── directional derivatives ──────────────────────────────────────────────────────────────────────────────


def test_a_parameter_has_no_directional_derivative(cs: Instance) -> None:
    cs.start()
    r = cs.references["r"]
    message = f"value reference {r} is no state, derivative or output"
    refused(cs, message, cs.fmu.getDirectionalDerivative, [r], [0], [1.0])


def test_no_directional_derivative_along_an_output(cs: Instance) -> None:
    cs.start()
    x = cs.references["x"]
    refused(cs, f"value reference {x} is no state", cs.fmu.getDirectionalDerivative, [x], [x], [1.0])


# ── Model Exchange ───────────────────────────────────────────────────────────────────────────────────────


def continuous(made: Instance) -> None:
    """Bring a Model Exchange instance into continuous-time mode."""
    made.start()
    info = made.fmu.newDiscreteStates()
    assert not any(info[:5])
    made.fmu.enterContinuousTimeMode()


def test_model_exchange_derivatives_and_outputs_equal_the_plants(me: Instance) -> None:
    continuous(me)
    x = (c_double * 3)(*X0.values())
    dx = (c_double * 3)()
    me.fmu.setTime(0.5)
    me.fmu.setContinuousStates(x, 3)
    me.set("v", 7.0)
    me.fmu.getDerivatives(dx, 3)
    expected = evaluate(SYSTEM.derivative, list(X0.values()), [0.0, 7.0], DEFAULTS)[0]
    np.testing.assert_allclose(list(dx), expected, rtol=1e-14)
    me.fmu.getContinuousStates(dx, 3)
    assert list(dx) == list(x)
    me.fmu.getNominalsOfContinuousStates(dx, 3)
    assert list(dx) == [1.0, 1.0, 1.0]
    outputs = evaluate(PLANT.output, list(X0.values()), [0.0, 7.0], DEFAULTS)[0]
    np.testing.assert_allclose(me.get(*(o.name for o in PLANT.output_list)), outputs, rtol=1e-14)


def test_model_exchange_has_no_events(me: Instance) -> None:
    continuous(me)
    assert me.fmu.completedIntegratorStep() == (0, 0)
    me.fmu.enterEventMode()
    me.fmu.enterContinuousTimeMode()
    me.fmu.terminate()


def test_model_exchange_takes_no_steps(me: Instance) -> None:
    continuous(me)
    message = "fmi2DoStep may not be called in mode 'continuous time' of this Model Exchange instance"
    status = me.fmu.dll.fmi2DoStep(c_void_p(me.fmu.component), c_double(0.0), c_double(MS), c_int(0))
    assert status == 3
    assert me.log[-1] == message


def test_model_exchange_refuses_values_that_are_no_numbers(me: Instance) -> None:
    continuous(me)
    states = (c_double * 3)(0.0, float("nan"), 0.0)
    refused(me, "alpha_dot was set to -?nan", me.fmu.setContinuousStates, states, 3)
    refused(me, "the time was set to inf", me.fmu.setTime, float("inf"))
    me.fmu.setContinuousStates((c_double * 3)(0.0, 1e200, 0.0), 3)
    me.fmu.enterEventMode()
    me.set("d", 1e200)
    refused(me, "alpha_ddot is", me.fmu.getDerivatives, (c_double * 3)(), 3)


def test_arrays_of_a_wrong_length_are_refused(me: Instance) -> None:
    continuous(me)
    fmu, array = me.fmu, (c_double * 4)()
    for call in (
        fmu.setContinuousStates,
        fmu.getContinuousStates,
        fmu.getDerivatives,
        fmu.getNominalsOfContinuousStates,
    ):
        refused(me, "an array of 4 values was given, expected 3", call, array, 4)
    refused(me, "an array of 4 values was given, expected 0", fmu.getEventIndicators, array, 4)


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────────


def test_a_step_before_initialisation_is_refused(cs: Instance) -> None:
    refused(cs, "fmi2DoStep may not be called in mode 'instantiated'", cs.fmu.doStep, 0.0, MS)


@pytest.mark.parametrize("h", [0.0, -MS, float("nan"), float("inf")])
def test_a_step_that_is_not_positive_is_refused(cs: Instance, h: float) -> None:
    cs.start()
    refused(cs, "the step size is .* expected a positive number", cs.fmu.doStep, 0.0, h)


def test_a_step_from_another_time_is_refused(cs: Instance) -> None:
    cs.start()
    refused(cs, "the importer is at t = 0.5 s, this model at t = 0 s", cs.fmu.doStep, 0.5, MS)


def test_a_step_past_the_stop_time_is_refused(cs: Instance) -> None:
    cs.start(stop=0.0015)
    cs.fmu.doStep(0.0, MS)
    refused(cs, "goes past the stop time 0.0015 s", cs.fmu.doStep, MS, MS)


def test_an_input_that_is_no_number_is_refused_by_name(cs: Instance) -> None:
    cs.start()
    refused(cs, r"v was set to -?nan at t = 0 s", cs.set, "v", float("nan"))


def test_a_refused_set_sets_nothing(cs: Instance) -> None:
    cs.start()
    r = cs.references
    refused(cs, "v was set to inf", cs.fmu.setReal, [r["tau_ext"], r["v"]], [1.0, float("inf")])
    assert cs.get("tau_ext", "v") == [0.0, 0.0]


@pytest.mark.parametrize("name", ["alpha", "x", "solver_step", "i_dot"])
def test_what_follows_from_the_run_cannot_be_set_in_it(cs: Instance, name: str) -> None:
    cs.start()
    refused(cs, f"{name} may not be set in mode 'step complete'", cs.set, name, 1.0)


def test_solver_step_must_be_positive(cs: Instance) -> None:
    refused(cs, "solver_step was set to 0 s, expected a positive number", cs.set, "solver_step", 0.0)


def test_parameters_that_make_no_sense_are_named_at_the_start(cs: Instance) -> None:
    refused(cs, "i_dot is -?(nan|inf) at the start; check the parameters", cs.start, {"l": 0.0})


def test_a_result_that_is_no_number_is_refused_by_name_and_the_state_is_kept(cs: Instance) -> None:
    """An inductance of 1 µH makes a pole at −5·10⁶ 1/s, which steps of 1 ms cannot follow."""
    cs.start({"l": 1e-6, "alpha_dot": 1.0})
    message = "alpha is no longer finite .* make the parameter solver_step .* smaller"
    refused(cs, message, cs.fmu.doStep, 0.0, 0.1)
    assert cs.get(*STATES) == [0.0, 1.0, 0.0]


def test_an_output_that_is_no_number_is_refused_by_name(cs: Instance) -> None:
    cs.start({"i": 1e200})
    refused(cs, "W_m is inf at t = 0 s", cs.get, "W_m")


def test_an_unknown_value_reference_is_refused(cs: Instance) -> None:
    refused(cs, "there is no value reference 99, the last one is 25", cs.fmu.getReal, [99])
    refused(cs, "there is no value reference 99, the last one is 25", cs.fmu.setReal, [99], [1.0])


def test_what_the_model_description_denies_is_refused(cs: Instance) -> None:
    cs.start()
    v, x = [cs.references["v"]], [cs.references["x"]]
    refused(cs, "order 1 to 3 can be followed, 4 was given", cs.fmu.setRealInputDerivatives, v, [4], [1.0])
    refused(cs, "value reference .* is no input", cs.fmu.setRealInputDerivatives, x, [1], [1.0])
    refused(cs, "maxOutputDerivativeOrder is 1", cs.fmu.getRealOutputDerivatives, x, [2])
    refused(cs, "steps are never pending", cs.fmu.cancelStep)


def test_the_last_successful_time_is_reported(cs: Instance) -> None:
    cs.start(t0=2.0)
    cs.fmu.doStep(2.0, 0.25)
    assert cs.fmu.getRealStatus(2) == 2.25
    assert cs.fmu.getBooleanStatus(3) is False


@pytest.mark.parametrize("type_name", ["Integer", "String"])
def test_variables_of_another_type_are_refused(cs: Instance, type_name: str) -> None:
    refused(cs, f"has no variables of type {type_name}", getattr(cs.fmu, f"get{type_name}"), [0])


def test_a_real_variable_is_no_boolean(cs: Instance) -> None:
    refused(cs, "alpha is of type real", cs.fmu.getBoolean, [0])


def test_input_derivatives_are_followed_within_the_step(cs: Instance) -> None:
    """v = 2 + 30 t − 40 t² over 100 ms, against the same polynomial cut into steps of 0.1 ms."""
    cs.start({**X0, "solver_step": 1e-4})
    cs.set("v", 2.0)
    v = [cs.references["v"]] * 2
    cs.fmu.setRealInputDerivatives(v, [1, 2], [30.0, -80.0])
    cs.fmu.doStep(0.0, 0.1)
    once, (end,) = cs.get(*STATES), cs.get("v")
    assert end == pytest.approx(2 + 30 * 0.1 - 40 * 0.01)
    cs.fmu.reset()
    cs.start({**X0, "solver_step": 1e-4})
    t = 1e-4 * (np.arange(1000) + 0.5)
    cut = cs.run(STATES, 1e-4, {"v": 2 + 30 * t - 40 * t**2})
    np.testing.assert_allclose(once, cut[-1], rtol=1e-7)


def test_input_derivatives_hold_for_one_step(cs: Instance) -> None:
    cs.start()
    cs.fmu.setRealInputDerivatives([cs.references["v"]], [1], [10.0])
    cs.fmu.doStep(0.0, 0.1)
    cs.fmu.doStep(0.1, 0.1)
    assert cs.get("v") == [pytest.approx(1.0)]


def test_output_derivatives_are_those_of_the_run(cs: Instance) -> None:
    names = ["alpha", "x", "tau_e", "alpha_ddot"]
    cs.start(X0)
    cs.set("v", 5.0)
    given = cs.fmu.getRealOutputDerivatives([cs.references[n] for n in names], [1] * 4)
    before = np.array(cs.get(*names))
    cs.fmu.doStep(0.0, 1e-6)
    np.testing.assert_allclose(list(given), (np.array(cs.get(*names)) - before) / 1e-6, rtol=1e-4)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-7, 1e-10])
def test_adaptive_steps_keep_their_tolerance(cs: Instance, tolerance: float) -> None:
    cs.start({**X0, "solver_step": 1e-4})
    fine = cs.run(STATES, 0.1, {"v": np.full(20, 5.0)})
    cs.fmu.reset()
    cs.start({**X0, "solver_tolerance": tolerance})
    difference = np.abs(cs.run(STATES, 0.1, {"v": np.full(20, 5.0)}) - fine).max()
    assert difference < 20 * tolerance
    assert difference > 1e-15


def test_adaptive_steps_name_a_state_that_cannot_be_followed(cs: Instance) -> None:
    cs.start({"alpha_dot": 1e150, "solver_tolerance": 1e-6})
    refused(cs, "cannot be followed in the step from t = 0 s to 1 s", cs.fmu.doStep, 0.0, 1.0)


def test_the_tolerance_must_be_below_one(cs: Instance) -> None:
    refused(cs, "solver_tolerance was set to 1, expected 0", cs.set, "solver_tolerance", 1.0)


def test_a_foreign_guid_is_refused(fmu: Path) -> None:
    log: list[str] = []
    with pytest.raises(Exception, match="instantiate"):
        Instance(fmu, guid="{0%s}", log=log)
    assert "the token is {0?s}, expected {" in log[-1]

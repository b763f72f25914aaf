"""Every status of every FMI function is honoured: warnings are told, what is worse ends run and calls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cosim_helpers import Lag, Source
from fmu_helpers import Driver
from reference_fmus import MODELS, binary, description_2, packed, reference

from exlinn_fmi.components.base import Component, Status
from exlinn_fmi.components.fmu import FmuComponent, FmuSettings
from exlinn_fmi.components.fmu_trajectory import trajectory
from exlinn_fmi.cosim.adaptive import AdaptiveOptions
from exlinn_fmi.cosim.extrapolation import ExtrapolationOptions
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master, Trajectories
from exlinn_fmi.errors import ComponentError

WORDS = {1: "fmi2Warning", 2: "fmi2Discard", 3: "fmi2Error", 4: "fmi2Fatal", 7: "the unknown status 7"}
BOTH = [
    "SetupExperiment",
    "EnterInitializationMode",
    "ExitInitializationMode",
    "SetReal",
    "GetReal",
    "GetInteger",
]
STATES = ["GetFMUstate", "SetFMUstate"]
STEPPING = ["DoStep", "SetRealInputDerivatives"]
EXCHANGE = [
    "EnterEventMode", "NewDiscreteStates", "EnterContinuousTimeMode", "CompletedIntegratorStep", "SetTime",
    "SetContinuousStates", "GetDerivatives", "GetEventIndicators", "GetContinuousStates",
    "GetNominalsOfContinuousStates",
]  # fmt: skip
STEP_TOO_LONG = ["SetTime", "SetContinuousStates", "GetDerivatives"]
"""Of which fmi2Discard makes the solver try a shorter step (FMI 2.0 §3.2.1)."""
USES = [
    *(("co_simulation", name) for name in BOTH + STATES + STEPPING),
    *(("model_exchange", name) for name in BOTH + STATES + EXCHANGE),
]


class Calls:
    """What the FMU is to return, and what was called."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder, self._patch = folder, monkeypatch
        library = binary(2, "statuses2.c", "MODEL=6")
        self.path = packed(folder, 2, description_2(MODELS["Switch"]), library)

    def heater(self, kind: str, name: str = "-", status: int = 0, after: int = 0) -> FmuComponent:
        """A heater with a thermostat; its function `name` returns `status` after so many calls."""
        self._patch.setenv("STATUS", f"{name} {status} {after}")
        self._patch.setenv("STATUS_LOG", str(self._folder / f"{name}-{status}.txt"))
        return FmuComponent("heater", self.path, FmuSettings(kind))

    def log(self, name: str, status: int) -> list[list[str]]:
        """Names of the functions called and what they returned."""
        return [line.split() for line in (self._folder / f"{name}-{status}.txt").read_text().splitlines()]


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calls:
    return Calls(tmp_path, monkeypatch)


def run(component: FmuComponent, name: str, compiled: bool = False) -> Trajectories:
    """A second, with a continuous and a discrete input that change where `name` is not about states."""
    parts: dict[str, Component] = {"heater": component}
    options: dict = {"compiled": compiled}
    if name in STATES:
        return Master(Graph(parts, []), 0.0, 1.0, 0.05, adaptive=AdaptiveOptions(tolerance=1e-3)).run()
    parts["load"], parts["offset"] = (
        Source("load", lambda t: np.sin(9 * t)),
        Source("offset", lambda t: t > 0.5),
    )
    if name == "SetRealInputDerivatives":
        parts["load"], options = Lag("load"), {"extrapolation": ExtrapolationOptions(order=1)}
    wires = [("load.y", "heater.load"), ("offset.y", "heater.offset")]
    return Master(Graph(parts, wires), 0.0, 1.0, 0.05, **options).run()


@pytest.mark.parametrize(("kind", "name"), USES)
@pytest.mark.parametrize("status", WORDS)
def test_no_status_is_passed_over(calls: Calls, kind: str, name: str, status: int) -> None:
    first_call = ["SetupExperiment", "EnterInitializationMode", "ExitInitializationMode", "EnterEventMode"]
    after = 0 if name in [*first_call, "GetNominalsOfContinuousStates"] else 3
    result = run(calls.heater(kind, name, status, after), name)
    log = calls.log(name, status)
    assert [name, str(status)] in log, "the status was never told"
    if status == 1:
        assert result.error is None
        said = result.statistics["warnings"]["heater"]["first"]
        assert f"fmi2{name}" in said
        assert "returned fmi2Warning: the fan rattles" in said
        clean = run(calls.heater(kind), name)
        assert not clean.statistics["warnings"]
        assert clean.frame.to_numpy().tobytes() == result.frame.to_numpy().tobytes()
        return
    assert isinstance(result.error, ComponentError)
    if not (status == 2 and name in STEP_TOO_LONG):
        assert f"fmi2{name} returned {WORDS[status]}" in str(result.error)
        assert "the fan rattles" in str(result.error)
    last = [called for called, _ in log[log.index([name, str(status)]) + 1 :]]
    if status == 4:
        assert last == []
    elif status == 3:
        assert set(last) <= {"FreeInstance", "FreeFMUstate"}
        assert last[-1] == "FreeInstance"


@pytest.mark.parametrize("name", ["SetReal", "GetReal", "GetInteger", "DoStep"])
@pytest.mark.parametrize("status", WORDS)
def test_compiled_stepping_honours_them_alike(calls: Calls, name: str, status: int) -> None:
    plain, fast = (
        run(calls.heater("co_simulation", name, status, 5), name, compiled) for compiled in (False, True)
    )
    assert fast.statistics["stepping"] == "compiled"
    assert str(fast.error) == str(plain.error)
    assert fast.statistics["warnings"] == plain.statistics["warnings"]
    assert fast.frame.to_numpy().tobytes() == plain.frame.to_numpy().tobytes()
    if status == 4:
        log = calls.log(name, status)
        assert log[-1] == [name, "4"]
        assert len([line for line in log if line == [name, "4"]]) == 2  # one of each run


@pytest.mark.parametrize(
    "name", ["SetReal", "SetContinuousStates", "GetDerivatives", "GetEventIndicators", "GetReal"]
)
def test_a_trajectory_warns(calls: Calls, name: str) -> None:
    component = calls.heater("model_exchange", name, 1, 9)
    times, output = np.linspace(0, 1, 11), "der(x)" if name == "GetReal" else "x"  # states are not asked for
    with pytest.warns(UserWarning, match=f"^heater: .*fmi2{name}.* returned fmi2Warning: the fan rattles"):
        table = trajectory(component, times, [output], {"load": np.sin(9 * times)})
    component.close()
    clean = calls.heater("model_exchange")
    assert (trajectory(clean, times, [output], {"load": np.sin(9 * times)}) == table).all()
    clean.close()


@pytest.mark.parametrize(
    "name", ["SerializedFMUstateSize", "SerializeFMUstate", "DeSerializeFMUstate", "SetFMUstate"]
)
@pytest.mark.parametrize("status", [2, 3, 4])
def test_a_state_that_cannot_be_kept_is_told(calls: Calls, name: str, status: int) -> None:
    driver = Driver(calls.heater("co_simulation", name, status)).begin()
    with pytest.raises(ComponentError, match=f"fmi2{name} returned {WORDS[status]}: the fan rattles"):
        driver.component.restore_state(
            driver.component.deserialize_state(
                driver.component.serialize_state(driver.component.save_state())
            )
        )
    if status > 2:
        before = len(calls.log(name, status))
        assert driver.step() == status
        assert driver.component.get(np.array([0]), np.zeros(1)) == status
        assert driver.component.set(np.array([4]), np.zeros(1)) == status
        assert len(calls.log(name, status)) == before
    driver.component.close()
    last = calls.log(name, status)[-1]
    assert last == ([name, "4"] if status == 4 else ["FreeInstance", "0"])


def test_after_an_error_a_saved_state_helps(calls: Calls) -> None:
    driver = Driver(calls.heater("co_simulation", "DoStep", 3, 2)).begin()
    state = driver.component.save_state()
    driver.run(2)
    assert [driver.step(), driver.step()] == [Status.ERROR, Status.ERROR]
    driver.component.restore_state(state)
    assert driver.get("x") == [0.0]
    driver.component.close()
    names = [name for name, _ in calls.log("DoStep", 3)]
    assert names.count("DoStep") == 3
    assert names[-2:] == ["Terminate", "FreeInstance"]


def test_nothing_is_called_after_terminate_was_fatal(calls: Calls) -> None:
    driver = Driver(calls.heater("co_simulation", "Terminate", 4)).begin()
    driver.run(2)
    driver.component.close()
    assert calls.log("Terminate", 4)[-1] == ["Terminate", "4"]


@pytest.mark.parametrize("status", [1, 2, 3])
def test_steps_between_events_of_fmi3_tell_theirs(tmp_path: Path, status: int) -> None:
    path = reference(tmp_path, "BouncingBall", 3, f"FAULT_STEP=(fmi3Status){status}")
    component = FmuComponent("ball", path, FmuSettings("co_simulation"))
    result = Master(Graph({"ball": component}, []), 0.0, 1.0, 0.1).run()
    if status == 1:
        assert result.error is None
        assert result.statistics["warnings"]["ball"]["first"].endswith("fmi3DoStep returned fmi3Warning")
        assert result.statistics["warnings"]["ball"]["count"] == 5
    else:
        assert "fmi3DoStep returned fmi3" in str(result.error)

"""FMI 3.0 on the paper's plant: arrays, derivatives both ways, intermediate update, early return, state."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator
from ctypes import byref, c_double, c_size_t
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from export_helpers import instance
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import fmi3ValueReference
from fmpy.simulation import instantiate_fmu
from fmpy.validation import validate_fmu

from exlinn_fmi.errors import InputError
from exlinn_fmi.export import export_plant
from exlinn_fmi.export.build import Options
from exlinn_fmi.export.check import check_fmu
from exlinn_fmi.plants import plant

PLANT = plant("dc_motor_cart")
STATES = PLANT.system.state_names
X0 = {"alpha": 0.7, "alpha_dot": -1.5, "i": 0.4}
MS = 1e-3


class Fmu3:
    """An instance of an FMI 3.0 FMU."""

    def __init__(self, path: Path, kind: str = "CoSimulation", **more: Any) -> None:
        self.description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.folder = Path(fmpy.extract(str(path)))
        self.log: list[str] = []
        self.fmu = instantiate_fmu(
            str(self.folder),
            self.description,
            kind,
            logger=lambda *a: self.log.append(a[-1].decode()),
            **more,
        )

    def start(self, starts: dict[str, float] | None = None) -> None:
        for name, value in (starts or {}).items():
            self.set(name, value)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, name: str, value: float) -> None:
        self.fmu.setFloat64([self.references[name]], [value])

    def get(self, *names: str) -> list[float]:
        return list(self.fmu.getFloat64([self.references[n] for n in names]))

    def close(self) -> None:
        self.fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_plant(PLANT, tmp_path_factory.mktemp("fmu") / "three.fmu", Options(fmi=3, arrays=True))


@pytest.fixture
def cs(fmu: Path) -> Iterator[Fmu3]:
    made = Fmu3(fmu)
    yield made
    made.close()


def test_fmpy_validates_without_a_problem(fmu: Path) -> None:
    assert validate_fmu(str(fmu)) == []


def test_it_does_what_its_reference_says(fmu: Path) -> None:
    found = check_fmu(fmu)
    assert not found.problems
    assert max(found.runs.values()) < 1e-9
    assert set(found.runs) == {"CoSimulation", "ModelExchange"}


def test_arrays_need_fmi_3() -> None:
    with pytest.raises(InputError, match=r"FMI 2.0 knows no arrays; ask for FMI 3.0 \(--fmi 3\)"):
        Options(fmi=2, arrays=True)


def test_both_versions_step_alike_to_the_last_bit(cs: Fmu3, tmp_path: Path) -> None:
    cs.start()
    cs.fmu.setFloat64([cs.references["v"]], [5.0])
    for k in range(100):
        cs.fmu.doStep(k * MS, MS)
    with instance(export_plant(PLANT, tmp_path / "two.fmu")) as two:
        two.start()
        assert cs.get(*STATES) == list(two.run(STATES, MS, {"v": np.full(100, 5.0)})[-1])


def test_the_state_is_an_array(cs: Fmu3) -> None:
    state = [cs.references["state"]]
    cs.fmu.setFloat64(state, list(X0.values()))
    cs.start()
    assert list(cs.fmu.getFloat64(state, 3)) == list(X0.values())
    assert cs.get(*STATES) == list(X0.values())
    change = list(cs.fmu.getFloat64([cs.references["der(state)"]], 3))
    assert change[1:] == cs.get("alpha_ddot", "i_dot")
    with pytest.raises(FMICallException):
        cs.fmu.getFloat64(state, 2)
    assert "room for 2 values" in cs.log[-1]


def test_adjoint_derivatives_are_the_transpose_of_the_directional_ones(cs: Fmu3) -> None:
    cs.fmu.setFloat64([cs.references["state"]], list(X0.values()))
    cs.start()
    known = [cs.references[n] for n in ("state", "v", "k_e", "r")]
    unknown = [cs.references[n] for n in ("der(state)", "alpha", "W_star", "tau_e")]
    rng = np.random.default_rng(0)
    seed, weight = rng.normal(size=6), rng.normal(size=6)
    forward, back = (c_double * 6)(), (c_double * 6)()
    u, z = (fmi3ValueReference * 4)(*unknown), (fmi3ValueReference * 4)(*known)
    given = (c_double * 6)(*seed)
    cs.fmu.fmi3GetDirectionalDerivative(cs.fmu.component, u, 4, z, 4, given, 6, forward, 6)
    weights = (c_double * 6)(*weight)
    cs.fmu.fmi3GetAdjointDerivative(cs.fmu.component, u, 4, z, 4, weights, 6, back, 6)
    assert np.dot(weight, list(forward)) == pytest.approx(np.dot(list(back), seed), rel=1e-13)


def test_the_importer_sees_internal_steps_and_may_move_inputs_there(fmu: Path) -> None:
    seen: list[float] = []

    def update(_: Any, time: float, want: bool, may: bool, done: bool, early: bool, *__: Any) -> None:
        assert want
        assert may
        assert done
        assert not early
        seen.append(time)
        made.set("v", 1000 * time)

    made = Fmu3(fmu, intermediate_update=update)
    made.start()
    made.fmu.doStep(0.0, 5 * MS)
    np.testing.assert_allclose(seen, MS * np.arange(1, 6), rtol=1e-12)
    assert made.get("v") == [pytest.approx(5.0)]
    assert made.get("i")[0] == pytest.approx(MS * (0 + 1 + 2 + 3 + 4), rel=0.02)
    made.close()


def test_a_step_may_end_early(fmu: Path) -> None:
    def update(_: Any, time: float, *rest: Any) -> None:
        rest[-2][0] = True
        rest[-1][0] = 0.0034

    made = Fmu3(fmu, intermediate_update=update, early_return_allowed=True)
    made.start()
    event, terminate, early, last = made.fmu.doStep(0.0, 0.01)
    assert (event, terminate, early) == (False, False, True)
    assert last == pytest.approx(0.0034)
    event, terminate, early, last = made.fmu.doStep(last, 0.0001)
    assert not early
    made.close()


def test_there_is_no_event_mode_in_co_simulation(fmu: Path) -> None:
    with pytest.raises(Exception, match="nstantiate"):
        Fmu3(fmu, event_mode_used=True)


def test_serialised_state_continues_bit_for_bit(cs: Fmu3) -> None:
    cs.start()
    cs.set("v", 3.0)
    cs.fmu.doStep(0.0, 0.1)
    saved = cs.fmu.getFMUState()
    data = cs.fmu.serializeFMUState(saved)
    cs.fmu.doStep(0.1, 0.1)
    onward = cs.get(*STATES)
    restored = cs.fmu.deserializeFMUState(data)
    cs.fmu.setFMUState(restored)
    cs.fmu.doStep(0.1, 0.1)
    assert cs.get(*STATES) == onward
    cs.fmu.freeFMUState(saved)
    cs.fmu.freeFMUState(restored)


def test_model_exchange_runs_through_fmpy(fmu: Path) -> None:
    options: dict[str, Any] = {"stop_time": 0.5, "output_interval": 0.1, "relative_tolerance": 1e-10}
    inputs = np.array([(0.0, 5.0), (1.0, 5.0)], dtype=[("time", float), ("v", float)])
    runs = [
        fmpy.simulate_fmu(str(fmu), fmi_type=kind, input=inputs, output=["alpha", "i"], **options)
        for kind in ("CoSimulation", "ModelExchange")
    ]
    for name in ("alpha", "i"):
        np.testing.assert_allclose(runs[0][name], runs[1][name], atol=1e-6)


def test_counts_and_clocks(fmu: Path) -> None:
    made = Fmu3(fmu, "ModelExchange")
    made.start()
    made.fmu.updateDiscreteStates()
    made.fmu.enterContinuousTimeMode()
    count = c_size_t()
    made.fmu.fmi3GetNumberOfContinuousStates(made.fmu.component, byref(count))
    assert count.value == 3
    made.fmu.fmi3GetNumberOfEventIndicators(made.fmu.component, byref(count))
    assert count.value == 0
    with pytest.raises(FMICallException):
        made.fmu.getInt32([0])
    assert "has no variables of type Int32" in made.log[-1]
    made.close()


def test_terminals_icon_card_and_provenance_are_inside(fmu: Path) -> None:
    with zipfile.ZipFile(fmu) as archive:
        names = set(archive.namelist())
        page = archive.read("documentation/index.html").decode()
        terminals = archive.read("terminalsAndIcons/terminalsAndIcons.xml").decode()
    extra = {
        f"extra/org.exlinn.fmi/{n}" for n in ("provenance.json", "reference_in.csv", "reference_out.csv")
    }
    assert {"sources/buildDescription.xml", "terminalsAndIcons/icon.png"} | extra <= names
    assert "<h1>DCMotorCart</h1>" in page
    assert 'variableName="tau_ext"' in terminals

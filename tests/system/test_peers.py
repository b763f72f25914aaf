"""The same systems through our master and other people's: the same trajectories where they are right."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import fmpy
import numpy as np
import pandas as pd
import pytest

from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master

PLANT = Path(__file__).parents[2] / "fmus" / "DCMotorCart.fmu"
OUTPUTS = ("alpha", "alpha_dot", "i", "alpha_ddot", "i_dot")
STEP, STEPS = 1e-2, 200
WIRES = [("a.alpha_dot", "b.v"), ("b.i", "a.v")]
START = {"alpha_dot": 3.0, "alpha": 0.4}


def ours(names: str, wires: list[tuple[str, str]], starts: dict[str, float], compiled: bool) -> pd.DataFrame:
    graph = Graph({name: FmuComponent(name, PLANT) for name in names}, wires)
    result = Master(graph, 0.0, STEPS * STEP, STEP, compiled=compiled).run({"a": starts})
    assert result.error is None
    return result.frame


@pytest.fixture(scope="module")
def references() -> dict[str, int]:
    description = fmpy.read_model_description(str(PLANT))
    return {v.name: v.valueReference for v in description.modelVariables}


@pytest.mark.parametrize("compiled", [False, True])
def test_fmpy_gives_the_same_trajectory(compiled: bool):
    starts = {**START, "v": 6.0}
    theirs = fmpy.simulate_fmu(
        str(PLANT),
        stop_time=STEPS * STEP,
        step_size=STEP,
        output_interval=STEP,
        fmi_type="CoSimulation",
        start_values=starts,
        output=list(OUTPUTS),
    )
    frame = ours("a", [], starts, compiled)
    np.testing.assert_allclose(theirs["time"], frame["time"], rtol=0, atol=1e-12)
    for name in OUTPUTS:
        np.testing.assert_allclose(theirs[name], frame[f"a.{name}"], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
def test_libcosim_gives_the_same_trajectory_of_two_fmus(references: dict[str, int], compiled: bool):
    pytest.importorskip("libcosimpy")
    from libcosimpy.CosimEnums import CosimVariableType
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    log_output_level(CosimLogLevel.WARNING)
    execution = CosimExecution.from_step_size(1e9 * STEP)
    slaves = {name: execution.add_local_slave(CosimLocalSlave(str(PLANT), name)) for name in "ab"}
    for name, value in START.items():
        assert execution.real_initial_value(slaves["a"], references[name], value)
    for source, target in WIRES:
        ends = [end for path in (source, target) for end in (slaves[path[0]], references[path[2:]])]
        execution.connect_real_variables(*ends)
    observer = CosimObserver.create_time_series(STEPS + 1)
    execution.add_observer(observer)
    for slave in slaves.values():
        for name in ("alpha", "alpha_dot", "i"):
            observer.start_time_series(slave, references[name], CosimVariableType.REAL)
    assert execution.step(STEPS)
    frame = ours("ab", WIRES, START, compiled)
    for part, slave in slaves.items():
        for name in ("alpha", "alpha_dot", "i"):
            _, numbers, values = observer.time_series_real_samples(slave, references[name], 1, STEPS)
            mine = frame[f"{part}.{name}"].to_numpy()[list(numbers)]
            np.testing.assert_allclose(values, mine, rtol=1e-9, atol=1e-12)
            assert len(values) == STEPS


@pytest.mark.parametrize("compiled", [False, True])
def test_ecos_gives_the_same_trajectory_of_two_fmus(compiled: bool):
    library = Path(sys.prefix) / "lib" / "libtbb.so.12"
    if not library.exists():
        pytest.skip("ecos needs libtbb")
    ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)
    ecospy = pytest.importorskip("ecospy")
    from ecospy.EcosParameterSet import EcosParameterSet

    ecospy.EcosLib.set_log_level("off")
    rows = []
    with ecospy.EcosSimulationStructure() as structure, EcosParameterSet() as parameters:
        for name in "ab":
            structure.add_model(name, PLANT)
        for source, target in WIRES:
            structure.make_real_connection(source.replace(".", "::"), target.replace(".", "::"))
        for name, value in START.items():
            parameters.add_real(f"a::{name}", value)
        structure.add_parameter_set("start", parameters)
        with ecospy.EcosSimulation(structure=structure, step_size=STEP) as simulation:
            simulation.init(parameter_set="start")
            for _ in range(STEPS):
                simulation.step(1)
                rows.append(
                    [simulation.get_real(f"{p}::{n}") for p in "ab" for n in ("alpha", "alpha_dot", "i")]
                )
            simulation.terminate()
    frame = ours("ab", WIRES, START, compiled)
    columns = [f"{part}.{name}" for part in "ab" for name in ("alpha", "alpha_dot", "i")]
    np.testing.assert_allclose(rows, frame[columns].to_numpy()[1:], rtol=1e-9, atol=1e-12)

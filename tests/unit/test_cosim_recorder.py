"""What is recorded, under which names and units, and how much fits."""

from __future__ import annotations

import pytest
from cosim_helpers import Gain, Integrator, Small, Source, run

from exlinn_fmi.components.base import Variable
from exlinn_fmi.cosim.recorder import Recorder, select
from exlinn_fmi.errors import InputError

ARRAY = Small("a", *(Variable(name, "output") for name in ("A[1,2]", "A[1,3]", "A1", "Ax")))


def chosen(*patterns: str) -> list[str]:
    components = {c.name: c for c in (Source("s", float), Integrator("plant"), ARRAY)}
    parts = list(components.values())
    return [f"{parts[c].name}.{parts[c].variables[k].name}" for c, k in select(components, patterns)]


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        (["*"], ["s.y", "plant.u", "plant.y", "a.A[1,2]", "a.A[1,3]", "a.A1", "a.Ax"]),
        (["plant.*"], ["plant.u", "plant.y", "plant.twice"]),
        (["plant.gain"], ["plant.gain"]),
        (["*.y"], ["s.y", "plant.y"]),
        (["plant.y", "*.y"], ["plant.y", "s.y"]),
        (["plant.?"], ["plant.u", "plant.y"]),
        (["a.A[1,2]"], ["a.A[1,2]"]),
        (["a.A[*]"], ["a.A[1,2]", "a.A[1,3]"]),
        ([], []),
    ],
)
def test_patterns_choose_variables(patterns: list[str], expected: list[str]):
    assert chosen(*patterns) == expected


def test_pattern_that_nothing_fits_is_refused_with_the_nearest_name():
    with pytest.raises(InputError, match=r"record: nothing fits 'plant.z'; did you mean") as caught:
        chosen("plant.z", "q.*")
    assert "nothing fits 'q.*'" in str(caught.value)


def test_columns_are_time_and_component_variable_with_units():
    result = run([Integrator("a")], record=["a.y", "a.gain", "a.twice"])
    assert list(result.frame) == ["time", "a.y", "a.gain", "a.twice"]
    assert result.units == {"time": "s", "a.y": "m"}


def test_parameters_and_open_inputs_are_recorded_as_they_started():
    result = run([Integrator("a")], record=["a.gain", "a.u"], starts={"a": {"gain": 3.0, "u": 2.0}})
    assert result.frame["a.gain"].tolist() == [3.0] * 11
    assert result.frame["a.u"].tolist() == [2.0] * 11


def test_local_variables_are_recorded_at_every_point():
    result = run([Integrator("a")], record=["a.y", "a.twice"], starts={"a": {"u": 1.0}})
    assert result.frame["a.twice"].tolist() == (2 * result.frame["a.y"]).tolist()
    assert result.frame["a.y"].iloc[-1] > 0.9


def test_what_is_recorded_does_not_change_the_run():
    def solve(record: list[str]) -> list[float]:
        components = [Integrator("a", 1.0), Gain("g", -2.0)]
        return run(components, "a.y > g.u", "g.y > a.u", record=record).frame["a.y"].tolist()

    assert solve(["a.y"]) == solve(["*", "a.gain", "a.twice"])


def test_nothing_but_time_may_be_recorded():
    result = run([Integrator("a")], record=[])
    assert list(result.frame) == ["time"]
    assert len(result.frame) == 11


def test_table_beyond_the_memory_is_refused_before_the_run():
    with pytest.raises(InputError, match=r"rows of 2 columns \(.* GB\) do not fit into memory; record fewer"):
        Recorder(["time", "y"], {}, 10**18)


def test_rows_of_a_run_that_ended_early_do_not_hold_the_memory_of_the_whole():
    recorder = Recorder(["time"], {}, 1000)
    recorder.table[:2] = [[0.0], [0.1]]
    recorder.rows = 2
    frame = recorder.frame()
    assert frame["time"].tolist() == [0.0, 0.1]
    assert frame.to_numpy().base is not recorder.table

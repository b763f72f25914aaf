"""Signal sources: a sampled output that is a function of time."""

from __future__ import annotations

from pathlib import Path

import pytest
from fmu_helpers import Driver
from pydantic import TypeAdapter

from exlinn_fmi.components.base import Status
from exlinn_fmi.components.signals import SignalSource
from exlinn_fmi.errors import DataError
from exlinn_fmi.scenario.signals import Signal


def source(folder: Path = Path(), **spec: object) -> SignalSource:
    return SignalSource("source", TypeAdapter(Signal).validate_python(spec), folder)


def test_a_source_has_one_sampled_output_with_the_unit_of_the_signal() -> None:
    component = source(signal="constant", value=2.0, unit="V")
    (y,) = component.variables
    assert (y.name, y.causality, y.unit, y.depends_on) == ("y", "output", "V", ())
    assert component.sampled


def test_a_source_gives_the_signal_at_each_communication_point() -> None:
    driver = Driver(source(signal="ramp", slope=2.0)).begin(start=1.0, h=0.25)
    values = []
    for _ in range(4):
        values += driver.get("y")
        driver.step()
    assert values == [2.0, 2.5, 3.0, 3.5]


def test_a_step_comes_at_its_tick(tmp_path: Path) -> None:
    driver = Driver(source(signal="step", time=0.3)).begin(h=0.1)
    driver.run(2)
    assert driver.get("y") == [0.0]
    driver.run(1)
    assert driver.get("y") == [1.0]


def test_a_table_that_is_too_short_is_refused_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "v.csv").write_text("time,v\n0,1\n1,2\n")
    component = source(tmp_path, signal="table", file="v.csv", column="v", outside="error")
    Driver(component).begin(stop=1.0)
    with pytest.raises(DataError, match=r"v\.csv: no value at t = 2 s"):
        Driver(component).begin(stop=2.0)


def test_a_source_stepped_beyond_its_table_reports_it(tmp_path: Path) -> None:
    (tmp_path / "v.csv").write_text("time,v\n0,1\n1,2\n")
    component = source(tmp_path, signal="table", file="v.csv", column="v", outside="error")
    driver = Driver(component).begin(stop=1.0, h=0.75)
    driver.run(2)
    with pytest.raises(AssertionError, match=r"no value at t = 1\.5 s"):
        driver.get("y")
    assert component.step(1.5, 0.75) == Status.OK

"""Connections that change values: units by definition and by text, factors and offsets."""

from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest
from cosim_helpers import Gain, Source
from fmu_helpers import VARIABLES_2, description_2, probe
from hypothesis import given
from hypothesis import strategies as st
from scenario_helpers import SCENARIO, load, problem

from exlinn_fmi import cli
from exlinn_fmi.components.base import SiUnit, Variable
from exlinn_fmi.components.fmu import read_variables
from exlinn_fmi.components.links import with_links
from exlinn_fmi.cosim.graph import Graph
from exlinn_fmi.cosim.master import Master
from exlinn_fmi.scenario.schema import Link, Scenario
from exlinn_fmi.scenario.units import linear, si_unit

KELVIN = (0, 0, 0, 0, 1, 0, 0, 0)


def unit(text: str | None, si: SiUnit | None = None) -> Variable:
    return Variable("v", "output", unit=text, si=si)


@pytest.mark.parametrize(
    ("one", "other", "factor", "offset"),
    [
        ("rad", "deg", 180 / math.pi, 0.0),
        ("V", "mV", 1000.0, 0.0),
        ("rpm", "rad/s", 2 * math.pi / 60, 0.0),
        ("degC", "K", 1.0, 273.15),
        ("K", "degC", 1.0, -273.15),
        ("degF", "degC", 5 / 9, -32 * 5 / 9),
        ("N.m", "J", 1.0, 0.0),
        ("C/s", "mA", 1000.0, 0.0),
        ("kN", "N", 1000.0, 0.0),
        ("m", "m", 1.0, 0.0),
        (None, "m", 1.0, 0.0),
        ("m", "1", 1.0, 0.0),
        ("widgets", "widgets", 1.0, 0.0),
    ],
)
def test_units_are_converted_by_their_text(one: str, other: str, factor: float, offset: float) -> None:
    found = linear(unit(one), unit(other))
    assert found == (pytest.approx(factor, rel=1e-13), pytest.approx(offset, rel=1e-13))


@pytest.mark.parametrize(
    ("one", "other"), [("m", "s"), ("V", "A"), ("rad/s", "Hz"), ("widgets", "m"), ("W", "J")]
)
def test_units_of_different_dimension_do_not_fit(one: str, other: str) -> None:
    assert linear(unit(one), unit(other)) is None


def test_definitions_count_more_than_texts() -> None:
    celsius = unit("T1", SiUnit(KELVIN, 1.0, 273.15))
    fahrenheit = unit("T2", SiUnit(KELVIN, 5 / 9, 459.67 * 5 / 9))
    factor, offset = linear(celsius, fahrenheit)
    assert factor * 100 + offset == pytest.approx(212)
    assert linear(celsius, unit("K")) == (1.0, 273.15)
    assert linear(celsius, unit("m")) is None
    double = unit("m", SiUnit((0, 1, 0, 0, 0, 0, 0, 0), 2.0))
    assert linear(double, unit("m")) == (2.0, 0.0)


UNITS = ["K", "degC", "degF"]


@given(st.sampled_from(UNITS), st.sampled_from(UNITS), st.sampled_from(UNITS), st.floats(-1e3, 1e3))
def test_conversions_go_together(one: str, two: str, three: str, value: float) -> None:
    def convert(a: str, b: str, x: float) -> float:
        factor, offset = linear(unit(a), unit(b))
        return factor * x + offset

    way = convert(two, three, convert(one, two, value))
    assert way == pytest.approx(convert(one, three, value), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "powers", "factor"),
    [
        ("V", (1, 2, -3, -1, 0, 0, 0, 0), 1.0),
        ("N.m.s/rad", (1, 2, -1, 0, 0, 0, 0, -1), 1.0),
        ("mm2", (0, 2, 0, 0, 0, 0, 0, 0), 1e-6),
        ("g", (1, 0, 0, 0, 0, 0, 0, 0), 1e-3),
        ("F", (-1, -2, 4, 2, 0, 0, 0, 0), 1.0),
    ],
)
def test_texts_are_known_in_base_units(text: str, powers: tuple, factor: float) -> None:
    found = si_unit(text)
    assert found.powers == powers
    assert found.factor == pytest.approx(factor)


def test_electrical_units_hang_together() -> None:
    for one, other in [
        ("V.A", "W"),
        ("Wb/A", "H"),
        ("C/V", "F"),
        ("V.s", "Wb"),
        ("V/A", "Ohm"),
        ("Wb/m2", "T"),
    ]:
        assert si_unit(one) == si_unit(other)


# ── definitions in FMUs ──────────────────────────────────────────────────────────────────────────────────


def with_units(units: str, variables: str = VARIABLES_2) -> str:
    text = description_2(variables=variables)
    return text.replace('<Unit name="m"><BaseUnit m="1"/></Unit>', units)


def test_fmus_define_their_units(tmp_path: Path) -> None:
    found = {v.name: v for v in read_variables(probe(tmp_path))}
    assert found["u"].si == SiUnit((0, 1, -1, 0, 0, 0, 0, 0))
    assert found["x"].si == SiUnit((0, 1, 0, 0, 0, 0, 0, 0))
    assert found["y"].si is None
    assert {v.name: v for v in read_variables(probe(tmp_path, version=3))}["u"].si == found["u"].si


def test_a_difference_of_temperatures_has_no_offset(tmp_path: Path) -> None:
    celsius = '<Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit>'
    text = with_units(celsius, VARIABLES_2.replace('<Real start="2" min', '<Real unit="degC" start="2" min'))
    text = text.replace(
        '<Real unit="m"/></SimpleType>', '<Real unit="degC" relativeQuantity="true"/></SimpleType>'
    )
    found = {v.name: v for v in read_variables(probe(tmp_path, description=text))}
    assert found["x"].si == SiUnit(KELVIN)
    assert found["gain"].si == SiUnit(KELVIN, 1.0, 273.15)


# ── in a run ─────────────────────────────────────────────────────────────────────────────────────────────


def test_values_are_changed_on_their_way() -> None:
    parts = {c.name: c for c in (Source("s", lambda t: 1.0 + t), Gain("g"), Gain("h"))}
    parts = with_links(parts, [("s.y", Link(to="g.u", factor=-2.0, offset=3.0)), ("s.y", Link(to="h.u"))])
    connections = [("s.y", "g.u"), ("s.y", "h.u")]
    frame = Master(Graph(parts, connections), 0.0, 1.0, 0.1).run().frame
    assert frame["g.u"].to_numpy() == pytest.approx(3.0 - 2.0 * frame["s.y"].to_numpy())
    assert frame["g.y"].equals(frame["g.u"])
    assert frame["h.u"].equals(frame["s.y"])


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_fmus_of_different_units_are_connected(tmp_path: Path, algorithm: str) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "a").mkdir()
    kmh = (
        '<Unit name="mile"><BaseUnit m="1" factor="1609.344"/></Unit><Unit name="m"><BaseUnit m="1"/></Unit>'
    )
    variables = VARIABLES_2.replace('<Real start="2" min', '<Real start="0" min').replace(
        'causality="input"><Real start="0" unit="m/s"/>', 'causality="input"><Real start="0" unit="mile"/>'
    )
    probe(tmp_path / "a")
    probe(tmp_path / "b", description=with_units(kmh, variables))
    file = tmp_path / "s.yaml"
    file.write_text(
        "name: s\ncomponents:\n  src: {source: {signal: constant, value: 3600, unit: km/h}}\n"
        "  a: {fmu: a/Probe.fmu, start: {gain: 0}}\n  b: {fmu: b/Probe.fmu}\n"
        "connections:\n  src.y: a.u\n  a.x: {to: b.u, offset: 1}\n"
        f"simulate: {{stop: 1, step: 0.1, algorithm: {algorithm}}}\n"
    )
    out = tmp_path / "run"
    assert cli.exit_code(["simulate", str(file), "--out", str(out)]) == 0
    table = pd.read_csv(out / "trajectories.csv")
    assert table["a.u"].to_numpy() == pytest.approx(1000.0)
    assert table["b.u"].to_numpy() == pytest.approx(table["a.x"].to_numpy() / 1609.344 + 1)


def test_connections_are_listed_with_what_they_change() -> None:
    scenario = Scenario.model_validate(
        {"name": "s", "connections": {"a.y": ["b.u", {"to": "c.u", "factor": 2}], "d.y": {"to": "e.u"}}}
    )
    assert scenario.connection_list() == [("a.y", "b.u"), ("a.y", "c.u"), ("d.y", "e.u")]
    assert [link.factor for _, link in scenario.links()] == [1.0, 2.0, 1.0]


def test_a_link_that_ignores_units_is_taken(tmp_path: Path) -> None:
    text = SCENARIO.replace("  plant.i: ctl.i\n", "  plant.x: {to: ctl.i, convert: false}\n")
    links = dict(load(tmp_path, text).scenario.links())
    assert not links["plant.x"].convert


@pytest.mark.parametrize(
    ("new", "path", "message"),
    [
        ("  plant.i: {to: ctl.current}\n", "connections.plant.i", "ctl has no variable 'current'"),
        ("  plant.i: {too: ctl.i}\n", "connections.plant.i.too", "unknown key 'too'; did you mean 'to'?"),
        ("  plant.x: {to: ctl.i, factor: 2}\n", "connections.plant.x", "unit mismatch"),
        ("  meter.on: {to: plant.brake, factor: 2}\n", "connections.meter.on", "is of type Boolean, and the"),
    ],
)
def test_a_link_that_does_not_fit_says_why(tmp_path: Path, new: str, path: str, message: str) -> None:
    found = problem(tmp_path, "  plant.i: ctl.i\n", new)
    assert found.path == path
    assert message in found.message

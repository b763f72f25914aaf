"""Drafts: what names and units tell, and scenarios that are valid whatever the variables are called."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.base import Variable
from exlinn_fmi.components.fmu_description import DefaultExperiment, FmuDescription
from exlinn_fmi.components.fmu_file import read_description
from exlinn_fmi.components.fmu_interfaces import Interface
from exlinn_fmi.data.foreign import columns_with_units
from exlinn_fmi.errors import ScenarioError
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.draft import fmu_draft, lone_fmu, span
from exlinn_fmi.scenario.draft_data import data_draft
from exlinn_fmi.scenario.draft_text import scenario_name
from exlinn_fmi.scenario.guess import Guess, Quantity, guess_coordinates
from exlinn_fmi.scenario.load import load_scenario


def names(guess: Guess) -> list[str | None]:
    members = (guess.position, guess.velocity, guess.acceleration, guess.input)
    return [None if q is None else q.name for q in members]


def columns(text: str) -> list[Quantity]:
    pairs = (entry.partition("|") for entry in text.split(","))
    return [Quantity(name, unit) for name, _, unit in pairs]


# ── guesses ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("phi|deg,n|rpm,i|mA,u|V", [["phi", "n", None, None], [None, "i", None, "u"]]),
        ("alpha,alpha_dot,i,v", [["alpha", "alpha_dot", None, None], [None, "i", None, "v"]]),
        ("x,u", [["x", None, None, "u"]]),
        ("s,v,f", [["s", "v", None, "f"]]),
        ("theta1,theta2,tau1,tau2", [["theta1", None, None, "tau1"], ["theta2", None, None, "tau2"]]),
        ("x1,x2,v1,v2,f", [["x1", "v1", None, "f"], ["x2", "v2", None, None]]),
        ("weg|mm,F|N", [["weg", None, None, "F"]]),
        ("T|degC,P|W", []),
        ("a,b,c", []),
    ],
)
def test_columns_are_told_by_units_then_names(given: str, expected: list[list[str | None]]) -> None:
    assert [names(g) for g in guess_coordinates(columns(given), alone=True)] == expected


@pytest.mark.parametrize(
    ("plant", "expected"),
    [
        ("DCMotorCart", [["alpha", "alpha_dot", "alpha_ddot", "tau_ext"], [None, "i", "i_dot", "v"]]),
        ("MEMSActuator", [["x", "x_dot", "x_ddot", "F_ext"], ["Q", "i", "i_dot", "v"]]),
        ("MagneticLevitation", [["x", "x_dot", "x_ddot", "F_ext"], [None, "i", "i_dot", "v"]]),
        ("MotorPendulum", [["phi", "phi_dot", "phi_ddot", "tau_ext"], [None, "i", "i_dot", "v"]]),
    ],
)
def test_coordinates_of_plants_are_found(root: Path, plant: str, expected: list[list[str | None]]) -> None:
    draft = fmu_draft(read_description(root / f"fmus/{plant}.fmu"), f"{plant}.fmu", "x.yaml")
    coordinates = parse(draft).data["learn"]["coordinates"]
    keys = ("position", "velocity", "acceleration", "input")
    found = [[c[k].removeprefix("plant.") if k in c else None for k in keys] for c in coordinates]
    assert found == expected


def test_a_variable_of_a_modelica_component_is_no_relative_one() -> None:
    quantities = columns("damper.s_rel|m,damper.v_rel|m/s,mass.s|m,mass.v|m/s,mass.a|m/s2,wall.s|m")
    (guess,) = guess_coordinates(quantities, columns("f"), states=2)
    assert names(guess) == ["mass.s", "mass.v", "mass.a", "f"]


# ── drafts are valid ─────────────────────────────────────────────────────────────────────────────────────

TEXT = st.text(st.characters(blacklist_categories=["Cs", "Cc"]), min_size=1, max_size=12)
UNITS = st.sampled_from(["", "m", "rad", "m/s", "rad/s", "A", "V", "N", "N.m", "m/s2", "1", "x y"])
VARIABLES = st.lists(
    st.builds(
        Variable,
        name=TEXT,
        causality=st.sampled_from(["input", "output", "local", "parameter"]),
        unit=UNITS,
        start=st.none() | st.floats(-1e3, 1e3),
        description=TEXT,
        min=st.none() | st.floats(-10, 0),
        max=st.none() | st.floats(0, 10),
    ),
    max_size=12,
    unique_by=lambda v: v.name,
)


def description(variables: tuple[Variable, ...], experiment: DefaultExperiment) -> FmuDescription:
    both = tuple(Interface(kind, "m") for kind in ("co_simulation", "model_exchange"))
    keys = tuple(range(len(variables)))
    return FmuDescription(
        Path("Übung 1.fmu"), 2, both[0], both, "", "tool: #1\nof ours", variables, (), keys, keys, keys,
        state_count=4, experiment=experiment,
    )  # fmt: skip


@given(variables=VARIABLES, stop=st.none() | st.floats(1e-3, 1e6), step=st.none() | st.floats(1e-6, 1e3))
@settings(max_examples=60, deadline=None, phases=[Phase.reuse, Phase.generate])  # shrinking takes minutes
def test_whatever_the_variables_are_called_the_draft_is_valid(variables, stop, step) -> None:
    fmu = description(tuple(variables), DefaultExperiment(0.0, stop, step))
    for text in (lone_fmu(fmu), fmu_draft(fmu, "Übung 1.fmu", "out.yaml")):
        assert parse(text).problems == ()
        check(text, variables)


def check(text: str, variables: list[Variable]) -> None:
    """Write a draft beside a file in the FMU's place, and load it with its variables known."""
    import tempfile

    from exlinn_fmi.factory import inspect
    from exlinn_fmi.scenario.schema import FmuComponent

    def look(spec, folder):
        return variables if isinstance(spec, FmuComponent) else inspect(spec, folder)

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "Übung 1.fmu").write_bytes(b"")
        file = Path(folder) / "draft.yaml"
        file.write_text(text, "utf-8")
        load_scenario(file, (), look)


@given(
    cells=st.lists(
        TEXT.filter(lambda t: not any(c in t for c in ',;|\t"')), min_size=2, max_size=6, unique=True
    )
)
@settings(max_examples=100, deadline=None)
def test_a_draft_of_a_table_is_yaml_and_says_what_is_left_to_do(cells: list[str]) -> None:
    text = data_draft(["a b.csv"], dict.fromkeys(cells, ""), "out.yaml")
    document = parse(text)
    assert document.problems == ()
    assert document.data["learn"]["data"]["files"] == ["a b.csv"]


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("head", "units"),
    [
        ("t [ms];phi (deg);u[V]", {"t [ms]": "ms", "phi (deg)": "deg", "u[V]": "V"}),
        ("time,n_rpm,s,x[1]", {"time": "", "n_rpm": "rpm", "s": "", "x[1]": ""}),
        ("time,phi,i\ns,deg,mA", {"time": "s", "phi": "deg", "i": "mA"}),
    ],
)
def test_units_of_columns_are_read(tmp_path: Path, head: str, units: dict[str, str]) -> None:
    mark = ";" if ";" in head else ","
    row = mark.join("1" for _ in units)
    (tmp_path / "d.csv").write_text(f"{head}\n{row}\n{row}\n")
    assert columns_with_units(tmp_path / "d.csv") == units


def test_todo_is_reported_with_what_is_wanted_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "d.csv").write_text("a,b\n1,2\n2,3\n")
    file = tmp_path / "d.yaml"
    file.write_text(data_draft(["d.csv"], {"a": "", "b": ""}, "d.yaml"))
    with pytest.raises(ScenarioError) as caught:
        load_scenario(file)
    assert "coordinates[0].unit: still TODO: unit of q, e.g. rad" in str(caught.value)
    assert all("still TODO" in p.message and p.line for p in caught.value.problems)


def test_a_name_is_made_of_any_file_name() -> None:
    assert [scenario_name(Path(n)) for n in ("Prüfstand 3.fmu", "плант.fmu", "a.b-c.csv")] == [
        "Prufstand_3",
        "mine",
        "a.b-c",
    ]


def test_the_run_is_that_of_the_fmu_where_it_makes_sense() -> None:
    assert span(DefaultExperiment(0.0, 2.0, 0.01)) == (2.0, 0.01)
    assert span(DefaultExperiment(0.0, 2.0, 2.0)) == (2.0, 0.002)
    assert span(DefaultExperiment(5.0)) == (15.0, 0.01)

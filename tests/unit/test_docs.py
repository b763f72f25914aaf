"""What the documentation says holds: scenarios are valid, code is where it is said to be, links lead on."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from exlinn_fmi.factory import inspect
from exlinn_fmi.scenario.load import load_scenario

ROOT = Path(__file__).parents[2]
GUIDE, THEORY, README = (ROOT / name for name in ("docs/guide.md", "docs/theory.md", "README.md"))


def blocks(file: Path, language: str) -> list[str]:
    """Fenced code of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", file.read_text("utf-8"), re.DOTALL | re.MULTILINE)


SCENARIOS = [text for text in blocks(GUIDE, "yaml") if re.search(r"^name: ", text, re.MULTILINE)]


@pytest.mark.parametrize("text", SCENARIOS, ids=lambda text: re.search(r"^name: (\w+)", text, re.M)[1])
def test_every_whole_scenario_of_the_guide_is_valid(text: str, tmp_path: Path) -> None:
    (tmp_path / "fmus").symlink_to(ROOT / "fmus")
    file = tmp_path / "scenarios" / "scenario.yaml"
    file.parent.mkdir()
    file.write_text(text, "utf-8")
    assert load_scenario(file, (), inspect).scenario.name


def test_the_guide_has_whole_scenarios() -> None:
    assert len(SCENARIOS) >= 3


def test_the_controller_of_the_guide_fits_its_learned_model(tmp_path: Path) -> None:
    (learned,) = [text for text in SCENARIOS if "name: learned_motor" in text]
    (control,) = [text for text in blocks(GUIDE, "yaml") if "nmpc:" in text]
    (tmp_path / "fmus").symlink_to(ROOT / "fmus")
    file = tmp_path / "scenarios" / "scenario.yaml"
    file.parent.mkdir()
    learned = re.sub(r"^components:\n(  .*\n)+", "", learned, flags=re.MULTILINE)
    file.write_text(f"{learned}\n{control}", "utf-8")
    assert load_scenario(file, (), inspect).scenario.metrics.output == "plant.x"


def test_the_component_of_the_guide_works_in_its_scenario(tmp_path: Path) -> None:
    (code,) = [text for text in blocks(GUIDE, "python") if "PythonComponent" in text]
    (part,) = [text for text in blocks(GUIDE, "yaml") if "filters:Lag" in text]
    (tmp_path / "filters.py").write_text(code, "utf-8")
    file = tmp_path / "scenario.yaml"
    file.write_text(f"name: filtered\ncomponents:\n{part}simulate: {{stop: 1.0}}\n", "utf-8")
    scenario = load_scenario(file, (), inspect).scenario
    from exlinn_fmi.factory import build

    lag = build("filter", scenario, tmp_path, tmp_path)
    lag.enter_initialization(0.0, 1.0, scenario.components["filter"].start)
    lag.exit_initialization()
    lag.set(lag.indices("input"), np.array([3.0]))
    lag.step(0.0, 0.2)
    value = np.zeros(1)
    lag.get(lag.indices("output"), value)
    assert value[0] == pytest.approx(6 * (1 - np.exp(-1)))


def test_every_file_and_name_of_the_theory_page_is_there() -> None:
    rows = re.findall(r"`(exlinn_fmi/[\w/]+\.py)`: ((?:`[\w.]+`(?:, )?)+)", THEORY.read_text("utf-8"))
    assert len(rows) >= 15
    for file, names in rows:
        module = importlib.import_module(file.removesuffix(".py").replace("/", "."))
        for name in re.findall(r"`([\w.]+)`", names):
            at: object = module
            for part in name.split("."):
                at = getattr(at, part)


@pytest.mark.parametrize("file", [GUIDE, THEORY, README], ids=lambda file: file.name)
def test_links_lead_somewhere(file: Path) -> None:
    def anchors(target: Path) -> set[str]:
        titles = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
        return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}

    for link in re.findall(r"\]\(([^)]+)\)", file.read_text("utf-8")):
        path, _, anchor = link.partition("#")
        if path.startswith("http"):
            continue
        target = file.parent / path if path else file
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("file", [GUIDE, README], ids=lambda file: file.name)
def test_commands_are_those_of_the_command_line(file: Path) -> None:
    from exlinn_fmi.cli import app

    known = {c.name or c.callback.__name__ for c in app.registered_commands if c.callback} | {"export"}
    named = set(re.findall(r"(?:^|`|/)exlinn (\w+)", file.read_text("utf-8"), re.MULTILINE))
    assert named >= {"run", "info", "simulate"}
    assert named <= known
    if file == GUIDE:
        assert named == known


def test_scenarios_that_are_named_are_there() -> None:
    for file in (GUIDE, THEORY, README):
        for name in re.findall(r"scenarios/[\w.]+\.(?:yaml|py)", file.read_text("utf-8")):
            assert (ROOT / name).exists(), name

"""FMUs that do harm, through the command line: exit code, error text, the rows so far, nothing left over."""

from __future__ import annotations

import os
from pathlib import Path

import pandas as pd
import pytest
from fmu_helpers import description_2, probe

from exlinn_fmi import cli
from exlinn_fmi.factory import is_isolated
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.load import load_scenario
from exlinn_fmi.scenario.schema import FmuComponent, Scenario

SCENARIO = """\
name: harm
components:
  source: {{source: {{signal: ramp, slope: 1, unit: m/s}}}}
  good: {{fmu: good/Probe.fmu}}
  bad: {{fmu: bad/Probe.fmu, isolate: true, timeout: 0.7}}
connections: {{source.y: [good.u, bad.u]}}
simulate: {{stop: 2.0, step: 0.1, algorithm: {algorithm}}}
"""


def scenario(folder: Path, *defines: str, algorithm: str = "jacobi") -> Path:
    for name, harm in (("good", ()), ("bad", defines)):
        (folder / name).mkdir()
        probe(folder / name, *harm)
    file = folder / "harm.yaml"
    file.write_text(SCENARIO.format(algorithm=algorithm))
    return file


def simulate(file: Path, *options: str) -> int:
    return cli.exit_code(["simulate", str(file), "--out", str(file.parent / "run"), *options])


def rows(file: Path) -> pd.DataFrame:
    return pd.read_csv(file.parent / "run" / "trajectories.csv")


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize(
    ("harm", "words"),
    [
        ("abort()", "its process was ended by SIGABRT, Aborted,"),
        ("exit(0)", "its process ended with exit code 0"),
        ("for (;;)", "no answer within 0.7 s, so its process was ended,"),
    ],
)
def test_harm_ends_the_run_with_the_rows_so_far(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], harm: str, words: str, algorithm: str
) -> None:
    file = scenario(tmp_path, f"HARM={harm}", "HARM_IN=STEP", algorithm=algorithm)
    assert simulate(file) == 2
    assert f"error: bad at t = 0.4 s: {words} in the step" in capsys.readouterr().err
    table = rows(file)
    assert table["time"].tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert (table["good.x"] == table["bad.x"]).all()


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
def test_an_isolated_fmu_gives_the_same_file_as_one_that_is_not(tmp_path: Path, algorithm: str) -> None:
    file = scenario(tmp_path, algorithm=algorithm)
    texts = []
    for isolate in ("true", "false"):
        assert simulate(file, "--set", f"components.bad.isolate={isolate}") == 0
        texts.append((tmp_path / "run" / "trajectories.csv").read_bytes())
    assert texts[0] == texts[1]
    table = rows(file)
    assert (table["good.x"] == table["bad.x"]).all()
    assert table["bad.x"].iloc[-1] == pytest.approx(0.01 * sum(range(20)))


def test_fmus_of_other_folders_are_isolated_unless_they_are_trusted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = scenario(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    probe(tmp_path / "elsewhere")
    inner = tmp_path / "inner"
    inner.mkdir()
    file = inner / "s.yaml"
    text = (
        "name: s\ncomponents:\n  far: {fmu: ../elsewhere/Probe.fmu}\n  near: {fmu: Probe.fmu}\n"
        "simulate: {stop: 1, step: 0.1}\n"
    )
    probe(inner)
    file.write_text(text)
    assert cli.exit_code(["info", str(file)]) == 0
    assert "isolated, in processes of their own: far\n" in capsys.readouterr().out
    file.write_text(text + "trust: [../elsewhere]\n")
    assert cli.exit_code(["info", str(file)]) == 0
    assert "isolated" not in capsys.readouterr().out
    file.write_text(text + "trust: [../nowhere]\n")
    assert cli.exit_code(["validate", str(file)]) == 1
    assert "s.yaml:6: trust[0]: there is no folder '../nowhere'" in capsys.readouterr().err


def test_a_link_into_the_folder_does_not_make_an_fmu_trusted(tmp_path: Path) -> None:
    file = scenario(tmp_path)
    outside = tmp_path.parent / f"{tmp_path.name}-outside"
    outside.mkdir()
    probe(outside)
    (tmp_path / "link.fmu").symlink_to(outside / "Probe.fmu")
    loaded = load_scenario(file)
    assert loaded.scenario.trusts(tmp_path / "good" / "Probe.fmu", tmp_path)
    assert not loaded.scenario.trusts(tmp_path / "link.fmu", tmp_path)


def test_shipped_scenarios_trust_the_shipped_fmus(root: Path) -> None:
    for file in (root / "scenarios").glob("*.yaml"):
        scenario = Scenario.model_validate(parse(file.read_text()).data)
        for spec in scenario.components.values():
            if isinstance(spec, FmuComponent):
                assert not is_isolated(spec, scenario, file.parent), file


def test_an_fmu_that_crashes_while_it_is_loaded_fails_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = scenario(tmp_path, "HARM=abort()", "HARM_IN=INSTANTIATE")
    assert simulate(file) == 2
    assert (
        "error: bad: its process was ended by SIGABRT, Aborted, in instantiation" in capsys.readouterr().err
    )


def test_an_isolated_fmu_may_be_had_twice_where_its_binary_may_not(tmp_path: Path) -> None:
    (tmp_path / "once").mkdir()
    probe(tmp_path / "once", description=description_2(once="true"))
    file = tmp_path / "once.yaml"
    file.write_text(
        "name: once\ncomponents:\n  a: {fmu: once/Probe.fmu, isolate: true}\n"
        "  b: {fmu: once/Probe.fmu, isolate: true}\nsimulate: {stop: 1, step: 0.1}\n"
    )
    assert simulate(file) == 0
    assert not list(Path(os.environ["EXLINN_CACHE"]).glob("new-*"))

"""Events in a scenario, from the file to trajectories and figures."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from fmu_helpers import probe

from exlinn_fmi import cli
from exlinn_fmi.results.charts import charts
from exlinn_fmi.results.interactive import plotly_figure
from exlinn_fmi.results.tables import read_run

SCENARIO = """\
name: faults
seed: 4
components:
  source: {source: {signal: constant, value: 1, unit: m/s}}
  fmu: {fmu: Probe.fmu, start: {gain: 0}%s}
connections: {source.y: fmu.u}
simulate: {stop: 2, step: 0.1%s}
events:
  - {name: kick, on: fmu.u, at: 0.5, until: 1.0, add: 2}
  - {on: fmu.trim, at: 1.2, set: 5}
  - {on: fmu.x, at: 1.5, noise: 0.1}
  - {name: stuck, on: source.y, when: {variable: fmu.x, above: 1.75}, hold: true}
"""


def simulate(folder: Path, extra: str = "", more: str = "") -> pd.DataFrame:
    probe(folder)
    file = folder / "faults.yaml"
    file.write_text(SCENARIO % (extra, more))
    assert cli.exit_code(["run", str(file), "--out", str(folder / "run")]) == 0
    return pd.read_csv(folder / "run" / "trajectories.csv")


@pytest.mark.parametrize("algorithm", ["jacobi", "gauss-seidel"])
@pytest.mark.parametrize("isolate", ["true", "false"])
def test_events_act_on_an_fmu_and_are_recorded(tmp_path: Path, algorithm: str, isolate: str) -> None:
    table = simulate(tmp_path, f", isolate: {isolate}", f", algorithm: {algorithm}")
    assert table["fmu.u"].tolist() == [1.0] * 5 + [3.0] * 5 + [1.0] * 11
    x = [0.0]
    for u in table["fmu.u"]:
        x.append(x[-1] + 0.1 * u)
    assert table["fmu.x"][:15].tolist() == pytest.approx(x[:15])
    assert table["fmu.y"].tolist() == pytest.approx([x[k] + 5 * (k >= 12) for k in range(21)])
    noise = table["fmu.x"][15:] - x[15:21]
    assert 0 < noise.abs().min() < noise.abs().max() < 0.5
    assert table["events.kick"].tolist() == [0] * 5 + [1] * 5 + [0] * 11
    assert table["events.stuck"].tolist() == [0] * 11 + [1] * 10  # x is 1.7 at t = 0.9 and 2.0 at t = 1


def test_figures_shade_the_time_of_events(tmp_path: Path) -> None:
    simulate(tmp_path)
    (chart,) = charts(read_run(tmp_path / "run"))
    assert chart.spans[0] == ("kick", pytest.approx(0.5), pytest.approx(1.0))
    assert chart.note.startswith("Shaded: kick 0.5–1 s; ")
    assert not any(line.label.startswith("events") for panel in chart.panels for line in panel.lines)
    shapes = plotly_figure(chart)["layout"]["shapes"]
    assert len(shapes) == len(chart.spans) * len(chart.panels)
    assert {"name": "kick", "x0": chart.spans[0][1], "yref": "y domain"}.items() <= shapes[0].items()


def test_events_are_listed_by_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate(tmp_path)
    capsys.readouterr()
    assert cli.exit_code(["info", str(tmp_path / "faults.yaml")]) == 0
    text = capsys.readouterr().out
    assert "  kick          add 2 on fmu.u from t = 0.5 s until t = 1 s\n" in text
    assert "hold source.y when fmu.x > 1.75" in text


def test_the_same_seed_gives_the_same_file(tmp_path: Path) -> None:
    first = simulate(tmp_path)
    file = tmp_path / "faults.yaml"
    frames = {}
    for seed in (4, 5):
        out = tmp_path / f"run{seed}"
        assert cli.exit_code(["simulate", str(file), "--out", str(out), "--set", f"seed={seed}"]) == 0
        frames[seed] = pd.read_csv(out / "trajectories.csv")
    pd.testing.assert_frame_equal(first, frames[4])
    assert not frames[4]["fmu.x"].equals(frames[5]["fmu.x"])

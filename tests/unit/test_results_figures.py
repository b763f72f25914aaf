"""Pictures of a run: which ones, how large, and that they are the same every time."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from results_helpers import make_run, trajectories, write_learning, write_trajectories

from exlinn_fmi.data.tables import write_table
from exlinn_fmi.results import figures
from exlinn_fmi.results.charts import charts
from exlinn_fmi.results.figures import draw, write_figures
from exlinn_fmi.results.panels import Chart, Line, Panel
from exlinn_fmi.results.tables import read_run


def text_of(svg: bytes) -> str:
    """Comments of an SVG, which hold the text that its glyphs spell."""
    return "\n".join(re.findall(r"<!-- (.*?) -->", svg.decode("utf-8"), re.DOTALL))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_run(tmp_path_factory.mktemp("whole"), control=True, learn=True)
    write_learning(folder)
    write_trajectories(folder)
    return folder


@pytest.fixture(scope="module")
def written(whole: Path) -> list[Path]:
    return write_figures(whole)


def test_every_chart_becomes_png_and_svg(whole: Path, written: list[Path]) -> None:
    files = written
    names = ("fig3_learning", "training", "fig4_control")
    assert [f.name for f in files] == [f"{name}.{suffix}" for name in names for suffix in ("png", "svg")]
    assert all(f.parent == whole / "figures" for f in files)
    assert all(f.read_bytes().startswith(b"\x89PNG") for f in files if f.suffix == ".png")


def test_figures_stay_small(written: list[Path]) -> None:
    assert all(f.stat().st_size < 500_000 for f in written)


def test_noise_of_many_samples_stays_small(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    noise = np.random.default_rng(0).normal(size=(200_000, 24))
    frame = pd.DataFrame(noise, columns=[f"c.v{k}" for k in range(24)])
    frame.insert(0, "time", 1e-3 * np.arange(200_000))
    write_table(folder / "trajectories", frame, {})
    assert all(len(content) < 500_000 for content in draw(charts(read_run(folder))[0], "noise").values())


def test_the_same_run_gives_the_same_bytes(whole: Path) -> None:
    chart = charts(read_run(whole))[1]
    assert draw(chart, "demo") == draw(chart, "demo")


def test_drawing_leaves_no_trace_in_matplotlib(whole: Path) -> None:
    before = dict(mpl.rcParams)
    draw(charts(read_run(whole))[1], "demo")
    assert dict(mpl.rcParams) == before


def test_axes_carry_names_units_and_bounds(whole: Path) -> None:
    svg = text_of(draw(charts(read_run(whole))[-1], "demo")["svg"])
    for text in ("x [m]", "alpha [rad]", "error [µm]", "v [V]   bounds −24 … 24 V", "time [s]", "reference"):
        assert text in svg


def test_text_of_the_user_is_drawn_as_it_is() -> None:
    line = Line("$_a$", np.arange(3.0), np.arange(3.0), "other")
    chart = Chart("c", "Recorded", (Panel("", "$x", (line,)),), note="not $shown$: _b")
    svg = text_of(draw(chart, "$name")["svg"])
    assert "$name: recorded" in svg.replace("\\", "")
    assert "$_a$" in svg.replace("\\", "")


def test_long_names_are_cut_in_the_middle() -> None:
    name = "component." + "very_long_name_" * 6 + "end"
    line = Line(name, np.arange(3.0), np.arange(3.0), "other")
    svg = text_of(draw(Chart("c", "Recorded", (Panel("", "m", (line, line)),)), "demo")["svg"])
    assert "component.very_long_name_…" in svg
    assert name not in svg


@pytest.mark.parametrize("rows", [1, 2, 15, 700])
def test_runs_cut_short_can_be_drawn(rows: int, tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    write_trajectories(folder, trajectories().head(rows))
    assert len(write_figures(folder)) == 2


def test_a_diverged_model_can_be_drawn(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    write_learning(folder, diverges=True)
    assert "learned out of sight from 0.801 s" in text_of((write_figures(folder)[1]).read_bytes())


def test_columns_without_a_number_can_be_drawn(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    frame = pd.DataFrame(
        {"time": [0.0, 1.0], "c.a": [np.nan, np.nan], "c.b": [np.inf, 1.0], "c.c": [True, False]}
    )
    write_table(folder / "trajectories", frame, {})
    assert [f.name for f in write_figures(folder)] == ["trajectories.png", "trajectories.svg"]


def test_a_run_without_data_has_no_figures(tmp_path: Path) -> None:
    assert write_figures(make_run(tmp_path, learn=True)) == []
    assert not (tmp_path / "figures").exists()


def test_no_axes_or_labels_overlap(whole: Path) -> None:
    for chart in charts(read_run(whole)):
        with mpl.rc_context(figures.STYLE):
            figure = figures._figure(chart, "demo")
            figure.draw_without_rendering()
            boxes = [axes.get_tightbbox() for axes in figure.axes]
            canvas = figure.bbox
            for k, box in enumerate(boxes):
                assert box is not None
                assert box.x0 >= canvas.x0 - 1
                assert box.x1 <= canvas.x1 + 1
                for other in boxes[:k]:
                    assert other is not None
                    width = min(box.x1, other.x1) - max(box.x0, other.x0)
                    height = min(box.y1, other.y1) - max(box.y0, other.y0)
                    assert width < 2 or height < 2, chart.name

"""The report: complete, self-contained, and safe whatever the user's texts are."""

from __future__ import annotations

import base64
import json
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from results_helpers import (
    PROVENANCE,
    UNITS,
    make_run,
    scenario_text,
    trajectories,
    write_learning,
    write_trajectories,
)

from exlinn_fmi.data.files import read_json, write_json
from exlinn_fmi.data.tables import write_table
from exlinn_fmi.results.interactive import packed
from exlinn_fmi.results.metrics import control_metrics
from exlinn_fmi.results.report import write_report
from exlinn_fmi.results.tables import read_run
from exlinn_fmi.results.typography import number
from exlinn_fmi.results.wording import describe, headlines

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(1)>&$body"


class Page(HTMLParser):
    """A report taken apart."""

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.ids: list[str] = []
        self.text = ""
        self._script = False
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._script = tag in ("script", "style")
        if identity := dict(attrs).get("id"):
            self.ids.append(identity)

    def handle_endtag(self, tag: str) -> None:
        self._script = False

    def handle_data(self, data: str) -> None:
        if not self._script:
            self.text += data


def page(folder: Path) -> Page:
    return Page(write_report(folder).read_text("utf-8"))


def chart_data(folder: Path) -> dict[str, Any]:
    text = write_report(folder).read_text("utf-8")
    (found,) = re.findall(r"^const charts = (.*);$", text, re.MULTILINE)
    content: dict[str, Any] = json.loads(found)
    return content


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_run(tmp_path_factory.mktemp("whole"), control=True, learn=True)
    write_learning(folder)
    frame = write_trajectories(folder)
    metrics = read_json(folder / "metrics.json")
    write_json(folder / "metrics.json", metrics | control_metrics(frame, read_run(folder).scenario, UNITS))
    return folder


@pytest.fixture(scope="module")
def whole_page(whole: Path) -> Page:
    return page(whole)


# ── one file, no network ─────────────────────────────────────────────────────────────────────────────────


def test_nothing_is_loaded_from_anywhere(whole_page: Page) -> None:
    for tag, attributes in whole_page.tags:
        assert tag not in ("link", "iframe", "object", "embed", "img", "base")
        assert "src" not in attributes
        assert not str(attributes.get("href", "#")).startswith(("http", "//", "file"))


def test_the_browser_is_told_to_load_nothing(whole_page: Page) -> None:
    (policy,) = [a["content"] for t, a in whole_page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy is not None
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy


def test_style_loads_nothing(whole: Path) -> None:
    text = write_report(whole).read_text("utf-8")
    (style,) = re.findall(r"<style>(.*?)</style>", text.split("<script>")[0], re.DOTALL)
    assert "url(" not in style
    assert "@import" not in style


def test_the_report_is_below_ten_megabytes(whole: Path) -> None:
    assert write_report(whole).stat().st_size < 10_000_000


def test_every_link_has_its_anchor(whole_page: Page) -> None:
    links = [str(a["href"]).removeprefix("#") for t, a in whole_page.tags if t == "a"]
    assert links == ["learning", "control", "metrics", "run", "provenance", "scenario"]
    assert set(links) <= set(whole_page.ids)


# ── what it shows ────────────────────────────────────────────────────────────────────────────────────────


def test_every_chart_has_its_place(whole: Path, whole_page: Page) -> None:
    data = chart_data(whole)
    assert list(data) == ["chart-fig3_learning", "chart-training", "chart-fig4_control"]
    assert set(data) <= set(whole_page.ids)


def test_zoom_in_time_is_linked_over_a_chart(whole: Path) -> None:
    layout = chart_data(whole)["chart-fig4_control"]["layout"]
    axes = [layout[key] for key in layout if key.startswith("xaxis")]
    assert len(axes) == 9  # seven panels and two strips
    assert all(axis.get("matches") == "x" for axis in axes[1:])
    assert all(axis["range"] == [0, 10] for axis in axes)


def test_lines_of_the_report_are_those_of_the_files(whole: Path) -> None:
    traces = chart_data(whole)["chart-fig3_learning"]["data"]
    frame = read_run(whole).evaluation.frame  # type: ignore[union-attr]
    measured = np.frombuffer(base64.b64decode(traces[0]["y"]["bdata"]), "<f4")
    assert traces[0]["y"]["dtype"] == "f4"
    assert np.allclose(measured, frame["alpha_dot"], rtol=1e-6, atol=1e-6)


def test_metrics_stand_in_plain_words_with_units(whole_page: Page) -> None:
    for text in (
        "Tracking error of plant.x, root mean square10 µmcontrol.rmse_x_m",
        "Largest relative error of an identified parameter5.00 × 10⁻⁵identify.max_rel_error",
        "Input plant.v, root mean square5.82 Vcontrol.input_rms",
        "Time of a solve, median1.51 ms",
        "Recorded values outside their bounds0control.violations",
    ):
        assert text in whole_page.text


def test_parameters_stand_beside_their_true_values(whole_page: Page) -> None:
    assert "parameteridentifiedtruerelative error" in whole_page.text
    assert "m_c*d^20.04000040.041.0 × 10⁻⁵" in whole_page.text


def test_parameters_are_not_listed_twice(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    write_learning(folder)
    more = {"identify.m_c*d^2": 0.04, "identify.m_c*d^2_rel_error": 1e-5, "identify.other_rel_error": 0.5}
    write_json(folder / "metrics.json", read_json(folder / "metrics.json") | more)
    text = page(folder).text
    assert "identify.m_c*d^2" not in text
    assert "Relative error of other0.5identify.other_rel_error" in text


def test_stages_tell_whether_they_ran(whole_page: Page) -> None:
    assert "collectunchanged, taken from the cache0.01 s" in whole_page.text
    assert "simulateran41.5 s" in whole_page.text


def test_provenance_names_versions_files_and_command(whole_page: Page) -> None:
    for text in ("exlinn run scenarios/demo.yaml", "DCMotorCart.fmu" + "cd" * 32, "casadi3.7.0", "3.11.2"):
        assert text in whole_page.text


def test_the_scenario_is_shown_as_it_is(whole_page: Page) -> None:
    assert scenario_text(control=True, learn=True) in whole_page.text


@pytest.mark.parametrize("parts", [{"learn": True}, {"control": True}, {"simulate": True}])
def test_sections_without_content_are_left_out(parts: dict[str, bool], tmp_path: Path) -> None:
    folder = make_run(tmp_path, **parts)
    if "learn" in parts:
        write_learning(folder)
    else:
        write_trajectories(folder, trajectories(stop=1))
    ids = page(folder).ids
    assert ("learning" in ids) == ("learn" in parts)
    assert ("control" in ids) == ("control" in parts)
    assert ("trajectories" in ids) == ("simulate" in parts)


def test_a_folder_with_nothing_but_a_scenario_has_a_report(tmp_path: Path) -> None:
    make_run(tmp_path, learn=True)
    (tmp_path / "provenance.json").unlink()
    assert [i for i in page(tmp_path).ids if not i.startswith("chart")] == ["scenario"]


def test_a_failed_run_says_so_first(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    write_trajectories(folder, trajectories().head(500))
    failed = {"simulate": {"status": "failed", "seconds": None}}
    record = PROVENANCE | {"stages": failed, "error": "plant.i at t = 0.5 s: NaN", "warnings": ["slow <FMU>"]}
    write_json(folder / "provenance.json", record)
    text = page(folder).text
    assert "The run failed. plant.i at t = 0.5 s: NaN" in text
    assert "Warning: slow <FMU>" in text
    assert text.index("The run failed.") < text.index("Closed loop")


def test_a_free_run_that_diverged_says_so(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    write_learning(folder, diverges=True)
    text = page(folder).text
    assert "error relative to the signaldivergedlearn.rollout_nrmse_10s" in text
    assert "divergedFree run over 10 s" in text


def test_what_could_not_be_judged_is_a_dash_and_no_headline(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    write_json(folder / "metrics.json", {"learn.force_mse_test": 1e-3, "identify.max_rel_error": None})
    text = page(folder).text
    assert "of an identified parameter–identify.max_rel_error" in text
    assert "–Largest relative error" not in text


def test_parameters_without_true_value_show_a_dash(tmp_path: Path) -> None:
    folder = make_run(tmp_path, learn=True)
    (folder / "parameters.csv").write_text("name,identified,true,rel_error\nj_m,0.1,,\n")
    assert "j_m0.1––" in page(folder).text


# ── hostile text ─────────────────────────────────────────────────────────────────────────────────────────


def test_text_of_the_user_never_becomes_markup(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True, description=HOSTILE)
    frame = trajectories(stop=0.1).rename(columns={"plant.x": f"plant.{HOSTILE}"})
    write_trajectories(folder, frame)
    write_json(folder / "metrics.json", {f"learn.{HOSTILE}": 1.0, HOSTILE: 2.0})
    bad = {
        "stages": {HOSTILE: HOSTILE},
        "files": {HOSTILE: HOSTILE},
        "packages": {HOSTILE: HOSTILE},
        "error": HOSTILE,
        "warnings": [HOSTILE],
        "command": [HOSTILE],
    }
    write_json(folder / "provenance.json", PROVENANCE | bad)
    (folder / "parameters.csv").write_text(f'name,identified,true,rel_error\n"{HOSTILE}",1,1,0\n')
    report = page(folder)
    assert [tag for tag, _ in report.tags].count("script") == 2
    assert "img" not in [tag for tag, _ in report.tags]
    assert not any(name.startswith("on") for _, attributes in report.tags for name in attributes)
    assert report.text.count(HOSTILE) >= 11


def test_names_in_charts_are_escaped_for_plotly(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    write_trajectories(folder, trajectories(stop=0.1).rename(columns={"plant.x": "plant.<b>x"}))
    names = [trace["name"] for trace in chart_data(folder)["chart-trajectories"]["data"]]
    assert "plant.&lt;b&gt;x" in names
    assert "plant.<b>x" in map(unescape, names)


def test_lines_of_an_overview_are_named_in_their_colours_above_their_panel(tmp_path: Path) -> None:
    folder = make_run(tmp_path, simulate=True)
    names = [f"plant.a_rather_long_name_of_a_variable_number_{k}" for k in range(3)]
    write_table(
        folder / "trajectories", pd.DataFrame(np.eye(3), columns=names).assign(time=[0.0, 1.0, 2.0]), {}
    )
    figure = chart_data(folder)["chart-trajectories"]
    (label,) = [a["text"] for a in figure["layout"]["annotations"]]
    for name, trace in zip(names, figure["data"], strict=True):
        assert f'<span style="color:{trace["line"]["color"]}">{name}</span>' in label
    assert label.count("<br>") == 2
    assert not any(trace["showlegend"] for trace in figure["data"])


def test_what_all_panels_have_in_common_is_named_once(whole: Path) -> None:
    traces = chart_data(whole)["chart-fig3_learning"]["data"]
    assert [t["name"] for t in traces if t["showlegend"]] == ["measured", "learned"]
    assert {t["legendgroup"] for t in traces if t["name"] == "learned"} == {"model"}


def test_logarithmic_axes_have_few_labels(whole: Path) -> None:
    axis = chart_data(whole)["chart-training"]["layout"]["yaxis"]
    assert axis["type"] == "log"
    assert axis["dtick"] == 2


# ── words and numbers ────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("x", "digits", "expected"),
    [
        (0.0, 3, "0"),
        (12.0, 3, "12"),
        (-3.0, 3, "−3"),
        (0.00172, 3, "0.00172"),
        (5.82291, 3, "5.82"),
        (12345.6, 3, "12346"),
        (-2.4e-5, 3, "−2.40 × 10⁻⁵"),
        (1.5e9, 3, "1.50 × 10⁹"),
        (0.0400004, 7, "0.0400004"),
        (float("nan"), 3, "–"),
        (float("inf"), 3, "inf"),
    ],
)
def test_numbers_are_written_to_be_read(x: float, digits: int, expected: str) -> None:
    assert number(x, digits) == expected


def test_unknown_metrics_are_named_after_their_key(whole: Path) -> None:
    run = read_run(whole)
    assert describe(run, "control.settling_time") == ("Settling time", "")
    assert describe(run, "odd") == ("Odd", "")


def test_metrics_of_several_controllers_name_theirs(tmp_path: Path) -> None:
    folder = make_run(tmp_path, control=True)
    file = folder / "scenario.yaml"
    text = file.read_text()
    start, end = text.index("  controller:\n"), text.index("connections:")
    file.write_text(text[:end] + text[start:end].replace("controller:", "second:") + text[end:])
    write_trajectories(folder, trajectories(stop=0.1))
    run = read_run(folder)
    found = describe(run, "control.controller.rmse_x_m")
    assert found == ("Tracking error of plant.x, root mean square (controller)", "m")
    assert describe(run, "control.second.violations") == ("Recorded values outside their bounds (second)", "")


def test_headlines_come_in_order_of_interest() -> None:
    keys = ["control.solve_ms_median", "control.rmse_x_m", "control.cost_mean", "learn.force_mse_test"]
    assert headlines(keys) == ["learn.force_mse_test", "control.rmse_x_m", "control.solve_ms_median"]


def test_arrays_travel_in_little_endian() -> None:
    content = packed(np.array([1.5, np.nan, 1e300]), "f4")
    values = np.frombuffer(base64.b64decode(content["bdata"]), "<f4")
    assert content["dtype"] == "f4"
    assert np.array_equal(values, np.array([1.5, np.nan, np.inf], dtype="<f4"), equal_nan=True)

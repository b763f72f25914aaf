"""The report of a run: one HTML file that holds everything it needs and asks the network for nothing."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from exlinn_fmi.data.files import write_text
from exlinn_fmi.results.charts import charts
from exlinn_fmi.results.interactive import plotly_figure
from exlinn_fmi.results.panels import Chart
from exlinn_fmi.results.tables import RunFiles, read_run
from exlinn_fmi.results.typography import number
from exlinn_fmi.results.wording import GROUPS, NO_VALUE, describe, headlines, value

if TYPE_CHECKING:
    import pandas as pd

TEMPLATE = Path(__file__).with_name("page.html")
SECTION_OF = {
    "fig3_learning": "learning",
    "training": "learning",
    "curves": "learning",
    "trajectories": "trajectories",
    "study_runs": "study",
    "study_causes": "study",
}
"""Which section a chart belongs to, curves of all variables alike; those of controllers to `control`."""
WORST = 5
"""How many of the worst runs of a study are listed."""


def write_report(folder: Path) -> Path:
    """Write ``report.html`` into a run folder, from its files alone.

    Args:
        folder: the run folder.

    Returns:
        The file written.

    Raises:
        DataError: it is no run folder, or one of its files cannot be read.
        StorageError: the report could not be written.
    """
    run = read_run(folder)
    file = folder / "report.html"
    write_text(file, render(run))
    return file


def render(run: RunFiles) -> str:
    """The report as HTML; every text that comes from the user is escaped."""
    from plotly.offline import get_plotlyjs

    drawn = charts(run)
    sections = {
        "learning": ("Learning", _parameters(run.parameters) + _charts(drawn, "learning")),
        "control": ("Closed loop", _charts(drawn, "control")),
        "study": ("Robustness", _charts(drawn, "study") + _worst(run)),
        "trajectories": ("Trajectories", _charts(drawn, "trajectories")),
        "metrics": ("Metrics", _metrics(run)),
        "run": ("Run", _stages(run.provenance)),
        "provenance": ("Provenance", _provenance(run.provenance)),
        "scenario": ("Scenario", f"<pre>{escape(run.scenario_text)}</pre>"),
    }
    filled = {name: section for name, section in sections.items() if section[1]}
    links = "".join(f'<a href="#{name}">{title}</a>' for name, (title, _) in filled.items())
    body = [
        _head(run),
        _problems(run.provenance),
        _cards(run),
        f"<nav>{links}</nav>",
        *(f'<section id="{name}"><h2>{title}</h2>{html}</section>' for name, (title, html) in filled.items()),
    ]
    return Template(TEMPLATE.read_text("utf-8")).substitute(
        title=escape(f"{run.scenario.name} — exlinn report"),
        body="\n".join(body),
        plotly=get_plotlyjs().replace("</script", r"<\/script"),
        charts=_script_json({_chart_id(chart): plotly_figure(chart) for chart in drawn}),
    )


# ── sections ─────────────────────────────────────────────────────────────────────────────────────────────


def _head(run: RunFiles) -> str:
    """Name, description, and when and with what it was run."""
    facts = [
        str(run.provenance.get("date", "")).replace("T", " ").replace("+00:00", " UTC"),
        f"exlinn {run.provenance['exlinn']}" if run.provenance.get("exlinn") else "",
        f"seed {run.scenario.seed}",
    ]
    return (
        f"<h1>{escape(run.scenario.name)}</h1><p>{escape(run.scenario.description)}</p>"
        f'<p class="faint">{" · ".join(escape(fact) for fact in facts if fact)}</p>'
    )


def _problems(provenance: Mapping[str, Any]) -> str:
    """What stopped the run, and what it warned of."""
    error = provenance.get("error")
    boxes = [f'<div class="problem"><b>The run failed.</b> {escape(str(error))}</div>'] if error else []
    boxes += [
        f'<div class="problem">Warning: {escape(str(warning))}</div>'
        for warning in provenance.get("warnings") or ()
    ]
    return "".join(boxes)


def _cards(run: RunFiles) -> str:
    """The few numbers that a reader wants first."""
    cards = [
        f'<div class="card"><b>{shown}</b><span>{escape(describe(run, key)[0])}</span></div>'
        for key in headlines(run.metrics)
        if (shown := value(run, key)) != NO_VALUE
    ]
    return f'<div class="cards">{"".join(cards)}</div>' if cards else ""


def _metrics(run: RunFiles) -> str:
    """All metrics by group, in plain words beside their keys."""
    html: list[tuple[str, str, str]] = []
    names: Iterable[str] = () if run.parameters is None else run.parameters["name"]
    listed = {f"identify.{name}{suffix}" for name in names for suffix in ("", "_std", "_rel_error")}
    keys = [key for key in run.metrics if key not in listed]  # the parameters have a table of their own
    groups = dict.fromkeys((*GROUPS, *(key.split(".")[0] for key in keys)))
    for group in groups:
        rows = [
            (escape(describe(run, key)[0]), value(run, key), f"<code>{escape(key)}</code>")
            for key in keys
            if key.split(".")[0] == group
        ]
        if rows:
            title = GROUPS.get(group, group.capitalize())
            html.append((f"<b>{escape(title)}</b>", "", ""))
            html += rows
    return _table(("", "value", "key"), html, {1}) if html else ""


def _charts(drawn: Iterable[Chart], section: str) -> str:
    """Places for the charts of a section, which the script at the end of the page fills."""
    html = []
    for chart in drawn:
        kind = chart.name.split("_")[0] if chart.name.startswith("curves_") else chart.name
        if SECTION_OF.get(kind, "control") == section:
            note = f'<p class="note">{escape(chart.note)}</p>' if chart.note else ""
            place = f'<div class="chart" id="{_chart_id(chart)}"></div>'
            html.append(f"<figure><h3>{escape(chart.title)}</h3>{place}{note}</figure>")
    return "".join(html)


def _parameters(parameters: pd.DataFrame | None) -> str:
    """Identified physical parameters beside their true values, where those are known."""
    if parameters is None:
        return ""
    known = [
        c
        for c in ("name", "identified", "std", "low", "high", "true", "rel_error", "unit")
        if c in parameters.columns
    ]
    titles = {
        "name": "parameter",
        "std": "standard deviation",
        "low": "95 % from",
        "high": "to",
        "rel_error": "relative error",
    }
    digits = {"identified": 7, "std": 2, "low": 6, "high": 6, "true": 7, "rel_error": 2}
    rows = [
        [
            number(float(cell), digits[column]) if column in digits else escape(str(cell))
            for column, cell in zip(known, row, strict=True)
        ]
        for row in parameters[known].itertuples(index=False)
    ]
    numbers = {k for k, c in enumerate(known) if c in digits}
    return "<h3>Identified parameters</h3>" + _table([titles.get(c, c) for c in known], rows, numbers)


def _worst(run: RunFiles) -> str:
    """The runs of a study that went worst, with what was drawn for them."""
    if run.study is None or run.scenario.study is None:
        return ""
    frame = run.study
    error = next((str(c) for c in frame.columns if str(c).startswith("control.rmse_")), None)
    order = ["success", *([error] if error else [])]
    worst = frame.sort_values(order, ascending=[True, False][: len(order)], na_position="first").head(WORST)
    varied = [path for path in run.scenario.study.vary if path in frame.columns]
    columns = [
        "run",
        "success",
        *([error] if error else []),
        *varied,
        *(["error"] if "error" in frame else []),
    ]
    titles = [escape(c.removeprefix("components.").removeprefix("control.")) for c in columns]

    def shown(value: object) -> str:
        if isinstance(value, float):
            return "" if value != value else number(value, 4)
        return escape(str(value))

    rows = [[shown(cell) for cell in row] for row in worst[columns].itertuples(index=False)]
    return "<h3>Worst runs</h3>" + _table(titles, rows)


def _stages(provenance: Mapping[str, Any]) -> str:
    """What was done, what came from the cache, and how long it took."""
    words = {"ran": "ran", "cached": "unchanged, taken from the cache"}
    rows = []
    for name, stage in (provenance.get("stages") or {}).items():
        facts = stage if isinstance(stage, Mapping) else {"status": stage}
        status, seconds = str(facts.get("status", "")), facts.get("seconds")
        took = f"{seconds:.3g} s" if isinstance(seconds, int | float) else ""
        rows.append((escape(str(name)), escape(words.get(status, status)), took))
    return _table(("stage", "", "time"), rows, {2}) if rows else ""


def _provenance(provenance: Mapping[str, Any]) -> str:
    """Versions, files and hashes that make the result what it is."""
    if not provenance:
        return ""
    command = " ".join(str(word) for word in provenance.get("command") or ())
    facts = {
        "command": command,
        "date": provenance.get("date"),
        "seed": provenance.get("seed"),
        "duration": f"{provenance['duration_s']:.3g} s" if provenance.get("duration_s") is not None else None,
        "exlinn": provenance.get("exlinn"),
        "Python": provenance.get("python"),
        "platform": provenance.get("platform"),
    }
    rows = [
        (key, f"<code>{escape(str(fact))}</code>") for key, fact in facts.items() if fact not in (None, "")
    ]
    files = [
        (escape(name), f'<span class="hash">{escape(str(digest))}</span>')
        for name, digest in (provenance.get("files") or {}).items()
    ]
    packages = [
        (escape(name), escape(str(version))) for name, version in (provenance.get("packages") or {}).items()
    ]
    html = _table(("", ""), rows)
    if files:
        html += "<h3>Files</h3>" + _table(("file", "SHA-256"), files)
    if packages:
        html += "<h3>Packages</h3>" + _packages(packages)
    return html


def _packages(packages: Sequence[tuple[str, str]]) -> str:
    """Package versions in columns of equal length."""
    third = max(1, -(-len(packages) // 3))
    parts = [packages[k : k + third] for k in range(0, len(packages), third)]
    return f'<div class="columns">{"".join(_table(("package", "version"), part) for part in parts)}</div>'


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    """An HTML table of cells that are HTML already; columns in `numbers` are set flush right."""
    classes = [' class="number"' if k in set(numbers) else "" for k in range(len(titles))]
    head = "".join(f"<th{c}>{title}</th>" for c, title in zip(classes, titles, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{c}>{cell}</td>" for c, cell in zip(classes, row, strict=True)) + "</tr>"
        for row in rows
    )
    head = f"<thead><tr>{head}</tr></thead>" if any(titles) else ""
    return f'<div class="wide"><table>{head}<tbody>{body}</tbody></table></div>'


def _chart_id(chart: Chart) -> str:
    """Anchor of a chart."""
    return f"chart-{chart.name}"


def _script_json(content: object) -> str:
    """JSON that may stand inside a script element: it cannot end the element."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False, default=float)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")

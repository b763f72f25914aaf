"""The model card, ``documentation/index.html``: what a model is, how far to trust it, where it is from."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

from exlinn_fmi.data.files import read_json
from exlinn_fmi.export.model import StateSpaceModel

ACCURACY = {
    "learn.force_mse_test": "mean square error of the inverse model's forces, unseen data",
    "learn.acceleration_mse_test": "mean square error of accelerations, unseen data",
    "learn.rollout_nrmse_2s": "NRMSE of a free run of 2 s, worst velocity, unseen data",
    "learn.rollout_nrmse_10s": "NRMSE of a free run of 10 s, worst velocity, unseen data",
    "learn.mass_matrix_min_eigenvalue": "least eigenvalue of the mass matrix on the data",
}
"""Metrics that a user of the model wants to see."""


@dataclass(frozen=True)
class Card:
    """Where a model came from and how good it is.

    Args:
        provenance: settings, seed, hash of the data, as far as there are any.
        metrics: of its run.
        parameters: rows of identified parameters: name, identified, low, high, …
    """

    provenance: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)
    parameters: tuple[Mapping[str, str], ...] = ()

    def provenance_text(self) -> str:
        """Where the FMU came from, as JSON; no date and no machine, so that builds are reproducible."""
        told = {"generator": f"exlinn_fmi {version('exlinn-fmi')}", "model": dict(self.provenance)}
        accuracy = {name: self.metrics[name] for name in ACCURACY if name in self.metrics}
        return json.dumps(told | {"accuracy": accuracy}, indent=1, sort_keys=True, default=str) + "\n"


def read_card(folder: Path) -> Card:
    """The card of a learned model from the files of its run.

    Args:
        folder: run folder with model.json; metrics.json and parameters.csv are used if they are there.
    """
    import csv

    provenance = read_json(folder / "model.json")
    told = {"weights_sha256": provenance["weights_sha256"], **provenance["provenance"]}
    metrics, table = folder / "metrics.json", folder / "parameters.csv"
    rows = tuple(csv.DictReader(table.read_text("utf-8").splitlines())) if table.exists() else ()
    return Card(told, read_json(metrics) if metrics.exists() else {}, rows)


def card_page(model: StateSpaceModel, card: Card, fmi: int) -> str:
    """The page.

    Args:
        model: what is exported.
        card: where it came from.
        fmi: major version of FMI.
    """
    learned = bool(card.provenance)
    parts = [
        f"<h1>{escape(model.identifier)}</h1>",
        f"<p>{escape(model.description or 'extended Lagrangian model')}. FMI {fmi}.0, Co-Simulation and "
        "Model Exchange, C sources inside.</p>",
        *(_validity(model) if learned else []),
        "<h2>Variables</h2>",
        _table(
            ("name", "unit", "what", "start", "trained range" if model.ranges else ""),
            (
                (
                    q.name,
                    q.unit,
                    q.description,
                    f"{q.start:g}" if q.role != "output" else "",
                    _range(model, q.name),
                )
                for q in model.variables
            ),
        ),
    ]
    accuracy = [
        (text, _number(card.metrics[name])) for name, text in ACCURACY.items() if name in card.metrics
    ]
    if accuracy:
        parts += ["<h2>Accuracy</h2>", _table(("figure", "value"), accuracy)]
    if card.parameters:
        parts += ["<h2>Identified parameters</h2>", _parameters(card.parameters)]
    if learned:
        rows = ((key, _number(value)) for key, value in sorted(card.provenance.items()) if key != "ranges")
        parts += ["<h2>Provenance</h2>", _table(("what", "value"), rows)]
    parts += [
        "<h2>Integration (Co-Simulation)</h2>",
        f"<p>Equal Runge-Kutta steps no longer than <code>solver_step</code> ({model.solver_step:g} s); with "
        "<code>solver_tolerance</code> above 0, Dormand-Prince steps of that relative tolerance.</p>",
    ]
    style = (
        "body{font:15px sans-serif;max-width:60em;margin:2em auto}td,th{padding:.2em .8em;text-align:left}"
    )
    body = "\n".join(parts)
    head = f"<meta charset='utf-8'><title>{escape(model.identifier)}</title><style>{style}</style>"
    return f"<!DOCTYPE html>\n<html lang='en'><head>{head}</head>\n<body>\n{body}\n</body></html>\n"


def _validity(model: StateSpaceModel) -> list[str]:
    """How far the model can be trusted."""
    if not model.ranges:
        return [
            "<p><strong>Validity:</strong> it is not known in which range this model was trained; train it "
            "again to have its range watched.</p>"
        ]
    return [
        "<p><strong>Validity:</strong> learned from data in the ranges below. Outside of them the model "
        "extrapolates: the output <code>in_range</code> is false there and a warning is logged. With the "
        "parameter <code>clamp</code> its equations see no value beyond the ranges.</p>"
    ]


def _range(model: StateSpaceModel, name: str) -> str:
    low, high = model.ranges.get(name, (0.0, 0.0))
    return f"{low:.6g} … {high:.6g}" if name in model.ranges else ""


def _parameters(rows: Iterable[Mapping[str, str]]) -> str:
    """Name, value and 95 % interval, where there is one."""

    def interval(row: Mapping[str, str]) -> str:
        low, high = row.get("low"), row.get("high")
        return f"{_number(low)} … {_number(high)}" if low and high else ""

    cells = ((row["name"], _number(row["identified"]), interval(row)) for row in rows)
    return _table(("parameter", "identified", "95 % interval"), cells)


def _number(value: Any) -> str:
    """Six digits of what is a number, all of what is not."""
    try:
        return f"{float(value):.6g}"
    except (TypeError, ValueError):
        return str(value)


def _table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    lines = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table>\n<tr>{head}</tr>\n{lines}\n</table>"

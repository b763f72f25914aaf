"""The learning benchmark on paper: tables for the terminal and the drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table

from baselines.bench import Row

COLUMNS = {
    "weights": "weights",
    "seconds": "CPU s",
    "acceleration_mse": "MSE of q̈",
    "rollout_nrmse_2s": "2 s",
    "rollout_nrmse_10s": "10 s",
    "rollout_nrmse_ood": "beyond",
    "rollout_nrmse_100s": "100 s",
}


def text(value: float) -> str:
    if math.isinf(value):
        return "diverges"
    return f"{value:.0f}" if 100 <= value < 1e5 and value == round(value) else f"{value:.2g}"


def print_table(rows: Sequence[Row], console: Console) -> None:
    """All learners, one below the other."""
    table = Table(title="clean data of the DC motor with cart; free runs: NRMSE of the worst velocity")
    table.add_column("learner")
    present = [key for key in COLUMNS if all(key in row.numbers for row in rows)]
    for key in present:
        table.add_column(COLUMNS[key], justify="right")
    for row in rows:
        table.add_row(row.name, *(text(row.numbers[key]) for key in present))
    console.print(table)


def draw(rows: Sequence[Row], folder: Path) -> None:
    """Accuracy against training time, and the error of the current as the free runs go on."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    # text stays text in the SVG
    plt.rcParams["svg.fonttype"] = "none"
    picture, (left, right) = plt.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    for row in rows:
        error = min(row.numbers["rollout_nrmse_10s"], 10.0)
        ours = row.key.startswith("ours")
        colour = {"ours.structured": "black", "ours.terms": "darkgray"}.get(row.key)
        (mark,) = left.loglog(row.numbers["seconds"], error, "*" if ours else "o", color=colour, markersize=9)
        left.annotate(
            row.name,
            (row.numbers["seconds"], error),
            (5, -11 if row.key == "ours.terms" else 4),
            textcoords="offset points",
            fontsize=8,
        )
        current = row.run.frame["i"].to_numpy()
        gap = np.abs(row.states[:, -1] - current) / current.std()
        smooth = pd.Series(gap).rolling(max(1, len(gap) // 50), min_periods=1).max()
        # Both of ours may be exact, and so lie on one another.
        dash = "--" if row.key == "ours.terms" else "-"
        right.semilogy(row.run.frame["time"], smooth, dash, color=mark.get_color(), label=row.name, lw=1)
    left.set_xlim(1e-2, 3e3)
    left.set(xlabel="training, CPU s of one thread", ylabel="NRMSE of a 10 s free run (10: diverged)")
    right.set(xlabel="time [s]", ylabel="error of i, relative to its standard deviation", ylim=(1e-13, 1e2))
    right.legend(fontsize=8, ncols=2)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("png", "svg"):
        picture.savefig(folder / f"learning.{kind}", dpi=150)
    plt.close(picture)

"""Makes the recordings in this folder: what a test bench would log of the DC motor with cart.

    python scenarios/data/record.py [FOLDER]

The plant `dc_motor_cart` on a voltage that a digital amplifier holds for 2 ms. The logger is a European one:
semicolons, decimal commas, two lines of remarks. It writes degrees of an encoder with 4096 lines that begins
anew after a turn, rpm of a tachogenerator and mA of a current probe, both with noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.signals import Multisine

STEP = 2e-3
SUBSTEPS = 4
LINES = 4096
NOISE = {"rpm": 0.1, "mA": 3.0}
"""Standard deviation of the noise: about 1 % and 0.5 % of the signals."""

RUNS = {
    "motor_1": (4.0, Multisine(signal="multisine", rms=5, band=(0.2, 3), lines=15, offset=5, seed=1)),
    "motor_2": (4.0, Multisine(signal="multisine", rms=5, band=(0.2, 3), lines=15, offset=-5, seed=2)),
    "motor_3": (4.0, Multisine(signal="multisine", rms=7, band=(0.2, 4), lines=20, offset=1.5, seed=3)),
    "motor_test": (8.0, Multisine(signal="multisine", rms=5, band=(0.2, 3), lines=15, offset=2.5, seed=11)),
}
"""Duration [s] and voltage [V] of each."""


def record(duration: float, voltage: Multisine, random: np.random.Generator) -> pd.DataFrame:
    """One run of the motor from rest, as the bench logs it."""
    system = PLANT.system
    t = STEP * np.arange(round(duration / STEP) + 1)
    u = np.round(signal_function(voltage, Path())(t), 2)
    inputs = np.vstack([u if name == "v" else np.zeros_like(u) for name in system.input_names])
    step = system.rk4(SUBSTEPS).mapaccum(len(t) - 1)
    parameters = np.tile(system.parameter_values[:, None], len(t) - 1)
    start = np.array([random.uniform(0, 2 * np.pi), 0.0, 0.0])
    states = np.hstack([start[:, None], np.array(step(start, inputs[:, :-1], parameters, STEP))])
    alpha, speed, current = (states[system.state_names.index(name)] for name in ("alpha", "alpha_dot", "i"))
    noise = {unit: deviation * random.standard_normal(len(t)) for unit, deviation in NOISE.items()}
    return pd.DataFrame(
        {
            "t [ms]": np.round(1e3 * t).astype(int),
            "phi [deg]": np.round(np.mod(np.floor(alpha / (2 * np.pi) * LINES), LINES) * 360 / LINES, 2),
            "n [rpm]": np.round(speed * 60 / (2 * np.pi) + noise["rpm"], 2),
            "i [mA]": np.round(1e3 * current + noise["mA"]).astype(int),
            "u [V]": u,
        }
    )


def main(folder: Path) -> None:
    """Write all runs."""
    random = np.random.default_rng(2024)
    for name, (duration, voltage) in RUNS.items():
        text = record(duration, voltage, random).to_csv(None, sep=";", decimal=",", index=False)
        remarks = f"# test bench 3, DC motor with cart, {duration:g} s\n# encoder {LINES} lines\n"
        (folder / f"{name}.csv").write_text(remarks + text, "utf-8", newline="\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)

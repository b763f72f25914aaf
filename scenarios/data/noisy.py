"""How noisy.csv and noisy_test.csv were made: the motor with cart, with 1 % noise and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.signals import Multisine, Signal, Sine

STATES = ["alpha", "alpha_dot", "i"]
FOLDER = Path(__file__).parent


def record(signal: Signal, duration: float, step: float) -> pd.DataFrame:
    """Run the motor from rest, its voltage held from row to row."""
    system, time = PLANT.system, np.arange(round(duration / step)) * step
    u = np.zeros((len(time), len(system.input_names)))
    u[:, system.input_names.index("v")] = signal_function(signal, FOLDER)(time)
    p = np.tile(system.parameter_values[:, None], len(time))
    after = system.rk4(2).mapaccum(len(time))(np.zeros(3), u.T, p, step * np.ones((1, len(time)))).full().T
    frame = pd.DataFrame({"time": time})
    frame[STATES] = np.vstack([np.zeros(3), after[:-1]])
    return frame.assign(v=u[:, system.input_names.index("v")])


if __name__ == "__main__":
    training = record(Sine(signal="sine", offset=4, amplitude=1, frequency=1 / np.pi), 10, 2e-3)
    noise = np.random.default_rng(0).standard_normal((len(training), 3))
    training[STATES] += 0.01 * training[STATES].std().to_numpy() * noise
    training.to_csv(FOLDER / "noisy.csv", index=False, float_format="%.6g")
    test = record(
        Multisine(signal="multisine", offset=4, rms=0.7, band=(0.1, 5), lines=10, seed=2), 10.1, 5e-3
    )
    test.to_csv(FOLDER / "noisy_test.csv", index=False, float_format="%.9g")

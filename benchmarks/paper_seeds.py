"""How many seeds of the paper's learner reach the paper's accuracy, and what the choices it leaves open cost.

Trains the preset `paper` as `scenarios/dcwc_paper.yaml` has it (excitation, features, sizes) on the plant
itself and prints, for each seed: mean square error of the forces on the unseen multisine, the smallest
eigenvalue of the mass matrix there (not above 0: no forward model), the 2 s free run, and the training time.

    python benchmarks/paper_seeds.py --seeds 10 --json paper_seeds.json
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.learn.card import report_card
from exlinn_fmi.learn.train import train
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.learning import Experiment, Learn, Paper
from exlinn_fmi.scenario.load import load_scenario

SCENARIO = Path(__file__).parents[1] / "scenarios" / "dcwc_paper.yaml"
TARGET = 1e-2
"""Mean square error of the forces that the issue asks for."""


def experiment_data(experiment: Experiment, learn: Learn) -> Dataset:
    """One experiment on the plant: RK4 at the sampling step, the voltage held over each step."""
    system, h = PLANT.system, experiment.step
    time = np.arange(round(experiment.duration / h) + 1) * h
    inputs = np.zeros((len(time), len(system.input_names)))
    for path, signal in experiment.inputs.items():
        voltage: Callable[[np.ndarray], np.ndarray] = signal_function(signal, SCENARIO.parent)
        inputs[:, system.input_names.index(path.split(".", 1)[1])] = voltage(time)
    p = system.parameter_values
    run = system.rk4(4).mapaccum(len(time) - 1)
    start = np.zeros(len(system.state_names))
    states = np.vstack([start, np.array(run(start, inputs[:-1].T, np.tile(p[:, None], len(time) - 1), h)).T])
    q = np.column_stack([states[:, 0], 0 * time])
    a = evaluate(system.forward, q, states[:, 1:], inputs, p)
    names = [*system.state_names, *(c.acceleration for c in system.coordinates), *system.input_names]
    frame = pd.DataFrame(np.hstack([states, a, inputs]), columns=names).assign(trajectory=0, time=time)
    return Dataset(frame, tuple(c.coordinate() for c in learn.coordinates))


def measure(seed: int, learn: Learn, method: Paper, data: Dataset, test: Dataset) -> dict[str, Any]:
    """Train with one seed and judge the result."""
    parts = split(data, learn.train_fraction, learn.split_blocks, seed)
    model = train(*parts, method, seed)
    card = report_card(model, parts[0], [test], learn.identify, {}).metrics
    return {
        "seed": seed,
        "force_mse_test": card["learn.force_mse_test"],
        "mass_matrix_min_eigenvalue": card["learn.mass_matrix_min_eigenvalue"],
        "rollout_nrmse_2s": card["learn.rollout_nrmse_2s"],
        "seconds": model.seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10, help="how many seeds, from 0 on")
    parser.add_argument("--batch", type=int, help="samples in a batch; the scenario's if not given")
    parser.add_argument("--json", type=Path, help="write the result there")
    options = parser.parse_args()
    learn = load_scenario(SCENARIO, []).scenario.learn
    assert learn is not None
    method = learn.method
    assert isinstance(method, Paper)
    if options.batch:
        method = method.model_copy(update={"batch": options.batch})
    data, test = experiment_data(learn.training[0], learn), experiment_data(learn.test[0], learn)
    print(f"{'seed':>4} {'force MSE':>10} {'min eig M':>10} {'2 s NRMSE':>10} {'seconds':>8}")
    rows = []
    for seed in range(options.seeds):
        row = measure(seed, learn, method, data, test)
        rows.append(row)
        print(
            f"{seed:4} {row['force_mse_test']:10.2e} {row['mass_matrix_min_eigenvalue']:10.4f} "
            f"{row['rollout_nrmse_2s']:10.2e} {row['seconds']:8.1f}",
            flush=True,
        )
    summary = {
        "batch": method.batch,
        "target": TARGET,
        "reached": sum(row["force_mse_test"] <= TARGET for row in rows),
        "positive_definite": sum(row["mass_matrix_min_eigenvalue"] > 0 for row in rows),
        "seeds": len(rows),
        "force_mse_test_median": statistics.median(row["force_mse_test"] for row in rows),
        "seconds_median": statistics.median(row["seconds"] for row in rows),
    }
    print(
        f"{summary['reached']} of {len(rows)} seeds reach {TARGET:g} "
        f"(median {summary['force_mse_test_median']:.1e}), "
        f"{summary['positive_definite']} have a mass matrix; batch {method.batch}, "
        f"{summary['seconds_median']:.1f} s each"
    )
    if options.json:
        plain = [{k: v if np.isfinite(v) else None for k, v in row.items()} for row in rows]
        options.json.write_text(json.dumps({**summary, "runs": plain}, indent=2) + "\n")


if __name__ == "__main__":
    main()

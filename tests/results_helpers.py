"""Run folders made of formulas: a cart that follows its reference as a good controller would make it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from exlinn_fmi.data.files import write_json
from exlinn_fmi.data.tables import write_table

COMPONENTS = """\
name: {name}
description: {description}
seed: 7
components:
  plant:
    plant: dc_motor_cart
"""
CONTROLLER = """\
  controller:
    step: 0.01
    nmpc:
      model: learned
      reference:
        coordinate: alpha
        trajectory: {signal: sine, amplitude: 0.15, frequency: 0.4}
        through: {map: scotch_yoke, crank: 0.2}
      inputs: {v: {min: -24.0, max: 24.0}}
      states: {i: {min: -4.0, max: 4.0}}
connections:
  plant.alpha: controller.alpha
  plant.alpha_dot: controller.alpha_dot
  plant.i: controller.i
  controller.v: plant.v
metrics:
  settle: 2.0
  output: plant.x
"""
LEARN = """\
learn:
  plant: plant
  coordinates:
    - {name: alpha, unit: rad, topology: circle, position: plant.alpha, velocity: plant.alpha_dot}
    - {name: Q, unit: C, kind: electrical, topology: cyclic, velocity: plant.i, input: plant.v}
  training:
    - {duration: 2.0, inputs: {plant.v: {signal: sine, amplitude: 5.0, frequency: 1.0}}}
"""
SIMULATE = """\
simulate:
  stop: 10.0
  step: 0.001
"""
UNITS = {
    "time": "s",
    "plant.alpha": "rad",
    "plant.alpha_dot": "rad/s",
    "plant.i": "A",
    "plant.x": "m",
    "plant.v": "V",
    "plant.D": "W",
    "controller.v": "V",
    "controller.reference": "m",
    "controller.reference_alpha": "rad",
    "controller.cost": "1",
    "controller.solve_time": "s",
}
PROVENANCE = {
    "exlinn": "0.1.0",
    "date": "2025-03-01T12:00:00+00:00",
    "command": ["exlinn", "run", "scenarios/demo.yaml"],
    "scenario": "demo.yaml",
    "seed": 7,
    "duration_s": 41.5,
    "stages": {
        "collect": {"status": "cached", "seconds": 0.01},
        "train": {"status": "cached", "seconds": 0.02},
        "simulate": {"status": "ran", "seconds": 41.5},
    },
    "files": {"demo.yaml": "ab" * 32, "DCMotorCart.fmu": "cd" * 32},
    "python": "3.11.2",
    "platform": "Linux",
    "packages": {"numpy": "2.2.0", "casadi": "3.7.0"},
}


def scenario_text(
    *,
    control: bool = False,
    learn: bool = False,
    simulate: bool = False,
    description: str = "made of formulas",
) -> str:
    """A scenario of the cart with the parts asked for."""
    text = COMPONENTS.format(name="demo", description=f'"{description}"')
    return text + CONTROLLER * control + LEARN * learn + SIMULATE * (simulate or control)


def make_run(folder: Path, **parts: bool | str) -> Path:
    """An empty run folder with a scenario."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scenario.yaml").write_text(scenario_text(**parts), "utf-8")  # type: ignore[arg-type]
    write_json(folder / "provenance.json", PROVENANCE)
    return folder


def trajectories(stop: float = 10.0, step: float = 1e-3, period: float = 0.01) -> pd.DataFrame:
    """The cart on ±150 mm at 0.4 Hz, 10 µm beside its reference; the controller holds between its samples."""
    time = step * np.arange(round(stop / step) + 1)
    held = period * np.floor(time / period + 1e-9)
    alpha, alpha_dot, current, _ = motion(time)
    reference = 0.15 * np.sin(2 * np.pi * 0.4 * held)
    return pd.DataFrame(
        {
            "time": time,
            "plant.alpha": alpha + 5e-5 * np.sin(9 * time),
            "plant.alpha_dot": alpha_dot,
            "plant.i": current,
            "plant.x": 0.2 * np.cos(alpha) + 1e-5 * np.sqrt(2) * np.cos(40 * time),
            "plant.v": motion(held)[3],
            "plant.D": 0.25 * alpha_dot**2 + 2.5 * current**2,
            "controller.v": motion(held)[3],
            "controller.reference": reference,
            "controller.reference_alpha": np.arccos(reference / 0.2),
            "controller.cost": 1e-6 + 0.1 * np.exp(-6 * held) + 1e-5 * np.sin(5 * held) ** 2,
            "controller.solve_status": np.zeros(time.size),
            "controller.iterations": np.ones(time.size),
            "controller.solve_time": 1.5e-3 + 1e-4 * np.sin(1e3 * held) ** 8,
            "controller.fallbacks": np.zeros(time.size),
        }
    )


def motion(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Angle, its rate, current and voltage that move the cart along the reference, by eq. (19)."""
    fine = np.linspace(0, max(float(time[-1]), 1e-3) + 0.01, 40_001)
    alpha = np.arccos(0.75 * np.sin(2 * np.pi * 0.4 * fine))
    alpha_dot = np.gradient(alpha, fine, edge_order=2)
    alpha_ddot = np.gradient(alpha_dot, fine, edge_order=2)
    inertia, sine = 0.1 + 0.04 * np.sin(alpha) ** 2, np.sin(2 * alpha)
    current = inertia * alpha_ddot + 0.02 * sine * alpha_dot**2 + 0.5 * alpha_dot
    voltage = np.gradient(current, fine, edge_order=2) + alpha_dot + 5 * current
    return tuple(np.interp(time, fine, y) for y in (alpha, alpha_dot, current, voltage))  # type: ignore[return-value]


def write_trajectories(folder: Path, frame: pd.DataFrame | None = None) -> pd.DataFrame:
    """Put trajectories into a run folder."""
    frame = trajectories() if frame is None else frame
    write_table(folder / "trajectories", frame, UNITS)
    return frame


def evaluation(samples: int = 2000, error: float = 1e-6) -> tuple[pd.DataFrame, dict[str, str]]:
    """Two seconds of an unseen multisine: measured, and learned with a relative error."""
    time = np.linspace(0, 2, samples, endpoint=False)
    wave = sum(np.sin(2 * np.pi * f * time + f**2) for f in (0.5, 1.5, 3.5, 5.5))
    units = {"alpha_dot": "rad/s", "i": "A", "alpha_ddot": "rad/s2", "i_dot": "A/s", "L": "J", "D": "W"}
    frame = pd.DataFrame({"time": time})
    for k, name in enumerate(units):
        measured = (k + 1) * np.roll(wave, 40 * k) ** (2 if name in "LD" else 1)
        frame[name] = measured
        frame[f"{name}_learned"] = measured * (1 + error * np.sin(30 * time))
    return frame, {"time": "s"} | units | {f"{n}_learned": u for n, u in units.items()}


def write_learning(folder: Path, *, diverges: bool = False) -> pd.DataFrame:
    """Put evaluation, training history, parameters and their metrics into a run folder."""
    frame, units = evaluation()
    if diverges:
        late = np.maximum(frame["time"].to_numpy() - 0.8, 0)
        with np.errstate(over="ignore", invalid="ignore"):
            frame["i_learned"] += np.expm1(3e3 * late)
            frame["alpha_dot_learned"] = np.where(late > 0.2, np.nan, frame["alpha_dot_learned"])
    write_table(folder / "evaluation", frame, units)
    steps = np.arange(60)
    loss = 10.0 ** (-steps / 6)
    history = {"iteration": steps, "stage": "full", "loss": loss, "validation_loss": 1.4 * loss + 1e-11}
    pd.DataFrame(history).assign(seconds=0.01 * steps).to_csv(folder / "training.csv", index=False)
    true = {"j_m": 0.1, "m_c*d^2": 0.04, "k_e": 1.0, "l": 1.0, "b_m": 0.5, "r": 5.0}
    table = pd.DataFrame({"name": list(true), "true": list(true.values())})
    table.insert(1, "identified", table["true"] * (1 + 1e-5 * np.arange(6)))
    table["rel_error"] = table["identified"] / table["true"] - 1
    table.to_csv(folder / "parameters.csv", index=False)
    metrics = {
        "learn.force_mse_test": 3.1e-10,
        "learn.rollout_nrmse_10s": np.inf if diverges else 2.4e-5,
        "learn.rollout_diverged": float(diverges),
        "identify.max_rel_error": 5e-5,
    }
    write_json(folder / "metrics.json", metrics)
    return frame

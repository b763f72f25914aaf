"""The report card of a learned model: how well it does on data that training never saw.

Forces are judged by the inverse model (17), accelerations by the forward model (16) at measured states,
velocities by free runs of the forward model; physical parameters beside the plant's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.curves import curves
from exlinn_fmi.learn.estimate import estimate
from exlinn_fmi.learn.guarantee import told
from exlinn_fmi.learn.identify import Identified, identify
from exlinn_fmi.learn.noise import relative_noise
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.terms import formula, term_table
from exlinn_fmi.learn.train import TrainedModel
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.scenario.learning import Identify, Objective

Array = NDArray[np.float64]

HORIZONS = {"2s": 2.0, "10s": 10.0}
NONE = np.zeros(0)
"""A learned model has no parameters beside its weights."""


@dataclass(frozen=True)
class ReportCard:
    """What is known of a learned model's quality.

    Args:
        metrics: ``learn.…`` and ``identify.…`` by name; NaN where there is nothing to judge by.
        parameters: columns name, identified, true, rel_error; std, low and high (95 % interval) where the
            parameters were fitted to the data themselves.
        evaluation: on the first test: time, and each quantity measured (``name``) and learned
            (``name_learned``).
        units: units of the evaluation's columns.
        texts: ``learn.guarantee``: whether bounded inputs keep the model bounded; ``learn.objective``,
            ``learn.optimiser``, ``learn.terms`` and ``identify.objective``: what was done and why, and the
            formula that was found, as far as there is any.
        terms: the terms that were found, if the model is made of such.
        curves: M(q), V(q), 1/C(x) and friction over velocity with 95 % bands, as `curves.curves` gives them.
    """

    metrics: dict[str, float]
    parameters: pd.DataFrame
    evaluation: pd.DataFrame
    units: dict[str, str]
    texts: dict[str, str] = field(default_factory=dict)
    terms: pd.DataFrame | None = None
    curves: pd.DataFrame = field(default_factory=pd.DataFrame)


def report_card(
    model: TrainedModel,
    train: Dataset,
    tests: list[Dataset],
    options: Identify,
    truth: Mapping[str, float],
    objective: Objective = "auto",
) -> ReportCard:
    """Judge a model.

    Args:
        model: the model.
        train: data it was fitted to.
        tests: data that training never saw, one trajectory each; the first is the unseen test of forces.
        options: parameters to read off.
        truth: parameters of the plant as far as they are known.
        objective: what the estimate of the parameters makes small.

    Raises:
        ModelError: a monomial of `options` cannot be read.
    """
    system = model.system
    metrics = {
        "learn.force_mse_train": float(np.mean(force_error(system, train) ** 2)),
        **_force_metrics(system, tests),
        **_rollout_metrics(system, tests),
        "learn.mass_matrix_min_eigenvalue": min(_least_mass(system, d) for d in (tests or [train])),
        "learn.seconds": model.seconds,
    }
    noise = relative_noise(train)
    metrics |= {f"learn.noise_{name}": value for name, value in noise.items()}
    found, texts = None, {"learn.guarantee": told(system, train)}
    if options.names:
        found, note = estimate(train, options, truth, objective)
        texts |= {"identify.objective": note} if note else {}
    found = found or identify(system, train, options, truth)
    terms = None
    if model.spec.form == "terms":
        names = ("lagrangian.terms", "dissipation.terms", "shapes")
        coefficients = np.concatenate([model.weights[name] for name in names])
        terms = term_table(model.spec, coefficients, np.array(model.provenance["deviations"]))
        texts["learn.terms"] = formula(terms)
    told_of = [name for name in ("objective", "optimiser") if name in model.provenance]
    texts |= {f"learn.{name}": model.provenance[name] for name in told_of}
    evaluation, units = _evaluation(system, (tests or [train])[0])
    metrics |= _identify_metrics(found)
    return ReportCard(metrics, found.parameters, evaluation, units, texts, terms, curves(model, train))


def force_error(system: LagrangianSystem, data: Dataset) -> Float[Array, "N n"]:
    """Forces of the inverse model (17) less those in the data."""
    q, v, a, force = data.arrays
    return evaluate(system.inverse, q, v, a, NONE) - force


def accelerations(system: LagrangianSystem, data: Dataset) -> Float[Array, "N n"]:
    """Accelerations of the forward model (16) at the measured states under the inputs."""
    q, v, _, force = data.arrays
    return evaluate(system.forward, q, v, force @ system.input_matrix, NONE)


def _least_mass(system: LagrangianSystem, data: Dataset) -> float:
    """Smallest eigenvalue of the mass matrix at the data, in SI units."""
    q, v, _, _ = data.arrays
    mass = evaluate(system.mass_matrix, q, v, NONE).reshape(-1, system.n, system.n)
    return float(np.linalg.eigvalsh(mass).min())


def _force_metrics(system: LagrangianSystem, tests: list[Dataset]) -> dict[str, float]:
    """Forces and accelerations on the first test."""
    names = [f"learn.force_mse_test_{c.name}" for c in system.coordinates]
    if not tests:
        return dict.fromkeys(["learn.force_mse_test", *names, "learn.acceleration_mse_test"], float("nan"))
    square = np.mean(force_error(system, tests[0]) ** 2, axis=0)
    difference = accelerations(system, tests[0]) - tests[0].arrays.a
    return {
        "learn.force_mse_test": float(square.mean()),
        **dict(zip(names, square.tolist(), strict=True)),
        "learn.acceleration_mse_test": float(np.mean(difference**2)),
    }


def _rollout_metrics(system: LagrangianSystem, tests: list[Dataset]) -> dict[str, float]:
    """Free runs: for each horizon on the first test that is long enough."""
    metrics: dict[str, float] = {}
    runs = [free_run(system, test) for test in tests]
    for label, duration in HORIZONS.items():
        errors = dict.fromkeys([c.velocity for c in system.coordinates], float("nan"))
        for test, states in zip(tests, runs, strict=True):
            found = nrmse(system, test, states, duration)
            if not all(np.isnan(value) for value in found.values()):
                errors = found
                break
        judged = [value for value in errors.values() if not np.isnan(value)]
        metrics[f"learn.rollout_nrmse_{label}"] = max(judged, default=float("nan"))
        metrics |= {f"learn.rollout_nrmse_{label}_{name}": value for name, value in errors.items()}
    metrics["learn.rollout_diverged"] = float(any(not np.isfinite(states).all() for states in runs))
    return metrics


def _identify_metrics(found: Identified) -> dict[str, float]:
    """Parameters as metrics; the largest error is not known where one that should be known is not found."""
    table = found.parameters
    known = table[table["true"].notna()]
    worst = known["rel_error"].max(skipna=False) if len(known) else float("nan")
    metrics = {"identify.max_rel_error": float(worst), "identify.misfit": found.misfit}
    for name, value, error in zip(table["name"], table["identified"], table["rel_error"], strict=True):
        metrics |= {f"identify.{name}": float(value), f"identify.{name}_rel_error": float(error)}
    if "std" in table:
        metrics |= {f"identify.{n}_std": float(s) for n, s in zip(table["name"], table["std"], strict=True)}
    return metrics


# ── measured against learned ─────────────────────────────────────────────────────────────────────────────


def _evaluation(system: LagrangianSystem, data: Dataset) -> tuple[pd.DataFrame, dict[str, str]]:
    """Velocities (free run), accelerations (forward model), inputs (inverse model), 𝓛 and D."""
    q, v, _, force = data.arrays
    states = pd.DataFrame(free_run(system, data), columns=system.state_names)
    learned: dict[str, Array] = {c.velocity: states[c.velocity].to_numpy() for c in system.coordinates}
    acceleration, inverse = accelerations(system, data), force + force_error(system, data)
    for i, c in enumerate(system.coordinates):
        learned[c.acceleration] = acceleration[:, i]
        if c.input is not None:
            learned[c.input] = inverse[:, i]
    learned["L"] = evaluate(system.lagrangian, q, v, NONE)[:, 0]
    learned["D"] = evaluate(system.dissipation, v, NONE)[:, 0]
    learned["D"] -= evaluate(system.dissipation, np.zeros_like(v[:1]), NONE)[0, 0]
    if "L" in data.frame:
        learned["L"] = _align(learned["L"], data.frame["L"].to_numpy(dtype=float), v)
    frame, units = pd.DataFrame({"time": data.frame["time"]}), {"time": "s"}
    known = {"L": "J", "D": "W"} | dict(data.units)
    for name, values in learned.items():
        columns = {name: data.frame[name].to_numpy(dtype=float)} if name in data.frame else {}
        for column, content in (columns | {f"{name}_learned": values}).items():
            frame[column], units[column] = content, known[name]
    return frame, units


def _align(
    learned: Float[Array, " N"], true: Float[Array, " N"], v: Float[Array, "N n"]
) -> Float[Array, " N"]:
    """𝓛 in the plant's gauge: forces fix it up to a constant and d/dt Σ c_i q_i, which are fitted here."""
    gauges = np.column_stack([np.ones(len(v)), v])
    aligned: Array = learned + gauges @ np.linalg.lstsq(gauges, true - learned, rcond=None)[0]
    return aligned

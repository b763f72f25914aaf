"""From a scenario to a better excitation: what the search counts on, and what the user gets to see."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.data.files import read_json, write_json, write_text
from exlinn_fmi.errors import InputError
from exlinn_fmi.factory import model_system
from exlinn_fmi.scenario.learning import LearnFromPlant, Noise
from exlinn_fmi.scenario.schema import PlantComponent
from exlinn_fmi.workspace import Run

if TYPE_CHECKING:
    from exlinn_fmi.learn.design import Judgement, Problem, Trial
    from exlinn_fmi.mechanics.coordinates import Parameter
    from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem

Array = NDArray[np.float64]


def propose(work: Run, truth: Mapping[str, float]) -> list[Path]:
    """Search for an excitation and write ``design.yaml`` and ``design.json``.

    Args:
        work: the scenario.
        truth: values of the plant's parameters, as far as it states them.

    Raises:
        InputError: there is no model to count on, or no excitation keeps the limits.
    """
    from exlinn_fmi.learn.design import improve, information_of

    learn = _plant_learned(work)
    system = _family(work, learn, truth)
    present = _present(work, learn, system)
    problem = _problem(work, learn, system, present)
    before = problem.judge(
        np.sum([information_of(replace(problem, step=step), [trial]) for trial, step in present], axis=0)
    )
    duration = learn.design.duration or sum(trial.duration for trial, _ in present)
    first = replace(present[0][0], duration=duration)

    def show(fraction: float, worst: float) -> None:
        work.reporter.update(fraction, f"worst {worst:.2%}, at present {before.worst:.2%}")

    found = improve(problem, first, learn.design.candidates, work.seed, show, work.stop)
    if found is None:
        raise InputError(
            f"{work.loaded.file}: learn.design: none of {learn.design.candidates} multisines keeps the "
            f"limits for {duration:g} s; widen `limits.states`, narrow `limits.inputs`, shorten `duration` "
            "or try more `candidates`"
        )
    after = problem.judge(information_of(problem, [found]))
    files = work.folder / "design.yaml", work.folder / "design.json"
    write_text(files[0], _snippet(learn, found, problem))
    write_json(files[1], _record(problem, found, before, after))
    return list(files)


def model_files(work: Run) -> list[Path]:
    """Files in the run folder that the search depends on."""
    names = ("model.json", "model.safetensors", "parameters.csv")
    return [file for name in names if (file := work.folder / name).exists()]


def summary(folder: Path) -> str:
    """What was found, as a table, and what to do next."""
    found = read_json(folder / "design.json")
    present, proposed = found["present"], found["proposed"]
    rows = [("parameter", "value", "present", "proposed")]
    rows += [
        (name, f"{found['values'][name]:.6g}", _percent(present["deviation"][name]), _percent(deviation))
        for name, deviation in proposed["deviation"].items()
    ]
    titles = {"worst": "worst (E)", "a": "rms (A)", "d": "mean axis (D)"}
    rows += [(title, "", _percent(present[k]), _percent(proposed[k])) for k, title in titles.items()]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["relative standard deviation that an efficient fit would have (Cramér–Rao)", ""]
    lines += [
        f"{row[0]:<{widths[0]}}" + "".join(f"  {t:>{w}}" for t, w in zip(row[1:], widths[1:], strict=True))
        for row in rows
    ]
    gain = found["improvement"]
    if proposed["worst"] is None or (gain is not None and gain <= 1):
        told = "nothing better than at present was found; widen learn.design.limits or try more candidates"
    else:
        better = (
            "which the present excitation tells nothing of" if gain is None else f"{gain:.2g} times better"
        )
        told = (
            f"the worst parameter: {better}\n"
            f"next: put {folder / 'design.yaml'} under `learn:` in place of `training:`, then `exlinn train`"
        )
    return "\n".join([*lines, "", told])


def _percent(value: float | None) -> str:
    return "not seen" if value is None else f"{100 * value:.3g} %"


# ── what the search counts on ────────────────────────────────────────────────────────────────────────────


def _plant_learned(work: Run) -> LearnFromPlant:
    """The `learn` section, if an excitation can be designed for it."""
    learn, file = work.learn, work.loaded.file
    if not isinstance(learn, LearnFromPlant):
        raise InputError(f"{file}: learn.data: nothing to excite; `exlinn design` needs `learn.plant`")
    if not learn.identify.names:
        raise InputError(
            f"{file}: learn.identify: no parameters to find out; name them with their monomials, "
            "e.g. `identify: {dissipation: {r: 0.5*i^2}}`"
        )
    return learn


def _family(work: Run, learn: LearnFromPlant, truth: Mapping[str, float]) -> LagrangianSystem:
    """The model with the parameters to find, at the values known so far."""
    from exlinn_fmi.learn.identify import Unknowns
    from exlinn_fmi.mechanics.family import family

    component = work.scenario.components[learn.plant]
    ours = f"plant:{component.plant}" if isinstance(component, PlantComponent) else "learned"
    model = learn.design.model or ours
    if model == "learned" and not (work.folder / "model.json").exists():
        raise InputError(
            f"{work.folder}: no model to count on yet; run `exlinn train {work.loaded.file}` first, or say "
            "`learn.design.model: plant:NAME` if the plant is one of ours"
        )
    base = model_system(model, work.loaded.folder, work.folder)
    base = replace(
        base, parameters=tuple(replace(p, value=truth.get(p.name, p.value)) for p in base.parameters)
    )
    base = base.with_inputs({c.coordinate().input or "" for c in learn.coordinates})
    values = {p.name: p.value for p in base.parameters} | dict(truth)
    parameters = _parameters(work, learn, values, model == "learned")
    unknowns = Unknowns.of(base.coordinates, learn.identify)
    return family(base, unknowns.basis, parameters).bound(unknowns.known)


def _parameters(
    work: Run, learn: LearnFromPlant, stated: Mapping[str, float], learned: bool
) -> tuple[Parameter, ...]:
    """The parameters to find: as identified first where the model was learned, else as stated first."""
    import pandas as pd

    from exlinn_fmi.learn.identify import true_value
    from exlinn_fmi.mechanics.coordinates import Parameter

    found: dict[str, float] = {}
    if (work.folder / "parameters.csv").exists():
        table = pd.read_csv(work.folder / "parameters.csv")
        found = dict(zip(table["name"], table["identified"], strict=True))
    result = []
    for name in learn.identify.names:
        known = found.get(name, float("nan")), learn.identify.known.get(name, true_value(name, stated))
        value = next((x for x in (known if learned else known[::-1]) if np.isfinite(x)), 0.0)
        if value == 0:
            raise InputError(
                f"{work.loaded.file}: learn.identify: no value of {name!r} is known to improve on: the plant "
                "states none, and training identified none; run `exlinn train` with it first, or take it out"
            )
        result.append(Parameter(name, float(value), ""))
    return tuple(result)


def _present(work: Run, learn: LearnFromPlant, system: LagrangianSystem) -> list[tuple[Trial, float]]:
    """The training experiments as they stand, with their steps."""
    from exlinn_fmi.learn.design import Trial

    own = work.scenario.components[learn.plant].starts()
    trials = []
    for spec in learn.training:
        start = {**own, **spec.start}
        x = np.array([float(start.get(name, 0.0)) for name in system.state_names])
        inputs = {path.split(".", 1)[1]: signal for path, signal in spec.inputs.items()}
        trials.append((Trial(inputs, x, spec.duration), spec.step))
    return trials


def _problem(
    work: Run, learn: LearnFromPlant, system: LagrangianSystem, present: list[tuple[Trial, float]]
) -> Problem:
    """Noise, limits and frequencies."""
    from exlinn_fmi.learn.design import Problem

    options = learn.design
    step, duration = min(s for _, s in present), options.duration or sum(t.duration for t, _ in present)
    free = np.tile([-np.inf, np.inf], (len(system.state_names), 1))
    open_ = np.tile([-np.inf, np.inf], (len(system.input_names), 1))
    problem = Problem(system, np.ones(len(free)), open_, free, (1 / duration, 1.0), step, work.loaded.folder)
    runs = [replace(problem, step=s).simulate([trial]) for trial, s in present]
    states = np.concatenate([x[0] for x, _ in runs])
    inputs = np.concatenate([u[0] for _, u in runs])
    if not np.isfinite(states).all():
        raise InputError(
            f"{work.loaded.file}: learn.training: the model diverges under the present excitation, so that "
            "nothing can be said of it; train the model better, or choose `learn.design.model`"
        )
    # Up to twice the corner of the fastest pole, as far as sampling shows it, and a decade at least.
    most = min(max(problem.fastest / np.pi, 10 / duration), 0.1 / step)
    band = options.band or (1 / duration, max(most, 2 / duration))
    return replace(
        problem,
        sigma=_noise(learn, system, states.std(axis=0)),
        inputs=_input_limits(work, learn, system, inputs),
        states=np.array([_bounds(options.limits.states.get(n), -np.inf, np.inf) for n in system.state_names]),
        band=(float(band[0]), float(band[1])),
    )


def _noise(learn: LearnFromPlant, system: LagrangianSystem, spread: Array) -> Array:
    """Standard deviation of the noise on each state, ∞ where it is not measured."""
    given, sigma = learn.design.noise, np.full(len(spread), np.inf)
    for k, name in enumerate(system.state_names):
        level = given.get(name) if isinstance(given, dict) else given
        if level is not None:
            # A signal that does not move at present has no share to go by: it is measured exactly as badly.
            sigma[k] = level.std if isinstance(level, Noise) else level * (spread[k] or 1.0)
    return sigma


def _input_limits(work: Run, learn: LearnFromPlant, system: LagrangianSystem, inputs: Array) -> Array:
    """Least and greatest value of each input: as stated, else as in the present training."""
    limits = np.array(
        [
            _bounds(learn.design.limits.inputs.get(name), float(u.min()), float(u.max()))
            for name, u in zip(system.input_names, inputs.T, strict=True)
        ]
    )
    for name, (low, high) in zip(system.input_names, limits, strict=True):
        if not low < high:
            raise InputError(
                f"{work.loaded.file}: learn.design.limits.inputs: {name} goes from {low:g} to {high:g}; "
                f"expected room between them, e.g. `limits: {{inputs: {{{name}: {{min: -12, max: 12}}}}}}`"
            )
    return limits


def _bounds(given: Any, low: float, high: float) -> tuple[float, float]:
    """Limits as given, else these."""
    if given is None:
        return low, high
    return (low if given.min is None else given.min), (high if given.max is None else given.max)


# ── what comes of it ─────────────────────────────────────────────────────────────────────────────────────


def _snippet(learn: LearnFromPlant, found: Trial, problem: Problem) -> str:
    """The experiment as a part of a scenario."""
    moved = {n: v for n, v in zip(problem.system.state_names, found.start.tolist(), strict=True) if v}
    entries = [f"  - duration: {found.duration:g}", f"    step: {problem.step:g}"]
    if moved:
        entries.append(f"    start: {_flow(moved)}")
    entries.append("    inputs:")
    for name, signal in found.inputs.items():
        entries.append(
            f"      {learn.plant}.{name}: {_flow(signal.model_dump(mode='json', exclude_none=True))}"
        )
    head = "# Proposed by `exlinn design`: goes under `learn:`, in place of `training:` or as part of it.\n"
    return head + "training:\n" + "\n".join(entries) + "\n"


def _flow(values: Mapping[str, Any]) -> str:
    """A mapping in one line of YAML: JSON is YAML."""
    return json.dumps(values)


def _record(problem: Problem, found: Trial, before: Judgement, after: Judgement) -> dict[str, Any]:
    """All that `summary` tells, and what it was found for."""
    system = problem.system
    names = [p.name for p in system.parameters]

    def told(at: Judgement) -> dict[str, Any]:
        deviation = dict(zip(names, at.deviation.tolist(), strict=True))
        return {"deviation": deviation, "worst": at.worst, "a": at.a, "d": at.d}

    return {
        "present": told(before),
        "proposed": told(after),
        "improvement": before.worst / after.worst,
        "values": {p.name: p.value for p in system.parameters},
        "noise": dict(zip(system.state_names, problem.sigma.tolist(), strict=True)),
        "limits": {
            "inputs": dict(zip(system.input_names, problem.inputs.tolist(), strict=True)),
            "states": dict(zip(system.state_names, problem.states.tolist(), strict=True)),
        },
        "duration": found.duration,
        "step": problem.step,
        "inputs": {n: s.model_dump(mode="json", exclude_none=True) for n, s in found.inputs.items()},
    }

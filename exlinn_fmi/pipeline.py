"""The way data flows, on one page: scenario → data set → learned model → closed loop (many) → report.

Every stage leaves its files in the run folder and is skipped when nothing that it depends on has changed
(`stages.py`). Parts are imported where they are used: a co-simulation never loads PyTorch.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from exlinn_fmi.data.files import read_json, write_text
from exlinn_fmi.data.tables import write_rows, write_table
from exlinn_fmi.errors import ExlinnError, InputError, RunError
from exlinn_fmi.experiment import cosimulate, experiment, remove_part, store_of
from exlinn_fmi.factory import inspect
from exlinn_fmi.stages import fingerprint
from exlinn_fmi.workspace import Reporter, Run, Silent, metrics

if TYPE_CHECKING:
    from exlinn_fmi.data.dataset import Dataset


def run(work: Run, resume: bool = False) -> dict[str, Any]:
    """Do everything that the scenario asks for; the metrics are returned and stand in ``metrics.json``."""
    try:
        if work.scenario.learn is not None:
            train(work)
        if work.scenario.simulate is not None:
            simulate(work, resume)
        if work.scenario.study is not None:
            sweep(work)
    except RunError:
        # The report shows what there is so far; should it fail as well, the first error is the one to tell.
        with suppress(ExlinnError):
            report(work.folder)
        raise
    report(work.folder, work.reporter)
    return metrics(work.folder)


def collect(work: Run) -> Dataset:
    """Bring the data together, from experiments on the plant or from measured files; save the data set.

    Raises:
        InputError: the files cannot be used.
        RunError: the plant failed, or the user stopped the run; the rows so far are on disk.
    """
    from exlinn_fmi.data.dataset import load_dataset, save_dataset
    from exlinn_fmi.data.measured import import_measured
    from exlinn_fmi.scenario.learning import STRUCTURE, LearnFromData

    learn = work.learn
    coordinates = tuple(c.coordinate() for c in learn.coordinates)
    measured = [c.model_dump(mode="json", exclude=STRUCTURE) for c in learn.coordinates]
    if isinstance(learn, LearnFromData):
        detail = f"{len(learn.data.files) + len(learn.data.test)} measured files"
        key = fingerprint(learn.data, measured, work.seed, files=work.files(learn.data))
    else:
        experiments = [*learn.training, *learn.test]
        spec = work.scenario.components[learn.plant]
        detail = f"{len(experiments)} experiments on {learn.plant}"
        key = fingerprint(spec, learn.plant, measured, experiments, files=work.files(spec, experiments))
    if work.unchanged("collect", key, detail):
        dataset = load_dataset(work.folder)
        for note in dataset.notes or ():
            work.warn(note)
        work.noted("collect", **work.history["collect"])  # with what was told
        return dataset
    began = time.perf_counter()
    try:
        if isinstance(learn, LearnFromData):
            dataset = import_measured(learn.data, coordinates, work.loaded.folder, work.seed)
        else:
            dataset = experiment(work, learn)
    except ExlinnError as error:
        raise work.failed("collect", error) from None
    for note in dataset.notes or ():
        work.warn(note)
    work.done("collect", key, save_dataset(work.folder, dataset), began)
    return dataset


def train(work: Run) -> None:
    """Fit the model to the training experiments, judge it on the unseen ones, save both.

    Raises:
        RunError: no usable model came of it.
    """
    learn, dataset, seed = work.learn, collect(work), work.seed
    settings = learn.model_dump(mode="json", exclude={"design"})  # which looks at what is learned here
    key = fingerprint(settings, seed, truth(work), work.stages.key("collect"))
    if work.unchanged("train", key, f"preset {learn.method.preset}"):
        for doubt in read_json(work.folder / "model.json")["provenance"]["doubts"]:
            work.warn(doubt)
        work.noted("train", **work.history["train"])  # with what was told
        return
    from exlinn_fmi.data.dataset import split
    from exlinn_fmi.learn.card import report_card
    from exlinn_fmi.learn.train import TrainProgress
    from exlinn_fmi.learn.train import train as fit
    from exlinn_fmi.learn.weights import save_model

    def show(at: TrainProgress) -> None:
        work.reporter.update(at.fraction, f"loss {at.loss:.2e}, validation {at.validation_loss:.2e}")

    began, tests = time.perf_counter(), dataset.tests
    part, validation = split(dataset.training, learn.train_fraction, learn.split_blocks, seed)
    method, structure, objective = learn.method, learn.structure, learn.objective
    try:
        model = fit(part, validation, method, seed, show, work.stop, objective, structure)
        card = report_card(model, part, tests, learn.identify, truth(work), objective)
    except ExlinnError as error:
        raise work.failed("train", error) from None
    for doubt in model.provenance["doubts"]:
        work.warn(doubt)
    written = save_model(work.folder, model)
    written += write_table(work.folder / "evaluation", card.evaluation, card.units)
    parameters = work.folder / "parameters.csv"
    write_text(parameters, card.parameters.to_csv(index=False))
    written.append(work.folder / "curves.csv")
    write_text(written[-1], card.curves.to_csv(index=False))
    if card.terms is not None:
        written.append(work.folder / "terms.csv")
        write_text(written[-1], card.terms.to_csv(index=False))
    work.replace_metrics(("learn.", "identify."), card.metrics | card.texts)
    if work.stop.take():
        # The stage is not recorded as done: the next run trains again.
        work.warn("training was stopped: the best weights so far are used; the next run trains to the end")
        work.noted("train", "interrupted", None)
    else:
        work.done("train", key, [*written, parameters], began)


def design(work: Run) -> None:
    """Propose an excitation that tells most of the parameter known worst; save it to paste into the scenario.

    Raises:
        InputError: there is no model to count on, or no excitation keeps the limits.
    """
    from exlinn_fmi.designing import model_files, propose

    learn = work.learn
    key = fingerprint(learn, work.seed, truth(work), files=[*work.files(learn), *model_files(work)])
    if work.unchanged("design", key, f"excitation for {len(learn.identify.names)} parameters"):
        return
    began = time.perf_counter()
    try:
        written = propose(work, truth(work))
    except ExlinnError as error:
        raise work.failed("design", error) from None
    if work.stop.take():
        work.warn("the search was stopped: the best excitation so far is proposed; run it again to search on")
        work.noted("design", "interrupted", None)
    else:
        work.done("design", key, written, began)


def simulate(work: Run, resume: bool = False) -> None:
    """Step all components of the scenario in lockstep; save trajectories and judge the closed loop.

    Args:
        work: the scenario.
        resume: whether to go on from the last checkpoint of a run that was stopped or killed.

    Raises:
        InputError: there is no checkpoint to go on from.
        RunError: a component failed, or the user stopped the run; the rows so far are on disk.
    """
    scenario, span = work.scenario, work.scenario.simulate
    if span is None:
        raise InputError(f"{work.loaded.file}: this needs a `simulate` section, and the scenario has none")
    if any(uses_learned(spec) for spec in scenario.components.values()):
        train(work)
    model = [path for path in work.folder.glob("model.*") if uses_learned(scenario)]
    # What `exlinn design` is to look for has no bearing on this.
    settings = scenario.model_dump(mode="json", exclude={"learn": {"design"}})
    key = fingerprint(settings, files=[*work.files(scenario), *sorted(model)])
    detail = f"{span.stop - span.start:g} s in steps of {span.step:g} s"
    if work.unchanged("simulate", key, detail):
        remove_part(work)  # of a run that was killed when it was just done
        return
    from exlinn_fmi.components.events import MONITOR, with_events
    from exlinn_fmi.components.links import with_links
    from exlinn_fmi.results.metrics import control_metrics

    began = time.perf_counter()
    components = {name: work.component(name) for name in scenario.components}
    facts: dict[str, str] = {}
    several = sum(bool(component.facts) for component in components.values()) > 1
    for name, component in components.items():
        for what, fact in component.facts.items():
            work.reporter.note(f"{name}: {what.replace('_', ' ')}: {fact}")
            facts[f"control.{name}.{what}" if several else f"control.{what}"] = fact
        for warning in component.warnings:
            work.warn(f"{name}: {warning}")
    if scenario.events:
        components = with_events(components, scenario.events, scenario.seed, span.step)
        span = span.model_copy(update={"record": [*span.record, f"{MONITOR}.*"]})
    components = with_links(components, scenario.links())
    starts = {name: spec.starts() for name, spec in scenario.components.items()}
    store = store_of(work, span, key, resume)
    result = cosimulate(work, components, scenario.connection_list(), span, starts, store)
    stem = work.folder / "trajectories"
    written = write_rows(stem, result.frames(), result.units)
    if result.rows is not None and len(result.frame) < result.rows.rows:
        share = round(result.rows.rows / len(result.frame))
        work.warn(f"metrics and figures are made of every {share}th of {result.rows.rows} rows")
    told = result.statistics
    statistics = {f"simulate.{k}": v for k, v in told.items() if isinstance(v, int | float | str)}
    for what in ("component_seconds", "late_steps", "longest_step"):
        statistics |= {f"simulate.{what}.{name}": value for name, value in told.get(what, {}).items()}
    for name, late in told.get("late_steps", {}).items():
        if late:
            longest = told["longest_step"][name]
            work.warn(f"{name}: {late} steps took longer than `pace` leaves them, at worst {longest:.3g} s")
    judged = control_metrics(result.frame, scenario, result.units)
    work.replace_metrics(("control.", "simulate."), judged | facts | statistics)
    for name, said in told["warnings"].items():
        work.warn(f"{name}: {said['count']} warnings, the first: {said['first']}")
    if result.error is None:
        work.done("simulate", key, written, began)
    if store is not None and (result.error is None or span.checkpoint is None):
        remove_part(work)  # not before: who is killed until here goes on from the last checkpoint
    if result.error is not None:
        raise work.failed("simulate", result.error)


def sweep(work: Run) -> None:
    """Run the closed loop many times as `study` says; save each run's result and what all of them tell.

    Raises:
        InputError: the scenario has no study.
    """
    from exlinn_fmi import study as studies

    study, scenario = studies.study_of(work), work.scenario
    if any(uses_learned(spec) for spec in scenario.components.values()):
        train(work)
    model = [path for path in work.folder.glob("model.*") if uses_learned(scenario)]
    settings = scenario.model_dump(mode="json")
    # A longer study goes on with a shorter one.
    settings["study"] = study.model_dump(mode="json", exclude={"repetitions", "workers"})
    runs = fingerprint(settings, files=[*work.files(scenario), *sorted(model)])
    key = fingerprint(runs, study.repetitions)
    if work.unchanged("sweep", key, f"{study.repetitions} runs, {len(study.vary)} values drawn for each"):
        return
    began = time.perf_counter()
    try:
        frame = studies.sweep(work, runs)
    except ExlinnError as error:
        raise work.failed("sweep", error) from None
    if len(frame):
        work.replace_metrics(("study.",), studies.summary(frame))
    if work.stop.take():
        work.warn(f"the study was stopped after {len(frame)} runs; run it again to go on")
        work.noted("sweep", "interrupted", None)
    else:
        work.done("sweep", key, [work.folder / "study.csv"], began)


def report(folder: Path, reporter: Reporter | None = None) -> Path:
    """Make figures and ``report.html`` from the files of a run folder; return the report's path."""
    from exlinn_fmi.results.figures import write_figures
    from exlinn_fmi.results.report import write_report

    (reporter or Silent()).stage("report", str(folder / "report.html"))
    write_figures(folder)
    return write_report(folder)


def truth(work: Run) -> dict[str, float]:
    """Values of the plant's parameters, as far as it states them; the scenario's start values count."""
    from exlinn_fmi.scenario.learning import LearnFromPlant

    if not isinstance(work.learn, LearnFromPlant):
        return {}
    spec = work.scenario.components[work.learn.plant]
    stated = {
        v.name: v.start
        for v in inspect(spec, work.loaded.folder)
        if v.causality == "parameter" and v.start is not None
    }
    return stated | {name: value for name, value in spec.starts().items() if name in stated}


def uses_learned(section: Any) -> bool:
    """Whether a section of a scenario names the model that the scenario itself learns."""
    if hasattr(section, "model_dump"):
        section = section.model_dump()
    if isinstance(section, Mapping):
        return section.get("model") == "learned" or any(map(uses_learned, section.values()))
    return False

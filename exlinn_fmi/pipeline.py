"""The way data flows, on one page: scenario → data set → learned model → closed loop → report.

Every stage leaves its files in the run folder and is skipped when nothing that it depends on has changed
(`stages.py`). Parts are imported where they are used: a co-simulation never loads PyTorch.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from exlinn_fmi.components.base import Component
from exlinn_fmi.data.files import read_json, write_json, write_table, write_text
from exlinn_fmi.errors import ExlinnError, InputError
from exlinn_fmi.factory import build, inspect
from exlinn_fmi.interrupts import StopRequest
from exlinn_fmi.scenario.load import LoadedScenario, load_scenario, named_files
from exlinn_fmi.stages import Stages, fingerprint

if TYPE_CHECKING:
    import pandas as pd

    from exlinn_fmi.cosim.master import Trajectories
    from exlinn_fmi.data.dataset import Dataset
    from exlinn_fmi.scenario.schema import AnyLearn, Experiment, LearnFromPlant, Scenario, Simulate

COMPARED = ("L", "D")
"""Plant outputs that, where there are any of that name, the report compares the learned 𝓛 and D with."""


class Reporter(Protocol):
    """Who is told how the work goes; the command line shows it, a library user may ignore it."""

    def stage(self, name: str, detail: str) -> None:
        """A stage begins."""

    def update(self, fraction: float, text: str = "") -> None:
        """The present stage is that far (0…1)."""

    def note(self, text: str) -> None:
        """Something that the user should know, e.g. a warning."""


class Silent:
    """A reporter that says nothing."""

    def stage(self, name: str, detail: str) -> None:
        """Nothing."""

    def update(self, fraction: float, text: str = "") -> None:
        """Nothing."""

    def note(self, text: str) -> None:
        """Nothing."""


@dataclass
class Run:
    """One scenario being worked on in its folder.

    Args:
        loaded: the scenario, checked.
        folder: where results go.
        reporter: who is told of progress.
        stop: whether the user asked to stop.
    """

    loaded: LoadedScenario
    folder: Path
    reporter: Reporter = field(default_factory=Silent)
    stop: StopRequest = field(default_factory=StopRequest)
    history: dict[str, dict[str, Any]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @classmethod
    def open(
        cls,
        file: Path,
        out: Path | None = None,
        overrides: Sequence[str] = (),
        reporter: Reporter | None = None,
    ) -> Run:
        """Read and check a scenario; nothing is run or written.

        Args:
            file: the scenario file.
            out: run folder; ``runs/<scenario name>`` if not given.
            overrides: ``key.path=value`` texts.
            reporter: who is told of progress.

        Raises:
            ScenarioError: everything that is wrong with the scenario.
        """
        loaded = load_scenario(file, overrides, inspect)
        return cls(loaded, out or Path("runs") / loaded.scenario.name, reporter or Silent())

    @property
    def scenario(self) -> Scenario:
        """The scenario."""
        return self.loaded.scenario

    @property
    def stages(self) -> Stages:
        """What was done in the run folder before."""
        return Stages(self.folder)

    @property
    def learn(self) -> AnyLearn:
        """The scenario's `learn` section.

        Raises:
            InputError: it has none.
        """
        if self.scenario.learn is None:
            raise InputError(f"{self.loaded.file}: this needs a `learn` section, and the scenario has none")
        return self.scenario.learn

    @property
    def seed(self) -> int:
        """The seed of learning."""
        return self.learn.seed if self.learn.seed is not None else self.scenario.seed

    def component(self, name: str) -> Component:
        """Make a component of the scenario."""
        return build(name, self.scenario, self.loaded.folder, self.folder)

    def files(self, *sections: object) -> list[Path]:
        """Files that sections of the scenario name: what results depend on beside the settings."""
        folder = self.loaded.folder
        return [folder / name for name in named_files(*sections, folder=folder)]

    def warn(self, text: str) -> None:
        """Tell the user, and the report, of something."""
        self.warnings.append(text)
        self.reporter.note(text)

    # ── the run folder ───────────────────────────────────────────────────────────────────────────────────

    def unchanged(self, stage: str, key: str, detail: str) -> bool:
        """Whether a stage need not run again; if it must, say so and lay the run folder."""
        if stage in self.history:
            return True  # done or found unchanged a moment ago
        if self.stages.holds(stage, key):
            self.reporter.stage(stage, "unchanged since the last run")
            self.noted(stage, "cached", None)
            return True
        self.reporter.stage(stage, detail)
        self.stages.forget(stage)
        write_text(self.folder / "scenario.yaml", self.loaded.text)
        return False

    def done(self, stage: str, key: str, written: Iterable[Path], began: float) -> None:
        """Record that a stage is done."""
        seconds = time.perf_counter() - began
        self.stages.record(stage, key, written, seconds)
        self.noted(stage, "ran", seconds)

    def failed(self, stage: str, error: ExlinnError) -> ExlinnError:
        """Record that a stage failed and why; gives the error back, to be raised."""
        self.noted(stage, "failed", None, error=str(error))
        return error

    def noted(self, stage: str, status: str, seconds: float | None, **more: Any) -> None:
        """Keep ``provenance.json`` up to date: where all that is in the folder came from."""
        from exlinn_fmi.results.tables import provenance, write_provenance

        self.history[stage] = {"status": status, "seconds": seconds}
        files = self.files(self.scenario)
        record = provenance(self.loaded.file, files, self.scenario.seed, self.history)
        write_provenance(self.folder, record | {"warnings": self.warnings} | more)

    def replace_metrics(self, prefixes: tuple[str, ...], new: Mapping[str, Any]) -> None:
        """Replace the metrics that begin with one of the prefixes."""
        kept = {name: value for name, value in metrics(self.folder).items() if not name.startswith(prefixes)}
        write_json(self.folder / "metrics.json", kept | dict(new))


# ── stages ───────────────────────────────────────────────────────────────────────────────────────────────


def run(work: Run) -> dict[str, Any]:
    """Do everything that the scenario asks for; the metrics are returned and stand in ``metrics.json``."""
    if work.scenario.learn is not None:
        train(work)
    if work.scenario.simulate is not None:
        simulate(work)
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
    from exlinn_fmi.scenario.schema import LearnFromData

    learn = work.learn
    coordinates = tuple(c.coordinate() for c in learn.coordinates)
    if isinstance(learn, LearnFromData):
        detail = f"{len(learn.data.files) + len(learn.data.test)} measured files"
        key = fingerprint(learn.data, learn.coordinates, work.seed, files=work.files(learn.data))
    else:
        experiments = [*learn.training, *learn.test]
        spec = work.scenario.components[learn.plant]
        detail = f"{len(experiments)} experiments on {learn.plant}"
        key = fingerprint(
            spec, learn.plant, learn.coordinates, experiments, files=work.files(spec, experiments)
        )
    if work.unchanged("collect", key, detail):
        dataset = load_dataset(work.folder)
        for note in dataset.notes:
            work.warn(note)
        return dataset
    began = time.perf_counter()
    try:
        if isinstance(learn, LearnFromData):
            dataset = import_measured(learn.data, coordinates, work.loaded.folder, work.seed)
        else:
            dataset = experiment(work, learn)
    except ExlinnError as error:
        raise work.failed("collect", error) from None
    for note in dataset.notes:
        work.warn(note)
    work.done("collect", key, save_dataset(work.folder, dataset), began)
    return dataset


def experiment(work: Run, learn: LearnFromPlant) -> Dataset:
    """Excite the plant through the master as `learn.training` and `learn.test` say.

    Raises:
        RunError: the plant failed, or the user stopped the run; the rows so far are on disk.
    """
    from exlinn_fmi.data.dataset import Dataset

    runs: list[Trajectories] = []
    for spec in (*learn.training, *learn.test):
        runs.append(excite(work, learn, spec))
        if runs[-1].error is not None:
            write_table(work.folder / "dataset", table(learn, runs), units(learn, runs[0]))
            raise runs[-1].error
    coordinates = tuple(c.coordinate() for c in learn.coordinates)
    columns = {str(name): values.to_numpy() for name, values in table(learn, runs).items()}
    held_out = tuple(range(len(learn.training), len(runs)))
    return replace(Dataset.from_columns(columns, coordinates, units(learn, runs[0])), held_out=held_out)


def train(work: Run) -> None:
    """Fit the model to the training experiments, judge it on the unseen ones, save both.

    Raises:
        RunError: no usable model came of it.
    """
    learn, dataset, seed = work.learn, collect(work), work.seed
    key = fingerprint(learn, seed, truth(work), work.stages.key("collect"))
    if work.unchanged("train", key, f"preset {learn.method.preset}"):
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
    model = fit(part, validation, learn.method, seed, show, work.stop)
    written = save_model(work.folder, model)
    card = report_card(model, part, tests, learn.identify, truth(work))
    written += write_table(work.folder / "evaluation", card.evaluation, card.units)
    parameters = work.folder / "parameters.csv"
    write_text(parameters, card.parameters.to_csv(index=False))
    work.replace_metrics(("learn.", "identify."), card.metrics)
    if work.stop.take():
        # The stage is not recorded as done: the next run trains again.
        work.warn("training was stopped: the best weights so far are used; the next run trains to the end")
        work.noted("train", "interrupted", None)
    else:
        work.done("train", key, [*written, parameters], began)


def simulate(work: Run) -> None:
    """Step all components of the scenario in lockstep; save trajectories and judge the closed loop.

    Raises:
        RunError: a component failed, or the user stopped the run; the rows so far are on disk.
    """
    scenario, span = work.scenario, work.scenario.simulate
    if span is None:
        raise InputError(f"{work.loaded.file}: this needs a `simulate` section, and the scenario has none")
    if any(uses_learned(spec) for spec in scenario.components.values()):
        train(work)
    model = [path for path in work.folder.glob("model.*") if uses_learned(scenario)]
    key = fingerprint(scenario, files=[*work.files(scenario), *sorted(model)])
    detail = f"{span.stop - span.start:g} s in steps of {span.step:g} s"
    if work.unchanged("simulate", key, detail):
        return
    from exlinn_fmi.results.metrics import control_metrics

    began = time.perf_counter()
    components = {name: work.component(name) for name in scenario.components}
    for name, component in components.items():
        for warning in getattr(component, "warnings", ()):
            work.warn(f"{name}: {warning}")
    starts = {name: spec.start for name, spec in scenario.components.items()}
    result = cosimulate(work, components, scenario.connection_list(), span, starts)
    written = write_table(work.folder / "trajectories", result.frame, result.units)
    statistics = {f"simulate.{k}": v for k, v in result.statistics.items() if isinstance(v, int | float)}
    judged = control_metrics(result.frame, scenario, result.units)
    work.replace_metrics(("control.", "simulate."), judged | statistics)
    for name, said in result.statistics["warnings"].items():
        work.warn(f"{name}: {said['count']} warnings, the first: {said['first']}")
    if result.error is not None:
        raise work.failed("simulate", result.error)
    work.done("simulate", key, written, began)


def report(folder: Path, reporter: Reporter | None = None) -> Path:
    """Make figures and ``report.html`` from the files of a run folder; return the report's path."""
    from exlinn_fmi.results.figures import write_figures
    from exlinn_fmi.results.report import write_report

    (reporter or Silent()).stage("report", str(folder / "report.html"))
    write_figures(folder)
    return write_report(folder)


# ── what the stages share ────────────────────────────────────────────────────────────────────────────────


def cosimulate(
    work: Run,
    components: Mapping[str, Component],
    connections: Sequence[tuple[str, str]],
    span: Simulate,
    starts: Mapping[str, Mapping[str, float]],
) -> Trajectories:
    """Step components in lockstep over `span`, with progress and Ctrl-C minded."""
    from exlinn_fmi.cosim.graph import Graph
    from exlinn_fmi.cosim.master import Master

    specs = work.scenario.components
    own_steps = {name: step for name in components if name in specs and (step := specs[name].step)}
    graph = Graph(components, connections)
    master = Master(graph, span.start, span.stop, span.step, own_steps, span.algorithm, span.record)
    return master.run(starts, lambda part, t: work.reporter.update(part, f"t = {t:.3f} s"), work.stop)


def excite(work: Run, learn: LearnFromPlant, experiment: Experiment) -> Trajectories:
    """Run one experiment on the plant: a source on each driven input, all that learning needs recorded."""
    from exlinn_fmi.components.signals import SignalSource
    from exlinn_fmi.scenario.schema import Simulate

    plant = learn.plant
    components = {plant: work.component(plant)}
    connections = []
    for k, (target, signal) in enumerate(experiment.inputs.items()):
        components[f"source_{k}"] = SignalSource(f"source_{k}", signal, work.loaded.folder)
        connections.append((f"source_{k}.y", target))
    outputs = {v.name for v in components[plant].variables if v.causality == "output"}
    paths = [p for c in learn.coordinates for p in (c.position, c.velocity, c.acceleration, c.input) if p]
    paths += [f"{plant}.{name}" for name in COMPARED if name in outputs]
    span = Simulate(stop=experiment.duration, step=experiment.step, record=list(dict.fromkeys(paths)))
    starts = {plant: {**work.scenario.components[plant].start, **experiment.start}}
    return cosimulate(work, components, connections, span, starts)


def table(learn: LearnFromPlant, runs: Sequence[Trajectories]) -> pd.DataFrame:
    """All experiments in one table: trajectory number, time, and the plant's variables by their own names."""
    import pandas as pd

    frames = [run.frame.rename(columns=lambda name: name.removeprefix(f"{learn.plant}.")) for run in runs]
    for number, frame in enumerate(frames):
        frame.insert(0, "trajectory", number)
    return pd.concat(frames, ignore_index=True)


def units(learn: LearnFromPlant, run: Trajectories) -> dict[str, str]:
    """Units of the columns of `table`."""
    return {name.removeprefix(f"{learn.plant}."): unit for name, unit in run.units.items()}


def truth(work: Run) -> dict[str, float]:
    """Values of the plant's parameters, as far as it states them; the scenario's start values count."""
    from exlinn_fmi.scenario.schema import LearnFromPlant

    if not isinstance(work.learn, LearnFromPlant):
        return {}
    spec = work.scenario.components[work.learn.plant]
    stated = {
        v.name: v.start
        for v in inspect(spec, work.loaded.folder)
        if v.causality == "parameter" and v.start is not None
    }
    return stated | {name: float(value) for name, value in spec.start.items() if name in stated}


def uses_learned(section: Any) -> bool:
    """Whether a section of a scenario names the model that the scenario itself learns."""
    if hasattr(section, "model_dump"):
        section = section.model_dump()
    if isinstance(section, Mapping):
        return section.get("model") == "learned" or any(map(uses_learned, section.values()))
    return False


def metrics(folder: Path) -> dict[str, Any]:
    """The metrics of a run folder by name, {} where there are none yet."""
    file = folder / "metrics.json"
    found: dict[str, Any] = read_json(file) if file.exists() else {}
    return found

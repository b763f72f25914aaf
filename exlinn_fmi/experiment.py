"""Experiments: components stepped in lockstep, and a plant excited so that a model can be learned of it."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from exlinn_fmi.components.base import Component, Number
from exlinn_fmi.data.tables import write_table
from exlinn_fmi.workspace import Run

if TYPE_CHECKING:
    import pandas as pd

    from exlinn_fmi.cosim.master import Trajectories
    from exlinn_fmi.cosim.store import Store
    from exlinn_fmi.data.dataset import Dataset
    from exlinn_fmi.scenario.learning import Experiment, LearnFromPlant
    from exlinn_fmi.scenario.schema import Simulate

PART = "simulate.part"
"""Folder of a run that goes on, in its run folder: checkpoints and rows."""

COMPARED = ("L", "D")
"""Plant outputs that, where there are any of that name, the report compares the learned 𝓛 and D with."""


def cosimulate(
    work: Run,
    components: Mapping[str, Component],
    connections: Sequence[tuple[str, str]],
    span: Simulate,
    starts: Mapping[str, Mapping[str, Number]],
    store: Store | None = None,
) -> Trajectories:
    """Step components in lockstep over `span`, with progress and Ctrl-C minded."""
    from exlinn_fmi.cosim.adaptive import AdaptiveOptions
    from exlinn_fmi.cosim.extrapolation import ExtrapolationOptions
    from exlinn_fmi.cosim.graph import Graph
    from exlinn_fmi.cosim.loops import LoopOptions
    from exlinn_fmi.cosim.master import Master

    specs = work.scenario.components
    own_steps = {name: step for name in components if name in specs and (step := specs[name].step)}
    graph = Graph(components, connections)
    loops = span.loop_settings
    master = Master(
        graph,
        span.start,
        span.stop,
        span.step,
        own_steps,
        span.algorithm,
        span.record,
        profile=span.profile,
        record_every=span.record_every,
        loops=LoopOptions(**loops.model_dump()) if loops else None,
        extrapolation=ExtrapolationOptions(**span.extrapolation.model_dump()) if span.extrapolation else None,
        adaptive=AdaptiveOptions(**span.adaptive.model_dump()) if span.adaptive else None,
    )
    report = lambda part, t: work.reporter.update(part, f"t = {t:.3f} s")  # noqa: E731
    return master.run(starts, report, work.stop, store, span.pace)


def store_of(work: Run, span: Simulate, key: str, resume: bool) -> Store | None:
    """Where a run keeps its rows, None where they stay in memory."""
    from exlinn_fmi.cosim.store import Store

    if span.stream is False and span.checkpoint is None and not resume:
        return None
    return Store(work.folder / PART, span.checkpoint, key, resume, always=bool(span.stream))


def remove_part(work: Run) -> None:
    """Remove what a run has kept on disk while it went on."""
    shutil.rmtree(work.folder / PART, ignore_errors=True)


def experiment(work: Run, learn: LearnFromPlant) -> Dataset:
    """Excite the plant through the master as `learn.training` and `learn.test` say.

    Raises:
        DataError: nothing can be learned from what the plant did; the rows are on disk.
        RunError: the plant failed, or the user stopped the run; the rows so far are on disk.
    """
    from exlinn_fmi.data.dataset import Dataset
    from exlinn_fmi.data.doubts import audit
    from exlinn_fmi.data.integration import euler_steps
    from exlinn_fmi.errors import DataError

    runs: list[Trajectories] = []
    for spec in (*learn.training, *learn.test):
        runs.append(excite(work, learn, spec))
        if runs[-1].error is not None:
            write_table(work.folder / "dataset", table(learn, runs), units(learn, runs[0]))
            raise runs[-1].error
    coordinates = tuple(c.coordinate() for c in learn.coordinates)
    columns = {str(name): values.to_numpy() for name, values in table(learn, runs).items()}
    held_out = tuple(range(len(learn.training), len(runs)))
    names = [f"learn.{key}[{k}]" for key in ("training", "test") for k in range(len(getattr(learn, key)))]
    try:
        dataset = replace(
            Dataset.from_columns(columns, coordinates, units(learn, runs[0])), held_out=held_out
        )
        return replace(dataset, notes=(*audit(dataset, names), *euler_steps(dataset)))
    except DataError:
        write_table(work.folder / "dataset", table(learn, runs), units(learn, runs[0]))
        raise


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
    starts = {plant: {**work.scenario.components[plant].starts(), **experiment.start}}
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

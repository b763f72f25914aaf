"""Robustness studies: the closed loop run many times, with values of the scenario drawn at random.

Each run is drawn from the seed and its own number alone, so that a study can be stopped, gone on with and
lengthened. Results so far stand in ``study.csv``; what they depend on, in ``study.json``.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from exlinn_fmi.data.files import read_json, write_json, write_text
from exlinn_fmi.errors import ExlinnError, InputError, RunError, nearest
from exlinn_fmi.experiment import cosimulate
from exlinn_fmi.factory import inspect
from exlinn_fmi.scenario.study import Choice, Distribution, Normal, Range, Relative, Study
from exlinn_fmi.workspace import Run

if TYPE_CHECKING:
    import pandas as pd

NUMBER, SUCCESS, ERROR = "run", "success", "error"
"""Columns of ``study.csv`` beside what was drawn and what came of it."""
PERCENTILES = (50, 90, 95)


def draw(study: Study, nominal: Mapping[str, float], number: int) -> dict[str, Any]:
    """The values of one run, by key path.

    Args:
        study: what varies.
        nominal: the value that a relative distribution is around, by key path.
        number: of the run.
    """
    return {
        path: _one(distribution, nominal.get(path, 0.0), np.random.default_rng([study.seed, number, k]))
        for k, (path, distribution) in enumerate(study.vary.items())
    }


def _one(distribution: Distribution, nominal: float, random: np.random.Generator) -> Any:
    if isinstance(distribution, Choice):
        return distribution.values[int(random.integers(len(distribution.values)))]
    if isinstance(distribution, Range):
        return float(random.uniform(distribution.min, distribution.max))
    if isinstance(distribution, Normal):
        return float(random.normal(distribution.mean, distribution.std))
    share = random.uniform(-1.0, 1.0) if distribution.shape == "uniform" else random.normal()
    return float(nominal * (1.0 + distribution.relative * share))


def nominals(work: Run) -> dict[str, float]:
    """The values that relative distributions are around: the scenario's, else the component's own.

    Raises:
        InputError: there is no such number.
    """
    study, plain = study_of(work), work.scenario.model_dump(mode="json")
    found: dict[str, float] = {}
    for path, distribution in study.vary.items():
        if isinstance(distribution, Relative):
            value = _look_up(plain, path.split("."))
            value = _start(work, path) if value is None else value
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise InputError(
                    f"{work.loaded.file}: study.vary.{path}: there is no number to vary by a share of it; "
                    "give the scenario one, or `min` and `max`"
                )
            found[path] = float(value)
    return found


def _look_up(section: Any, keys: list[str]) -> Any:
    """What stands at a key path, None where nothing does."""
    for key in keys:
        if isinstance(section, list) and key.isdigit() and int(key) < len(section):
            section = section[int(key)]
        elif isinstance(section, dict):
            section = section.get(key)
        else:
            return None
    return section


def _start(work: Run, path: str) -> float | None:
    """Start value that a component states for itself, for a path ``components.NAME.start.VARIABLE``."""
    parts = path.split(".", 3)
    spec = work.scenario.components.get(parts[1]) if len(parts) == 4 else None
    if spec is None or parts[2] != "start":
        return None
    return next((v.start for v in inspect(spec, work.loaded.folder) if v.name == parts[3]), None)


def study_of(work: Run) -> Study:
    """The scenario's `study` section.

    Raises:
        InputError: it has none, or nothing to run.
    """
    for section in ("study", "simulate"):
        if getattr(work.scenario, section) is None:
            raise InputError(
                f"{work.loaded.file}: this needs a `{section}` section, and the scenario has none"
            )
    assert work.scenario.study is not None
    return work.scenario.study


def sweep(work: Run, key: str) -> pd.DataFrame:
    """Run what is not done yet, in several processes, and write each result as it comes.

    Args:
        work: the scenario, whose model is learned.
        key: what results depend on; those under another key are not gone on with.

    Returns:
        One row for each run that is done, by number.

    Raises:
        InputError: what `success` names is not judged.
        RunError: a run ended its process.
    """
    import pandas as pd

    study, around = study_of(work), nominals(work)
    rows = {row[NUMBER]: row for row in _done(work.folder, key) if row[NUMBER] < study.repetitions}
    left = [n for n in range(study.repetitions) if n not in rows]
    _record(work.folder, key, rows)
    workers = min(study.workers or os.cpu_count() or 1, max(1, len(left)))
    for row in _runs(work, study, around, left, workers):
        judged = [name.removeprefix("control.") for name in row if name.startswith("control.")]
        for name in [] if row[ERROR] else study.success:
            if name not in judged:
                hint = nearest(name, judged, "metrics of the closed loop")
                raise InputError(f"{work.loaded.file}: study.success.{name}: no such metric; {hint}")
        rows[row[NUMBER]] = row
        _record(work.folder, key, rows)
        good = sum(bool(r[SUCCESS]) for r in rows.values())
        work.reporter.update(len(rows) / study.repetitions, f"{len(rows)} runs, {good} successes")
    return pd.DataFrame([rows[number] for number in sorted(rows)])


def _runs(
    work: Run, study: Study, around: Mapping[str, float], left: Iterable[int], workers: int
) -> Iterator[dict[str, Any]]:
    """Rows of runs as they end; Ctrl-C lets those under way end, and starts no more."""
    jobs = iter(left)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_quiet) as pool:
        pending: set[Future[dict[str, Any]]] = set()
        while True:
            while len(pending) < workers and not work.stop() and (number := next(jobs, None)) is not None:
                drawn = draw(study, around, number)
                overrides = [*work.loaded.overrides, f"seed={study.seed + number}"]
                overrides += [f"{path}={json.dumps(value)}" for path, value in drawn.items()]
                pending.add(pool.submit(one, work.loaded.file, work.folder, overrides, number, drawn))
            if not pending:
                return
            ended, pending = wait(pending, return_when=FIRST_COMPLETED)
            for job in ended:
                try:
                    yield job.result()
                except BrokenProcessPool:
                    raise RunError(
                        "a run of the study ended its process, as an FMU that crashes does; run such an FMU "
                        "apart (`isolate: true`), then the run alone fails"
                    ) from None


def _quiet() -> None:
    """Ctrl-C is for the process that hands out the work."""
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)


def one(
    file: Path, folder: Path, overrides: list[str], number: int, drawn: Mapping[str, Any]
) -> dict[str, Any]:
    """One run: the closed loop with values drawn, judged.

    Args:
        file: the scenario.
        folder: where the learned model is; nothing is written there.
        overrides: what makes this run.
        number: of the run.
        drawn: the values that were drawn, by key path.

    Returns:
        Number, drawn values, metrics of the closed loop, whether it was a success, and the error if any.
    """
    from exlinn_fmi.results.metrics import control_metrics

    judged: dict[str, float] = {}
    most: Mapping[str, float] = {}
    error = ""
    try:
        work = Run.open(file, folder, overrides)
        scenario, span = work.scenario, work.scenario.simulate
        assert span is not None
        most = study_of(work).success
        components = {name: work.component(name) for name in scenario.components}
        starts = {name: spec.starts() for name, spec in scenario.components.items()}
        result = cosimulate(work, components, scenario.connection_list(), span, starts)
        judged = control_metrics(result.frame, scenario, result.units)
        error = "" if result.error is None else str(result.error)
    except ExlinnError as failed:
        error = str(failed)
    kept = {
        name: value for name, value in judged.items() if "solve_ms" not in name and "feedback_ms" not in name
    }
    success = not error and all(kept.get(f"control.{key}", math.inf) <= most[key] for key in most)
    return {NUMBER: number, **drawn, **kept, SUCCESS: float(success), ERROR: error}


def summary(frame: pd.DataFrame) -> dict[str, float]:
    """What a study tells: share of successes with its 95 % interval, percentiles of what was judged.

    Args:
        frame: one row for each run.
    """
    count, good = len(frame), float(frame[SUCCESS].sum())
    low, high = wilson(good, count)
    found = {
        "study.runs": float(count),
        "study.success_rate": good / count,
        "study.success_rate_low": low,
        "study.success_rate_high": high,
        "study.failed": float((frame[ERROR].fillna("") != "").sum()),
    }
    for column in map(str, frame.columns):
        name = column.removeprefix("control.")
        values = frame[column].to_numpy()
        if name == column:
            continue
        values = values[np.isfinite(values.astype(float))].astype(float)
        if not values.size:
            continue
        if name.startswith(("rmse_", "max_error_")):
            found |= {f"study.{name}_p{p}": float(np.percentile(values, p)) for p in PERCENTILES}
            found[f"study.{name}_max"] = float(values.max())
        elif name in ("violations", "fallbacks"):
            found[f"study.runs_with_{name}"] = float(np.count_nonzero(values))
        elif name == "decrease":
            found["study.decrease_p50"] = float(np.median(values))
            found["study.decrease_min"] = float(values.min())
    return found


def wilson(good: float, count: int) -> tuple[float, float]:
    """95 % interval of a share (E. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Args:
        good: number of successes.
        count: number of trials.
    """
    z = 1.959963984540054
    share, spread = good / count, z**2 / count
    centre = (share + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(share * (1 - share) / count + spread / (4 * count))
    return 0.0 if good == 0 else centre - half, 1.0 if good == count else centre + half


# ── on disk ──────────────────────────────────────────────────────────────────────────────────────────────


def _record(folder: Path, key: str, rows: Mapping[int, Mapping[str, Any]]) -> None:
    """Write what is done so far, whole."""
    import pandas as pd

    frame = pd.DataFrame([rows[number] for number in sorted(rows)])
    write_text(folder / "study.csv", frame.to_csv(index=False) if len(frame) else f"{NUMBER}\n")
    write_json(folder / "study.json", {"key": key, "runs": [dict(rows[number]) for number in sorted(rows)]})


def _done(folder: Path, key: str) -> list[dict[str, Any]]:
    """Rows of runs that were done under this key."""
    file = folder / "study.json"
    record = read_json(file) if file.exists() else {}
    rows: list[dict[str, Any]] = record.get("runs", []) if record.get("key") == key else []
    return rows

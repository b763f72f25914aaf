"""Training of an extended Lagrangian model on the inverse-model residual, whichever the learner."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset, required_columns
from exlinn_fmi.data.doubts import audit
from exlinn_fmi.errors import TrainingError
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.verdict import NOTHING, POOR, judge
from exlinn_fmi.mechanics.coordinates import input_names, state_names
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import ModelSpec, learned_system
from exlinn_fmi.mechanics.structure import UNKNOWN, Structure
from exlinn_fmi.scenario.learning import Objective, Paper, Structured, Terms

Status = Literal["converged", "iterations", "interrupted"]
ADVICE = (
    "check the columns of the data, their signs and units, and whether `coordinates` are those of the plant"
)
HISTORY = ["iteration", "stage", "loss", "validation_loss", "seconds"]
"""Columns of the training history."""


class TrainProgress(NamedTuple):
    """How far training is.

    Args:
        iteration: iterations (or epochs) done.
        total: the most there will be.
        loss: mean square of the residual on the training data.
        validation_loss: the same on the validation data.
    """

    iteration: int
    total: int
    loss: float
    validation_loss: float

    @property
    def fraction(self) -> float:
        """Share of the work that is done at most."""
        return min(self.iteration / self.total, 1.0)


@dataclass(frozen=True)
class TrainedModel:
    """A learned model: what it is, its weights, and how it came about.

    Args:
        spec: everything but the weights.
        weights: arrays by name.
        history: one row for each iteration, columns `HISTORY`.
        status: ``converged``: nothing more was to be gained; ``iterations``: all that were allowed are done;
            ``interrupted``: stopped by the user. The weights are the best on the validation data in any case.
        seconds: training time [s].
        provenance: seed, settings, losses, hash of the data and the range of each state and input in them.
    """

    spec: ModelSpec
    weights: dict[str, NDArray[np.float64]]
    history: pd.DataFrame
    status: Status
    seconds: float
    provenance: dict[str, Any]

    @cached_property
    def system(self) -> LagrangianSystem:
        """The model's equations of motion."""
        return learned_system(self.spec, self.weights)


def train(
    train: Dataset,
    validation: Dataset,
    method: Structured | Terms | Paper,
    seed: int,
    progress: Callable[[TrainProgress], None] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    objective: Objective = "auto",
    structure: Structure = UNKNOWN,
) -> TrainedModel:
    """Fit a model; keep the weights that are best on the validation data.

    Args:
        train: data to fit.
        validation: data to watch.
        method: the learner and its settings.
        seed: of the first weights and of batches.
        progress: told after each iteration.
        should_stop: asked after each iteration; the best weights so far are kept then.
        objective: what a learner that has the choice makes small.
        structure: what is known of the plant's energies, friction and constant forces.

    Raises:
        DataError: nothing can be learned from the data.
        TrainingError: the loss is not finite from the start, or the model predicts nothing.
    """
    told = audit(train)
    # Notes are on the whole recordings, of which these may be a part.
    doubts = list(told if train.notes is None else train.notes)
    began = time.perf_counter()
    best: Iterate | None = None
    status: Status = "converged"
    rows: list[tuple[int, str, float, float, float]] = []
    with _solvable():
        spec, iterates, total = _learner(train, validation, method, seed, objective, structure)
        for number, now in enumerate(iterates):
            rows.append((number, now.stage, now.loss, now.validation_loss, time.perf_counter() - began))
            if math.isfinite(now.validation_loss) and (best is None or now.rank < best.rank):
                best = now
            if progress is not None:
                progress(TrainProgress(number, total, now.loss, now.validation_loss))
            status = "iterations" if number >= total else "converged"
            if should_stop():
                status = "interrupted"
                break
    if best is None:
        raise TrainingError(
            "the loss was not finite in any iteration; check the data's units and columns for outliers"
        )
    provenance = {
        "method": method.model_dump(mode="json"),
        "seed": seed,
        "loss": best.loss,
        "validation_loss": best.validation_loss,
        "samples": len(train),
        "data_sha256": _data_hash(train),
        "ranges": _ranges(train),
        "doubts": doubts,
        **best.notes,
    }
    history = pd.DataFrame(rows, columns=HISTORY)
    model = TrainedModel(spec, best.weights, history, status, time.perf_counter() - began, provenance)
    verdict = judge(model.system, train)
    if verdict.error >= NOTHING and status != "interrupted":
        raise TrainingError(f"{verdict}: it has learned nothing; {ADVICE}")
    if verdict.error >= POOR:
        doubts.append(f"{verdict}; {ADVICE}")
    return model


@contextmanager
def _solvable() -> Iterator[None]:
    """A solve that breaks down is told of as what it is: data that determine no model."""
    try:
        with np.errstate(all="ignore"):  # what comes of it is judged in the end
            yield
    except np.linalg.LinAlgError as error:
        raise TrainingError(
            f"the equations of motion of these data cannot be solved ({error}): they determine no model; "
            f"{ADVICE}"
        ) from error


def _learner(
    train: Dataset,
    validation: Dataset,
    method: Structured | Terms | Paper,
    seed: int,
    objective: Objective,
    structure: Structure,
) -> tuple[ModelSpec, Iterator[Iterate], int]:
    """The model, its iterates, and the most iterations."""
    if isinstance(method, Paper):
        from exlinn_fmi.learn.paper import (  # PyTorch is loaded here and nowhere else
            iterate_paper,
            paper_spec,
        )

        spec = paper_spec(train, method)
        return spec, iterate_paper(spec, train, validation, method, seed), method.epochs
    if isinstance(method, Terms):
        from exlinn_fmi.learn.terms import STAGES, iterate_terms, terms_spec

        spec = terms_spec(train, method, structure)
        return spec, iterate_terms(spec, train, validation, objective, method), STAGES
    from exlinn_fmi.learn.structured import begin, iterate_structured, most_iterations, structured_spec

    spec, start = structured_spec(train, method, seed, structure, begin(objective, train, validation))
    iterates = iterate_structured(spec, start, train, validation, method, objective)
    return spec, iterates, most_iterations(method, objective, train)


def _ranges(train: Dataset) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of each state and input."""
    names = [*state_names(train.coordinates), *input_names(train.coordinates)]
    return {name: (float(train.frame[name].min()), float(train.frame[name].max())) for name in names}


def _data_hash(dataset: Dataset) -> str:
    """SHA-256 of the values that were trained on."""
    values = dataset.frame[required_columns(dataset.coordinates)].to_numpy(dtype=float)
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()

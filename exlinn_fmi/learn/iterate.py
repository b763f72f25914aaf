"""What every learner yields after each iteration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Iterate:
    """Weights after an iteration.

    Args:
        weights: arrays by name.
        loss: mean square of the residual on the training data.
        validation_loss: the same on the validation data.
        stage: what the learner is doing.
        step: iterates of a later step are preferred whatever their validation loss.
        notes: what the user should know of them: into the model's provenance.
        proper: whether the mass matrix is positive definite throughout the data, as a forward model needs.
        score: what iterates of one step are preferred by, where it is not both losses.
    """

    weights: dict[str, NDArray[np.float64]]
    loss: float
    validation_loss: float
    stage: str
    proper: bool = True
    step: int = 0
    notes: Mapping[str, Any] = field(default_factory=dict)
    score: float | None = None

    @property
    def rank(self) -> tuple[bool, int, float]:
        """The smaller the better: proper first, then by step of the work, then by score or product of losses.

        A validation block at the edge of the data asks for what training never saw: there the best of models
        may be as far off as a poor one, and only the training loss tells them apart. Where noise is fitted,
        it is the validation loss that grows by much.
        """
        score = self.loss * self.validation_loss if self.score is None else self.score
        return (not self.proper, -self.step, score)

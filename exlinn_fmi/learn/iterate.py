"""What every learner yields after each iteration."""

from __future__ import annotations

from dataclasses import dataclass

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
        proper: whether the mass matrix is positive definite throughout the data, as a forward model needs.
    """

    weights: dict[str, NDArray[np.float64]]
    loss: float
    validation_loss: float
    stage: str
    proper: bool = True

    @property
    def rank(self) -> tuple[bool, float]:
        """The smaller the better: proper first, then by validation loss."""
        return (not self.proper, self.validation_loss)

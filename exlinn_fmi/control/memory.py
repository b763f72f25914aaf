"""What a controller remembers from one tick to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.control.dropout import Heard
from exlinn_fmi.control.estimator import Belief
from exlinn_fmi.control.reference import References
from exlinn_fmi.control.solver import Plan


@dataclass(frozen=True)
class Memory:
    """What one tick hands to the next.

    Args:
        time: of the coming tick [s].
        branch: branch of the references' kinematics, None before the first measurement.
        plan: guess for the coming tick, None where there is none.
        coming: reference of the coming tick, None where nothing is prepared.
        left: how many inputs of the plan are left to fall back on.
        references: the last reference.
        belief: what is expected of the state that the coming measurements tell of, None where nothing is.
        applied: the last input that was found.
        heard: what came of the measurements so far.
        fallbacks: how often a fallback was needed so far.
        cost: last cost.
        stage: its first term.
        P: terminal weight of the last solve, without that factor.
        error: state less reference that it expects at the coming tick.
        kkt: last KKT residual.
        slack: last violation of a state bound.
        end: last terminal cost, without what it is multiplied by for the terminal set.
        level: α of that set.
    """

    time: float = 0.0
    branch: tuple[int, ...] | None = None
    plan: Plan | None = None
    coming: References | None = None
    left: int = 0
    references: References | None = None
    belief: Belief | None = None
    applied: NDArray[np.float64] | None = None
    heard: Heard | None = None
    fallbacks: int = 0
    cost: float = 0.0
    stage: float = 0.0
    P: NDArray[np.float64] | None = None
    error: NDArray[np.float64] | None = None
    kkt: float = 0.0
    slack: float = 0.0
    end: float = 0.0
    level: float = 0.0

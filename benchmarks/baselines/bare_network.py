"""Our structured form left to its hidden neurons alone, without the direct path from the features.

The direct path holds this plant exactly, so that the default learner never asks its neurons. Here they must
carry all that depends on the position, as in the paper: four of them, but smooth.
"""

from __future__ import annotations

import numpy as np

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.assembly import inverse_assembly
from exlinn_fmi.learn.levenberg import levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.objective import Inverse, Objective
from exlinn_fmi.learn.refine import FLOOR
from exlinn_fmi.learn.structured import structured_spec
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import learned_system
from exlinn_fmi.scenario.learning import Structured

HIDDEN = 4
EVERY = 5
"""Every so manieth row is trained on."""
FIRST = 0.1
"""Size of the first output weights, relative to the constants."""
DECAY = 1e-24
"""λ of the L2 term: directions that the residual leaves free need some curvature."""


def bare_network(data: Dataset, seed: int, iterations: int) -> LagrangianSystem:
    """Train by Levenberg–Marquardt on the inverse-model residual.

    Args:
        data: what to train on.
        seed: of the first weights.
        iterations: most accepted steps.
    """
    spec, start = structured_spec(data, Structured(preset="structured", hidden=HIDDEN), seed)
    networks = StructuredNetworks(spec)
    direct = slice(1, spec.layout.basis - spec.layout.hidden)
    masks = spec.layout.free
    masks["lagrangian.output"][:, direct] = False
    part = StructuredNetworks(spec, networks.pack_mask(masks))
    weights = {name: w.copy() for name, w in start.weights.items()}
    output, random = weights["lagrangian.output"], np.random.default_rng(seed)
    output[:, direct.stop :] = (
        FIRST * np.abs(output[:, :1]).max() * random.standard_normal((len(output), HIDDEN))
    )
    samples = inverse_assembly(spec, data.arrays).part(slice(None, None, EVERY))
    objective = Objective(Inverse(part, samples), DECAY)
    best = part.pack(weights)
    descent = levenberg_marquardt(best, objective.linearise, objective.value, FLOOR)
    for step, _ in zip(descent, range(iterations), strict=False):
        best = step.theta
    return learned_system(spec, part.unpack(best))

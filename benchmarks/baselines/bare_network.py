"""Our structured form left to its hidden neurons alone, without the direct path from the features.

The direct path holds this plant exactly, so that the default learner never asks its neurons. Here they must
carry all that depends on the position, as in the paper: four of them, but smooth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.assembly import Assembly, inverse_assembly
from exlinn_fmi.learn.levenberg import Normal, levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.structured import structured_spec
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import learned_system
from exlinn_fmi.scenario.learning import Structured

HIDDEN = 4
EVERY = 5
"""Every so manieth row is trained on."""
FIRST = 0.1
"""Size of the first output weights, relative to the constants."""
DECAY = 1e-16
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
    chosen = networks.pack_mask(masks)
    weights = {name: w.copy() for name, w in start.weights.items()}
    output, random = weights["lagrangian.output"], np.random.default_rng(seed)
    output[:, direct.stop :] = (
        FIRST * np.abs(output[:, :1]).max() * random.standard_normal((len(output), HIDDEN))
    )
    first = networks.pack(weights) * chosen
    samples = inverse_assembly(spec, data.arrays).part(slice(None, None, EVERY))

    def full(theta: NDArray) -> NDArray:
        all_of_them = np.zeros(len(chosen))
        all_of_them[chosen] = theta
        return all_of_them

    def normal(theta: NDArray) -> Normal:
        return _normal(networks, full(theta), samples, chosen)

    def value(theta: NDArray) -> float:
        with np.errstate(all="ignore"):
            square = np.mean(networks.residual(full(theta), samples) ** 2)
        return float(square) + DECAY * float(theta @ theta)

    best = first[chosen]
    for step, _ in zip(levenberg_marquardt(best, normal, value), range(iterations), strict=False):
        best = step.theta
    return learned_system(spec, networks.unpack(full(best)))


def _normal(networks: StructuredNetworks, theta: NDArray, samples: Assembly, chosen: NDArray) -> Normal:
    r, j = networks.jacobian(theta, samples)
    part, j = theta[chosen], j[:, :, chosen].reshape(-1, chosen.sum())
    count = r.size
    return Normal(
        float(np.mean(r**2)) + DECAY * float(part @ part),
        r.ravel() @ j / count + DECAY * part,
        j.T @ j / count + DECAY * np.eye(len(part)),
    )

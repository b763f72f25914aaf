"""The structured networks as the plain numbers that the kernel reads: `network_open` in kernel/network.h."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.layout import Layout
from exlinn_fmi.mechanics.learned import Networks, angular, friction_width, hidden_layers

MOST_COORDINATES = 8
"""What the kernel has room for."""


def pack_networks(
    system: LagrangianSystem, driven: Sequence[int] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Integers (sizes and index lists) and numbers (scales and weights) of a system's networks.

    Args:
        system: any.
        driven: coordinates that inputs act on; those of the system's inputs if not given.

    Returns:
        None where the system is not made of structured networks, or is too large for the kernel.
    """
    networks = system.networks
    if networks is None or system.n > MOST_COORDINATES:
        return None
    layout = networks.spec.layout
    if driven is None:
        driven = [i for i, c in enumerate(system.coordinates) if c.input is not None]
    return _integers(networks, layout, driven), _numbers(networks, layout)


def _integers(networks: Networks, layout: Layout, driven: Sequence[int]) -> NDArray[np.int64]:
    coordinates = networks.spec.coordinates
    n, positions = len(coordinates), layout.positions
    first = np.cumsum([0, *layout.columns])  # each block has columns of L of its own
    block = {i: b for b, block in enumerate(layout.blocks) for i in block}
    kinds = {"L": 0, "A": 1, "V": 2}
    outputs = [(kinds[kind], i, first[block[i]] + c if kind == "L" else 0) for kind, i, c in layout.outputs]
    sizes = [
        n,
        len(positions),
        len(layout.owners),
        len(layout.products),
        layout.hidden,
        len(outputs),
        first[-1],
        layout.friction,
        layout.bumps,
        len(driven),
        layout.depth,
    ]
    lists: list[Sequence[int]] = [
        sizes,
        [positions.index(i) if i in positions else -1 for i in range(n)],
        positions,
        [coordinates[i].topology == "circle" for i in positions],
        [a for product in layout.products for a in (*product, -1)[:3]],
        *([output[k] for output in outputs] for k in range(3)),
        driven,
    ]
    return np.array([number for part in lists for number in part], dtype=np.int64)


def _numbers(networks: Networks, layout: Layout) -> NDArray[np.float64]:
    spec, weights, scales = networks.spec, networks.weights, networks.spec.scales
    assert scales is not None
    coordinates, positions, n = spec.coordinates, layout.positions, len(spec.coordinates)
    slope = [
        angular(coordinates[i]) if coordinates[i].topology == "circle" else 1.0 / scales.reach[i]
        for i in positions
    ]
    gyro = np.zeros((n, n))
    for value, (i, j) in zip(weights["lagrangian.coupling"], layout.couplings, strict=True):
        gyro[i, j], gyro[j, i] = value, -value
    width, layers = friction_width(weights), list(hidden_layers(spec, weights))
    parts = [
        [scales.time, scales.energy],
        scales.position,
        [scales.centre[i] for i in positions],
        slope,
        spec.epsilon,
        *(weight for weight, _ in layers),
        *(bias for _, bias in layers),
        weights["lagrangian.output"],
        gyro,
        weights["lagrangian.offset"],
        weights["dissipation.viscous"] ** 2,
        weights["dissipation.quadratic"] ** 2,
        weights["dissipation.friction"] ** 2 * width,
        1.0 / width,
    ]
    return np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in parts])

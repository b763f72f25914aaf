"""The gradient of the structured networks' mean square, in one pass back, against their Jacobian."""

from __future__ import annotations

import numpy as np
import pytest

from exlinn_fmi.data.dataset import Samples
from exlinn_fmi.learn.adjoint import Adjoint
from exlinn_fmi.learn.assembly import Assembly, inverse_assembly
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.learned import ModelSpec, Scales

ARM = (Coordinate("phi", "rad", topology="circle"), Coordinate("psi", "rad", topology="circle"))
LINE = Coordinate("x", "m", topology="line")
CHARGE = Coordinate("Q", "C", "electrical", "cyclic", "i", "A")
STORED = Coordinate("q_c", "C", "electrical", "line", "j", "A")
SYSTEMS = [(ARM[0], CHARGE), (LINE, STORED), (*ARM, LINE, CHARGE), (CHARGE,)]


def anywhere(coordinates: tuple[Coordinate, ...]) -> tuple[StructuredNetworks, np.ndarray, Assembly]:
    """Networks, weights and data that are all random."""
    random, n = np.random.default_rng(len(coordinates)), len(coordinates)
    scales = Scales(0.3, 2.0, tuple(random.uniform(0.5, 2, n)), (0.1,) * n, (1.5,) * n)
    spec = ModelSpec("structured", coordinates, 3, scales, epsilon=tuple(random.uniform(0.1, 1, n)))
    networks = StructuredNetworks(spec)
    samples = Samples(*random.standard_normal((4, 20, n)))
    return networks, random.standard_normal(networks.size), inverse_assembly(spec, samples)


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=lambda cs: "-".join(c.name for c in cs))
def test_gradient_is_that_of_the_mean_square(coordinates: tuple[Coordinate, ...]) -> None:
    networks, theta, data = anywhere(coordinates)
    residual, jacobian = networks.jacobian(theta, data)
    loss, gradient = Adjoint(networks, data).mean_square(theta)
    assert loss == pytest.approx(np.mean(residual**2), rel=1e-12)
    expected = 2 / residual.size * np.tensordot(residual, jacobian, axes=2)
    assert gradient == pytest.approx(expected, rel=1e-9, abs=1e-12 * np.abs(expected).max())

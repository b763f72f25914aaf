"""How the structured networks move: against their CasADi form, and derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from learn_helpers import random_model

from exlinn_fmi.learn.motion import NetworkMotion
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.learned import learned_system
from exlinn_fmi.mechanics.sensitivity import Propagator

ARM = (
    Coordinate("phi", "rad", topology="circle", input="u", input_unit="N.m"),
    Coordinate("theta", "deg", topology="circle"),
)
LINE = Coordinate("x", "m", input="F", input_unit="N")
CHARGE = Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V")
STORED = Coordinate("q_c", "C", "electrical", "line", "j", "A")
SYSTEMS = [(ARM[0], CHARGE), (LINE, STORED), (*ARM, LINE, CHARGE), (CHARGE,)]
NAMES = ["-".join(c.name for c in system) for system in SYSTEMS]


def anywhere(coordinates: tuple[Coordinate, ...]) -> tuple[NetworkMotion, np.ndarray, np.ndarray, np.ndarray]:
    """A random model, and states and inputs of the size that it is made for; some beyond its data."""
    spec, weights = random_model(4, coordinates, hidden=3)
    networks = StructuredNetworks(spec)
    motion = NetworkMotion(networks, 1e-3 * spec.scales.time)
    random, (state, _) = np.random.default_rng(0), motion._units()
    x = 1.5 * random.standard_normal((6, len(state))) * state
    u = random.standard_normal((6, len(motion.input_names)))
    return motion, networks.pack(dict(weights)), x, u


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=NAMES)
def test_rates_are_those_of_the_casadi_system(coordinates: tuple[Coordinate, ...]) -> None:
    motion, theta, x, u = anywhere(coordinates)
    spec = motion.networks.spec
    system = learned_system(spec, motion.networks.unpack(theta))
    none, at = np.zeros(0), motion._rates(theta, x, u)
    expected = evaluate(system.derivative, x, u, none)
    assert at.rate == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
    poles = evaluate(system.state_jacobian, x, u, none).reshape(at.by_state.shape)
    size = np.abs(poles).max(axis=(0, 2))[:, None]
    assert (at.by_state / size) == pytest.approx(poles / size, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=NAMES)
def test_rates_depend_on_weights_as_differences_say(coordinates: tuple[Coordinate, ...]) -> None:
    motion, theta, x, u = anywhere(coordinates)
    found = motion._rates(theta, x, u).by_weight
    for k, step in enumerate(1e-6 * np.eye(len(theta))):
        ends = [motion._rate(motion.networks.unpack(theta + s * step), x, u) for s in (1, -1)]
        difference = (ends[0] - ends[1]) / 2e-6
        assert found[:, :, k] == pytest.approx(difference, rel=1e-5, abs=1e-7 * np.abs(found).max())


def test_runs_are_those_of_the_casadi_system_step_by_step() -> None:
    motion, theta, x, _ = anywhere(SYSTEMS[0])
    system = learned_system(motion.networks.spec, motion.networks.unpack(theta))
    random = np.random.default_rng(1)
    u, steps = random.standard_normal((6, 9, 2)), motion.step * random.uniform(0.5, 2, (6, 9))
    run = NetworkMotion(motion.networks, steps).run(x, u, theta)
    assert run == pytest.approx(Propagator(system, steps).run(x, u, np.zeros(0)), rel=1e-9)


def test_sensitivities_are_finite_differences() -> None:
    motion, theta, x, _ = anywhere(SYSTEMS[0])
    u = np.random.default_rng(1).standard_normal((6, 9, 2))
    *_, last = motion.sensitivities(motion.run(x, u, theta), u, theta)
    nx = x.shape[1]
    for k in range(nx + len(theta)):
        dx, dp = np.zeros(nx), np.zeros(len(theta))
        (dx if k < nx else dp)[k % nx if k < nx else k - nx] = 1e-6
        ends = [motion.run(x + s * dx, u, theta + s * dp)[:, -1] for s in (1, -1)]
        size = np.abs(last[:, :, k]).max()
        assert last[:, :, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-6 * size + 1e-8)


def test_a_run_that_diverges_is_not_finite_and_ends() -> None:
    motion, theta, x, u = anywhere(SYSTEMS[1])
    long = np.repeat(u[:, None], 20, axis=1)
    with np.errstate(all="ignore"):
        run = NetworkMotion(motion.networks, 1e6).run(1e200 * x, long, theta)
    assert not np.isfinite(run[:, -1]).any()

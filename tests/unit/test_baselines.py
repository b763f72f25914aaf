"""The peers of the learning benchmark: their equations are those of their papers, and they learn."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest
import torch
from baselines.black_box import BlackBox, NeuralOde
from baselines.double_autograd import DoubleAutograd
from baselines.hamiltonian import DissipativeSymoden, PortHamiltonian
from baselines.jets import Jet, Network
from baselines.lagrangian import DeLaN, Lnn
from baselines.learner import STRIDE, Learner
from baselines.record import record
from baselines.sindy import Sindy
from torch import Tensor

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.assembly import inverse_assembly
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.structured import structured_spec
from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.plants.motor_pendulum import PLANT as PENDULUM
from exlinn_fmi.scenario.learning import Structured
from exlinn_fmi.scenario.signals import Multisine

SIGNAL = Multisine(signal="multisine", offset=2.9, rms=2.9, band=(0.5, 5), seed=3)
LAGRANGIAN = (DeLaN, Lnn)
HAMILTONIAN = (DissipativeSymoden, PortHamiltonian)


@pytest.fixture(autouse=True, scope="module")
def _double_precision() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.fixture(scope="module")
def data() -> Dataset:
    """A second of the motor."""
    return record(PLANT, "v", [SIGNAL], 1.0)


def states(learner: Learner, count: int = 7) -> tuple[Tensor, Tensor, Tensor]:
    """Random q, q̇ and F, dimensionless."""
    draw = torch.Generator().manual_seed(1)
    return tuple(torch.randn(count, learner.n, generator=draw) for _ in range(3))


def gradient(value: Tensor, *by: Tensor) -> tuple[Tensor, ...]:
    """Of a sum, so that it may be derived again."""
    return torch.autograd.grad(value.sum(), by, create_graph=True, materialize_grads=True)


def euler_lagrange(lagrangian: Tensor, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
    """d/dt ∂𝓛/∂q̇ − ∂𝓛/∂q by automatic differentiation."""
    by_q, momentum = gradient(lagrangian, q, v)
    rows = []
    for k in range(q.shape[1]):
        along_q, along_v = gradient(momentum[:, k], q, v)
        rows.append((along_q * v + along_v * a).sum(1))
    return torch.stack(rows, 1) - by_q


# ── derivatives ──────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("activation", ["tanh", "softplus"])
def test_jets_are_value_gradient_and_hessian(activation: str) -> None:
    torch.manual_seed(0)
    network = Network(3, 2, width=5, activation=activation)
    x = torch.randn(4, 3)
    eye = torch.eye(3).expand(4, 3, 3)
    out = network.jet(Jet(x, eye, torch.zeros(4, 3, 3, 3)))
    torch.testing.assert_close(out.value, network(x))
    torch.testing.assert_close(out.first, torch.vmap(torch.func.jacrev(network))(x))
    torch.testing.assert_close(out.second, torch.vmap(torch.func.hessian(network))(x))


def test_features_are_derived_by_the_dimensionless_position(data: Dataset) -> None:
    learner = DeLaN(data, 0)
    q = states(learner)[0]
    out = learner.jet(q, second=True)
    torch.testing.assert_close(
        out.first, torch.vmap(torch.func.jacrev(lambda x: learner.jet(x[None]).value[0]))(q)
    )
    torch.testing.assert_close(
        out.second, torch.vmap(torch.func.hessian(lambda x: learner.jet(x[None]).value[0]))(q)
    )


# ── equations ────────────────────────────────────────────────────────────────────────────────────────────


def test_inverse_of_forward_is_identity_in_delan(data: Dataset) -> None:
    learner = DeLaN(data, 0)
    q, v, force = states(learner)
    torch.testing.assert_close(learner.inverse(q, v, learner.acceleration(q, v, force)), force)


def test_delan_obeys_euler_lagrange(data: Dataset) -> None:
    learner = DeLaN(data, 0)
    q, v, force = (x.requires_grad_() for x in states(learner))
    a = learner.acceleration(q, v, force)
    mass = learner.terms(q, v)[0]
    potential = learner.network(learner.jet(q).value)[:, 0]
    energy = torch.einsum("bi,bij,bj->b", v, mass, v) / 2 - potential
    friction = torch.nn.functional.softplus(learner.friction) * v
    torch.testing.assert_close(euler_lagrange(energy, q, v, a) + friction, force)


def test_lnn_obeys_euler_lagrange(data: Dataset) -> None:
    learner = Lnn(data, 0)
    q, v, force = (x.requires_grad_() for x in states(learner))
    a = learner.acceleration(q, v, force)
    friction = torch.nn.functional.softplus(learner.friction) * v
    torch.testing.assert_close(euler_lagrange(learner.lagrangian(q, v).value, q, v, a) + friction, force)


@pytest.mark.parametrize("kind", HAMILTONIAN)
def test_energy_of_a_hamiltonian_learner_decays_without_input(
    kind: type[DissipativeSymoden], data: Dataset
) -> None:
    learner = kind(data, 0)
    q, v, _ = (x.requires_grad_() for x in states(learner, 50))
    by_q, by_v = gradient(learner.hamiltonian(q, v), q, v)
    power = (by_q * v + by_v * learner.acceleration(q, v, torch.zeros_like(v))).sum(1)
    root = learner._triangular(learner.resistance(learner.jet(q).value))
    torch.testing.assert_close(power, -((root.mT @ v[..., None])[..., 0] ** 2).sum(1))
    assert (power <= 0).all()


def test_canonical_hamiltonian_learner_obeys_euler_lagrange(data: Dataset) -> None:
    learner = DissipativeSymoden(data, 0)
    q, v, force = (x.requires_grad_() for x in states(learner))
    z = learner.jet(q).value
    mass = torch.linalg.inv(learner._positive(learner._triangular(learner.inverse_mass(z))))
    kinetic = torch.einsum("bi,bij,bj->b", v, mass, v) / 2
    root = learner._triangular(learner.resistance(z))
    port = learner.port(z).reshape(len(q), learner.n, -1) @ force[:, learner.inputs, None]
    expected = (port - root @ root.mT @ v[..., None])[..., 0]
    a = learner.acceleration(q, v, force)
    found = euler_lagrange(kinetic - learner.potential(z)[:, 0], q, v, a)
    torch.testing.assert_close(found, expected)


def test_interconnection_acts_but_does_no_work(data: Dataset) -> None:
    learner, without = PortHamiltonian(data, 0), PortHamiltonian(data, 0)
    q, v, force = states(learner)
    with torch.no_grad():
        for weights in without.skew.parameters():
            weights.zero_()
        inverse_mass = learner._positive(learner._triangular(learner.inverse_mass(learner.jet(q).value)))
        difference = learner.acceleration(q, v, force) - without.acceleration(q, v, force)
        acting = torch.linalg.solve(inverse_mass, difference)
    assert acting.abs().max() > 1e-3
    torch.testing.assert_close((acting * v).sum(1), torch.zeros(len(q)), atol=1e-12, rtol=0)


@pytest.mark.parametrize("plant", [PLANT, PENDULUM], ids=lambda plant: plant.name)
def test_double_autograd_is_our_structured_model(plant: Plant) -> None:
    source = plant.system.input_names[-1]
    samples = record(plant, source, [SIGNAL], 0.05)
    spec, start = structured_spec(samples, Structured(preset="structured", hidden=3), 0)
    networks, assembly = StructuredNetworks(spec), inverse_assembly(spec, samples.arrays)
    theta = networks.pack(start.weights)
    theirs = DoubleAutograd(spec, networks.unpack(theta))
    batch = theirs.batch(samples.arrays)
    r, j = networks.jacobian(theta, assembly)
    np.testing.assert_allclose(theirs.residual(*batch).detach(), r, rtol=1e-9, atol=1e-12)
    expected = 2 / r.size * np.tensordot(r, j, axes=2)
    found = networks.pack({name: g.numpy() for name, g in theirs.gradient(*batch).items()})
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())


# ── training and use ─────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("kind", [BlackBox, NeuralOde, *LAGRANGIAN, *HAMILTONIAN])
def test_training_makes_the_loss_smaller(kind: type[Learner], data: Dataset) -> None:
    if kind is NeuralOde:
        pytest.importorskip("torchdiffeq")
    learner = kind(data, 0)
    rows = learner.draw()
    before = learner.loss(rows).item()
    learner.fit(20 / learner.steps)
    assert learner.loss(rows).item() < 0.9 * before


def test_a_seed_gives_the_same_learner_again(data: Dataset) -> None:
    predictions = []
    for _ in range(2):
        learner = BlackBox(data, 3)
        learner.fit(2 / learner.steps)
        predictions.append(learner.predict(data.arrays))
    np.testing.assert_array_equal(*predictions)


def test_sindy_finds_the_current_equation(data: Dataset) -> None:
    pytest.importorskip("pysindy")
    learner = Sindy(data, 0)
    learner.degrees, learner.thresholds = (2,), (1e-3,)
    learner.fit()
    # di/dt = (v − r i − k_e α̇)/l is a polynomial, the other equation is not.
    np.testing.assert_allclose(learner.predict(data.arrays)[:, 1], data.arrays.a[:, 1], atol=1e-5)
    assert int((learner.coefficients[1] != 0).sum()) <= 6


class TrueMotor(Learner):
    """Nothing to learn: the motor's own equations."""

    name: ClassVar[str] = "truth"

    def build(self) -> None:
        """No network."""

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """By hand, from (18) and (19), in dimensionless variables."""
        speed, force_unit = torch.tensor(self.scales.velocity), torch.tensor(self.scales.force)
        alpha, (alpha_dot, i), u = (
            q[:, 0] * self.scales.position[0],
            (v * speed).T,
            (force * force_unit)[:, 1],
        )
        cart = 0.04 * torch.sin(alpha)
        turn = (i - 0.5 * alpha_dot - cart * torch.cos(alpha) * alpha_dot**2) / (
            0.1 + cart * torch.sin(alpha)
        )
        return torch.stack([turn, u - 5 * i - alpha_dot], 1) * self.scales.time / speed


def test_free_run_of_the_true_equations_follows_the_record(data: Dataset) -> None:
    learner = TrueMotor(data, 0)
    np.testing.assert_allclose(learner.predict(data.arrays), data.arrays.a, rtol=1e-9, atol=1e-9)
    other = record(PLANT, "v", [SIGNAL], 2.0)
    for test, (rows, run) in zip([data, other], learner.free_runs([data, other]), strict=True):
        names = ["alpha", "alpha_dot", "i"]
        measured = test.frame[names].to_numpy()[::STRIDE]
        np.testing.assert_array_equal(rows.frame[names], measured)
        assert ((run - measured).std(axis=0) < 1e-4 * measured.std(axis=0)).all()


class Runaway(TrueMotor):
    """Diverges."""

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """Grows without bound."""
        return 100 * (1 + v.abs())


def test_a_run_that_diverges_ends_in_nan(data: Dataset) -> None:
    ((_, run),) = Runaway(data, 0).free_runs([data])
    assert np.isfinite(run[0]).all()
    assert np.isnan(run[-1, 1:]).all()


# ── data ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_records_start_where_the_plant_does_and_hold_together() -> None:
    data = record(PLANT, "v", [SIGNAL, SIGNAL], 0.5)
    frame = data.frame[data.frame["trajectory"] == 1]
    assert (frame[["alpha", "alpha_dot", "i"]].iloc[0] == 0).all()
    # the input is held from row to row, so a row's acceleration is that of the interval after it
    step, current = 1e-3, frame["i"].to_numpy()
    np.testing.assert_allclose(np.diff(current) / step, frame["i_dot"].iloc[:-1], atol=5e-2)
    np.testing.assert_array_equal(data.frame["v"][:500], data.frame["v"][500:])

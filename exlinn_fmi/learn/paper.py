"""The paper's learner: monomials into one hidden ReLU layer for 𝓛 and for D, trained together by Adam.

The second derivative of ReLU vanishes almost everywhere, so that the inverse model (17) reads

    F = Σ_k ∂𝓛/∂φ_k (d/dt ∂φ_k/∂q̇ − ∂φ_k/∂q) + Σ_k ∂D/∂ψ_k ∂ψ_k/∂q̇:

the brackets depend on data alone and are computed once, and a gradient step costs a few small products.

What the paper leaves open is chosen as measured by `benchmarks/paper_seeds.py`:

- Features enter as they are; divided by their rms fewer seeds reach the target.
- Hidden biases are 1 and stay: they have no gradient (F sees them only through which units are on), while
  weight decay would draw them to 0, where no unit is on at rest (φ = 0) and the mass matrix vanishes there.
- Batches of 8: as reliable as smaller ones, and faster.
- Of the weights after each epoch those are kept that are best on the validation data, M ≻ 0 going before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.learned import ModelSpec, learned_system
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.scenario.learning import Paper

NETWORKS = ("lagrangian", "dissipation")


def paper_spec(train: Dataset, options: Paper) -> ModelSpec:
    """The model to train.

    Raises:
        ModelError: a feature cannot be read.
    """
    lagrangian, dissipation = tuple(options.lagrangian_features), tuple(options.dissipation_features)
    MonomialBasis(train.coordinates, lagrangian, dissipation)
    return ModelSpec(
        "features",
        train.coordinates,
        options.hidden,
        lagrangian_features=lagrangian,
        dissipation_features=dissipation,
    )


@dataclass(frozen=True)
class _Data:
    """Features (N, K), their Euler–Lagrange terms (N, n, K), 𝓛's first, and forces (N, n)."""

    features: Tensor
    terms: Tensor
    force: Tensor

    @classmethod
    def of(cls, spec: ModelSpec, dataset: Dataset) -> _Data:
        basis = spec.basis
        q, v, a, force = dataset.arrays
        terms = evaluate(basis.regressor, q, v, a, basis.start).reshape(*v.shape, -1)
        return cls(*(torch.from_numpy(x).float() for x in (evaluate(basis.values(), q, v), terms, force)))

    def __len__(self) -> int:
        return len(self.force)

    def rows(self, chosen: Tensor | slice) -> _Data:
        return _Data(self.features[chosen], self.terms[chosen], self.force[chosen])


class _Network:
    """One ReLU network whose weights and gradients are views into two flat vectors.

    Args:
        features: which columns of the data are its inputs.
        hidden: number of units.
    """

    def __init__(self, features: slice, hidden: int) -> None:
        self.features = features
        self.inputs = features.stop - features.start
        self.size = hidden * (self.inputs + 1)
        self.bias = torch.ones(hidden)

    def view(self, flat: Tensor, gradient: Tensor) -> None:
        """Take the places of weights and gradients in the flat vectors."""
        hidden = len(self.bias)
        self.weight, self.output = flat[:-hidden].view(hidden, self.inputs), flat[-hidden:]
        self.weight_gradient = gradient[:-hidden].view(hidden, self.inputs)
        self.output_gradient = gradient[-hidden:]

    def slopes(self, data: _Data) -> tuple[Tensor, Tensor]:
        """Which units are on (B, h), and the output's derivatives with respect to the features (B, k)."""
        on = (torch.addmm(self.bias, data.features[:, self.features], self.weight.T) > 0).float()
        return on, (on * self.output) @ self.weight

    def backward(self, on: Tensor, upstream: Tensor) -> None:
        """Gradients, given the loss's derivatives with respect to `slopes` (B, k)."""
        torch.mm((on * self.output).T, upstream, out=self.weight_gradient)
        torch.sum(on * (upstream @ self.weight.T), 0, out=self.output_gradient)


class _Pair:
    """Both networks, in one vector so that Adam takes one step for all."""

    def __init__(self, spec: ModelSpec, seed: int) -> None:
        first, count = len(spec.lagrangian_features), len(spec.dissipation_features)
        slices = (slice(0, first), slice(first, first + count))
        self.networks = [_Network(part, spec.hidden) for part in slices]
        size = sum(network.size for network in self.networks)
        self.flat, self.gradient = torch.zeros(size), torch.zeros(size)
        start = 0
        for network in self.networks:
            own = slice(start, start + network.size)
            network.view(self.flat[own], self.gradient[own])
            start += network.size
        self.flat.grad = self.gradient
        random = torch.Generator().manual_seed(seed)
        for network in self.networks:  # as torch.nn.Linear does
            for array, inputs in ((network.weight, network.inputs), (network.output, spec.hidden)):
                array.uniform_(-(inputs**-0.5), inputs**-0.5, generator=random)

    def residual(self, data: _Data) -> tuple[Tensor, list[Tensor]]:
        """F̂ − F (B, n), and which units are on in each network."""
        on, slopes = zip(*(network.slopes(data) for network in self.networks), strict=True)
        force = torch.bmm(data.terms, torch.cat(slopes, 1).unsqueeze(2)).squeeze(2)
        return force - data.force, list(on)

    def backward(self, data: _Data) -> None:
        """Gradient of the mean square residual."""
        residual, on = self.residual(data)
        upstream = torch.bmm(residual.unsqueeze(1), data.terms).squeeze(1) * (2 / residual.numel())
        for network, active in zip(self.networks, on, strict=True):
            network.backward(active, upstream[:, network.features])

    def weights(self) -> dict[str, NDArray[np.float64]]:
        """Arrays by name, in double precision."""
        return {
            f"{name}.{part}": array.numpy().astype(np.float64)
            for name, network in zip(NETWORKS, self.networks, strict=True)
            for part, array in (
                ("hidden.weight", network.weight),
                ("hidden.bias", network.bias),
                ("output.weight", network.output),
            )
        }


def iterate_paper(
    spec: ModelSpec, train: Dataset, validation: Dataset, options: Paper, seed: int
) -> Iterator[Iterate]:
    """Train; ends after the last epoch.

    Args:
        spec: from `paper_spec`.
        train: data to fit.
        validation: data to watch.
        options: the learner's settings.
        seed: of first weights and batches.

    Yields:
        The start and every epoch.
    """
    # Products this small gain nothing from threads, and lose much where the cores are shared.
    torch.set_num_threads(1)
    data, held = _Data.of(spec, train), _Data.of(spec, validation)
    pair = _Pair(spec, seed)
    adam = torch.optim.Adam(
        [pair.flat], lr=options.learning_rate, weight_decay=options.weight_decay, fused=True
    )
    random = torch.Generator().manual_seed(seed)
    yield _iterate(spec, pair, data, held, validation)
    for _ in range(options.epochs):
        shuffled = data.rows(torch.randperm(len(data), generator=random))
        for first in range(0, len(shuffled), options.batch):
            pair.backward(shuffled.rows(slice(first, first + options.batch)))
            adam.step()
        yield _iterate(spec, pair, data, held, validation)


def _iterate(spec: ModelSpec, pair: _Pair, data: _Data, held: _Data, validation: Dataset) -> Iterate:
    """The present weights, their losses, and whether M ≻ 0 on the validation data."""
    weights = pair.weights()
    loss, validation_loss = (float(pair.residual(d)[0].square().mean()) for d in (data, held))
    samples = validation.arrays
    mass = evaluate(learned_system(spec, weights).mass_matrix, samples.q, samples.v, np.zeros(0))
    least = np.linalg.eigvalsh(mass.reshape(-1, *[len(spec.coordinates)] * 2)).min()
    return Iterate(weights, loss, validation_loss, "epoch", bool(least > 0))

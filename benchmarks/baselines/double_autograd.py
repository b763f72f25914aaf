"""Our structured model as most would write it: 𝓛 in PyTorch, the equations of motion by double autograd.

Same formula, weights and units as `learn.networks`, so that the gradients can be compared to the last digits.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from exlinn_fmi.data.dataset import Samples
from exlinn_fmi.mechanics.learned import NARROWEST, ModelSpec, angular


class DoubleAutograd:
    """Residual of the inverse model (17) and the gradient of its mean square.

    Args:
        spec: a structured model.
        weights: its weights by name.
    """

    def __init__(self, spec: ModelSpec, weights: dict[str, np.ndarray]) -> None:
        self.spec = spec
        self.weights = {name: torch.tensor(w, requires_grad=True) for name, w in weights.items()}

    def batch(self, samples: Samples) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """q, q̇, q̈ and F, dimensionless."""
        s = self.spec.scales
        units = (np.array(s.position), s.velocity, s.velocity / s.time, s.force)
        return tuple(torch.from_numpy(x / unit) for x, unit in zip(samples, units, strict=True))

    def loss(self, q: Tensor, w: Tensor, a: Tensor, force: Tensor) -> Tensor:
        """Mean square of the residual."""
        return torch.mean(self.residual(q, w, a, force) ** 2)

    def gradient(self, q: Tensor, w: Tensor, a: Tensor, force: Tensor) -> dict[str, Tensor]:
        """Of the loss, by each weight array."""
        weights = list(self.weights.values())  # offsets and drag, which are optional, are left out
        found = torch.autograd.grad(self.loss(q, w, a, force), weights, materialize_grads=True)
        return dict(zip(self.weights, found, strict=True))

    def residual(self, q: Tensor, w: Tensor, a: Tensor, force: Tensor) -> Tensor:
        """d/dt ∂𝓛/∂q̇ − ∂𝓛/∂q + ∂D/∂q̇ − F (B, n), (11)."""
        q, w = q.detach().requires_grad_(), w.detach().requires_grad_()
        energy = self.lagrangian(q, w).sum()
        by_q, momentum = torch.autograd.grad(energy, (q, w), create_graph=True)
        rates = []
        for k in range(q.shape[1]):
            bends = torch.autograd.grad(
                momentum[:, k].sum(), (q, w), create_graph=True, materialize_grads=True
            )
            rates.append((bends[0] * w + bends[1] * a).sum(1))
        (friction,) = torch.autograd.grad(self.dissipation(w).sum(), w, create_graph=True)
        return torch.stack(rates, 1) - by_q + friction - force

    def lagrangian(self, q: Tensor, w: Tensor) -> Tensor:
        """𝓛 (B,)."""
        layout, weights = self.spec.layout, self.weights
        z = self._features(q)
        products = [math.prod(z[:, i] for i in product)[:, None] for product in layout.products]
        bias = weights["lagrangian.hidden.bias"]
        hidden = torch.tanh(z @ weights["lagrangian.hidden.weight"].T + bias)
        basis = torch.cat([torch.ones(len(q), 1, dtype=q.dtype), z, *products, hidden], 1)
        out = basis @ weights["lagrangian.output"].T
        energy = (torch.tensor(self.spec.epsilon, dtype=q.dtype) * w**2).sum(1) / 2
        for block in layout.blocks:
            momenta = sum(out[:, layout.rows[i]] * w[:, [i]] for i in block)  # Lᵀq̇ of the block
            energy = energy + (momenta**2).sum(1) / 2
        for row, (kind, i, _) in enumerate(layout.outputs):
            if kind != "L":
                energy = energy + (out[:, row] * w[:, i] if kind == "A" else -out[:, row])
        for k, (i, j) in enumerate(layout.couplings):
            energy = energy + weights["lagrangian.coupling"][k] * q[:, j] * w[:, i]
        return energy

    def dissipation(self, w: Tensor) -> Tensor:
        """D (B,)."""
        viscous, strength = self.weights["dissipation.viscous"], self.weights["dissipation.friction"]
        width = NARROWEST + torch.exp(self.weights["dissipation.width"])
        x = w[:, :, None] / width
        # log cosh x without overflow
        log_cosh = torch.nn.functional.softplus(2 * x) - x - math.log(2)
        return (viscous**2 * w**2).sum(1) / 2 + ((strength * width) ** 2 * log_cosh).sum((1, 2))

    def _features(self, q: Tensor) -> Tensor:
        """z(q), in the order of the layout."""
        s, columns = self.spec.scales, []
        for i in self.spec.layout.positions:
            here, c = q[:, i] * s.position[i], self.spec.coordinates[i]
            if c.topology == "circle":
                columns += [torch.sin(angular(c) * here), torch.cos(angular(c) * here)]
            else:
                columns.append((here - s.centre[i]) / s.reach[i])
        return torch.stack(columns, 1)

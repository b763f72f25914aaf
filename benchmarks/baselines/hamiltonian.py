"""Learners built on a Hamiltonian H = ½ pᵀM⁻¹(q)p + V(q), p = M(q)q̇, with dissipation and inputs.

ṗ = −∂H/∂q + (J(q) − R(q)) ∂H/∂p + g(q) u with R ⪰ 0 and J = −Jᵀ: without inputs dH/dt = −q̇ᵀR q̇ ≤ 0.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from baselines.jets import Network
from baselines.learner import Learner

LEAST = 1e-2
"""Added to the diagonal of M⁻¹, dimensionless."""


class DissipativeSymoden(Learner):
    """Canonical: J = 0, as for mechanisms; the gyroscopic coupling of the two domains has no place in it."""

    name = "Dissipative SymODEN"
    citation = "Zhong, Dey, Chakraborty (2020), ICLR workshop, arXiv:2002.08860"
    configuration = "M⁻¹, V, R, g: 2×64 tanh each; acceleration loss"
    interconnection: ClassVar[bool] = False

    def build(self) -> None:
        """A network for each function of q."""
        n = self.n
        self.tril, self.lower = torch.tril_indices(n, n), torch.tril_indices(n, n, -1)
        self.inverse_mass = Network(self.features, self.tril.shape[1])
        self.potential = Network(self.features, 1)
        self.resistance = Network(self.features, self.tril.shape[1])
        self.port = Network(self.features, n * len(self.inputs))
        if self.interconnection:
            self.skew = Network(self.features, self.lower.shape[1])

    def hamiltonian(self, q: Tensor, v: Tensor) -> Tensor:
        """H (B,)."""
        z = self.jet(q)
        factor = self._triangular(self.inverse_mass(z.value))
        momentum = torch.linalg.solve(self._positive(factor), v)
        return (momentum * v).sum(1) / 2 + self.potential(z.value)[:, 0]

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """d/dt (M⁻¹p)."""
        z = self.jet(q)
        out = self.inverse_mass.jet(z)
        factor = self._triangular(out.value)
        slope = torch.zeros(len(q), self.n, self.n, self.n)
        slope[:, *self.tril] = out.first
        half = torch.einsum("bijk,blj->bilk", slope, factor)
        by_q = half + half.transpose(1, 2)  # ∂(M⁻¹)_il/∂q_k
        inverse_mass = self._positive(factor)
        momentum = torch.linalg.solve(inverse_mass, v)
        root = self._triangular(self.resistance(z.value))
        matrix = -root @ root.mT
        if self.interconnection:
            upper = torch.zeros_like(matrix)
            upper[:, *self.lower] = self.skew(z.value)
            matrix = matrix + upper - upper.mT
        port = self.port(z.value).reshape(len(q), self.n, len(self.inputs))
        rate = (port @ force[:, self.inputs, None] + matrix @ v[..., None])[..., 0]
        rate = rate - torch.einsum("bilk,bi,bl->bk", by_q, momentum, momentum) / 2
        rate = rate - self.potential.jet(z).first[:, 0]
        turning = torch.einsum("bilk,bk,bl->bi", by_q, v, momentum)
        return (inverse_mass @ rate[..., None])[..., 0] + turning

    def _triangular(self, entries: Tensor) -> Tensor:
        matrix = torch.zeros(len(entries), self.n, self.n)
        matrix[:, *self.tril] = entries
        return matrix

    def _positive(self, factor: Tensor) -> Tensor:
        return factor @ factor.mT + LEAST * torch.eye(self.n)


class PortHamiltonian(DissipativeSymoden):
    """With a learned interconnection J(q): the true plant is within its reach."""

    name = "pH-NN"
    citation = (
        "Desai et al. (2021), Phys. Rev. E 104, 034312; J(x) as in Roth et al. (2025), arXiv:2502.02480"
    )
    configuration = "M⁻¹, V, J, R, g: 2×64 tanh each; acceleration loss"
    interconnection = True

"""Learners built on a Lagrangian: DeLaN (structured) and LNN (any function)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.jets import Jet, Network
from baselines.learner import Learner

LEAST_MASS = 1e-2
"""Added to the diagonal of a mass matrix, dimensionless."""


class DeLaN(Learner):
    """T = ½ q̇ᵀM(q)q̇ with M = LLᵀ and V(q) from one network with three heads; viscous joint friction.

    Both domains' coordinates enter as in the extended Lagrangian: q = (α, Q). No term is linear in q̇, so
    that the coupling k_e·α·Q̇ has no place.
    """

    name = "DeLaN"
    citation = "Lutter, Ritter, Peters (2019), ICLR; friction as in Lutter, Peters (2023), IJRR 42, 83"
    configuration = "2×64 softplus; inverse and forward loss"

    def build(self) -> None:
        """One network for V, the diagonal and the rest of L."""
        self.lower = torch.tril_indices(self.n, self.n, -1)
        self.network = Network(self.features, 1 + self.n + self.lower.shape[1], activation="softplus")
        self.friction = nn.Parameter(torch.zeros(self.n))

    def terms(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Mass matrix (B, n, n), and centrifugal, gravity and friction forces together (B, n)."""
        out = self.network.jet(self.jet(q))
        n = self.n
        diagonal = out.value[:, 1 : 1 + n]
        factor = torch.diag_embed(nn.functional.softplus(diagonal))
        slope = torch.zeros(len(q), n, n, n)  # ∂L_ij/∂q_k
        own = torch.arange(n)
        slope[:, own, own] = torch.sigmoid(diagonal)[..., None] * out.first[:, 1 : 1 + n]
        factor[:, *self.lower] = out.value[:, 1 + n :]
        slope[:, *self.lower] = out.first[:, 1 + n :]
        mass = factor @ factor.mT + LEAST_MASS * torch.eye(n)
        half = torch.einsum("bijk,blj->bilk", slope, factor)
        by_q = half + half.transpose(1, 2)  # ∂M_il/∂q_k
        forces = torch.einsum("bilk,bk,bl->bi", by_q, v, v) - torch.einsum("bilk,bi,bl->bk", by_q, v, v) / 2
        return mass, forces + out.first[:, 0] + nn.functional.softplus(self.friction) * v

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """M⁻¹ (F − …)."""
        mass, rest = self.terms(q, v)
        return torch.linalg.solve(mass, force - rest)

    def inverse(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """The forces that make the accelerations a."""
        mass, rest = self.terms(q, v)
        return (mass @ a[..., None])[..., 0] + rest

    def loss(self, rows: Tensor) -> Tensor:
        """Forward and inverse error; the forces have size 1 already."""
        q, v, a, force = (x[rows] for x in self.samples)
        mass, rest = self.terms(q, v)
        inverse = (mass @ a[..., None])[..., 0] + rest - force
        forward = torch.linalg.solve(mass, inverse) / self.spread  # a − â
        return torch.mean(inverse**2) + torch.mean(forward**2)


class Lnn(Learner):
    """𝓛(q, q̇) is any function; q̈ from its Hessian. Viscous friction is added, which the paper has not.

    It may see α itself beside sin α and cos α, so that the coupling k_e·α·Q̇ is within its reach; and it
    starts at a unit mass matrix, which the special initialisation of the paper is for.
    """

    name = "LNN"
    citation = "Cranmer et al. (2020), ICLR workshop, arXiv:2003.04630"
    configuration = "2×64 softplus; acceleration loss; viscous friction added"
    steps = 6000
    batch = 128
    rate = 1e-3

    def build(self) -> None:
        """One network for 𝓛."""
        self.circles = [i for i in self.positions if self.coordinates[i].topology == "circle"]
        angles = self.samples.q[:, self.circles]
        self.mean, self.deviation = angles.mean(0), angles.std(0)
        self.network = Network(self.features + len(self.circles) + self.n, 1, activation="softplus")
        self.friction = nn.Parameter(torch.zeros(self.n))

    def lagrangian(self, q: Tensor, v: Tensor) -> Jet:
        """𝓛 with derivatives by (q, q̇)."""
        z, n = self.jet(q, second=True), self.n
        turned = (q[:, self.circles] - self.mean) / self.deviation
        inputs = torch.cat([z.value, turned, v], 1)
        first = q.new_zeros(len(q), inputs.shape[1], 2 * n)
        second = q.new_zeros(len(q), inputs.shape[1], 2 * n, 2 * n)
        first[:, : self.features, :n] = z.first
        second[:, : self.features, :n, :n] = z.second
        first[:, self.features : -n, :n] = torch.eye(n)[self.circles] / self.deviation[:, None]
        first[:, -n:, n:] = torch.eye(n)
        out = self.network.jet(Jet(inputs, first, second))
        bend = out.second[:, 0].clone()
        bend[:, n:, n:] += torch.eye(n)
        slope = out.first[:, 0] + torch.cat([0 * q, v], 1)
        return Jet(out.value[:, 0] + (v**2).sum(1) / 2, slope, bend)

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """(∂²𝓛/∂q̇²)⁻¹ (F − friction + ∂𝓛/∂q − ∂²𝓛/∂q̇∂q q̇)."""
        n, at = self.n, self.lagrangian(q, v)
        rest = (at.second[:, n:, :n] @ v[..., None])[..., 0] - at.first[:, :n]
        rest = rest + nn.functional.softplus(self.friction) * v
        # The paper takes a pseudo-inverse, which is the inverse wherever there is one.
        return torch.linalg.solve_ex(at.second[:, n:, n:], force - rest)[0]

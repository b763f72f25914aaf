"""The gradient of the structured networks' equations, in one pass forwards and one back: no Jacobian is made.

Network outputs and functions of position are *jets*: their values, then their derivatives by each z_j. All
have the samples last, so that the products of matrices are few and large. Shapes: B samples, n equations,
T functions f, O outputs, H basis functions, K = 1 + nz rows of a jet, h hidden units, R products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.learn.assembly import Assembly
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.mechanics.layout import Layout
from exlinn_fmi.mechanics.learned import NARROWEST, friction_width

Array = NDArray[np.float64]
Upstream = Callable[
    [Float[Array, "B n"], Float[Array, "B n"]], tuple[Float[Array, "B n"], Float[Array, "B n"]]
]
"""From residual and inertial forces to the derivatives by each of what is made small."""


class _Products(NamedTuple):
    """The functions f_t as sums of products of two outputs; output O is the constant 1.

    Args:
        factors: first factors of all products, then second ones.
        others: what each of these is multiplied by.
        sums: 1 where a product belongs to a function.
        scatter: 1 where a factor is an output.
    """

    factors: NDArray[np.intp]
    others: NDArray[np.intp]
    sums: Float[Array, "T R"]
    scatter: Float[Array, "O 2R"]

    @classmethod
    def of(cls, layout: Layout) -> _Products:
        """M_ij = Σ_c L_ic L_jc; A and V are outputs themselves."""
        every, one = np.arange(len(layout.outputs)), len(layout.outputs)
        pairs = [
            zip(every[layout.rows[i]], every[layout.rows[j]], strict=True)
            if kind == "M"
            else [(layout.outputs.index((kind, i, j)), one)]
            for kind, i, j in layout.terms
        ]
        counts, flat = zip(*((t, pair) for t, own in enumerate(pairs) for pair in own), strict=True)
        left, right = np.array(flat).T
        factors, others = np.concatenate([left, right]), np.concatenate([right, left])
        sums = np.equal.outer(np.arange(len(layout.terms)), counts).astype(float)
        return cls(factors, others, sums, np.equal.outer(every, factors).astype(float))


class _Forward(NamedTuple):
    """What the pass back needs of the one forwards."""

    weights: dict[str, Array]
    basis: Float[Array, "H K B"]
    others: Float[Array, "2R K B"]
    slip: tuple[Float[Array, "B n k"], Float[Array, "B n k"]]
    residual: Float[Array, "B n"]
    inertia: Float[Array, "B n"]


@dataclass(frozen=True)
class Adjoint:
    """The inverse model at samples, and derivatives of what is made of its residual.

    Args:
        networks: what is trained.
        data: from `inverse_assembly`.
    """

    networks: StructuredNetworks
    data: Assembly

    @cached_property
    def _products(self) -> _Products:
        return _Products.of(self.networks.spec.layout)

    @cached_property
    def _direct(self) -> Float[Array, "nd K B"]:
        """The direct path [1, z, products], which no weight changes."""
        return _jets(self.data.basis, self.data.slopes)

    @cached_property
    def _coefficients(self) -> Float[Array, "n T K B"]:
        """What multiplies the functions' jets in each equation."""
        return _jets(self.data.value, self.data.gradient)

    def mean_square(self, theta: Float[Array, " P"]) -> tuple[float, Float[Array, " P"]]:
        """Mean square of the residual and its gradient by θ."""
        found: list[float] = []

        def upstream(residual: Array, inertia: Array) -> tuple[Array, Array]:
            found.append(float(np.vdot(residual, residual)) / residual.size)
            return 2 / residual.size * residual, np.zeros_like(inertia)

        gradient = self.gradient(theta, upstream)
        return found[0], gradient

    def forces(self, theta: Float[Array, " P"]) -> tuple[Float[Array, "B n"], Float[Array, "B n"]]:
        """The residual and the inertial forces in it."""
        forward = self._forward(self.networks.unpack(theta))
        return forward.residual, forward.inertia

    def gradient(self, theta: Float[Array, " P"], upstream: Upstream) -> Float[Array, " P"]:
        """Derivatives by θ of what `upstream` has the derivatives of by residual and inertial forces."""
        forward = self._forward(self.networks.unpack(theta))
        by_residual, by_inertia = upstream(forward.residual, forward.inertia)
        by_terms = np.einsum("ntkb,bn->tkb", self._coefficients, by_residual)
        by_terms[:, 0] += np.einsum("ntb,bn->tb", self._coefficients[:, :, 0], by_inertia)
        return self.networks.pack({**self._networks(forward, by_terms), **self._others(forward, by_residual)})

    def _forward(self, weights: dict[str, Array]) -> _Forward:
        data, products = self.data, self._products
        direct, slope = self._direct, weights["lagrangian.hidden.weight"]  # (nd, K, B), (h, nz)
        basis = np.empty((len(direct) + len(slope), *direct.shape[1:]))
        basis[: len(direct)] = direct
        tanh = np.tanh(slope @ data.z.T + weights["lagrangian.hidden.bias"][:, None])
        basis[len(direct) :, 0] = tanh
        np.multiply((1 - tanh**2)[:, None], slope[:, :, None], out=basis[len(direct) :, 1:])
        out = weights["lagrangian.output"]
        jets = np.zeros((len(out) + 1, *direct.shape[1:]))
        jets[-1, 0] = 1
        np.matmul(out, basis.reshape(len(basis), -1), out=jets[:-1].reshape(len(out), -1))
        half, other = len(products.factors) // 2, jets[products.others]
        left, right = other[half:], other[:half]
        product = left * right[:, :1]
        product[:, 1:] += left[:, :1] * right[:, 1:]
        terms = (products.sums @ product.reshape(len(product), -1)).reshape(-1, *direct.shape[1:])
        terms[:, 0] += self._least[:, None]
        rest, slip = self.networks.others(weights, data)
        residual = np.einsum("ntkb,tkb->bn", self._coefficients, terms) + rest
        inertia = np.einsum("ntb,tb->bn", self._coefficients[:, :, 0], terms[:, 0])
        return _Forward(weights, basis, other, slip, residual, inertia)

    @cached_property
    def _least(self) -> Float[Array, " T"]:
        """ε of each function that is on M's diagonal."""
        spec = self.networks.spec
        return np.array(
            [spec.epsilon[i] if kind == "M" and i == j else 0 for kind, i, j in spec.layout.terms]
        )

    def _networks(self, forward: _Forward, by_terms: Float[Array, "T K B"]) -> dict[str, Array]:
        """Derivatives by the networks' weights, from those by the functions' jets."""
        products, other, basis = self._products, forward.others, forward.basis
        by_product = products.sums.T @ by_terms.reshape(len(by_terms), -1)
        by_factor = np.concatenate([by_product, by_product]).reshape(other.shape)
        by_value = np.sum(by_factor[:, 1:] * other[:, 1:], axis=1)
        by_factor *= other[:, :1]
        by_factor[:, 0] += by_value
        flat = products.scatter @ by_factor.reshape(len(by_factor), -1)
        slope = forward.weights["lagrangian.hidden.weight"]
        start = len(basis) - len(slope)
        hidden = forward.weights["lagrangian.output"][:, start:]
        tanh = basis[start:, 0]
        first = 1 - tanh**2
        by_hidden = (hidden.T @ flat).reshape(len(slope), *basis.shape[1:])
        by_slope = by_hidden[:, 1:] * first[:, None]  # (h, nz, B)
        inner = by_hidden[:, 0] * first - 2 * tanh * np.einsum("hjb,hj->hb", by_slope, slope)
        return {
            "lagrangian.output": flat @ basis.reshape(len(basis), -1).T,
            "lagrangian.hidden.weight": inner @ self.data.z + by_slope.sum(axis=2),
            "lagrangian.hidden.bias": inner.sum(axis=1),
        }

    def _others(self, forward: _Forward, pull: Float[Array, "B n"]) -> dict[str, Array]:
        """Derivatives by couplings, offsets and friction, from those by the residual."""
        weights, data = forward.weights, self.data
        power = pull.T @ data.velocity  # (n, n)
        a, s = weights["dissipation.friction"], friction_width(weights)
        force, slope = (
            np.einsum("bn,bnk->nk", p, x)
            for p, x in zip((pull, pull * data.velocity), forward.slip, strict=True)
        )
        drag = np.einsum("bn,bn->n", pull, data.velocity * np.abs(data.velocity))
        return {
            "lagrangian.coupling": np.array(
                [power[i, j] - power[j, i] for i, j in self.networks.spec.layout.couplings]
            ),
            "lagrangian.offset": -(pull * data.push).sum(axis=0),
            "dissipation.viscous": 2 * weights["dissipation.viscous"] * np.diag(power),
            "dissipation.friction": 2 * a * s * force,
            "dissipation.width": a**2 * (force - slope / s) * (s - NARROWEST),
            "dissipation.quadratic": 2 * weights["dissipation.quadratic"] * drag,
        }


def _jets(values: Float[Array, "B ..."], slopes: Float[Array, "B ... nz"]) -> Float[Array, "... K B"]:
    """Values and derivatives in one array, samples last."""
    return np.ascontiguousarray(np.moveaxis(np.concatenate([values[..., None], slopes], axis=-1), 0, -1))

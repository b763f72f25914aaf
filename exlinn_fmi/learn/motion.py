"""How the structured networks move, and how that depends on states and weights: fits to trajectories need it.

The equations of motion r(q, v, a; θ) = F give a = M⁻¹(F − r(q, v, 0)), and by implicit differentiation
∂a/∂θ = −M⁻¹ ∂r/∂θ, ∂a/∂x = −M⁻¹ ∂r/∂x. All is numpy on batches; ∂r/∂x takes second derivatives of the
networks, which are those of M, A and V once the chain rule has led them to q.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Samples
from exlinn_fmi.learn.assembly import inverse_assembly, product_curvature, topology_curvature
from exlinn_fmi.learn.networks import StructuredNetworks, coupling_columns
from exlinn_fmi.mechanics.coordinates import input_names
from exlinn_fmi.mechanics.sensitivity import Motion

Array = NDArray[np.float64]

ROWS = 1024
"""Rows whose derivatives are made at once."""
RK4 = ((0.0, 1), (0.5, 2), (0.5, 2), (1.0, 1))
"""Places of the four stages within a step, and their weights in sixths."""


class _Rates(NamedTuple):
    """ẋ, ∂ẋ/∂x and ∂ẋ/∂θ."""

    rate: Float[Array, "B nx"]
    by_state: Float[Array, "B nx nx"]
    by_weight: Float[Array, "B nx P"]


@dataclass(frozen=True)
class NetworkMotion(Motion):
    """RK4 through recorded inputs, held from row to row; parameters are the networks' free weights θ.

    Args:
        networks: what moves.
        step: from row to row [s], one for all or (B, K).
    """

    networks: StructuredNetworks
    step: float | Float[Array, "B K"]

    def run(
        self, start: Float[Array, "B nx"], inputs: Float[Array, "B K m"], p: Float[Array, " P"]
    ) -> Float[Array, "B rows nx"]:
        """States at all rows; not finite from where a segment diverges."""
        count, steps, _ = inputs.shape
        h = np.broadcast_to(self.step, (count, steps))
        states = np.empty((count, steps + 1, start.shape[1]))
        states[:, 0] = start
        weights = self.networks.unpack(p)
        for k in range(steps):
            x, length = states[:, k], h[:, k, None]
            slope, total = np.zeros_like(x), np.zeros_like(x)
            for part, weight in RK4:
                slope = self._rate(weights, x + part * length * slope, inputs[:, k])
                total += weight * slope
            states[:, k + 1] = x + length / 6 * total
            if not np.isfinite(states[:, k + 1]).any():
                states[:, k + 1 :] = np.nan
                break
        return states

    def sensitivities(
        self, states: Float[Array, "B rows nx"], inputs: Float[Array, "B K m"], p: Float[Array, " P"]
    ) -> Iterator[Float[Array, "B nx columns"]]:
        """Derivatives of the states by the segment's first state and by θ, at each row from the first on."""
        count, steps, _ = inputs.shape
        nx = states.shape[2]
        h = np.broadcast_to(self.step, (count, steps))
        s = np.concatenate(
            [np.broadcast_to(np.eye(nx), (count, nx, nx)), np.zeros((count, nx, len(p)))], axis=2
        )
        yield s
        width = max(ROWS // count, 1)
        for first in range(0, steps, width):
            part = slice(first, min(first + width, steps))
            by_x, by_p = self._steps(states[:, part], inputs[:, part], h[:, part], p)
            for k in range(by_x.shape[1]):
                s = by_x[:, k] @ s
                s[:, :, nx:] += by_p[:, k]
                yield s

    def _steps(
        self,
        states: Float[Array, "B k nx"],
        inputs: Float[Array, "B k m"],
        h: Float[Array, "B k"],
        p: Float[Array, " P"],
    ) -> tuple[Float[Array, "B k nx nx"], Float[Array, "B k nx P"]]:
        """∂x⁺/∂x and ∂x⁺/∂θ of one step from each row, by the chain rule through its four stages."""
        shape, nx = states.shape, states.shape[2]
        x, u = states.reshape(-1, nx), inputs.reshape(-1, inputs.shape[2])
        length = h.reshape(-1, 1)
        wide = length[:, :, None]
        slope: Array = np.zeros_like(x)
        by_x: Array = np.zeros((len(x), nx, nx))
        by_p: Array = np.zeros((len(x), nx, len(p)))
        sum_x, sum_p = np.zeros_like(by_x), np.zeros_like(by_p)
        for part, weight in RK4:
            at = self._rates(p, x + part * length * slope, u)
            slope = at.rate
            by_x = at.by_state @ (np.eye(nx) + part * wide * by_x)
            by_p = at.by_weight + part * wide * (at.by_state @ by_p) if part else at.by_weight
            sum_x += weight * by_x
            sum_p += weight * by_p
        sum_x, sum_p = np.eye(nx) + wide / 6 * sum_x, wide / 6 * sum_p
        return sum_x.reshape(*shape[:2], nx, nx), sum_p.reshape(*shape[:2], nx, -1)

    # ── the equations of motion ──────────────────────────────────────────────────────────────────────────

    def _samples(self, x: Float[Array, "B nx"], u: Float[Array, "B m"]) -> Samples:
        """A state and inputs as samples without acceleration."""
        spec = self.networks.spec
        n, kept = len(spec.coordinates), spec.layout.positions
        q, force = np.zeros((len(x), n)), np.zeros((len(x), n))
        q[:, kept] = x[:, : len(kept)]
        force[:, [i for i, c in enumerate(spec.coordinates) if c.input is not None]] = u
        return Samples(q, x[:, len(kept) :], np.zeros((len(x), n)), force)

    def _units(self) -> tuple[Float[Array, " nx"], Float[Array, " nx"]]:
        """Units of the state and of its rate."""
        spec = self.networks.spec
        assert spec.scales is not None
        size = np.array(spec.scales.position)
        state = np.concatenate([size[spec.layout.positions], spec.scales.velocity])
        return state, state / spec.scales.time

    def _rate(
        self, weights: dict[str, Array], x: Float[Array, "B nx"], u: Float[Array, "B m"]
    ) -> Float[Array, "B nx"]:
        """ẋ in the user's units."""
        data = inverse_assembly(self.networks.spec, self._samples(x, u))
        residual, mass = self.networks.balance(weights, data)
        return self._join(x, -_solved(mass, residual[..., None])[..., 0])

    def _join(self, x: Float[Array, "B nx"], a: Float[Array, "B n"]) -> Float[Array, "B nx"]:
        """ẋ of positions and velocities, from dimensionless accelerations."""
        kept = self.networks.spec.layout.positions
        moved = x[:, len(kept) :][:, kept]
        return np.concatenate([moved, a * self._units()[1][len(kept) :]], axis=1)

    def _rates(self, p: Float[Array, " P"], x: Float[Array, "B nx"], u: Float[Array, "B m"]) -> _Rates:
        """ẋ and its derivatives in the user's units."""
        networks, kept = self.networks, self.networks.spec.layout.positions
        spec, weights, samples = networks.spec, networks.unpack(p), self._samples(x, u)
        assert spec.scales is not None
        residual, mass = networks.balance(weights, inverse_assembly(spec, samples))
        a = -_solved(mass, residual[..., None])[..., 0]
        speed = spec.scales.velocity / spec.scales.time
        moving = samples._replace(a=a * speed)
        data = inverse_assembly(spec, moving)
        _, by_weight = networks.jacobian(p, data)
        by_q, by_v = self._by_state(weights, samples, a)
        nx, m = x.shape[1], len(kept)
        state, rate = self._units()
        result = np.zeros((len(x), nx, nx + len(p)))
        result[:, np.arange(m), m + np.array(kept, dtype=int)] = 1
        columns = np.concatenate([by_q[:, :, kept] / state[:m], by_v / state[m:], by_weight], axis=2)
        result[:, m:] = -_solved(mass, columns) * rate[m:, None]
        return _Rates(self._join(x, a), result[:, :, :nx], result[:, :, nx:])

    def _by_state(
        self, weights: dict[str, Array], samples: Samples, a: Float[Array, "B n"]
    ) -> tuple[Float[Array, "B n n"], Float[Array, "B n n"]]:
        """∂r/∂q and ∂r/∂v, dimensionless.

        r_k = M_kj a_j + ∂_l M_kj v_l v_j − ½ ∂_k M_ij v_i v_j + (∂_l A_k − ∂_k A_l) v_l + ∂_k V + ∂D/∂v_k + …
        """
        networks, spec = self.networks, self.networks.spec
        assert spec.scales is not None
        v = samples.v / spec.scales.velocity
        m1, m2, a1, a2, v2 = self._functions(weights, samples)
        twist = np.einsum("bklm,bl->bkm", a2, v) - np.einsum("blkm,bl->bkm", a2, v)
        by_q = np.einsum("bkjm,bj->bkm", m1, a) + np.einsum("bkjlm,bl,bj->bkm", m2, v, v)
        by_q += -np.einsum("bijkm,bi,bj->bkm", m2, v, v) / 2 + twist + v2
        by_v = np.einsum("bkjm,bj->bkm", m1, v) + np.einsum("bkml,bl->bkm", m1, v)
        by_v += -np.einsum("bmjk,bj->bkm", m1, v) + a1 - a1.swapaxes(1, 2)
        n = v.shape[1]
        unit = np.broadcast_to(np.eye(n), (1, n, n))
        coupling = [
            coupling_columns(spec.layout, e) @ weights["lagrangian.coupling"] for e in unit[0][:, None]
        ]
        by_v += np.concatenate(coupling).T
        by_v += networks.friction_slope(weights, v)[:, :, None] * np.eye(n)
        return by_q, by_v

    def _functions(
        self, weights: dict[str, Array], samples: Samples
    ) -> tuple[
        Float[Array, "B n n n"],
        Float[Array, "B n n n n"],
        Float[Array, "B n n"],
        Float[Array, "B n n n"],
        Float[Array, "B n n"],
    ]:
        """∂M, ∂²M, ∂A, ∂²A and ∂²V by q; derivatives are the last indices."""
        networks, spec = self.networks, self.networks.spec
        assert spec.scales is not None
        layout, (count, n) = spec.layout, samples.q.shape
        size = np.array(spec.scales.position)
        data = inverse_assembly(spec, samples)
        value, first, second = networks.outputs(weights, data, product_curvature(data.z, layout.products))
        slope, bend = topology_curvature(spec, samples.q)
        owners = np.array(layout.owners, dtype=int)
        chain = np.zeros((count, len(owners), n))
        chain[:, np.arange(len(owners)), owners] = slope * size[owners]
        by_q = first @ chain
        twice = np.einsum("bojk,bjl,bkm->bolm", second, chain, chain, optimize=True)
        for j, k in enumerate(owners):
            twice[:, :, k, k] += first[:, :, j] * (bend[:, j] * size[k] ** 2)[:, None]
        m1, m2 = np.zeros((count, n, n, n)), np.zeros((count, n, n, n, n))
        a1, a2, v2 = np.zeros((count, n, n)), np.zeros((count, n, n, n)), np.zeros((count, n, n))
        for kind, i, j in layout.terms:
            if kind == "M":
                one, other = layout.rows[i], layout.rows[j]
                d = np.einsum("bck,bc->bk", by_q[:, one], value[:, other])
                d += np.einsum("bc,bck->bk", value[:, one], by_q[:, other])
                cross = np.einsum("bck,bcl->bkl", by_q[:, one], by_q[:, other])
                dd = np.einsum("bckl,bc->bkl", twice[:, one], value[:, other]) + cross
                dd += np.einsum("bc,bckl->bkl", value[:, one], twice[:, other]) + cross.swapaxes(1, 2)
                m1[:, i, j] = m1[:, j, i] = d
                m2[:, i, j] = m2[:, j, i] = dd
            else:
                row = layout.outputs.index((kind, i, j))
                if kind == "A":
                    a1[:, i], a2[:, i] = by_q[:, row], twice[:, row]
                else:
                    v2 = twice[:, row]
        return m1, m2, a1, a2, v2

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.networks.size

    @property
    def input_names(self) -> list[str]:
        """Names of the inputs."""
        return input_names(self.networks.spec.coordinates)


def _solved(mass: Float[Array, "B n n"], right: Float[Array, "B n k"]) -> Float[Array, "B n k"]:
    """M⁻¹ right; not finite where M or the right side is not."""
    fine = np.isfinite(mass).all(axis=(1, 2))
    result = np.full(right.shape, np.nan)
    result[fine] = np.linalg.solve(mass[fine], right[fine])
    return result

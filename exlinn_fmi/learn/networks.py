"""The structured networks in numpy: residual of the inverse model and its Jacobian, by hand.

The residual is linear in values and derivatives of the functions of position (`assembly.py`), those are
products of network outputs, and the outputs are linear in the basis [1, z, products, tanh(Wz + b)]: four
short chain rules. Shapes: B samples, n equations, T functions f, O outputs, H basis functions, nz network
inputs, h hidden units.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.learn.assembly import Assembly
from exlinn_fmi.mechanics.layout import Layout
from exlinn_fmi.mechanics.learned import NARROWEST, ModelSpec, friction_width

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Forward:
    """Values that residual and Jacobian share."""

    basis: Float[Array, "B H"]
    slopes: Float[Array, "B H nz"]
    outputs: Float[Array, "B O"]
    gradients: Float[Array, "B O nz"]
    slip: tuple[Float[Array, "B n k"], Float[Array, "B n k"]]
    residual: Float[Array, "B n"]


@dataclass(frozen=True)
class StructuredNetworks:
    """The structured form of `ModelSpec` as a function of one vector θ of its free weights.

    Args:
        spec: the model.
        chosen: which of its free weights θ has; all if not given.
        held: values of all free weights, those in θ aside; 0 if not given.
    """

    spec: ModelSpec
    chosen: NDArray[np.bool_] | None = field(default=None, compare=False)
    held: Float[Array, " F"] | None = field(default=None, compare=False)

    @cached_property
    def _every(self) -> NDArray[np.bool_]:
        """Which of all weights are free."""
        return np.concatenate([mask.ravel() for mask in self.spec.layout.free.values()])

    @cached_property
    def _free(self) -> NDArray[np.bool_]:
        """Which of all weights, one after the other, are in θ."""
        free = self._every.copy()
        if self.chosen is not None:
            free[free] = self.chosen
        return free

    @cached_property
    def _places(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        """Where each array lies among all weights, and its shape."""
        places, start = {}, 0
        for name, shape in self.spec.layout.shapes.items():
            stop = start + int(np.prod(shape))
            places[name] = (slice(start, stop), shape)
            start = stop
        return places

    @property
    def size(self) -> int:
        """Number of free weights."""
        return int(self._free.sum())

    def unpack(self, theta: Float[Array, " P"]) -> dict[str, Array]:
        """Weight arrays by name."""
        full = np.zeros(self._free.shape)
        if self.held is not None:
            full[self._every] = self.held
        full[self._free] = theta
        return {name: full[part].reshape(shape) for name, (part, shape) in self._places.items()}

    def pack(self, weights: dict[str, Array]) -> Float[Array, " P"]:
        """θ of weight arrays."""
        return np.concatenate([weights[name].ravel() for name in self.spec.layout.shapes])[self._free]

    def pack_mask(self, masks: dict[str, NDArray[np.bool_]]) -> NDArray[np.bool_]:
        """Which entries of θ are chosen by masks on the weight arrays."""
        return np.concatenate([masks[name].ravel() for name in self.spec.layout.shapes])[self._free]

    # ── values ───────────────────────────────────────────────────────────────────────────────────────────

    def residual(self, theta: Float[Array, " P"], data: Assembly) -> Float[Array, "B n"]:
        """Equations of motion less the forces in the data, in units of `Scales.force`."""
        return self._forward(self.unpack(theta), data).residual

    def _forward(self, weights: dict[str, Array], data: Assembly) -> _Forward:
        basis, slopes = self.basis(weights, data)
        outputs, gradients = _outputs(weights, basis, slopes)
        f, df = self._terms(outputs, gradients)
        other, slip = self.others(weights, data)
        residual = np.einsum("bnt,bt->bn", data.value, f) + other
        residual += np.einsum("bntz,btz->bn", data.gradient, df)
        return _Forward(basis, slopes, outputs, gradients, slip, residual)

    def others(
        self, weights: dict[str, Array], data: Assembly
    ) -> tuple[Float[Array, "B n"], tuple[Float[Array, "B n k"], Float[Array, "B n k"]]]:
        """What is no function of position: coupling, friction, offsets, less the forces; and `_slip`."""
        force = coupling_columns(self.spec.layout, data.velocity) @ weights["lagrangian.coupling"]
        force += weights["dissipation.viscous"] ** 2 * data.velocity
        force -= weights["lagrangian.offset"] * data.push + data.target
        a, s = weights["dissipation.friction"], friction_width(weights)
        slip = self._slip(data.velocity[:, :, None] / s)
        force += np.einsum("nk,bnk->bn", a**2 * s, slip[0])
        if self.spec.layout.drag:
            force += weights["dissipation.quadratic"] ** 2 * data.velocity * np.abs(data.velocity)
        return force, slip

    def _slip(self, x: Float[Array, "B n k"]) -> tuple[Float[Array, "B n k"], Float[Array, "B n k"]]:
        """Force of each friction unit at q̇/s, and its derivative: tanh x, and x exp(−x²/2) for Stribeck's."""
        force = np.tanh(x)
        slope = 1 - force**2
        if self.spec.layout.bumps:
            at = x[:, :, -1]
            fall = np.exp(-(at**2) / 2)
            force[:, :, -1], slope[:, :, -1] = at * fall, (1 - at**2) * fall
        return force, slope

    def friction(self, weights: dict[str, Array], data: Assembly) -> Float[Array, "B n f"]:
        """Forces of viscous friction, of each friction unit and of drag, before their strengths."""
        s, v = friction_width(weights), data.velocity[:, :, None]
        return np.concatenate([v, s * self._slip(v / s)[0], v * np.abs(v)], axis=2)

    def basis(
        self, weights: dict[str, Array], data: Assembly
    ) -> tuple[Float[Array, "B H"], Float[Array, "B H nz"]]:
        """[1, z, products, tanh(Wz + b)] and derivatives."""
        w = weights["lagrangian.hidden.weight"]
        hidden = np.tanh(data.z @ w.T + weights["lagrangian.hidden.bias"])
        return (
            np.concatenate([data.basis, hidden], axis=1),
            np.concatenate([data.slopes, (1 - hidden**2)[:, :, None] * w], axis=1),
        )

    def _terms(
        self, outputs: Float[Array, "B O"], gradients: Float[Array, "B O nz"]
    ) -> tuple[Float[Array, "B T"], Float[Array, "B T nz"]]:
        """Functions f_t from outputs: M_ij = Σ_c L_ic L_jc + ε_i δ_ij; A and V are outputs themselves."""
        layout, rows = self.spec.layout, self.spec.layout.rows
        f = np.empty((len(outputs), len(layout.terms)))
        df = np.empty((len(outputs), len(layout.terms), gradients.shape[2]))
        for t, (kind, i, j) in enumerate(layout.terms):
            if kind == "M":
                left, right = outputs[:, rows[i]], outputs[:, rows[j]]
                f[:, t] = np.einsum("bc,bc->b", left, right) + (self.spec.epsilon[i] if i == j else 0.0)
                df[:, t] = np.einsum("bc,bcz->bz", left, gradients[:, rows[j]])
                df[:, t] += df[:, t] if i == j else np.einsum("bc,bcz->bz", right, gradients[:, rows[i]])
            else:
                row = layout.outputs.index((kind, i, j))
                f[:, t], df[:, t] = outputs[:, row], gradients[:, row]
        return f, df

    def balance(
        self, weights: dict[str, Array], data: Assembly
    ) -> tuple[Float[Array, "B n"], Float[Array, "B n n"]]:
        """The residual, and the mass matrix M."""
        forward, layout = self._forward(weights, data), self.spec.layout
        n = data.target.shape[1]
        mass = np.zeros((len(data), n, n))
        for kind, i, j in layout.terms:
            if kind == "M":
                left, right = forward.outputs[:, layout.rows[i]], forward.outputs[:, layout.rows[j]]
                mass[:, i, j] = mass[:, j, i] = np.einsum("bc,bc->b", left, right)
        mass[:, range(n), range(n)] += self.spec.epsilon
        return forward.residual, mass

    def outputs(
        self, weights: dict[str, Array], data: Assembly, curvature: Float[Array, "B nd nz nz"]
    ) -> tuple[Float[Array, "B O"], Float[Array, "B O nz"], Float[Array, "B O nz nz"]]:
        """Outputs with first and second derivatives with respect to z.

        Args:
            weights: arrays by name.
            data: the samples.
            curvature: second derivatives of the direct path's functions.
        """
        basis, slopes = self.basis(weights, data)
        out, w = weights["lagrangian.output"], weights["lagrangian.hidden.weight"]
        start = self.spec.layout.basis - self.spec.layout.hidden
        tanh = basis[:, start:]
        bent = (-2 * tanh * (1 - tanh**2)) @ _outer(out[:, start:], w)
        second = np.einsum("oh,bhjk->bojk", out[:, :start], curvature) + bent.reshape(
            len(basis), len(out), *curvature.shape[2:]
        )
        return (*_outputs(weights, basis, slopes), second)

    def friction_slope(self, weights: dict[str, Array], v: Float[Array, "B n"]) -> Float[Array, "B n"]:
        """∂²D/∂q̇² of each velocity."""
        slope = self._slip(v[:, :, None] / friction_width(weights))[1]
        curvature = np.einsum("nk,bnk->bn", weights["dissipation.friction"] ** 2, slope)
        drag = 2 * weights["dissipation.quadratic"] ** 2 * np.abs(v)
        return np.asarray(curvature + weights["dissipation.viscous"] ** 2 + drag)

    # ── derivatives ──────────────────────────────────────────────────────────────────────────────────────

    def jacobian(
        self, theta: Float[Array, " P"], data: Assembly
    ) -> tuple[Float[Array, "B n"], Float[Array, "B n P"]]:
        """Residual and its derivatives with respect to θ."""
        weights, layout = self.unpack(theta), self.spec.layout
        forward = self._forward(weights, data)
        value, gradient = self._output_coefficients(forward, data)  # (B, n, O), (B, n, O, nz)
        (rows, n, _), used = value.shape, self._used
        output = value[..., None] * forward.basis[:, None, None, :used]  # (B, n, O, used)
        for j in range(gradient.shape[3]):
            output += gradient[..., j, None] * forward.slopes[:, None, None, :used, j]
        parts = (
            [] if used < layout.basis else [*self._hidden_columns(weights, forward, data, value, gradient)]
        )
        parts += [
            output.reshape(rows, n, -1),
            coupling_columns(layout, data.velocity),
            -np.eye(n) * data.push[:, :, None],
            *_dissipation_columns(weights, forward, data),
        ]
        return forward.residual, np.concatenate(parts, axis=2)[:, :, self._columns]

    @cached_property
    def _used(self) -> int:
        """So many functions of the basis does θ have weights for: not the hidden units where it has none."""
        layout = self.spec.layout
        places, shape = self._places["lagrangian.output"]
        hidden = (
            self._free[: places.start].any() or self._free[places].reshape(shape)[:, -layout.hidden :].any()
        )
        return layout.basis if hidden else layout.basis - layout.hidden

    @cached_property
    def _columns(self) -> NDArray[np.bool_]:
        """Which of the columns that `jacobian` makes belong to θ."""
        if self._used == self.spec.layout.basis:
            return self._free
        places, shape = self._places["lagrangian.output"]
        output = self._free[places].reshape(shape)[:, : self._used]
        return np.concatenate([output.ravel(), self._free[places.stop :]])

    def _output_coefficients(
        self, forward: _Forward, data: Assembly
    ) -> tuple[Float[Array, "B n O"], Float[Array, "B n O nz"]]:
        """Derivatives of the residual with respect to each output's value and gradient."""
        layout, rows, (samples, n) = self.spec.layout, self.spec.layout.rows, data.target.shape
        value = np.zeros((samples, n, len(layout.outputs)))
        gradient = np.zeros((*value.shape, data.z.shape[1]))
        for t, (kind, i, j) in enumerate(layout.terms):
            by_value, by_gradient = data.value[:, :, t], data.gradient[:, :, t]
            if kind != "M":
                row = layout.outputs.index((kind, i, j))
                value[:, :, row] += by_value
                gradient[:, :, row] += by_gradient
                continue
            for one, other in ((rows[i], rows[j]), (rows[j], rows[i])):
                partner = forward.outputs[:, None, other]
                slope = np.einsum("bnz,bcz->bnc", by_gradient, forward.gradients[:, other])
                value[:, :, one] += by_value[:, :, None] * partner + slope
                gradient[:, :, one] += by_gradient[:, :, None] * partner[..., None]
        return value, gradient

    def _hidden_columns(
        self,
        weights: dict[str, Array],
        forward: _Forward,
        data: Assembly,
        value: Float[Array, "B n O"],
        gradient: Float[Array, "B n O nz"],
    ) -> tuple[Float[Array, "B n W"], Float[Array, "B n h"]]:
        """Columns of the hidden layer's weights and biases."""
        h, (rows, n, _, nz) = self.spec.layout.hidden, gradient.shape
        w = weights["lagrangian.hidden.weight"]
        out = weights["lagrangian.output"][:, self.spec.layout.basis - h :]  # (O, h)
        tanh = forward.basis[:, self.spec.layout.basis - h :]
        first = 1 - tanh**2
        by_slope = np.einsum("bnoz,oh->bnhz", gradient, out)
        bias = np.einsum("bno,oh->bnh", value, out) * first[:, None]
        bias -= np.einsum("bnhz,hz->bnh", by_slope, w) * (2 * tanh * first)[:, None]
        weight = bias[..., None] * data.z[:, None, None] + by_slope * first[:, None, :, None]
        return weight.reshape(rows, n, h * nz), bias


def coupling_columns(layout: Layout, velocity: Float[Array, "B n"]) -> Float[Array, "B n C"]:
    """What each K_ij contributes to the equations: (K − Kᵀ) q̇."""
    columns = np.zeros((*velocity.shape, len(layout.couplings)))
    for k, (i, j) in enumerate(layout.couplings):
        columns[:, i, k] = velocity[:, j]
        columns[:, j, k] = -velocity[:, i]
    return columns


def _outer(out: Float[Array, "O h"], w: Float[Array, "h nz"]) -> Float[Array, "h k"]:
    """Of each unit: its share in each output times the square of its slopes, k = O·nz·nz."""
    return np.asarray(np.einsum("oh,hj,hk->hojk", out, w, w).reshape(len(w), len(out) * w.shape[1] ** 2))


def _outputs(
    weights: dict[str, Array], basis: Float[Array, "B H"], slopes: Float[Array, "B H nz"]
) -> tuple[Float[Array, "B O"], Float[Array, "B O nz"]]:
    """Network outputs and their derivatives."""
    out = weights["lagrangian.output"]
    return basis @ out.T, np.matmul(out, slopes)


def _dissipation_columns(weights: dict[str, Array], forward: _Forward, data: Assembly) -> list[Array]:
    """Columns of D's viscous, friction, width and drag weights."""
    v, (rows, n) = data.velocity, data.velocity.shape
    a, s = weights["dissipation.friction"], friction_width(weights)
    force, slope = forward.slip  # (B, n, k)
    viscous = 2 * weights["dissipation.viscous"] * v
    friction = 2 * a * s * force
    width = a**2 * (force - v[:, :, None] / s * slope) * (s - NARROWEST)
    drag = 2 * weights["dissipation.quadratic"] * v * np.abs(v)
    # A velocity's friction acts in its own equation alone.
    own = np.eye(n)
    return [
        viscous[:, :, None] * own,
        (friction[:, :, None] * own[:, :, None]).reshape(rows, n, -1),
        (width[:, :, None] * own[:, :, None]).reshape(rows, n, -1),
        drag[:, :, None] * own,
    ]

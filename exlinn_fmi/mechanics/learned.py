"""Learned extended Lagrangian systems: what the networks for 𝓛 and D look like, and their CasADi form.

Two forms of two networks (𝓛 and D) that are trained together, and one without any:

``structured``
    𝓛 = ½ q̇ᵀM(q)q̇ + (Kq + A(q))ᵀq̇ − V(q) with M = L(q)L(q)ᵀ + ε ≻ 0, apart for mechanical and electrical
    coordinates. L, A and V are the outputs of one network with a hidden tanh layer and a direct path; K is a
    strictly triangular constant (a coupling like k_e·Q̇·α is linear in q, which no periodic function holds).
    D = Σᵢ ½ bᵢ² q̇ᵢ² + Σₖ aᵢₖ² sᵢₖ² log cosh(q̇ᵢ/sᵢₖ): convex, D(0) = 0, D'(0) = 0, of bounded curvature.
    Positions of lines saturate far outside the data (`saturate`), so that M and V are bounded everywhere:
    with M ≻ 0 and viscous friction, bounded inputs then move the model at bounded velocities for ever.
``features``
    The paper's: monomials of (q, q̇) into one hidden ReLU layer, one output, for 𝓛 and for D.
``terms``
    𝓛 = Σ p_k φ_k(q, q̇) and D = Σ p_k ψ_k(q̇) with monomials φ and ψ; those with p_k = 0 are left out.

Networks see dimensionless quantities only: `Scales` carries the units, so that training does not know them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import combinations_with_replacement, pairwise
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, check_coordinates
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol
from exlinn_fmi.mechanics.friction import log_cosh
from exlinn_fmi.mechanics.monomials import MonomialBasis

Weights = Mapping[str, NDArray[np.float64]]

NARROWEST = 0.02
"""Least width of a friction unit, relative to the rms velocity: anything sharper is as good as a jump."""

FAITHFUL = 2.0
"""The position of a line is what it is within so many times its reach in the data; there it saturates."""

TURN = {"rad": 2 * np.pi, "mrad": 2000 * np.pi, "deg": 360.0, "rev": 1.0}
"""A full turn in the units that an angle may have; any other is read as rad."""


@dataclass(frozen=True)
class Scales:
    """The units in which a structured model sees its data; n numbers each where not said otherwise.

    q̂ = q/position, q̇̂ = q̇·time/position, q̈̂ = q̈·time²/position, F̂ = F·position/energy: the equations of
    motion keep their form.

    Args:
        time: [s], a single number.
        energy: [J], a single number.
        position: in the unit of each coordinate.
        centre: middle of the range of q in the data, 0 where the coordinate is no line.
        reach: half of that range, 1 where the coordinate is no line.
    """

    time: float
    energy: float
    position: tuple[float, ...]
    centre: tuple[float, ...]
    reach: tuple[float, ...]

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Unit of each velocity."""
        return np.array(self.position) / self.time

    @property
    def force(self) -> NDArray[np.float64]:
        """Unit of each generalised force."""
        return self.energy / np.array(self.position)


@dataclass(frozen=True)
class ModelSpec:
    """Everything about a learned model but its weights.

    Args:
        form: ``structured``, ``features`` or ``terms``.
        coordinates: the generalised coordinates.
        hidden: units of the hidden layer of each network.
        scales: units of a structured model; None for features.
        epsilon: smallest dimensionless mass of each coordinate (structured), shape (n,).
        lagrangian_features: monomials for 𝓛 (features and terms).
        dissipation_features: monomials for D (features and terms).
    """

    form: Literal["structured", "features", "terms"]
    coordinates: tuple[Coordinate, ...]
    hidden: int
    scales: Scales | None = None
    epsilon: tuple[float, ...] = ()
    lagrangian_features: tuple[str, ...] = ()
    dissipation_features: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_coordinates(self.coordinates)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ModelSpec:
        """The spec that `to_dict` described.

        Raises:
            ModelError: a key is missing or unknown, or a value does not fit.
        """
        try:
            plain: dict[str, Any] = _with_tuples(data)
            plain["coordinates"] = tuple(Coordinate(**c) for c in data["coordinates"])
            if plain.get("scales") is not None:
                plain["scales"] = Scales(**_with_tuples(data["scales"]))
            spec = cls(**plain)
            spec.shapes()
        except (TypeError, KeyError, AttributeError, ValueError) as error:
            raise ModelError(f"not the description of a model that this version can read: {error}") from error
        return spec

    @cached_property
    def layout(self) -> Layout:
        """How the structured networks are laid out."""
        return Layout(self)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each weight array.

        Raises:
            ModelError: the form is not known.
        """
        if self.form == "structured":
            return self.layout.shapes
        if self.form == "features":
            inputs = {"lagrangian": self.lagrangian_features, "dissipation": self.dissipation_features}
            return {
                f"{network}.{part}": shape
                for network, features in inputs.items()
                for part, shape in {
                    "hidden.weight": (self.hidden, len(features)),
                    "hidden.bias": (self.hidden,),
                    "output.weight": (self.hidden,),
                }.items()
            }
        if self.form == "terms":
            return {
                "lagrangian.terms": (len(self.lagrangian_features),),
                "dissipation.terms": (len(self.dissipation_features),),
            }
        raise ModelError(f"unknown form of model {self.form!r}; expected 'structured', 'features' or 'terms'")


def _with_tuples(data: Mapping[str, Any]) -> dict[str, Any]:
    """JSON's lists as tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}


class Layout:
    """Sizes and index sets of the structured networks, derived from the coordinates alone.

    Network inputs z are the topology features: sin and cos of a circle, the scaled position of a line,
    nothing of a cyclic coordinate. Each output is linear in the basis [1, z, products, tanh(Wz + b)].

    Attributes:
        positions: coordinates that are not cyclic.
        owners: for each feature z the coordinate that it comes from.
        products: two or three features that are multiplied: of different coordinates, or of a line.
        blocks: members of each diagonal block of M.
        columns: number of columns of L in each block.
        terms: the functions of q in 𝓛: ("M", i, j), ("A", i, i) and ("V", 0, 0).
        outputs: the network's outputs: ("L", i, column), ("A", i, i), ("V", 0, 0).
        rows: for each coordinate the outputs that are its row of L.
        couplings: (i, j) for each constant K_ij q_j q̇_i.
    """

    def __init__(self, spec: ModelSpec) -> None:
        kinds = [c.kind for c in spec.coordinates]
        n = len(kinds)
        topologies = [c.topology for c in spec.coordinates]
        self.positions = [i for i in range(n) if topologies[i] != "cyclic"]
        self.owners = [i for i in self.positions for _ in range(2 if topologies[i] == "circle" else 1)]
        self.products = [
            product
            for degree in (2, 3)
            for product in combinations_with_replacement(range(len(self.owners)), degree)
            if all(
                self.owners[a] != self.owners[b] or topologies[self.owners[a]] == "line"
                for a, b in pairwise(product)
            )
        ]
        blocks = [[i for i in range(n) if kinds[i] == kind] for kind in ("mechanical", "electrical")]
        self.blocks = [block for block in blocks if block]
        self.columns = [len(block) + len(self.positions) for block in self.blocks]
        # One component of A can be gauged away: 𝓛 + d/dt χ(q) has the same equations of motion.
        free = [i for i in range(n) if i not in self.positions[:1]] if self.positions else []
        self.terms: list[tuple[str, int, int]] = [
            ("M", *ij) for block in self.blocks for ij in combinations_with_replacement(block, 2)
        ]
        self.terms += [("A", i, i) for i in free] + [("V", 0, 0)] * bool(self.positions)
        self.outputs: list[tuple[str, int, int]] = [
            ("L", i, c)
            for block, columns in zip(self.blocks, self.columns, strict=True)
            for i in block
            for c in range(columns)
        ]
        self.outputs += [term for term in self.terms if term[0] != "M"]
        self.rows = {
            i: slice(self.outputs.index(("L", i, 0)), self.outputs.index(("L", i, columns - 1)) + 1)
            for block, columns in zip(self.blocks, self.columns, strict=True)
            for i in block
        }
        # K_ij q_j q̇_i and K_ji q_i q̇_j differ by a gauge: write it with a q that is no charge if there is
        # one.
        order = sorted(range(n), key=lambda i: (topologies[i] == "cyclic", kinds[i] == "electrical", i))
        self.couplings = [(order[b], order[a]) for a in range(n) for b in range(a + 1, n)]
        self.hidden = spec.hidden if self.positions else 0
        self.basis = 1 + len(self.owners) + len(self.products) + self.hidden
        self.friction = -(-spec.hidden // n)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each weight array."""
        n = sum(len(block) for block in self.blocks)
        return {
            "lagrangian.hidden.weight": (self.hidden, len(self.owners)),
            "lagrangian.hidden.bias": (self.hidden,),
            "lagrangian.output": (len(self.outputs), self.basis),
            "lagrangian.coupling": (len(self.couplings),),
            "dissipation.viscous": (n,),
            "dissipation.friction": (n, self.friction),
            "dissipation.width": (n, self.friction),
        }

    @property
    def free(self) -> dict[str, NDArray[np.bool_]]:
        """Which weights are trained: constants in A and V have no effect and stay 0."""
        masks = {name: np.ones(shape, dtype=bool) for name, shape in self.shapes.items()}
        masks["lagrangian.output"][[kind != "L" for kind, _, _ in self.outputs], 0] = False
        return masks

    @property
    def direct(self) -> dict[str, NDArray[np.bool_]]:
        """Those of the free weights that need no hidden unit: the direct path, K and viscous friction."""
        masks = self.free
        masks["lagrangian.output"][:, self.basis - self.hidden :] = False
        for name in masks.keys() - {"lagrangian.output", "lagrangian.coupling", "dissipation.viscous"}:
            masks[name][:] = False
        return masks


def angular(coordinate: Coordinate) -> float:
    """Factor from the unit of an angle to rad."""
    return 2 * np.pi / TURN.get(coordinate.unit, TURN["rad"])


def learned_system(spec: ModelSpec, weights: Weights) -> LagrangianSystem:
    """The equations of motion of a learned model.

    Args:
        spec: its description.
        weights: arrays of the shapes that `spec.shapes()` says.

    Raises:
        ModelError: an array is missing, of the wrong shape, or holds values that are not finite.
    """
    check_weights(spec, weights)
    if spec.form == "terms":
        p = np.concatenate([weights["lagrangian.terms"], weights["dissipation.terms"]])
        found = MonomialBasis(spec.coordinates, spec.lagrangian_features, spec.dissipation_features)
        return found.only(p != 0).system().bound(p[p != 0])
    if spec.form == "features":
        basis = MonomialBasis(spec.coordinates, spec.lagrangian_features, spec.dissipation_features)
        return LagrangianSystem.build(
            spec.coordinates,
            lambda q, v, p: _relu_network(weights, "lagrangian", basis.expressions(q, v)[0]),
            lambda v, p: _relu_network(weights, "dissipation", basis.expressions(0 * v, v)[1]),
        )
    return LagrangianSystem.build(
        spec.coordinates,
        lambda q, v, p: _structured_lagrangian(spec, weights, q, v),
        lambda v, p: _structured_dissipation(spec, weights, v),
    )


def check_weights(spec: ModelSpec, weights: Weights) -> None:
    """Refuse weights that do not belong to a spec.

    Raises:
        ModelError: an array is missing, superfluous, of the wrong shape, or holds values that are not finite.
    """
    shapes = spec.shapes()
    for name in sorted(shapes.keys() ^ weights.keys()):
        raise ModelError(
            f"weights: {name!r} is {'missing' if name in shapes else 'not part of this form of model'}"
        )
    for name, shape in shapes.items():
        if weights[name].shape != shape:
            raise ModelError(f"weights: {name!r} has shape {weights[name].shape}, expected {shape}")
        if not np.isfinite(weights[name]).all():
            raise ModelError(f"weights: {name!r} holds values that are not finite; train the model again")


def _relu_network(weights: Weights, network: str, inputs: Symbol) -> Symbol:
    """One hidden ReLU layer and one output."""
    weight, bias, output = (
        ca.DM(weights[f"{network}.{part}"]) for part in ("hidden.weight", "hidden.bias", "output.weight")
    )
    hidden = ca.mtimes(weight, inputs) + bias
    return ca.dot(output, hidden * (hidden > 0))


def topology_features(spec: ModelSpec, q: Symbol) -> Symbol:
    """Network inputs z(q): sin and cos of circles, (q − centre)/reach of lines, saturated."""
    assert spec.scales is not None
    features = []
    for i in spec.layout.positions:
        c = spec.coordinates[i]
        if c.topology == "circle":
            features += [ca.sin(angular(c) * q[i]), ca.cos(angular(c) * q[i])]
        else:
            features.append(saturate((q[i] - spec.scales.centre[i]) / spec.scales.reach[i]))
    return ca.vertcat(ca.SX(0, 1), *features)


def saturate(z: Symbol) -> Symbol:
    """Keep z up to ±`FAITHFUL`, lead it from there on twice differentiably towards ±(`FAITHFUL` + 1).

    A polynomial of a position leads a model that has left its data off to infinity in finite time; nothing
    is known there but that the plant would not do that.
    """
    beyond = ca.fmax(ca.fabs(z) - FAITHFUL, 0)
    return z - ca.sign(z) * (beyond - ca.tanh(beyond))


def _structured_lagrangian(spec: ModelSpec, weights: Weights, q: Symbol, v: Symbol) -> Symbol:
    """𝓛 of the structured form [J]."""
    assert spec.scales is not None
    layout, scales = spec.layout, spec.scales
    z = topology_features(spec, q)
    x, w = q / ca.DM(scales.position), v / ca.DM(scales.velocity)
    products = [math.prod(z[a] for a in product) for product in layout.products]
    hidden = ca.tanh(
        ca.mtimes(ca.DM(weights["lagrangian.hidden.weight"]), z) + ca.DM(weights["lagrangian.hidden.bias"])
    )
    basis = ca.vertcat(1, z, *products, hidden) if layout.positions else ca.SX(1)
    output = weights["lagrangian.output"]
    momentum: dict[
        tuple[int, int], Symbol
    ] = {}  # (block, column) → Σᵢ L_ic w_i, so that ½ Σ_c (…)² = ½ wᵀLLᵀw
    energy = ca.SX(0)
    block_of = {i: b for b, block in enumerate(layout.blocks) for i in block}
    for row, (kind, i, c) in enumerate(layout.outputs):
        value = ca.mtimes(ca.DM(output[row : row + 1]), basis)
        if kind == "L":
            key = (block_of[i], c)
            momentum[key] = momentum.get(key, 0) + value * w[i]
        else:
            energy += value * w[i] if kind == "A" else -value
    energy += sum(m**2 for m in momentum.values()) / 2 + ca.dot(ca.DM(spec.epsilon), w**2) / 2
    for k, (i, j) in enumerate(layout.couplings):
        energy += float(weights["lagrangian.coupling"][k]) * x[j] * w[i]
    return scales.energy * energy


def _structured_dissipation(spec: ModelSpec, weights: Weights, v: Symbol) -> Symbol:
    """D of the structured form [W]."""
    assert spec.scales is not None
    viscous, friction = weights["dissipation.viscous"], weights["dissipation.friction"]
    width = friction_width(weights)
    power = ca.SX(0)
    for i, unit in enumerate(spec.scales.velocity):
        w = v[i] / unit
        power += viscous[i] ** 2 / 2 * w**2
        for a, s in zip(friction[i], width[i], strict=True):
            power += (a * s) ** 2 * log_cosh(w / s)
    return spec.scales.energy / spec.scales.time * power


def friction_width(weights: Weights) -> NDArray[np.float64]:
    """Widths s of the friction units, relative to the velocities' units, shape (n, units)."""
    return NARROWEST + np.exp(weights["dissipation.width"])

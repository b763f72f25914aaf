"""Learned extended Lagrangian systems: what the networks for 𝓛 and D look like, and their CasADi form.

Two forms of two networks (𝓛 and D) that are trained together, and one without any:

``structured``
    𝓛 = ½ q̇ᵀM(q)q̇ + (Kq + A(q))ᵀq̇ − V(q) with M = L(q)L(q)ᵀ + ε ≻ 0, apart for mechanical and electrical
    coordinates. L, A and V are the outputs of one network with a hidden tanh layer and a direct path; K is a
    strictly triangular constant (a coupling like k_e·Q̇·α is linear in q, which no periodic function holds).
    D = Σᵢ ½ bᵢ² q̇ᵢ² + Σₖ aᵢₖ² sᵢₖ² log cosh(q̇ᵢ/sᵢₖ): convex, D(0) = 0, D'(0) = 0, of bounded curvature;
    where the user says so with dᵢ² |q̇ᵢ|³/3 and with Stribeck's bump in place of a log cosh, which dissipates
    at any speed, too. A constant force oᵢ of unknown size is oᵢ qᵢ in 𝓛.
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
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.errors import ModelError
from exlinn_fmi.mechanics.coordinates import Coordinate, Parameter, check_coordinates, full_turn
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol
from exlinn_fmi.mechanics.friction import log_cosh, stribeck
from exlinn_fmi.mechanics.layout import Layout
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.mechanics.structure import UNKNOWN, Structure

Weights = Mapping[str, NDArray[np.float64]]

NARROWEST = 0.02
"""Least width of a friction unit, relative to the rms velocity: anything sharper is as good as a jump."""

FAITHFUL = 2.0
"""The position of a line is what it is within so many times its reach in the data; there it saturates."""


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
        structure: which energies the plant has; what it has not, the structured networks have not either.
        inside: parameters inside functions of the monomials (terms), and where they were looked for.
        depth: hidden layers of a structured model, all of `hidden` units; what is trained here has one.
    """

    form: Literal["structured", "features", "terms"]
    coordinates: tuple[Coordinate, ...]
    hidden: int
    scales: Scales | None = None
    epsilon: tuple[float, ...] = ()
    lagrangian_features: tuple[str, ...] = ()
    dissipation_features: tuple[str, ...] = ()
    structure: Structure = UNKNOWN
    inside: tuple[tuple[str, float], ...] = ()
    depth: int = 1

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
            plain["structure"] = Structure(**_with_tuples(data["structure"]))
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

    @property
    def basis(self) -> MonomialBasis:
        """Its monomials."""
        return MonomialBasis(
            self.coordinates,
            self.lagrangian_features,
            self.dissipation_features,
            tuple(Parameter(name, value, "") for name, value in self.inside),
        )

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
                "shapes": (len(self.inside),),
            }
        raise ModelError(f"unknown form of model {self.form!r}; expected 'structured', 'features' or 'terms'")


def _with_tuples(data: Mapping[str, Any]) -> dict[str, Any]:
    """JSON's lists as tuples."""

    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    return {key: tuples(value) for key, value in data.items()}


@dataclass(frozen=True)
class Networks:
    """A structured model: description and weights."""

    spec: ModelSpec
    weights: Weights


def angular(coordinate: Coordinate) -> float:
    """Factor from the unit of an angle to rad."""
    return 2 * np.pi / full_turn(coordinate.unit)


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
        p = np.concatenate([weights[name] for name in ("lagrangian.terms", "dissipation.terms", "shapes")])
        found = spec.basis
        chosen = p[: found.size] != 0
        return found.only(chosen).system().bound(p[found.kept(chosen)])
    if spec.form == "features":
        basis = spec.basis
        return LagrangianSystem.build(
            spec.coordinates,
            lambda q, v, p: _relu_network(weights, "lagrangian", basis.expressions(q, v)[0]),
            lambda v, p: _relu_network(weights, "dissipation", basis.expressions(0 * v, v)[1]),
        )
    system = LagrangianSystem.build(
        spec.coordinates,
        lambda q, v, p: structured_lagrangian(spec, weights, q, v),
        lambda v, p: structured_dissipation(spec, weights, v),
    )
    return replace(system, networks=Networks(spec, weights))


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


def hidden_layers(
    spec: ModelSpec, weights: Weights
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Weights and biases of each hidden layer of the structured 𝓛."""
    for name in ("hidden", *(f"hidden_{layer}" for layer in range(2, spec.depth + 1))):
        yield weights[f"lagrangian.{name}.weight"], weights[f"lagrangian.{name}.bias"]


def structured_lagrangian(
    spec: ModelSpec, weights: Weights, q: Symbol, v: Symbol, network: Symbol | None = None
) -> Symbol:
    """𝓛 of the structured form [J].

    Args:
        spec: the model.
        weights: its weights.
        q: coordinates, a symbol or expression (n).
        v: velocities (n).
        network: what the hidden units give to each output, if it is known from elsewhere.
    """
    assert spec.scales is not None
    layout, scales = spec.layout, spec.scales
    z = topology_features(spec, q)
    x, w = q / ca.DM(scales.position), v / ca.DM(scales.velocity)
    products = [math.prod(z[a] for a in product) for product in layout.products]
    hidden = z
    for weight, bias in hidden_layers(spec, weights) if network is None else ():
        hidden = ca.tanh(ca.mtimes(ca.DM(weight), hidden) + ca.DM(bias))
    basis = ca.vertcat(1, z, *products, hidden) if layout.positions else ca.SX(1)
    output = weights["lagrangian.output"]
    if network is not None:
        basis, output = ca.vertcat(1, z, *products), output[:, : layout.basis - layout.hidden]
    momentum: dict[
        tuple[int, int], Symbol
    ] = {}  # (block, column) → Σᵢ L_ic w_i, so that ½ Σ_c (…)² = ½ wᵀLLᵀw
    energy = ca.SX(0)
    block_of = {i: b for b, block in enumerate(layout.blocks) for i in block}
    for row, (kind, i, c) in enumerate(layout.outputs):
        value = ca.mtimes(ca.DM(output[row : row + 1]), basis) + (0 if network is None else network[row])
        if kind == "L":
            key = (block_of[i], c)
            momentum[key] = momentum.get(key, 0) + value * w[i]
        else:
            energy += value * w[i] if kind == "A" else -value
    energy += sum(m**2 for m in momentum.values()) / 2 + ca.dot(ca.DM(spec.epsilon), w**2) / 2
    for k, (i, j) in enumerate(layout.couplings):
        energy += float(weights["lagrangian.coupling"][k]) * x[j] * w[i]
    energy += ca.dot(ca.DM(weights["lagrangian.offset"]), x)
    return scales.energy * energy


def structured_dissipation(spec: ModelSpec, weights: Weights, v: Symbol) -> Symbol:
    """D of the structured form [W]; arguments as for `structured_lagrangian`."""
    assert spec.scales is not None
    viscous, friction = weights["dissipation.viscous"], weights["dissipation.friction"]
    width, quadratic = friction_width(weights), weights["dissipation.quadratic"]
    smooth = spec.layout.friction - spec.layout.bumps
    power = ca.SX(0)
    for i, unit in enumerate(spec.scales.velocity):
        w = v[i] / unit
        power += viscous[i] ** 2 / 2 * w**2 + quadratic[i] ** 2 / 3 * ca.fabs(w) ** 3
        for k, (a, s) in enumerate(zip(friction[i], width[i], strict=True)):
            power += (a * s) ** 2 * (log_cosh if k < smooth else stribeck)(w / s)
    return spec.scales.energy / spec.scales.time * power


def friction_width(weights: Weights) -> NDArray[np.float64]:
    """Widths s of the friction units, relative to the velocities' units, shape (n, units)."""
    return NARROWEST + np.exp(weights["dissipation.width"])

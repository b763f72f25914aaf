"""A learned system with its network outside: equations of what the network gives, not of its weights.

The equations of motion need a network's outputs and their slopes at one point, no more: in place of the
network stands its expansion r₀ + R (z − z₀) to first order, whose derivatives at z = z₀ are the same. So the
equations stay short however wide and deep the network is, which is evaluated apart, in loops over its
weights. That holds for networks of position (``structured``), which enter 𝓛 times velocities, and for ReLU
networks (``features``), whose second derivatives are 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.mechanics.coordinates import Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, Symbol
from exlinn_fmi.mechanics.learned import (
    ModelSpec,
    Weights,
    check_weights,
    hidden_layers,
    structured_dissipation,
    structured_lagrangian,
    topology_features,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Network:
    """Fully connected layers and a linear output without a bias.

    Args:
        layers: weights (units, inputs) and biases (units,) of each hidden layer.
        output: weights (outputs, units of the last layer).
        activation: of all hidden layers.
    """

    layers: tuple[tuple[Array, Array], ...]
    output: Array
    activation: Literal["tanh", "relu"]

    @property
    def inputs(self) -> int:
        """Number of features."""
        return int(self.layers[0][0].shape[1])

    @property
    def size(self) -> int:
        """Number of outputs and slopes together."""
        return int(self.output.shape[0]) * (1 + self.inputs)

    def value_and_slopes(self, z: Float[Array, " nz"]) -> Float[Array, " size"]:
        """Outputs, and then, feature by feature, their slopes with it.

        Args:
            z: features.
        """
        value, slopes = z, np.eye(len(z))
        for weight, bias in self.layers:
            value, slopes = weight @ value + bias, weight @ slopes
            if self.activation == "tanh":
                value = np.tanh(value)
                slopes = (1 - value**2)[:, None] * slopes
            else:
                slopes = (value > 0)[:, None] * slopes
                value = np.maximum(value, 0)
        return np.concatenate([self.output @ value, (self.output @ slopes).T.ravel()])


@dataclass(frozen=True)
class Expansion:
    """A learned system as equations and a network.

    Args:
        system: its parameters are r, what the network gives, and the features z₀ where it gives that.
        features: (q, v) → z.
        network: z → r.
    """

    system: LagrangianSystem
    features: ca.Function
    network: Network


def expand(spec: ModelSpec, weights: Weights) -> Expansion | None:
    """A learned model with its network outside; None for a model that has none.

    Args:
        spec: its description.
        weights: arrays of the shapes that `spec.shapes()` says.

    Raises:
        ModelError: the weights do not belong to the spec.
    """
    check_weights(spec, weights)
    n = len(spec.coordinates)
    q, v = ca.SX.sym("q", n), ca.SX.sym("v", n)
    if spec.form == "structured" and spec.layout.hidden:
        network = Network(
            tuple(hidden_layers(spec, weights)),
            weights["lagrangian.output"][:, spec.layout.basis - spec.layout.hidden :],
            "tanh",
        )
        features = ca.Function("features", [q, v], [topology_features(spec, q)])
        system = LagrangianSystem.build(
            spec.coordinates,
            lambda q, v, p: structured_lagrangian(
                spec, weights, q, v, _first_order(network, topology_features(spec, q), p)
            ),
            lambda v, p: structured_dissipation(spec, weights, v),
            _parameters(network),
        )
        return Expansion(system, features, network)
    if spec.form == "features":
        return _expand_features(spec, weights, q, v)
    return None


def _expand_features(spec: ModelSpec, weights: Weights, q: Symbol, v: Symbol) -> Expansion:
    """The two ReLU networks side by side as one with the features of both and two outputs."""
    basis = spec.basis
    own = len(spec.lagrangian_features)
    parts = [
        [weights[f"{name}.{part}"] for part in ("hidden.weight", "hidden.bias", "output.weight")]
        for name in ("lagrangian", "dissipation")
    ]
    (w_1, b_1, o_1), (w_2, b_2, o_2) = parts
    weight = np.zeros((len(w_1) + len(w_2), w_1.shape[1] + w_2.shape[1]))
    weight[: len(w_1), :own], weight[len(w_1) :, own:] = w_1, w_2
    output = np.zeros((2, len(weight)))
    output[0, : len(w_1)], output[1, len(w_1) :] = o_1, o_2
    network = Network(((weight, np.concatenate([b_1, b_2])),), output, "relu")

    def seen(q: Symbol, v: Symbol) -> Symbol:
        return ca.vertcat(basis.expressions(q, v)[0], basis.expressions(0 * v, v)[1])

    system = LagrangianSystem.build(
        spec.coordinates,
        lambda q, v, p: _first_order(network, seen(q, v), p)[0],
        lambda v, p: _first_order(network, seen(0 * v, v), p, skip=own)[1],
        _parameters(network),
    )
    return Expansion(system, ca.Function("features", [q, v], [seen(q, v)]), network)


def _parameters(network: Network) -> tuple[Parameter, ...]:
    """Those of an expansion: r and z₀."""
    names = [f"r_{k}" for k in range(network.size)] + [f"z_{k}" for k in range(network.inputs)]
    return tuple(Parameter(name, 0.0, "") for name in names)


def _first_order(network: Network, z: Symbol, p: Symbol, skip: int = 0) -> Symbol:
    """r₀ + R (z − z₀), of the features from number `skip` on: the others move nothing here."""
    outputs, inputs = network.output.shape[0], network.inputs
    slopes = ca.reshape(p[outputs : network.size], outputs, inputs)
    return p[:outputs] + ca.mtimes(slopes[:, skip:], (z - p[network.size :])[skip:])

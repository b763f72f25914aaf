"""Networks that pass first and second derivatives along with their values.

Energy-based learners need ∂𝓛/∂q, ∂²𝓛/∂q̇² and the like inside the loss. Pushing them forward through the
layers gives what `torch.autograd` applied twice would, at a fraction of its cost (a test holds the two
together).

Shapes: B samples, I inputs or outputs, k variables that are derived by.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

Activation = Literal["tanh", "softplus"]


class Jet(NamedTuple):
    """A value (B, I), its first derivatives (B, I, k) and, where asked for, second ones (B, I, k, k)."""

    value: Tensor
    first: Tensor
    second: Tensor | None = None


class Network(nn.Module):
    """A multilayer perceptron with a linear last layer.

    Args:
        inputs: how many.
        outputs: how many.
        width: units of each hidden layer.
        depth: number of hidden layers.
        activation: of the hidden layers.
    """

    def __init__(
        self, inputs: int, outputs: int, width: int = 64, depth: int = 2, activation: Activation = "tanh"
    ) -> None:
        super().__init__()
        sizes = [inputs] + depth * [width] + [outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.activation = activation

    def forward(self, x: Tensor) -> Tensor:
        """Value alone: (B, inputs) → (B, outputs)."""
        function = torch.tanh if self.activation == "tanh" else nn.functional.softplus
        *hidden, last = self.layers
        for layer in hidden:
            x = function(layer(x))
        return last(x)

    def jet(self, x: Jet) -> Jet:
        """Value and derivatives by whatever the inputs are derived by."""
        *hidden, last = self.layers
        for layer in hidden:
            x = self._activate(_affine(layer, x))
        return _affine(last, x)

    def _activate(self, x: Jet) -> Jet:
        if self.activation == "tanh":
            value = torch.tanh(x.value)
            slope = 1 - value**2
            bend = -2 * value * slope
        else:
            value, slope = nn.functional.softplus(x.value), torch.sigmoid(x.value)
            bend = slope * (1 - slope)
        first = slope[..., None] * x.first
        if x.second is None:
            return Jet(value, first)
        outer = x.first[..., :, None] * x.first[..., None, :]
        return Jet(value, first, slope[..., None, None] * x.second + bend[..., None, None] * outer)


def _affine(layer: nn.Module, x: Jet) -> Jet:
    weight = layer.weight
    second = None if x.second is None else torch.einsum("oi,bijk->bojk", weight, x.second)
    return Jet(layer(x.value), weight @ x.first, second)

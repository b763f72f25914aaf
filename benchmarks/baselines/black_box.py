"""Learners that know nothing of mechanics but that velocities are the rates of positions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from baselines.jets import Network
from baselines.learner import Learner
from exlinn_fmi.data.dataset import Dataset


class BlackBox(Learner):
    """A multilayer perceptron from (z(q), q̇, F) to q̈."""

    name = "MLP"
    citation = "Hornik, Stinchcombe, White (1989), Neural Networks 2, 359"
    configuration = "2×64 tanh on (sin α, cos α, α̇, i, v), accelerations as target"

    def build(self) -> None:
        """One network."""
        self.network = Network(self.features + self.n + len(self.inputs), self.n)

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """The network's outputs, in units of the standard deviations."""
        return self.spread * self.network(torch.cat([self.jet(q).value, v, force[:, self.inputs]], 1))


class NeuralOde(BlackBox):
    """The same network, trained through an ODE solver on pieces of the trajectories."""

    name = "neural ODE"
    citation = "Chen et al. (2018), NeurIPS 31; torchdiffeq"
    configuration = "2×64 tanh, torchdiffeq rk4 through 100 ms pieces, states as target"
    steps = 3000
    batch = 64

    nodes = 10
    stride = 10
    """Rows from node to node; even, so that RK4's middle stage falls on a row too."""

    def __init__(self, data: Dataset, seed: int) -> None:
        super().__init__(data, seed)
        frame, length = data.frame, self.nodes * self.stride
        number, time = frame["trajectory"].to_numpy(), frame["time"].to_numpy()
        self.starts = torch.from_numpy(np.flatnonzero(number[length:] == number[:-length]))
        self.interval = float(np.median(np.diff(time))) / self.scales.time

    def draw(self) -> Tensor:
        """First rows of pieces that lie within a trajectory."""
        return self.starts[torch.randint(len(self.starts), (self.batch,), generator=self.random)]

    def loss(self, rows: Tensor) -> Tensor:
        """Mean square error of the states along the pieces, relative to the velocities' variance."""
        from torchdiffeq import odeint

        q, v, _, force = self.samples

        def rate(t: Tensor, state: Tensor) -> Tensor:
            now = rows + int(torch.round(t / self.interval))
            here, speed = state[:, : self.n], state[:, self.n :]
            return torch.cat([speed * mask, self.acceleration(here, speed, force[now])], 1)

        mask = torch.tensor([float(i in self.positions) for i in range(self.n)])
        nodes = torch.arange(0, self.nodes + 1) * self.stride
        states = odeint(rate, torch.cat([q[rows], v[rows]], 1), nodes * self.interval, method="rk4")
        at = rows[None] + nodes[:, None]
        return torch.mean(((states - torch.cat([q[at], v[at]], 2)) / torch.cat(2 * [v.std(dim=0)])) ** 2)

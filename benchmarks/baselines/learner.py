"""What the learners that are trained by PyTorch share: units, features of positions, Adam, and free runs.

All of them see the same dimensionless data (`Scales`, the units that our own learner uses), angles as
(sin, cos), no cyclic position, and clean accelerations: more than most of their papers give them.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from baselines.jets import Jet
from exlinn_fmi.data.dataset import Dataset, Samples
from exlinn_fmi.learn.assembly import data_scales
from exlinn_fmi.mechanics.learned import angular

LOST = 100.0
"""A free run that leaves the measured range by this factor has diverged."""
STRIDE = 10
"""Rows in a step of a free run; even, so that RK4's middle stages fall on a row."""


class Learner(nn.Module, ABC):
    """A model of the accelerations; leaves give its equations.

    Args:
        data: what it will be trained on, which fixes the units.
        seed: of the first weights and of the batches.
    """

    name: ClassVar[str]
    citation: ClassVar[str]
    configuration: ClassVar[str]
    steps: ClassVar[int] = 15_000
    batch: ClassVar[int] = 256
    rate: ClassVar[float] = 2e-3

    def __init__(self, data: Dataset, seed: int) -> None:
        super().__init__()
        self.coordinates = data.coordinates
        self.scales = data_scales(data.arrays, data.coordinates)
        self.samples = self._dimensionless(data.arrays)
        self.spread = self.samples.a.std(dim=0)
        self.positions = [i for i, c in enumerate(self.coordinates) if c.topology != "cyclic"]
        self.inputs = [i for i in range(self.n) if self.samples.F[:, i].std() > 0]
        self.random = torch.Generator().manual_seed(seed)
        torch.manual_seed(seed)
        self.build()

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    @property
    def size(self) -> int:
        """Number of weights."""
        return sum(p.numel() for p in self.parameters())

    # ── what a leaf gives ────────────────────────────────────────────────────────────────────────────────

    @abstractmethod
    def build(self) -> None:
        """Make the networks."""

    @abstractmethod
    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """Dimensionless accelerations (B, n)."""

    def loss(self, rows: Tensor) -> Tensor:
        """Mean square error of the accelerations on some rows of the data, relative to their variance."""
        q, v, a, force = (x[rows] for x in self.samples)
        return torch.mean(((self.acceleration(q, v, force) - a) / self.spread) ** 2)

    # ── features ─────────────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def _owners(self) -> tuple[list[int], list[int], Tensor, Tensor, Tensor]:
        """Circles and lines, factors from q̂ to the angle and to z, each feature's coordinate."""
        circles = [i for i in self.positions if self.coordinates[i].topology == "circle"]
        lines = [i for i in self.positions if i not in circles]
        unit = torch.tensor(self.scales.position)
        turn = unit[circles] * torch.tensor([angular(self.coordinates[i]) for i in circles])
        own = torch.eye(self.n)[[*circles, *circles, *lines]]
        return circles, lines, turn, unit[lines] / torch.tensor(self.scales.reach)[lines], own

    @property
    def features(self) -> int:
        """Number of features z."""
        return len(self._owners[4])

    def jet(self, q: Tensor, second: bool = False) -> Jet:
        """z(q): sin and cos of circles, (q − centre)/reach of lines; derivatives by q̂."""
        circles, lines, turn, stretch, own = self._owners
        sin, cos = torch.sin(turn * q[:, circles]), torch.cos(turn * q[:, circles])
        centre = torch.tensor(self.scales.centre)[lines] / torch.tensor(self.scales.reach)[lines]
        straight = stretch * q[:, lines] - centre
        slope = torch.cat([turn * cos, -turn * sin, stretch.expand_as(straight)], 1)
        first = slope[..., None] * own
        bend = None
        if second:
            curve = torch.cat([-(turn**2) * sin, -(turn**2) * cos, 0 * straight], 1)
            bend = curve[..., None, None] * (own[:, :, None] * own[:, None, :])
        return Jet(torch.cat([sin, cos, straight], 1), first, bend)

    # ── training ─────────────────────────────────────────────────────────────────────────────────────────

    def fit(self, share: float = 1.0) -> float:
        """Train by Adam, its step size falling along a cosine; gives the CPU seconds that it took.

        Args:
            share: of the steps that this learner takes.
        """
        steps = max(1, round(share * self.steps))
        optimiser = torch.optim.Adam(self.parameters(), self.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        began = time.process_time()
        for _ in range(steps):
            optimiser.zero_grad()
            self.loss(self.draw()).backward()
            nn.utils.clip_grad_norm_(self.parameters(), 10.0)
            optimiser.step()
            schedule.step()
        return time.process_time() - began

    def draw(self) -> Tensor:
        """Rows of a batch."""
        return torch.randint(len(self.samples.q), (self.batch,), generator=self.random)

    # ── use, in the units of the data ────────────────────────────────────────────────────────────────────

    def predict(self, samples: Samples) -> NDArray[np.float64]:
        """Accelerations at measured states under recorded forces, (N, n) in the units of the data."""
        q, v, _, force = self._dimensionless(samples)
        with torch.no_grad():
            scaled = self.acceleration(q, v, force).numpy()
        return scaled * self.scales.velocity / self.scales.time

    def free_runs(self, tests: Sequence[Dataset]) -> list[tuple[Dataset, NDArray[np.float64]]]:
        """Run freely from the first row of each test by RK4; gives every `STRIDE`-th row.

        States are as `learn.rollout` has them, at those rows; once a velocity has left the measured range by
        the factor `LOST`, all that follows is NaN. The true plant run like this errs by less than 1e-4 of its
        standard deviation.
        """
        samples = [self._dimensionless(test.arrays) for test in tests]
        longest = max(len(test) for test in tests)
        # What is held from row to row lies half a row behind; so do the means of neighbours.
        force = torch.stack([_pad((s.F + torch.roll(s.F, 1, 0)) / 2, longest) for s in samples], 1)
        force[0] = torch.stack([s.F[0] for s in samples])
        q, v = torch.stack([s.q[0] for s in samples]), torch.stack([s.v[0] for s in samples])
        time = tests[0].frame["time"].to_numpy()
        h = STRIDE * float(time[1] - time[0]) / self.scales.time
        bound = LOST * max(float(s.v.abs().max()) for s in samples)
        states = [torch.cat([q, v], 1)]
        with torch.no_grad():
            for k in range(0, longest - STRIDE, STRIDE):
                q, v = self._step(q, v, force[k : k + STRIDE + 1 : STRIDE // 2], h)
                v = torch.where((v.abs() < bound).all(1, keepdim=True), v, torch.nan)
                states.append(torch.cat([q, v], 1))
        unit = np.concatenate([self.scales.position, self.scales.velocity])
        run = torch.stack(states, 1).numpy() * unit
        kept = [*self.positions, *range(self.n, 2 * self.n)]
        coarse = [Dataset(t.frame[::STRIDE], t.coordinates, t.units) for t in tests]
        return [(test, run[k][: len(test), kept]) for k, test in enumerate(coarse)]

    def _step(self, q: Tensor, v: Tensor, force: Tensor, h: float) -> tuple[Tensor, Tensor]:
        """One step of the classical Runge–Kutta method, forces at its beginning, middle and end."""
        k1 = self.acceleration(q, v, force[0])
        v2 = v + h / 2 * k1
        k2 = self.acceleration(q + h / 2 * v, v2, force[1])
        v3 = v + h / 2 * k2
        k3 = self.acceleration(q + h / 2 * v2, v3, force[1])
        v4 = v + h * k3
        k4 = self.acceleration(q + h * v3, v4, force[2])
        return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def _dimensionless(self, samples: Samples) -> Samples:
        s = self.scales
        units = (np.array(s.position), s.velocity, s.velocity / s.time, s.force)
        return Samples(*(torch.from_numpy(x / unit) for x, unit in zip(samples, units, strict=True)))


def _pad(values: Tensor, rows: int) -> Tensor:
    """The last row repeated until there are enough."""
    return torch.cat([values, values[-1:].expand(rows - len(values), -1)])

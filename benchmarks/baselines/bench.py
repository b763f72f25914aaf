"""What the learning benchmark measures on: data of the DC motor with cart, and models, each made once."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from baselines.record import record
from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.learn.card import accelerations
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.train import TrainedModel, train
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.learning import Structured, Terms
from exlinn_fmi.scenario.signals import Multisine, Sine

METHOD = Structured(preset="structured")
"""The default learner."""
TERMS = Terms(preset="terms")
"""The learner that looks for a short sum of terms."""
HARDLY = 0.02
"""Share of a peer's training in a quick run."""
HORIZONS = {"2s": ("10s", 2.0), "10s": ("10s", 10.0), "ood": ("ood", 10.0), "100s": ("100s", 100.0)}
"""Which test a free run is compared with, and for how long [s]."""


def paper() -> Sine:
    """The paper's excitation, v = 4 + sin 2t."""
    return Sine(signal="sine", offset=4, amplitude=1, frequency=1 / math.pi)


def multisine(seed: int, gain: float = 1.0) -> Multisine:
    """Turns the motor through the full circle; backwards where the gain is negative."""
    return Multisine(
        signal="multisine", offset=2.9 * np.sign(gain), rms=2.9 * abs(gain), band=(0.1, 5), seed=seed
    )


class Row(NamedTuple):
    """A learner in the table; numbers by the names that they have in the JSON."""

    key: str
    name: str
    numbers: dict[str, float]
    run: Dataset
    states: np.ndarray


class Bench:
    """Data and models, each made once and only when asked for.

    Args:
        seeds: how many of our models are trained.
        quick: one seed, hardly any training of the peers, no run of 100 s.
    """

    def __init__(self, seeds: int, quick: bool) -> None:
        self.seeds = range(1 if quick else seeds)
        self.quick = quick
        self.ours = lru_cache(None)(self._ours)
        self.our_row = lru_cache(None)(self._our_row)
        self.peer_row = lru_cache(None)(self._peer_row)

    @cached_property
    def training(self) -> Dataset:
        """Two trajectories."""
        return record(PLANT, "v", [paper(), multisine(1)], 10)

    @cached_property
    def tests(self) -> dict[str, Dataset]:
        """Free runs to be compared with, by name."""
        runs = {
            "10s": record(PLANT, "v", [multisine(11)], 10),
            "ood": record(PLANT, "v", [multisine(13, -2)], 10),
        }
        return runs if self.quick else runs | {"100s": record(PLANT, "v", [multisine(12)], 100)}

    def errors(self, runs: Mapping[str, tuple[Dataset, np.ndarray]]) -> dict[str, float]:
        """Errors of free runs, each of the worst velocity; ∞ where it diverged."""
        found = {
            f"rollout_nrmse_{label}": max(nrmse(PLANT.system, *runs[test], duration).values())
            for label, (test, duration) in HORIZONS.items()
            if test in runs
        }
        return found | {"diverged": float(not np.isfinite(list(found.values())).all())}

    def _ours(self, preset: str, seed: int) -> tuple[TrainedModel, float]:
        """A model of ours and the CPU seconds that its training took."""
        return trained(self.training, METHOD if preset == "structured" else TERMS, seed)

    def _our_row(self, preset: str, seed: int) -> Row:
        """One of our models in the table."""
        (model, seconds), test = self.ours(preset, seed), self.tests["10s"]
        states = {name: (data, free_run(model.system, data)) for name, data in self.tests.items()}
        numbers = {
            "weights": float(sum(w.size for w in model.weights.values())),
            "seconds": seconds,
            "acceleration_mse": float(np.mean((accelerations(model.system, test) - test.arrays.a) ** 2)),
            **self.errors(states),
        }
        return Row(f"ours.{preset}", f"ours, {preset}", numbers, *states["10s"])

    def _peer_row(self, slug: str) -> Row:
        """A peer in the table."""
        peer = peers()[slug](self.training, 0)
        seconds = peer.fit(HARDLY if self.quick else 1.0)
        test = self.tests["10s"]
        states = dict(zip(self.tests, peer.free_runs(list(self.tests.values())), strict=True))
        numbers = {
            "weights": float(peer.size),
            "seconds": seconds,
            "acceleration_mse": float(np.mean((peer.predict(test.arrays) - test.arrays.a) ** 2)),
            **self.errors(states),
        }
        return Row(f"peers.{slug}", peer.name, numbers, *states["10s"])


def trained(data: Dataset, method: Structured | Terms, seed: int) -> tuple[TrainedModel, float]:
    """A model and the CPU seconds that its training took; a fifth of the data is held back to watch it."""
    parts = split(data, 0.8, 10, seed)
    began = time.process_time()
    model = train(*parts, method, seed)
    return model, time.process_time() - began


def peers() -> dict[str, type]:
    """The peers, by the name that they have in the JSON; they work in double precision."""
    import torch

    from baselines.black_box import BlackBox, NeuralOde
    from baselines.hamiltonian import DissipativeSymoden, PortHamiltonian
    from baselines.lagrangian import DeLaN, Lnn
    from baselines.sindy import Sindy

    torch.set_default_dtype(torch.float64)
    learners = (BlackBox, NeuralOde, DeLaN, Lnn, DissipativeSymoden, PortHamiltonian, Sindy)
    return {peer.name.lower().replace(" ", "_").replace("-", "_"): peer for peer in learners}

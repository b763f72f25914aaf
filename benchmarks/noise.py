"""Learning from noisy data: at the Cramér–Rao bound, true terms and no others, honest intervals.

    python benchmarks/noise.py [--json F] [--quick] [--only NAME ...]

Data: 10 s of the paper's excitation of the DC motor with cart at 1 kHz, white noise on angle, speed and
current of the share of each signal's standard deviation that the figure's name says; no accelerations.
For coverage also noise that is correlated from row to row: autoregressive (0.9 of each row goes into the
next), and white noise through a zero-phase low-pass of order 8 at 40 Hz, as `learn.data.filter` makes it.
Free runs are over 10 s on a multisine that training never sees, from models that were found among generic
terms; their error is that of the worst velocity, relative to its standard deviation.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from baselines.bench import multisine
from baselines.figure import Figure, print_figures
from baselines.record import record
from rich.console import Console
from scipy.signal import butter, lfilter, sosfiltfilt
from threadpoolctl import threadpool_limits

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.data.files import write_json
from exlinn_fmi.learn.basis import generic_basis
from exlinn_fmi.learn.discover import discover
from exlinn_fmi.learn.rollout import free_run, nrmse
from exlinn_fmi.learn.trajectory import Shooting, cut, maximum_likelihood
from exlinn_fmi.learn.weak import weak_regression
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.plants.dc_motor_cart import COORDINATES, PLANT
from exlinn_fmi.scenario.signals import Sine

STATES = ["alpha", "alpha_dot", "i"]
FAMILY = MonomialBasis(
    COORDINATES,
    ("0.5*alpha_dot^2", "0.5*sin(alpha)^2*alpha_dot^2", "0.5*i^2", "alpha*i"),
    ("0.5*alpha_dot^2", "0.5*i^2"),
)
TRUE = np.array([0.1, 0.04, 1.0, 1.0, 0.5, 5.0])
LEVELS = (0.001, 0.01, 0.05)
SETS = 50
"""Data sets of 1 % noise for the deviation of parameters, …"""
COVERED = 200
"""… and for the coverage of their intervals."""
SETTLE = 1000
"""Rows in which a filter forgets how it began."""
DISCOVERIES = 12
"""Data sets of each level of noise for the discovery of terms."""


@lru_cache(None)
def clean() -> Dataset:
    """The paper's excitation, v = 4 + sin 2t."""
    return record(PLANT, "v", [Sine(signal="sine", offset=4, amplitude=1, frequency=1 / math.pi)], 10)


@lru_cache(None)
def unseen() -> Dataset:
    """The test of free runs."""
    return record(PLANT, "v", [multisine(1)], 10)


def noisy(level: float, seed: int, kind: str = "white") -> Dataset:
    """With noise, and accelerations that say nothing."""
    frame = clean().frame.copy()
    spread = frame[STATES].std().to_numpy()
    frame[STATES] += level * spread * SHAPED[kind](np.random.default_rng(seed), len(frame))
    frame[["alpha_ddot", "i_dot"]] = np.random.default_rng(seed + 1).standard_normal((len(frame), 2))
    return Dataset(frame, clean().coordinates)


def autoregressive(random: np.random.Generator, rows: int) -> np.ndarray:
    """Noise of deviation 1 of which 0.9 goes into the next row."""
    white = random.standard_normal((rows + SETTLE, 3))
    return math.sqrt(1 - 0.9**2) * lfilter([1], [1, -0.9], white, axis=0)[SETTLE:]


def filtered(random: np.random.Generator, rows: int) -> np.ndarray:
    """Noise of deviation 1 below 40 Hz."""
    white = random.standard_normal((rows + 2 * SETTLE, 3))
    low = sosfiltfilt(butter(4, 40, fs=1000, output="sos"), white, axis=0)[SETTLE:-SETTLE]
    return low / np.sqrt(np.mean(low**2, axis=0))


SHAPED: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "white": lambda random, rows: random.standard_normal((rows, 3)),
    "autoregressive": autoregressive,
    "filtered": filtered,
}
"""Noise of deviation 1 on three states, by kind."""


@lru_cache(None)
def bound(level: float) -> np.ndarray:
    """Cramér–Rao's bound on the standard deviations of the parameters."""
    family = FAMILY.system()
    exact = cut(clean(), STATES, family.input_names)
    sigma = level * clean().frame[STATES].std().to_numpy()
    shooting = Shooting(family, replace(exact, sigma=sigma))
    return np.sqrt(np.diag(shooting.information(shooting.start(TRUE)).covariance))


@lru_cache(None)
def estimate(level: float, seed: int, kind: str = "white") -> tuple[np.ndarray, np.ndarray]:
    """Parameters and their stated deviations, by maximum likelihood from the weak form's start."""
    family, data = FAMILY.system(), noisy(level, 1000 + 2 * seed, kind)
    start = weak_regression(FAMILY, data).solve()
    fit = maximum_likelihood(family, cut(data, STATES, family.input_names), start)
    return fit.p, np.sqrt(np.diag(fit.information.covariance))


class Found(NamedTuple):
    """A discovery: whether it is the truth, and the error of its free run."""

    exact: bool
    rollout: float


@lru_cache(None)
def discovery(level: float, seed: int) -> Found:
    """From generic terms, no accelerations."""
    data = noisy(level, 5000 + 2 * seed)
    basis = generic_basis(data)
    *_, found = discover(basis, None, data)
    terms = basis.only(found.chosen)
    exact = (set(terms.lagrangian), set(terms.dissipation)) == (
        set(FAMILY.lagrangian),
        set(FAMILY.dissipation),
    )
    system = terms.system().bound(found.fit.p)
    test = unseen()
    return Found(exact, max(nrmse(system, test, free_run(system, test), 10.0).values()))


# ── figures: True for a quick look ───────────────────────────────────────────────────────────────────────


def param_std_over_crlb(quick: bool) -> float:
    """Worst parameter: standard deviation over 50 data sets, relative to the Cramér–Rao bound."""
    p = np.array([estimate(0.01, seed)[0] for seed in range(5 if quick else SETS)])
    return float((p.std(axis=0, ddof=1) / bound(0.01)).max())


def coverage(quick: bool, kind: str = "white") -> float:
    """Share of the 95 % intervals of all parameters that hold the truth."""
    found = [estimate(0.01, seed, kind) for seed in range(5 if quick else COVERED)]
    return float(np.mean([np.abs(p - TRUE) < 1.96 * std for p, std in found]))


def rollout(level: float, quick: bool) -> float:
    """Median over five data sets."""
    return median(discovery(level, seed).rollout for seed in range(1 if quick else 5))


def exact_fraction(quick: bool) -> float:
    """Share of discoveries that hold the six true terms and no others."""
    return float(
        np.mean([discovery(level, k).exact for level in LEVELS for k in range(1 if quick else DISCOVERIES)])
    )


FIGURES = {
    "noise1.param_std_over_crlb": Figure(param_std_over_crlb, 1.3, 1.1, whole=False),
    "noise1.rollout_nrmse_10s": Figure(lambda quick: rollout(0.01, quick), 1e-3, 3e-4, whole=False),
    "noise5.rollout_nrmse_10s": Figure(lambda quick: rollout(0.05, quick), 5e-3, 1.5e-3, whole=False),
    "discovery.exact_fraction": Figure(exact_fraction, 0.9, 1.0, at_least=True, whole=False),
    "coverage.fraction": Figure(coverage, 0.9, at_least=True, whole=False, most=0.99),
    "coverage.autoregressive": Figure(
        lambda quick: coverage(quick, "autoregressive"), 0.9, at_least=True, whole=False, most=0.99
    ),
    "coverage.filtered": Figure(
        lambda quick: coverage(quick, "filtered"), 0.9, at_least=True, whole=False, most=0.99
    ),
}


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for all numbers")
    parser.add_argument("--quick", action="store_true", help="few data sets")
    parser.add_argument("--only", nargs="+", default=[""], metavar="NAME", help="beginnings of names")
    options = parser.parse_args()
    console, numbers = Console(stderr=True), {}
    with threadpool_limits(1):
        for name, figure in FIGURES.items():
            if name.startswith(tuple(options.only)):
                numbers[name] = figure.measure(options.quick)
                console.log(f"{name} = {numbers[name]:.4g}")
    print_figures(numbers, FIGURES, Console(), options.quick)
    if options.json:
        write_json(options.json, numbers)


if __name__ == "__main__":
    main()

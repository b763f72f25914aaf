"""Design of experiments: the excitation that tells most of the parameter that is known worst.

With white noise σ on the measured states the data tell of (x₀, p) as much as Fisher's information says,
Σ_k S_kᵀ diag(1/σ²) S_k with the sensitivities S of the states; x₀ is not known either and is eliminated. Its
inverse is the Cramér–Rao bound on the covariance of p. The criterion is the largest relative standard
deviation; candidates are multisines about a mean, one for each input, that keep the limits of the inputs by
construction and those of the states by trial.

References: Goodwin, Payne (1977), Dynamic System Identification: Experiment Design and Data Analysis;
    Storn, Price (1997), J. Global Optimization 11, 341 (differential evolution).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.excitation import signal_function
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.sensitivity import Propagator
from exlinn_fmi.scenario.signals import Multisine, Signal

Array = NDArray[np.float64]

GENES = 5
"""Numbers from 0 to 1 that make a multisine: mean, rms, lowest and highest frequency, phases."""
SEEDS = 64
"""Sets of phases to choose from."""
LINES = 20
"""Sines in each multisine."""
BATCH = 25
"""Candidates that are simulated at once."""
FITTEST = 24
"""Best candidates that are refined, …"""
GENERATIONS = 8
"""… for so many generations of differential evolution."""
UNSEEN = 1e-12
"""Eigenvalues of the scaled information below this share of the largest tell of directions not seen."""
DIGITS = 4
"""Significant digits of a proposal."""
SHRINK = 0.98
"""Factor on the rms of a proposal that breaks a limit when it is looked at closely."""
HOPELESS = 1e6
"""Criterion of a candidate that diverges or breaks limits beyond all measure."""


@dataclass(frozen=True)
class Trial:
    """One experiment to be judged: signals by input (0 where not named), and the state where it starts."""

    inputs: dict[str, Signal]
    start: Float[Array, " nx"]
    duration: float


class Judgement(NamedTuple):
    """What an excitation would tell.

    Args:
        deviation: relative standard deviation of each parameter, ∞ where nothing is told of it.
        worst: the largest (E: the worst parameter).
        a: root mean square (A-optimality).
        d: geometric mean of the axes of the ellipsoid of confidence (D-optimality).
    """

    deviation: Float[Array, " P"]
    worst: float
    a: float
    d: float


@dataclass(frozen=True)
class Problem:
    """What is to be found out, by what sensors, within what limits.

    Args:
        system: a family with the parameters to find, at their values as known so far.
        sigma: noise of each state, ∞ where it is not measured.
        inputs: least and greatest value of each input.
        states: least and greatest value of each state, ∞ where there is no limit.
        band: lowest and highest frequency that may be used [Hz].
        step: sampling step [s].
        folder: where the files of signals lie.
    """

    system: LagrangianSystem
    sigma: Float[Array, " nx"]
    inputs: Float[Array, "m 2"]
    states: Float[Array, "nx 2"]
    band: tuple[float, float]
    step: float
    folder: Path

    @cached_property
    def propagator(self) -> Propagator:
        """Of states and sensitivities."""
        return Propagator(self.system, self.step)

    def coarse(self) -> Problem:
        """The same with the longest step that still shows the motion; noise so that as much is told."""
        step = max(self.step, min(0.1 / self.band[1], 0.5 / self.fastest))
        return replace(self, step=step, sigma=self.sigma * np.sqrt(self.step / step))

    @cached_property
    def fastest(self) -> float:
        """Largest |pole| at rest [1/s]."""
        x, u = np.zeros(len(self.system.state_names)), np.zeros(len(self.system.input_names))
        poles = self.system.state_jacobian(x, u, self.system.parameter_values).full()
        return max(float(np.abs(np.linalg.eigvals(poles)).max()), np.finfo(float).tiny)

    def held(self, trial: Trial) -> Float[Array, "K m"]:
        """The inputs at each row but the last."""
        time = _grid(trial.duration, self.step)
        columns = [
            signal_function(trial.inputs[name], self.folder)(time)
            if name in trial.inputs
            else np.zeros_like(time)
            for name in self.system.input_names
        ]
        return np.column_stack(columns)

    def simulate(self, trials: Sequence[Trial]) -> tuple[Float[Array, "B rows nx"], Float[Array, "B K m"]]:
        """States and inputs of trials of equal duration; not finite from where one diverges."""
        inputs = np.stack([self.held(trial) for trial in trials])
        start = np.stack([trial.start for trial in trials])
        with np.errstate(all="ignore"):
            states = self.propagator.run(start, inputs, self.system.parameter_values)
        return states, inputs

    def information(
        self, states: Float[Array, "B rows nx"], inputs: Float[Array, "B K m"]
    ) -> Float[Array, "B P P"]:
        """Fisher's information on p, the start not being known."""
        nx, size = states.shape[2], states.shape[2] + len(self.system.parameters)
        matrix = np.zeros((len(states), size, size))
        p = self.system.parameter_values
        for s in self.propagator.sensitivities(states, inputs, p):
            weighted = s / self.sigma[:, None]
            matrix += weighted.transpose(0, 2, 1) @ weighted
        cross = matrix[:, :nx, nx:]
        rest: Array = matrix[:, nx:, nx:] - cross.transpose(0, 2, 1) @ _inverse(matrix[:, :nx, :nx]) @ cross
        return rest

    def judge(self, information: Float[Array, "P P"]) -> Judgement:
        """What can be told of the parameters with that information."""
        value = self.system.parameter_values
        scaled = information * np.outer(value, value)
        diagonal = np.diag(scaled)
        # Where next to nothing is told, cancellation may leave less than nothing.
        size = np.sqrt(np.where(diagonal > np.finfo(float).tiny, diagonal, np.inf))
        values, vectors = np.linalg.eigh(scaled / size[:, None] / size)
        seen = values > UNSEEN * max(values.max(), np.finfo(float).tiny)
        variance = ((vectors[:, seen] / size[:, None]) ** 2 / values[seen]).sum(axis=1)
        lost = (np.abs(vectors[:, ~seen]) > 1e-4).any(axis=1) | (np.diag(scaled) <= 0)
        deviation = np.where(lost, np.inf, np.sqrt(variance))
        volume = (
            np.exp(-(np.log(values).sum() / 2 + np.log(size).sum()) / len(value)) if seen.all() else np.inf
        )
        return Judgement(
            deviation, float(deviation.max()), float(np.sqrt(np.mean(deviation**2))), float(volume)
        )

    def excess(self, states: Float[Array, "B rows nx"], inputs: Float[Array, "B K m"]) -> Float[Array, " B"]:
        """How far states and inputs are beyond their limits, relative to these; ∞ where a trial diverges."""
        worst = np.zeros(len(states))
        for values, limits in ((states, self.states), (inputs, self.inputs)):
            for (low, high), column in zip(limits, np.moveaxis(values, 2, 0), strict=True):
                span = high - low if np.isfinite(high - low) else max(abs(b) for b in (low, high, 1e-300))
                for bound, side in ((high, 1), (low, -1)):
                    if np.isfinite(bound):
                        worst = np.maximum(worst, (side * (column - bound)).max(axis=1) / (span or 1.0))
        finite = np.isfinite(states).all(axis=(1, 2))
        return np.where(finite & np.isfinite(worst), np.maximum(worst, 0), np.inf)

    def multisines(self, genes: Float[Array, " G"], trial: Trial) -> Trial:
        """The trial with multisines that genes between 0 and 1 describe, within the limits of the inputs.

        Args:
            genes: `GENES` for each input.
            trial: where it starts, how long it takes and what units the inputs have.
        """
        signals: dict[str, Signal] = {}
        names = self.system.input_names
        for name, (low, high), part in zip(names, self.inputs, genes.reshape(-1, GENES), strict=True):
            mean, rms, first, last, seed = (float(gene) for gene in part)
            edge = np.log(self.band[1] / self.band[0])
            # At least an octave, so that 20 lines are different frequencies.
            bottom = self.band[0] * np.exp(first * max(edge - np.log(2), 0))
            top = bottom * np.exp(np.log(2) + last * max(np.log(self.band[1] / bottom) - np.log(2), 0))
            band, number = (_rounded(bottom), _rounded(top)), min(int(seed * SEEDS), SEEDS - 1)
            most, least = _peaks(band, number, trial.duration, self.step)
            offset = _rounded(low + mean * (high - low))
            room = min((high - offset) / most, (offset - low) / least)
            given = trial.inputs.get(name)
            signals[name] = Multisine(
                signal="multisine",
                rms=max(_rounded(room * rms, down=True), 1e-9 * (high - low)),
                band=band,
                lines=LINES,
                offset=offset,
                seed=number,
                unit=given.unit if given is not None else None,
            )
        return replace(trial, inputs=signals)


def information_of(problem: Problem, trials: Sequence[Trial]) -> Float[Array, "P P"]:
    """What several experiments tell together."""
    return np.asarray(
        np.sum([problem.information(*problem.simulate([trial]))[0] for trial in trials], axis=0)
    )


def improve(
    problem: Problem,
    trial: Trial,
    candidates: int,
    seed: int,
    progress: Callable[[float, float], None] = lambda fraction, best: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Trial | None:
    """Search for multisines that tell most of the parameter that is known worst.

    Candidates are drawn at random and judged on a coarse grid of time; differential evolution refines the
    best; the winner is looked at closely and made smaller while it breaks a limit.

    Args:
        problem: what is to be found out.
        trial: where it starts and how long it takes.
        candidates: how many are drawn.
        seed: of all that is drawn.
        progress: told the share of the work and the smallest worst deviation so far.
        should_stop: asked often; what was found so far serves then.

    Returns:
        The best; None where no candidate keeps the limits.
    """
    from scipy import optimize

    evolve: Any = optimize.differential_evolution  # whose types know nothing of `vectorized`
    size = GENES * len(problem.system.input_names)
    search = _Search(problem.coarse(), trial, candidates + GENERATIONS * FITTEST, progress, should_stop)
    drawn = np.random.default_rng(seed).uniform(size=(candidates, size))
    scores = search(drawn.T)
    first = drawn[np.argsort(scores, kind="stable")[:FITTEST]]
    if not search.stopped and len(first) >= 5:  # fewer do not make a population
        evolve(
            search,
            [(0.0, 1.0)] * size,
            init=first,
            maxiter=GENERATIONS - 1,
            rng=seed,
            polish=False,
            tol=0,
            updating="deferred",
            vectorized=True,
            callback=lambda intermediate_result: search.stopped,
        )
    if search.best is None:
        return None
    return _kept_within(problem, problem.multisines(search.best, trial))


class _Search:
    """The criterion of many candidates at a time, remembering the best that keeps the limits."""

    def __init__(
        self,
        problem: Problem,
        trial: Trial,
        total: int,
        progress: Callable[[float, float], None],
        should_stop: Callable[[], bool],
    ) -> None:
        self.problem, self.trial, self.total = problem, trial, total
        self.progress, self.should_stop = progress, should_stop
        self.done, self.stopped, self.lowest = 0, False, float("inf")
        self.best: Array | None = None

    def __call__(self, genes: Float[Array, "G N"]) -> Float[Array, " N"]:
        """Worst relative deviation of each candidate, more where limits are broken."""
        scores = np.full(genes.shape[1], 2 * HOPELESS)
        for first in range(0, len(scores), BATCH):
            self.stopped = self.stopped or self.should_stop()
            if self.stopped:
                break
            rows = slice(first, first + BATCH)
            scores[rows] = self._batch(genes.T[rows])
            self.done += len(scores[rows])
            self.progress(min(self.done / self.total, 1.0), self.lowest)
        return scores

    def _batch(self, genes: Float[Array, "B G"]) -> Float[Array, " B"]:
        problem = self.problem
        states, inputs = problem.simulate([problem.multisines(g, self.trial) for g in genes])
        excess = problem.excess(states, inputs)
        # Far off candidates guide the search by their excess alone.
        scores = HOPELESS * (1 + np.minimum(excess, 1.0))
        near = np.flatnonzero(excess < 0.2)
        if not near.size:
            return scores
        for k, matrix in zip(near, problem.information(states[near], inputs[near]), strict=True):
            if not np.isfinite(matrix).all():
                continue  # on the brink of diverging: states are finite yet, sensitivities are not
            worst = problem.judge(matrix).worst
            scores[k] = min(worst * (1 + 100 * excess[k]), HOPELESS)
            if excess[k] == 0 and worst < self.lowest:
                self.lowest, self.best = worst, genes[k]
        return scores


def _kept_within(problem: Problem, trial: Trial) -> Trial | None:
    """The trial, smaller until it keeps all limits at the sampling step; None where its mean breaks one."""
    for _ in range(100):
        if problem.excess(*problem.simulate([trial]))[0] == 0:
            return trial
        smaller = {
            name: signal.model_copy(update={"rms": _rounded(SHRINK * signal.rms, down=True)})
            for name, signal in trial.inputs.items()
            if isinstance(signal, Multisine)
        }
        trial = replace(trial, inputs={**trial.inputs, **smaller})
    return None


@lru_cache(maxsize=4096)
def _peaks(band: tuple[float, float], seed: int, duration: float, step: float) -> tuple[float, float]:
    """How far a multisine of rms 1 goes up and down."""
    spec = Multisine(signal="multisine", rms=1.0, band=band, lines=LINES, seed=seed)
    values = signal_function(spec, Path())(_grid(duration, step))
    return max(float(values.max()), 1e-3), max(float(-values.min()), 1e-3)


def _grid(duration: float, step: float) -> Float[Array, " K"]:
    """Times where inputs are set."""
    return np.asarray(np.arange(max(round(duration / step), 1)) * step, dtype=float)


def _inverse(matrices: Float[Array, "B n n"]) -> Float[Array, "B n n"]:
    """Inverses of information matrices, of the directions that are seen at all."""
    size = np.sqrt(np.maximum(np.diagonal(matrices, axis1=1, axis2=2), np.finfo(float).tiny))
    scale: Array = size[:, :, None] * size[:, None, :]
    return np.asarray(np.linalg.pinv(matrices / scale, rcond=UNSEEN, hermitian=True) / scale)


def _rounded(value: float, down: bool = False) -> float:
    """To `DIGITS` significant digits."""
    if value == 0:
        return 0.0
    unit = 10.0 ** (np.floor(np.log10(abs(value))) - DIGITS + 1)
    count = np.floor(value / unit) if down else np.round(value / unit)
    return float(f"{count * unit:.{DIGITS}g}")

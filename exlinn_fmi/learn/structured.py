"""Training of the structured form: a linear start, then Levenberg–Marquardt on the inverse-model residual.

Three stages: the direct path alone, which suffices for mechanisms whose Lagrangian is trigonometric or a low
polynomial in the positions; then, if the target is not met, with the hidden units, from silent ones or from a
linear start of their own, whichever is better; both on every k-th sample, since sampled
motion repeats itself. The last stage takes all samples. Networks of many weights take L-BFGS instead of
Levenberg–Marquardt once the hidden units join.

Where states are noisy, what comes of it is refined on trajectories (`refine`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import DataError
from exlinn_fmi.learn.assembly import data_scales, inverse_assembly
from exlinn_fmi.learn.iterate import Iterate
from exlinn_fmi.learn.lbfgs import lbfgs
from exlinn_fmi.learn.levenberg import levenberg_marquardt
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.noise import CLEAN, relative_noise
from exlinn_fmi.learn.objective import Inverse, Objective, Rows, loss
from exlinn_fmi.learn.refine import FLOOR, SWEEPS, Candidate, refine
from exlinn_fmi.learn.start import Start, hidden_starts, linear_start
from exlinn_fmi.learn.tested import Weak, usual_accelerations
from exlinn_fmi.learn.windows import SHORTEST
from exlinn_fmi.mechanics.learned import ModelSpec
from exlinn_fmi.mechanics.structure import UNKNOWN, Structure
from exlinn_fmi.scenario.learning import Objective as Goal
from exlinn_fmi.scenario.learning import Optimiser, Structured

Array = NDArray[np.float64]

MOST = 2 * sum(most for most, _ in SWEEPS)
"""Most iterations on trajectories."""
CONSISTENT = 1e-3
"""Accelerations that leave no more than this share of the forces unexplained are as good as measured."""
COARSE = 4000
"""About as many samples do the first stages look at."""
EQUATIONS = 4
"""With L-BFGS as many equations at least for each weight, as far as there are."""
GENERAL = 10.0
"""A linear start whose loss is so much larger on the validation data is far too rich."""
PATIENCE = {"direct": (10, 0.5), "hidden": (20, 0.8), "all": (3, 0.5)}
"""A stage ends when that many iterations left more than that share of the loss."""
PATIENCE_LBFGS = (10, 0.8)
"""The same for rounds of L-BFGS."""
LARGE = 1500
"""More weights than that are left to L-BFGS: there it is ahead for the first minutes, and LM takes 3 s for an
iteration, which grows with their square as its memory does."""


def structured_spec(
    train: Dataset,
    options: Structured,
    seed: int,
    structure: Structure = UNKNOWN,
    objective: Goal = "auto",
) -> tuple[ModelSpec, Start]:
    """The model to train and its first weights.

    Args:
        train: data that excite all coordinates.
        options: the learner's settings.
        seed: of what is drawn.
        structure: what is known of the plant.
        objective: what is made small first, see `begin`.

    Raises:
        DataError: there are fewer equations than weights, or no trajectory is long enough for `weak`.
    """
    samples = train.arrays
    if objective == "weak":
        samples = samples._replace(a=usual_accelerations(train))
    scales = data_scales(samples, train.coordinates)
    n = len(train.coordinates)
    spec = ModelSpec(
        "structured", train.coordinates, options.hidden, scales, epsilon=(0.0,) * n, structure=structure
    )
    unknowns = sum(int(mask.sum()) for mask in spec.layout.free.values())
    if len(train) * n < unknowns:
        raise DataError(
            f"data set: {len(train)} rows to fit (without those that validate) give {len(train) * n} "
            f"equations for {unknowns} weights, expected at least {-(-unknowns // n)} rows; record for "
            "longer, lower `learn.method.hidden`, or choose the preset 'terms'"
        )
    start = linear_start(equations(StructuredNetworks(spec), train, objective), seed)
    return replace(spec, epsilon=start.epsilon), start


def optimiser(options: Structured, weights: int) -> tuple[Optimiser, str]:
    """What makes the loss small once the hidden units join, and why.

    Args:
        options: the learner's settings.
        weights: how many there are.
    """
    if options.optimiser != "auto":
        return options.optimiser, f"{options.optimiser}: as the scenario says"
    if weights > LARGE:
        return "l-bfgs", f"l-bfgs: {weights} weights, more than {LARGE}"
    return "levenberg-marquardt", f"levenberg-marquardt: {weights} weights, no more than {LARGE}"


def most_iterations(options: Structured, objective: Goal, train: Dataset) -> int:
    """The most iterates there will be, as far as that is known beforehand."""
    return options.iterations + MOST * (choose(objective, train)[0] == "trajectory")


def iterate_structured(
    spec: ModelSpec,
    start: Start,
    train: Dataset,
    validation: Dataset,
    options: Structured,
    objective: Goal = "auto",
) -> Iterator[Iterate]:
    """Train; ends when the target is met or nothing more is gained.

    Args:
        spec: from `structured_spec`.
        start: from there too.
        train: data to fit.
        validation: data to watch.
        options: the learner's settings.
        objective: what to make small.

    Yields:
        The start of each stage and every iteration.

    Raises:
        DataError: the objective is `weak` and no trajectory is long enough for it.
    """
    networks = StructuredNetworks(spec)
    best: dict[str, Iterate] = {}
    notes: dict[str, Any] = {
        "objective": choose(objective, train)[1],
        "noise": relative_noise(train),
        "optimiser": optimiser(options, networks.size)[1],
    }
    first = begin(objective, train, validation)
    data, held = (equations(networks, part, first) for part in (train, validation))
    stages = _descend(data, held, start, options)
    for now, _ in zip(stages, range(options.iterations + 1), strict=False):
        for stage in {now.stage, "any"}:
            if stage not in best or now.rank < best[stage].rank:
                best[stage] = now
        yield replace(now, notes=notes)
    chosen, notes["objective"] = choose(objective, train, best["any"].loss)
    if chosen == "trajectory":
        notes["objective"] += f"; from a start by {first!r}"
        direct, full = (networks.pack(best[stage].weights) for stage in ("direct", "any"))
        mask, large = networks.pack_mask(spec.layout.direct), networks.size > LARGE
        if large:
            notes["objective"] += (
                f"; of {networks.size} weights only the direct path's are fitted to trajectories"
            )
        if not full[~mask].any():  # units that were never asked begin as they were drawn
            full = np.where(mask, full, networks.pack(start.weights))
        candidates = (
            Candidate("trajectory, direct", direct, mask),
            Candidate("trajectory", full, mask if large else np.ones_like(mask)),
        )
        yield from refine(networks, candidates, train, validation, notes)


def begin(objective: Goal, train: Dataset, validation: Dataset) -> Goal:
    """What the first stages make small: noise is averaged by the weak form, and grows in accelerations.

    Args:
        objective: what the user chose.
        train: data to fit.
        validation: data to watch.
    """
    if objective == "weak":
        return objective
    longest = min(int(data.frame.groupby("trajectory").size().max()) for data in (train, validation))
    noisy = max(relative_noise(train).values()) > CLEAN and longest >= SHORTEST
    return "weak" if noisy and choose(objective, train)[0] == "trajectory" else "inverse"


def choose(objective: Goal, data: Dataset, loss: float = 0.0) -> tuple[Goal, str]:
    """What to make small, and why.

    Args:
        objective: what the user chose; ``auto`` leaves it to the data.
        data: what is fitted.
        loss: share of the forces, squared, that the inverse model left unexplained.
    """
    if objective != "auto":
        return objective, f"{objective}: as the scenario says"
    noise = relative_noise(data)
    worst = max(noise, key=lambda name: noise[name])
    if noise[worst] > CLEAN:
        why = f"{worst} has {100 * noise[worst]:.2g} % noise, the most of all states"
        return "trajectory", f"trajectory: {why}"
    if loss > CONSISTENT**2:
        share = f"{100 * float(np.sqrt(loss)):.2g} % of forces do not fit the accelerations"
        doubt = "noise that was filtered looks like motion; 'trajectory' fits the states themselves"
        return "inverse", f"inverse: states look clean, but {share}: {doubt}"
    return "inverse", "inverse: the states are clean and the accelerations do not contradict them"


def equations(networks: StructuredNetworks, data: Dataset, objective: Goal) -> Rows:
    """What the first stages make small: the equations against test functions, or at the samples."""
    if objective == "weak":
        return Weak.all(networks, data)
    return Inverse(networks, inverse_assembly(networks.spec, data.arrays))


def _descend(data: Rows, held: Rows, start: Start, options: Structured) -> Iterator[Iterate]:
    """The three stages on the inverse model or its weak form."""
    networks, spec = data.networks, data.networks.spec
    first_order = optimiser(options, networks.size)[0] == "l-bfgs"
    coarse = data.thin(max(COARSE, EQUATIONS * networks.size // len(spec.coordinates) * first_order))
    theta, chosen, met = networks.pack(start.weights), networks.pack_mask(spec.layout.direct), False
    for stage, (patience, share) in PATIENCE.items():
        if stage == "hidden" and met:
            continue
        if stage == "hidden":
            chosen = np.ones_like(chosen)
            best = _best_start(theta, coarse, held)
            now = Iterate(networks.unpack(best), loss(coarse, best), loss(held, best), stage)
            if first_order and now.validation_loss > GENERAL * now.loss:
                yield now  # its weights are so large that L-BFGS would get nowhere from there
            else:
                theta = best
        # Units that do not take part yet are silent; each starts from where it was drawn when it joins.
        part = StructuredNetworks(spec, chosen)
        rows, judge = (x.of(part) for x in (data if stage == "all" else coarse, held))
        objective = Objective(rows, options.regularisation)
        losses: list[float] = []
        if first_order and chosen.all():
            patience, share = PATIENCE_LBFGS
            descent = lbfgs(theta, objective.gradient, objective.sizes)
        else:
            descent = levenberg_marquardt(theta[chosen], objective.linearise, objective.value, FLOOR)
        for step in descent:
            losses.append(step.value - options.regularisation * float(step.theta @ step.theta))
            yield Iterate(part.unpack(step.theta), losses[-1], loss(judge, step.theta), stage)
            met = losses[-1] <= options.target
            if met or (len(losses) > patience and losses[-1] > share * losses[-1 - patience]):
                break
        theta[chosen] = step.theta


def _best_start(theta: Float[Array, " P"], data: Rows, held: Rows) -> Float[Array, " P"]:
    """The weights as they are, hidden units silent, or those of a linear start, ranked as `Iterate` does."""
    networks = data.networks
    starts = map(networks.pack, hidden_starts(data, networks.unpack(theta)))
    return min((theta, *starts), key=lambda start: loss(data, start) * loss(held, start))

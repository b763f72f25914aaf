"""How well, how fast and how far ahead: our learner and its peers on the same data of the DC motor with cart.

    python benchmarks/learning.py [--json F] [--out FOLDER] [--seeds 5] [--quick] [--only NAME ...]

Training data: 10 s of the paper's excitation and 10 s of a multisine that turns the motor through the full
circle, both clean and at 1 kHz. Tests: multisines that training never sees, for 2, 10 and 100 s, and one
outside the range of the training data (backwards, at twice the amplitude). Errors of free runs are those of
the worst velocity, relative to its standard deviation. Times are CPU seconds of one thread.

Figures under noise are those of benchmarks/noise.py; those of other plants are of what their scenarios learn.

Prints the figures beside what they must be, and the table of all learners; writes learning.json, learning.png
and learning.svg to FOLDER. `--only` takes beginnings of names, e.g. `clean.`, `ours` or `peers.mlp`.
`--quick` looks whether all is well: one seed, hardly any training of the peers and of the four neurons, and
nothing that takes long (100 s of free run, accelerations missing, a million samples, other plants).
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import noise
import numpy as np
import pandas as pd
from baselines.bench import METHOD, TERMS, Bench, Row, multisine, peers, trained
from baselines.figure import Figure, print_figures
from baselines.record import record
from baselines.show import draw, print_table
from rich.console import Console
from threadpoolctl import threadpool_limits

from exlinn_fmi import pipeline
from exlinn_fmi.data.dataset import Dataset, Samples, required_columns
from exlinn_fmi.data.files import write_json
from exlinn_fmi.learn.adjoint import Adjoint
from exlinn_fmi.learn.assembly import inverse_assembly
from exlinn_fmi.learn.card import force_error
from exlinn_fmi.learn.identify import identify
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.learn.structured import structured_spec
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants.dc_motor_cart import COORDINATES, PLANT
from exlinn_fmi.scenario.learning import Identify
from exlinn_fmi.workspace import Run, metrics

PARAMETERS = Identify(
    lagrangian={
        "j_m": "0.5*alpha_dot^2",
        "m_c*d^2": "0.5*sin(alpha)^2*alpha_dot^2",
        "l": "0.5*i^2",
        "k_e": "i*alpha",
    },
    dissipation={"b_m": "0.5*alpha_dot^2", "r": "0.5*i^2"},
)
ROOT = Path(__file__).parents[1]
TRUTH = {p.name: p.value for p in PLANT.parameters}

# ── figures ──────────────────────────────────────────────────────────────────────────────────────────────


FIGURES: dict[str, Figure] = {}


def figure(name: str, must: float, stretch: float = math.nan, **kind: bool):
    """Put a function into `FIGURES`: from the bench to the number."""

    def put(measure: Callable[[Bench], float]) -> Callable[[Bench], float]:
        FIGURES[name] = Figure(measure, must, stretch, **kind)
        return measure

    return put


@figure("clean.force_mse", 1e-12, 1e-20)
def force_mse(bench: Bench) -> float:
    """Inverse model of the default learner on the unseen multisine."""
    return median(_force_mse(bench, bench.ours("structured", seed)[0].system) for seed in bench.seeds)


@figure("clean.net_force_mse", 1e-10, 1e-12, whole=False)
def net_force_mse(bench: Bench) -> float:
    """The same with the paper's four neurons, smooth, and nothing beside them."""
    from baselines.bare_network import bare_network

    steps = 20 if bench.quick else 400
    return median(_force_mse(bench, bare_network(bench.training, seed, steps)) for seed in bench.seeds)


@figure("clean.seconds_to_1e-8", 0.5, 0.1)
def seconds_to_accuracy(bench: Bench) -> float:
    """Training time with the loosest target that leads to 1e-8 on the unseen multisine."""

    def least(seed: int) -> float:
        for exponent in range(6, 14):
            method = METHOD.model_copy(update={"target": 10.0**-exponent})
            model, seconds = trained(bench.training, method, seed)
            if _force_mse(bench, model.system) <= 1e-8:
                return seconds
        return math.inf

    return median(map(least, bench.seeds))


@figure("clean.rollout_nrmse_10s", 1e-6, 1e-10)
def rollout_10s(bench: Bench) -> float:
    """Free run on the unseen multisine."""
    return median(bench.our_row("structured", seed).numbers["rollout_nrmse_10s"] for seed in bench.seeds)


@figure("clean.rollout_nrmse_100s", 1e-5, 1e-10, slow=True)
def rollout_100s(bench: Bench) -> float:
    """Free run on another one, for 100 s."""
    return median(bench.our_row("structured", seed).numbers["rollout_nrmse_100s"] for seed in bench.seeds)


@figure("clean.param_max_rel_error", 1e-6, 1e-9, slow=True)
def param_error(bench: Bench) -> float:
    """Worst physical parameter, from positions, velocities and inputs alone, as a sum of terms."""
    data = without_accelerations(bench.training)
    model, _ = trained(data, TERMS, 0)  # nothing in it is drawn but the split
    found = identify(model.system, data, PARAMETERS, TRUTH).parameters
    return float(found["rel_error"].max(skipna=False))


@figure("baseline_over_ours", 1000, at_least=True, whole=False)
def baseline_over_ours(bench: Bench) -> float:
    """10 s free run of the best peer over ours."""
    best = min(bench.peer_row(slug).numbers["rollout_nrmse_10s"] for slug in peers())
    return best / rollout_10s(bench)


@figure("million.seconds", 60, slow=True)
def million_seconds(bench: Bench) -> float:
    """Training on 10⁶ samples."""
    return million()[0]


@figure("million.gib", 2, slow=True)
def million_gib(bench: Bench) -> float:
    """Peak memory of the process that does it."""
    return million()[1]


@figure("gradient.over_double_autograd", 10, 50, at_least=True)
def gradient_ratio(bench: Bench) -> float:
    """Loss and gradient at batch 64: PyTorch's double autograd over ours, in one run."""
    from baselines.double_autograd import DoubleAutograd

    spec, start = structured_spec(bench.training, METHOD, 0)
    rows = np.random.default_rng(0).choice(len(bench.training), 64, replace=False)
    samples = Samples(*(x[rows] for x in bench.training.arrays))
    networks, data = StructuredNetworks(spec), inverse_assembly(spec, samples)
    theta = networks.pack(start.weights)
    theirs = DoubleAutograd(spec, networks.unpack(theta))
    batch = theirs.batch(samples)

    expected = networks.pack({name: g.numpy() for name, g in theirs.gradient(*batch).items()})
    ours = Adjoint(networks, data)
    found = ours.mean_square(theta)[1]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    rounds = range(3 if bench.quick else 20)
    pairs = [
        (_seconds(lambda: theirs.gradient(*batch)), _seconds(lambda: ours.mean_square(theta))) for _ in rounds
    ]
    return median(a / b for a, b in pairs)


def _other_plant(name: str) -> Callable[[Bench], float]:
    """Free run over 10 s of what the plant's scenario learns, the median over seeds."""

    def measure(bench: Bench) -> float:
        found = []
        with TemporaryDirectory() as folder:  # where the data are collected once
            for seed in bench.seeds:
                work = Run.open(ROOT / "scenarios" / f"{name}.yaml", Path(folder), [f"learn.seed={seed}"])
                pipeline.train(work)
                found.append(metrics(work.folder)["learn.rollout_nrmse_10s"])
        return median(math.inf if value is None else value for value in found)

    return measure


for plant in ("maglev", "mems", "motor_pendulum", "two_link_arm"):
    FIGURES[f"{plant}.rollout_nrmse_10s"] = Figure(_other_plant(plant), 1e-4, 1e-8, slow=True)
for name, entry in noise.FIGURES.items():
    FIGURES[name] = entry._replace(measure=partial(lambda ask, bench: ask(bench.quick), entry.measure))


def _force_mse(bench: Bench, system: LagrangianSystem) -> float:
    return float(np.mean(force_error(system, bench.tests["10s"]) ** 2))


def _seconds(work: Callable[[], object], calls: int = 50) -> float:
    """Of so many calls, one after the other as in training."""
    began = time.process_time()
    for _ in range(calls):
        work()
    return time.process_time() - began


def without_accelerations(data: Dataset) -> Dataset:
    """The same data as a user has them who measures no accelerations."""
    gone = [c.acceleration for c in data.coordinates]
    columns = {name: data.frame[name] for name in data.frame if name not in gone}
    return Dataset.from_columns(columns, data.coordinates, data.units)


@lru_cache(None)
def million() -> tuple[float, float]:
    """Seconds and GiB of a process of its own that trains on 10⁶ samples."""
    data = record(PLANT, "v", [multisine(seed) for seed in range(100, 110)], 100)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "million.parquet"
        data.frame[required_columns(COORDINATES)].to_parquet(path)
        del data
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            return pool.apply(_train_on_file, (path,))


def _train_on_file(path: Path) -> tuple[float, float]:
    with threadpool_limits(1):
        data = Dataset(pd.read_parquet(path), COORDINATES)
        _, seconds = trained(data, METHOD, 0)
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # Linux counts in KiB


# ── the command ──────────────────────────────────────────────────────────────────────────────────────────


def measure(
    bench: Bench, only: Sequence[str], console: Console
) -> Iterator[tuple[dict[str, float], list[Row]]]:
    """The figures and the rows of the table that are asked for, after each what there is so far."""

    def wanted(name: str) -> bool:
        return not only or any(name.startswith(start) for start in only)

    found, rows = {}, []
    for name, entry in FIGURES.items():
        if wanted(name) and not (bench.quick and entry.slow):
            began = time.perf_counter()
            found[name] = entry.measure(bench)
            console.log(f"{name} = {found[name]:.3g} after {time.perf_counter() - began:.0f} s")
            yield found, rows
    table = {f"ours.{preset}": partial(bench.our_row, preset, 0) for preset in ("structured", "terms")}
    table |= {f"peers.{slug}": partial(bench.peer_row, slug) for slug in peers()}
    for name, row in table.items():
        if wanted(name):
            rows.append(row())
            yield found, rows


def main() -> None:
    """Measure, print, draw, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for all numbers")
    parser.add_argument(
        "--out", type=Path, default=Path("runs/benchmarks/learning"), help="folder for the drawing"
    )
    parser.add_argument("--seeds", type=int, default=5, help="how many of our models; each peer has one")
    parser.add_argument("--quick", action="store_true", help="one seed, hardly any training of the peers")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="beginnings of names")
    options = parser.parse_args()
    console = Console(stderr=True)
    found, rows, stopped = {}, [], False
    try:
        with threadpool_limits(1):
            for found, rows in measure(Bench(options.seeds, options.quick), options.only, console):
                keep(found, rows, [options.out / "learning.json", options.json])
    except KeyboardInterrupt:
        stopped = True
        console.log("interrupted: what was measured until then is kept")
    paper = Console(width=max(Console().width, 110))
    if found:
        print_figures(found, FIGURES, paper, options.quick)
    if rows:
        print_table(rows, paper)
        draw(rows, options.out)
    raise SystemExit(130 if stopped else 0)


def keep(found: dict[str, float], rows: list[Row], files: Sequence[Path | None]) -> None:
    """Write all numbers that there are."""
    numbers = dict(found)
    for row in rows:
        numbers |= {f"{row.key}.{name}": value for name, value in row.numbers.items()}
    for file in files:
        if file:
            write_json(file, numbers)


if __name__ == "__main__":
    main()

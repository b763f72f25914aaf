"""Data sets: trajectories of coordinates, velocities, accelerations and inputs as one pandas frame.

Columns: ``trajectory`` (int), ``time`` [s], positions that are not cyclic, velocities, accelerations,
    inputs, all by their names in `Coordinate`; further columns (energies, …) may follow. Rows of a
    trajectory stand together, in the order of time. Beside an acceleration that was estimated stands its
    input as ``<input>_matched``: with the same filter over it (`estimate_missing`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, NDArray

from exlinn_fmi.data.derivatives import (
    LEAST_NOISE,
    SHORTEST,
    Between,
    best_window,
    derivative,
    integral,
    noise_level,
)
from exlinn_fmi.data.files import read_json, write_json
from exlinn_fmi.data.tables import read_table, write_table
from exlinn_fmi.errors import DataError
from exlinn_fmi.mechanics.coordinates import (
    Coordinate,
    check_coordinates,
    input_names,
    state_names,
    state_units,
)

MINIMUM_ROWS = 20
"""Fewest samples that a model is trained on."""
TELLING = 20
"""Fewest rows of a trajectory that its noise is estimated from."""


class Samples(NamedTuple):
    """q [unit of q], v = q̇, a = q̈ and generalised forces F, shape (N, n); cyclic q and absent F are 0.

    Forces are those that belong to the accelerations: matched ones where those were estimated.
    """

    q: Float[NDArray[np.float64], "N n"]
    v: Float[NDArray[np.float64], "N n"]
    a: Float[NDArray[np.float64], "N n"]
    F: Float[NDArray[np.float64], "N n"]


@dataclass(frozen=True)
class Dataset:
    """Trajectories of a system; checked when made.

    Args:
        frame: the columns that the head of this module names; the index is 0, 1, 2, ….
        coordinates: the generalised coordinates.
        units: unit by column name; those of the coordinates are filled in.
        held_out: trajectories that training never sees.
        notes: what the user should know of the data, None where nobody has looked (`doubts.audit`).
        estimated: columns that were estimated from others.

    Raises:
        DataError: a column is missing or not numeric, a value is not finite, or time does not increase.
    """

    frame: pd.DataFrame
    coordinates: tuple[Coordinate, ...]
    units: Mapping[str, str] = field(default_factory=dict)
    held_out: tuple[int, ...] = ()
    notes: tuple[str, ...] | None = None
    estimated: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_coordinates(self.coordinates)
        object.__setattr__(self, "units", coordinate_units(self.coordinates) | dict(self.units))
        object.__setattr__(self, "frame", self.frame.reset_index(drop=True))
        _check_columns(self.frame, required_columns(self.coordinates))
        _check_time(self.frame)

    @classmethod
    def from_columns(
        cls,
        columns: Mapping[str, ArrayLike],
        coordinates: tuple[Coordinate, ...],
        units: Mapping[str, str] | None = None,
    ) -> Dataset:
        """A data set from arrays by name; velocities and accelerations that are not there are estimated.

        Args:
            columns: arrays of one length each; without ``trajectory`` all rows are one trajectory.
            coordinates: the generalised coordinates.
            units: unit by column name.

        Raises:
            DataError: lengths differ, or a column is missing that cannot be estimated.
        """
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        if "time" not in arrays:
            raise DataError(f"data set: column 'time' is missing; found {', '.join(arrays) or 'no column'}")
        rows = arrays["time"].size
        for name, values in arrays.items():
            if values.shape != (rows,):
                found = f"{len(values)} rows" if values.ndim == 1 else f"the shape {values.shape}"
                raise DataError(f"data set: column {name!r} has {found}, expected {rows} as in 'time'")
        frame = pd.DataFrame({"trajectory": np.zeros(rows, dtype=int), **arrays})
        whole = estimate_missing(frame, coordinates)
        estimated = tuple(name for name in required_columns(coordinates) if name not in frame)
        return cls(whole, coordinates, units or {}, estimated=estimated)

    def __len__(self) -> int:
        return len(self.frame)

    @cached_property
    def arrays(self) -> Samples:
        """The samples as arrays."""
        shape = (len(self.frame), len(self.coordinates))
        q, v, a = (np.zeros(shape) for _ in range(3))
        for i, c in enumerate(self.coordinates):
            if c.topology != "cyclic":
                q[:, i] = self.frame[c.name]
            v[:, i], a[:, i] = self.frame[c.velocity], self.frame[c.acceleration]
        return Samples(q, v, a, self._forces(matched))

    @cached_property
    def recorded_forces(self) -> Float[NDArray[np.float64], "N n"]:
        """Generalised forces as recorded, matched to no acceleration; 0 where none acts."""
        return self._forces(str)

    def _forces(self, name: Callable[[str], str]) -> Float[NDArray[np.float64], "N n"]:
        force = np.zeros((len(self.frame), len(self.coordinates)))
        for i, c in enumerate(self.coordinates):
            if c.input is not None:
                force[:, i] = self.frame[name(c.input) if name(c.input) in self.frame else c.input]
        return force

    @cached_property
    def noise(self) -> Float[NDArray[np.float64], " nx"]:
        """Standard deviation of the white noise on each state, in its unit.

        Trajectories that are too short to tell are left out.
        """
        names = state_names(self.coordinates)
        squares, rows = np.zeros(len(names)), 0
        for _, part in self.frame.groupby("trajectory"):
            if len(part) >= TELLING:
                values = part[names].to_numpy(dtype=float)
                squares += len(part) * np.array([noise_level(column) ** 2 for column in values.T])
                rows += len(part)
        size = np.abs(self.frame[names].to_numpy(dtype=float)).max(axis=0)
        return np.maximum(np.sqrt(squares / max(rows, 1)), LEAST_NOISE * np.where(size > 0, size, 1))

    @property
    def trajectories(self) -> list[int]:
        """Numbers of the trajectories, in the order of the rows."""
        return [int(k) for k in self.frame["trajectory"].unique()]

    @property
    def training(self) -> Dataset:
        """The data set of the trajectories that are not held out."""
        return self.select(set(self.trajectories) - set(self.held_out))

    @property
    def tests(self) -> list[Dataset]:
        """The trajectories that are held out, each as a data set."""
        return [self.select([number]) for number in self.held_out]

    def select(self, trajectories: Iterable[int]) -> Dataset:
        """The data set of some of the trajectories."""
        chosen = self.frame["trajectory"].isin(list(trajectories))
        return replace(self, frame=self.frame[chosen], held_out=())


def matched(name: str) -> str:
    """Column of an input with the filter over it that made its coordinate's acceleration."""
    return f"{name}_matched"


def required_columns(coordinates: tuple[Coordinate, ...]) -> list[str]:
    """Names of the columns that a data set has at least, in their order."""
    accelerations = [c.acceleration for c in coordinates]
    return ["trajectory", "time", *state_names(coordinates), *accelerations, *input_names(coordinates)]


def coordinate_units(coordinates: tuple[Coordinate, ...]) -> dict[str, str]:
    """Units of the required columns."""
    units = {"trajectory": "1", "time": "s"}
    units |= dict(zip(state_names(coordinates), state_units(coordinates), strict=True))
    units |= {c.acceleration: c.acceleration_unit for c in coordinates}
    return units | {c.input: c.input_unit for c in coordinates if c.input is not None}


def split(dataset: Dataset, fraction: float, blocks: int, seed: int) -> tuple[Dataset, Dataset]:
    """Divide a data set by blocks of time into one to fit and one to validate.

    Each trajectory is cut into `blocks` blocks of equal length; blocks are drawn so that each trajectory
    gives its share. Blocks that are neighbours stay one trajectory; the parts are numbered anew.

    Args:
        dataset: what to divide.
        fraction: share of the blocks to fit, in (0, 1); at least one block goes to either side.
        blocks: blocks per trajectory; one block in all is cut in two.
        seed: seed of the draw.

    Raises:
        DataError: there are fewer than two samples.
    """
    if len(dataset) < 2:
        raise DataError(
            f"data set: found {len(dataset)} rows, expected at least 2 to split; record for longer"
        )
    rows = [np.flatnonzero(dataset.frame["trajectory"] == k) for k in dataset.trajectories]
    pieces = max(blocks, 2) if len(rows) == 1 else blocks
    cut = [[b for b in np.array_split(r, pieces) if len(b)] for r in rows]
    random = np.random.default_rng(seed)
    # Ranked draws, trajectory by trajectory: the first of each, then the second of each, …
    drawn = sorted(
        (rank + random.uniform(), t, int(b))
        for t, parts in enumerate(cut)
        for rank, b in enumerate(random.permutation(len(parts)))
    )
    count = min(max(round((1 - fraction) * len(drawn)), 1), len(drawn) - 1)
    held = {(t, b) for _, t, b in drawn[:count]}
    return _pick(dataset, cut, held, keep=False), _pick(dataset, cut, held, keep=True)


def _pick(
    dataset: Dataset, cut: list[list[Int[NDArray[np.intp], " _"]]], held: set[tuple[int, int]], keep: bool
) -> Dataset:
    """The blocks that are held (or not), numbered anew where rows are not consecutive."""
    rows = np.concatenate(
        [block for t, parts in enumerate(cut) for b, block in enumerate(parts) if ((t, b) in held) is keep]
    )
    frame = dataset.frame.iloc[rows].copy()
    breaks = (np.diff(rows) != 1) | (np.diff(frame["trajectory"].to_numpy()) != 0)
    frame["trajectory"] = np.concatenate([[0], np.cumsum(breaks)])
    return replace(dataset, frame=frame, held_out=())


# ── missing columns ──────────────────────────────────────────────────────────────────────────────────────


def estimate_missing(
    frame: pd.DataFrame, coordinates: tuple[Coordinate, ...], between: Between = "hold"
) -> pd.DataFrame:
    """Fill in velocities from positions and accelerations from velocities, for each trajectory apart.

    The derivative of sampled velocities is a mean of the acceleration over a window. Where inputs are held,
    and jump at the rows, it is that of the input over the same window that it belongs to, not the one at the
    row, which begins to act there: so the filter goes over the input's integral as well.

    Args:
        frame: with ``trajectory``, ``time`` and at least the positions, or the velocities where cyclic.
        coordinates: the generalised coordinates.
        between: how inputs go from row to row.

    Raises:
        DataError: a column is missing that cannot be estimated, or a trajectory is too short for it.
    """
    frame = frame.copy()
    _check_columns(frame, [c for c in ("trajectory", "time") if c in frame] or ["time"])
    for c in coordinates:
        source = [] if c.topology == "cyclic" else [c.name]
        for target in (c.velocity, c.acceleration):
            if target not in frame:
                if not source:
                    raise DataError(
                        f"data set: column {target!r} is missing and cannot be estimated, because {c.name!r} "
                        "is cyclic; record it"
                    )
                _check_columns(frame, source)
                _check_time(frame)
                order = 2 if target == c.acceleration and source[-1] == c.name else 1
                driven = c.input if target == c.acceleration and c.input in frame else None
                _estimate(frame, source[-1], target, order, driven, between)
            elif target == c.velocity:
                source.append(target)
    return frame


def _estimate(
    frame: pd.DataFrame, column: str, target: str, order: int, driven: str | None, between: Between
) -> None:
    """Put the time derivative of a column, each trajectory apart, into another; match the input that acts."""
    found, seen = np.empty(len(frame)), np.empty(len(frame))
    if driven is not None:
        _check_columns(frame, [driven])
    for number in frame["trajectory"].unique():
        rows = np.flatnonzero(frame["trajectory"] == number)
        names = ["time", column, driven or "time"]
        time, values, force = frame[names].iloc[rows].to_numpy(dtype=float).T
        try:
            with np.errstate(over="ignore"):  # values out of all proportion are told of by `doubts`
                window = best_window(values, order) if len(rows) >= SHORTEST else None
                found[rows] = derivative(time, values, order, window)
        except DataError as error:
            raise DataError(f"data set: column {column!r} of trajectory {number}: {error}") from error
        seen[rows] = derivative(time, integral(time, force, between, order), order, window)
    frame[target] = found
    if driven is not None:
        frame[matched(driven)] = seen


# ── checks ───────────────────────────────────────────────────────────────────────────────────────────────


def _check_columns(frame: pd.DataFrame, names: list[str]) -> None:
    """Refuse frames in which a column is missing, not numeric or not finite."""
    for name in names:
        if name not in frame:
            raise DataError(
                f"data set: column {name!r} is missing; found {', '.join(map(str, frame.columns))}"
            )
        if not pd.api.types.is_numeric_dtype(frame[name]):
            raise DataError(f"data set: column {name!r} holds {frame[name].dtype}, expected numbers")
        bad = np.flatnonzero(~np.isfinite(frame[name].to_numpy(dtype=float)))
        if len(bad):
            raise DataError(
                f"data set: column {name!r}, row {bad[0]} (the first is 0): found "
                f"{frame[name].iloc[bad[0]]}, expected a finite number; "
                f"{len(bad)} such row{'s' * (len(bad) > 1)}: remove or repair them"
            )


def _check_time(frame: pd.DataFrame) -> None:
    """Refuse trajectories in which time does not increase, or whose rows do not stand together."""
    numbers, time = frame["trajectory"].to_numpy(), frame["time"].to_numpy(dtype=float)
    same = numbers[1:] == numbers[:-1]
    back = np.flatnonzero(same & (np.diff(time) <= 0))
    if len(back):
        row = int(back[0]) + 1
        raise DataError(
            f"data set: column 'time', row {row} (the first is 0): {time[row]:.9g} s after "
            f"{time[row - 1]:.9g} s in trajectory {numbers[row]}; time must increase: sort the rows or give "
            "the part a trajectory of its own"
        )
    starts = numbers[np.flatnonzero(np.concatenate([[True], ~same]))] if len(numbers) else numbers
    again = np.flatnonzero(pd.Series(starts).duplicated())
    if len(again):
        raise DataError(
            f"data set: column 'trajectory': the rows of trajectory {starts[again[0]]} do not stand "
            "together; sort the rows by trajectory"
        )


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────


def save_dataset(folder: Path, dataset: Dataset) -> list[Path]:
    """Write dataset.csv, dataset.parquet and dataset.meta.json (units, coordinates, …); return their paths.

    Raises:
        StorageError: one of them could not be written.
    """
    write_table(folder / "dataset", dataset.frame, dataset.units)
    meta = folder / "dataset.meta.json"
    content = {
        "units": dataset.units,
        "coordinates": [asdict(c) for c in dataset.coordinates],
        "held_out": dataset.held_out,
        "notes": dataset.notes,
        "estimated": dataset.estimated,
    }
    write_json(meta, content)
    return [folder / "dataset.csv", folder / "dataset.parquet", meta]


def load_dataset(folder: Path) -> Dataset:
    """Read what `save_dataset` wrote.

    Raises:
        DataError: a file is missing or does not hold a data set.
    """
    frame, units = read_table(folder / "dataset")
    meta = folder / "dataset.meta.json"
    try:
        content = read_json(meta)
        coordinates = tuple(Coordinate(**c) for c in content["coordinates"])
        stated = [name for name in ("held_out", "notes", "estimated") if content.get(name) is not None]
        more = {name: tuple(content[name]) for name in stated}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{meta}: no coordinates can be read from it ({error}); collect again") from error
    return Dataset(frame, coordinates, units, **more)

"""Generalised coordinates and parameters: the vocabulary in which every system is described."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from exlinn_fmi.errors import ModelError

Kind = Literal["mechanical", "electrical"]
Topology = Literal["line", "circle", "cyclic"]

TURN = {"rad": math.tau, "mrad": 1000 * math.tau, "deg": 360.0, "rev": 1.0}
"""A full turn in the units that an angle may have."""


def full_turn(unit: str) -> float:
    """A full turn in the unit of an angle; units not in `TURN` are read as rad."""
    return TURN.get(unit, math.tau)


@dataclass(frozen=True)
class Coordinate:
    """One generalised coordinate q with its velocity q̇ and the input F that acts on it.

    Args:
        name: name of q, e.g. ``alpha``.
        unit: SI unit of q, e.g. ``rad``; that of the velocity is given by `velocity_unit`.
        kind: ``mechanical`` (angle, displacement) or ``electrical`` (charge).
        topology: ``line`` (𝓛 may depend on q), ``circle`` (𝓛 depends on q mod 2π, coupling terms
            may grow linearly) or ``cyclic`` (𝓛 does not depend on q: q is no state at all).
        velocity: name of q̇, e.g. ``alpha_dot`` or ``i``; default ``<name>_dot``.
        velocity_unit: unit of q̇; default ``<unit>/s``.
        acceleration: name of q̈; default ``<velocity>_dot``, or ``<name>_ddot`` after ``<name>_dot``.
        input: name of the generalised force or voltage acting on q, None where none acts.
        input_unit: its unit.
    """

    name: str
    unit: str
    kind: Kind = "mechanical"
    topology: Topology = "line"
    velocity: str = ""
    velocity_unit: str = ""
    acceleration: str = ""
    input: str | None = None
    input_unit: str = ""

    def __post_init__(self) -> None:
        velocity = self.velocity or f"{self.name}_dot"
        standard = velocity == f"{self.name}_dot"
        fill = {
            "velocity": velocity,
            "velocity_unit": self.velocity_unit or f"{self.unit}/s",
            "acceleration": self.acceleration or (f"{self.name}_ddot" if standard else f"{velocity}_dot"),
        }
        for key, value in fill.items():
            object.__setattr__(self, key, value)

    @property
    def acceleration_unit(self) -> str:
        """Unit of q̈: rad/s → rad/s2, m/s → m/s2, A → A/s."""
        return f"{self.velocity_unit}2" if self.velocity_unit.endswith("/s") else f"{self.velocity_unit}/s"

    @property
    def force_unit(self) -> str:
        """Unit of the generalised force on q, J over that of q: m → N, rad → N.m, C → V."""
        return self.input_unit or {"m": "N", "rad": "N.m", "C": "V"}.get(self.unit, f"J/{self.unit}")


@dataclass(frozen=True)
class Parameter:
    """A physical parameter of a plant: name, value, SI unit and what it is."""

    name: str
    value: float
    unit: str
    description: str = ""


def state_names(coordinates: tuple[Coordinate, ...]) -> list[str]:
    """Names of the state x = (q of all coordinates that are not cyclic, q̇ of all)."""
    positions = [c.name for c in coordinates if c.topology != "cyclic"]
    return positions + [c.velocity for c in coordinates]


def state_units(coordinates: tuple[Coordinate, ...]) -> list[str]:
    """Units of the state, in the order of `state_names`."""
    positions = [c.unit for c in coordinates if c.topology != "cyclic"]
    return positions + [c.velocity_unit for c in coordinates]


def input_names(coordinates: tuple[Coordinate, ...]) -> list[str]:
    """Names of the inputs u, in the order of the coordinates they act on."""
    return [c.input for c in coordinates if c.input is not None]


def check_coordinates(coordinates: tuple[Coordinate, ...]) -> None:
    """Refuse coordinate sets with no member or with a name used twice.

    Raises:
        ModelError: with the name that is at fault.
    """
    if not coordinates:
        raise ModelError("a system needs at least one generalised coordinate, found none")
    seen: set[str] = set()
    for c in coordinates:
        for name in (c.name, c.velocity, c.acceleration, *([c.input] if c.input else [])):
            if name in seen:
                raise ModelError(
                    f"coordinate {c.name!r}: the name {name!r} is used twice; rename one of them"
                )
            seen.add(name)

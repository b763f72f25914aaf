"""Guesses from names and units: which variables of a plant, or columns of a file, are a coordinate's.

A guess is the beginning of a scenario that the user goes on with, never a decision: where units or names do
not speak for it, nothing is guessed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

from exlinn_fmi.mechanics.coordinates import Kind, Topology
from exlinn_fmi.scenario.units import conversion

ANGLES = "phi|theta|alpha|beta|psi|gamma|angle|rot|rotation"
LENGTHS = "s|x|y|z|h|pos|position|displacement|stroke"
TURNING, MOVING = "w|n|omega|speed|vel|velocity", "v|speed|vel|velocity"
ACCELERATING = "a|acc|acceleration"
CURRENTS, CHARGES = "i|i_a|ia|current", "q|charge"
VOLTAGES, FORCES, TORQUES = "v|u|voltage", "f|force", "tau|torque|m|t"
RELATIVE = re.compile(r"rel|flange|support|nominal|start|ref|set", re.IGNORECASE)
"""Parts of names of what is seldom the coordinate itself."""


@dataclass(frozen=True)
class Quantity:
    """A variable of a plant or a column of a file.

    Args:
        name: its name there.
        unit: its unit there, empty where that is not known.
        weight: how much speaks for it before its name and unit are looked at, e.g. that it is an output.
    """

    name: str
    unit: str = ""
    weight: int = 0

    @property
    def stem(self) -> str:
        """The name without the component that it belongs to, in small letters."""
        return self.name.rpartition(".")[2].lower()

    def measures(self, unit: str) -> bool:
        """Whether its unit is stated and can be converted to another."""
        return self.unit not in ("", "1", "-") and conversion(self.unit, unit) is not None

    def may_measure(self, unit: str, names: str) -> bool:
        """Whether its unit, or where none is stated its name, says that it is measured in a unit."""
        if self.unit not in ("", "1", "-"):
            return self.measures(unit)
        return _numbered(names, self.stem) is not None


@dataclass(frozen=True)
class Guess:
    """What may be a generalised coordinate.

    Args:
        kind: mechanical or electrical.
        topology: how its position may enter.
        unit: of q in the model.
        position: q; None where cyclic.
        velocity: q̇; None where it is to be estimated.
        acceleration: q̈, None where it is to be estimated.
        input: the input on it, None where there seems to be none.
    """

    kind: Kind
    topology: Topology
    unit: str
    position: Quantity | None
    velocity: Quantity | None
    acceleration: Quantity | None = None
    input: Quantity | None = None

    @property
    def velocity_unit(self) -> str:
        """Unit of q̇ in the model."""
        return "A" if self.kind == "electrical" else f"{self.unit}/s"

    @property
    def input_unit(self) -> str:
        """Unit of the input in the model."""
        return {"rad": "N.m", "m": "N"}.get(self.unit, "V")

    @property
    def members(self) -> Iterator[Quantity]:
        """The variables that it is made of."""
        return (q for q in (self.position, self.velocity, self.acceleration, self.input) if q is not None)


_KINDS: tuple[tuple[Kind, Topology, str, str, str], ...] = (
    ("mechanical", "circle", "rad", ANGLES, TURNING),
    ("mechanical", "line", "m", LENGTHS, MOVING),
    ("electrical", "line", "C", CHARGES, CURRENTS),
)


def guess_coordinates(
    quantities: Iterable[Quantity],
    inputs: Sequence[Quantity] | None = None,
    states: int | None = None,
    alone: bool = False,
) -> list[Guess]:
    """What may be the generalised coordinates among some quantities.

    Args:
        quantities: outputs, states and what else may be one.
        inputs: inputs of the plant; looked for among the quantities if not given.
        states: number of states of the plant, which bounds that of the coordinates.
        alone: whether a position alone is enough, its velocity being estimated.
    """
    free = list(quantities)
    found: list[Guess] = []
    left = states if states else len(free) + 2
    for guess in _motions(free, alone):
        if left >= 2 and not _used(guess, found):
            found.append(guess)
            left -= 2
    currents = [q for q in free if q.may_measure("A", CURRENTS) and not RELATIVE.search(q.name)]
    for current in sorted(currents, key=lambda q: (-q.weight, len(q.name))):
        guess = Guess("electrical", "cyclic", "C", None, current)
        if (
            left >= 1
            and not _used(guess, found)
            and (states or not any(g.kind == "electrical" for g in found))
        ):
            found.append(guess)
            left -= 1
    taken = {q.name for guess in found for q in guess.members}
    found = [
        replace(g, acceleration=_acceleration(g, [q for q in free if q.name not in taken])) for g in found
    ]
    return _with_inputs(found, [q for q in free if q.name not in taken] if inputs is None else inputs)


def _used(guess: Guess, found: Sequence[Guess]) -> bool:
    names = {q.name for other in found for q in other.members}
    return any(q.name in names for q in guess.members)


def _motions(free: Sequence[Quantity], alone: bool) -> list[Guess]:
    """Pairs of position and velocity, and positions alone where these are enough; the likeliest first."""
    rated: list[tuple[int, Guess]] = []
    for kind, topology, unit, names, speeds in _KINDS:
        velocity_unit = "A" if kind == "electrical" else f"{unit}/s"
        places = [q for q in free if q.may_measure(unit, f"{names}|q" if unit == "rad" else names)]
        pairs = [(p, v) for p, v in product(places, free) if p is not v and _same_place(p, v)]
        for p, v in pairs:
            link = 3 if _is_rate(v, p) else 2 if _alike(p, names, v, speeds) else 0
            stated = v.measures(velocity_unit)
            if (link and (stated or v.unit in ("", "1", "-"))) or (stated and p.measures(unit)):
                rated.append((link + 2 * stated + _weight(p, v), Guess(kind, topology, unit, p, v)))
        if alone and kind == "mechanical":
            rated += [(_weight(p) - 2, Guess(kind, topology, unit, p, None)) for p in places]
    return [guess for _, guess in sorted(rated, key=lambda r: -r[0])]


def _weight(*members: Quantity) -> int:
    return sum(q.weight - 3 * bool(RELATIVE.search(q.name)) for q in members)


def _same_place(one: Quantity, other: Quantity) -> bool:
    """Whether two variables belong to the same component of the plant."""
    parts = [re.sub(r"der\((.*)\)", r"\1", q.name).rpartition(".")[0] for q in (one, other)]
    return parts[0] == parts[1]


def _is_rate(rate: Quantity, of: Quantity) -> bool:
    """Whether a name says that it is the derivative of another."""
    forms = (
        "der({})",
        "{}_dot",
        "{}dot",
        "d{}",
        "d_{}",
        "{}_d",
        "{}_vel",
        "d{}_dt",
        "d{}/dt",
        "v_{}",
        "{}_t",
    )
    bare, known = _bare(rate.name), _bare(of.name)
    return any(bare == form.format(known) for form in forms) or rate.name == f"der({of.name})"


def _bare(name: str) -> str:
    """A name without component and unit, in small letters."""
    leaf = name if name.startswith("der(") else name.rpartition(".")[2]
    return re.sub(r"\s*[\[(][^)\]]*[\])]$", "", leaf).strip().lower() if not leaf.startswith("der(") else leaf


def _alike(one: Quantity, ones: str, other: Quantity, others: str) -> bool:
    """Whether two names are of two kinds, and go on alike: ``x1`` and ``v1``."""
    first, second = _numbered(f"{ones}|q", _bare(one.name)), _numbered(others, _bare(other.name))
    return first is not None and first == second


def _numbered(names: str, name: str) -> str | None:
    """What follows one of several names at the beginning of another; None where none is there."""
    match = re.fullmatch(rf"(?:{names})((?:_?\d*|_\w+))", _bare(name))
    return match[1] if match else None


def _acceleration(guess: Guess, free: Sequence[Quantity]) -> Quantity | None:
    """The acceleration of a coordinate, where there is one that names or units speak for."""
    if guess.velocity is None:
        return None
    unit, velocity, position = f"{guess.velocity_unit}/s", guess.velocity, guess.position
    fitting: list[tuple[int, Quantity]] = []
    for q in free:
        stated = q.measures(unit) or (unit == "A/s" and q.unit == "A/s")
        if not (stated or q.unit in ("", "1", "-")) or not _same_place(q, velocity):
            continue
        named = _is_rate(q, velocity) or (position is not None and _is_second(q, position))
        alike = guess.topology == "line" and _alike(velocity, MOVING, q, ACCELERATING)
        if named or alike or (stated and position is not None and not q.name.startswith("der(")):
            fitting.append((2 * alike + 3 * named + 2 * stated + q.weight, q))
    return max(fitting, key=lambda r: r[0])[1] if fitting else None


def _is_second(rate: Quantity, of: Quantity) -> bool:
    """Whether a name says that it is the second derivative of another."""
    name, known = _bare(rate.name), _bare(of.name)
    return name in (f"{known}_ddot", f"{known}ddot", f"dd{known}", f"{known}_dd")


def _with_inputs(found: Sequence[Guess], inputs: Sequence[Quantity]) -> list[Guess]:
    """The coordinates with the inputs that act on them, as far as units, names or number tell."""
    free, result = list(inputs), list(found)
    names = {"N.m": TORQUES, "N": FORCES, "V": VOLTAGES}
    tests: tuple[Callable[[Quantity, Guess], bool], ...] = (
        lambda q, g: q.measures(g.input_unit),
        lambda q, g: q.may_measure(g.input_unit, names[g.input_unit]),
    )
    for test in tests:
        for k, guess in enumerate(result):
            match = next((q for q in free if guess.input is None and test(q, guess)), None)
            if match is not None:
                result[k] = replace(guess, input=match)
                free.remove(match)
    if len(result) == 1 and len(free) == 1 and result[0].input is None and free[0].unit in ("", "1", "-"):
        result[0] = replace(result[0], input=free[0])
    return result

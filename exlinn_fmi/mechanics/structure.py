"""What is known of a plant's energies before it is learned: which there are, and what may depend on what.

In 𝓛 = ½ q̇ᵀM(q)q̇ + (Kq + A(q))ᵀq̇ − V(q) a function of position that mixes mechanical and electrical
coordinates is a coupling: magnetic where it stands beside the velocity of a charge (an inductance L(x), a
flux k_e α), electric where it is stored with the charge (Q²/2C(x), in V).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from exlinn_fmi.mechanics.coordinates import Coordinate

Coupling = Literal["any", "magnetic", "electric", "none"]
Friction = Literal["viscous", "coulomb", "stribeck", "quadratic"]
Place = Literal["M", "A", "V", "K"]
"""Where a function of position stands in 𝓛; K is the constant that a single position is multiplied by."""


@dataclass(frozen=True)
class Structure:
    """Energies, friction and constant forces that a plant has.

    Args:
        potential: whether mechanical positions store energy: gravity, springs.
        coupling: between mechanical and electrical coordinates; ``any`` where that is not known.
        friction: kinds of friction of each velocity, None where not known; () where nothing is known.
        offset: whether a constant force of unknown size acts on each coordinate beside its input; () for
            none.
    """

    potential: bool = True
    coupling: Coupling = "any"
    friction: tuple[tuple[Friction, ...] | None, ...] = ()
    offset: tuple[bool, ...] = ()

    def friction_of(self, i: int, default: tuple[Friction, ...]) -> tuple[Friction, ...]:
        """Kinds of friction of a velocity.

        Args:
            i: number of the coordinate.
            default: where they are not known.
        """
        known = self.friction[i] if self.friction else None
        return default if known is None else known

    def has_offset(self, i: int) -> bool:
        """Whether a constant force of unknown size acts on a coordinate."""
        return bool(self.offset) and self.offset[i]

    def allows(
        self, place: Place, coordinates: tuple[Coordinate, ...], i: int, positions: Collection[int]
    ) -> bool:
        """Whether a function of these positions may stand there.

        Args:
            place: M_ij, A_i, V, or K_i.
            coordinates: the generalised coordinates.
            i: the coordinate whose velocity stands beside the function; of no meaning for V.
            positions: coordinates that the function depends on, none for a constant.
        """
        kinds = {coordinates[k].kind for k in positions}
        if place == "V":
            if len(kinds) == 2:
                return self.coupling in ("any", "electric")
            return self.potential or kinds != {"mechanical"}
        own = coordinates[i].kind
        if place == "K":  # q_j q̇_i and q_i q̇_j are the same but for a gauge
            return kinds <= {own} or self.coupling in ("any", "magnetic")
        return kinds <= {own} or self.coupling == "any" or (self.coupling, own) == ("magnetic", "electrical")


UNKNOWN = Structure()
"""Nothing is known: all energies there may be."""

"""Ground-truth plants, one page each."""

from __future__ import annotations

from exlinn_fmi.errors import InputError
from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.plants import dc_motor_cart

PLANTS: dict[str, Plant] = {page.PLANT.name: page.PLANT for page in (dc_motor_cart,)}


def plant(name: str) -> Plant:
    """The plant of that name.

    Raises:
        InputError: there is none; the message lists those there are.
    """
    if name not in PLANTS:
        raise InputError(f"no plant {name!r}; there are: {', '.join(sorted(PLANTS))}")
    return PLANTS[name]

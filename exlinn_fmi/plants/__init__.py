"""Ground-truth plants, one page each."""

from __future__ import annotations

from exlinn_fmi.errors import InputError
from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.plants import (
    dc_motor_cart,
    magnetic_levitation,
    mems_actuator,
    motor_pendulum,
    two_link_arm,
)

PAGES = (dc_motor_cart, magnetic_levitation, mems_actuator, motor_pendulum, two_link_arm)
PLANTS: dict[str, Plant] = {page.PLANT.name: page.PLANT for page in PAGES}


def plant(name: str) -> Plant:
    """The plant of that name.

    Raises:
        InputError: there is none; the message lists those there are.
    """
    if name not in PLANTS:
        raise InputError(f"no plant {name!r}; there are: {', '.join(sorted(PLANTS))}")
    return PLANTS[name]

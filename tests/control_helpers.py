"""Systems and options that several tests of the controller use."""

from __future__ import annotations

import dataclasses

from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.plants.dc_motor_cart import PLANT


def without_input(system: LagrangianSystem, *names: str) -> LagrangianSystem:
    """The system with these inputs gone."""
    coordinates = tuple(
        dataclasses.replace(c, input=None, input_unit="") if c.input in names else c
        for c in system.coordinates
    )
    return dataclasses.replace(system, coordinates=coordinates)


def motor_cart() -> LagrangianSystem:
    """The paper's plant, driven by its voltage alone."""
    return without_input(PLANT.system, "tau_ext")

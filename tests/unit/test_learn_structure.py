"""Structure as the user knows it: energies, friction and constant forces, for all learners alike."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import pytest
from learn_helpers import multisine, simulate
from scenario_helpers import SCENARIO, load

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.learn.basis import entry, generic_basis
from exlinn_fmi.learn.card import force_error
from exlinn_fmi.learn.train import train
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.friction import log_cosh, stribeck
from exlinn_fmi.mechanics.structure import Structure
from exlinn_fmi.scenario.learning import Structured, Terms

MOTOR = (
    Coordinate("phi", "rad", topology="circle"),
    Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),
)
STRUCTURE = Structure(
    potential=False,
    coupling="magnetic",
    friction=(("viscous", "coulomb", "stribeck", "quadratic"), ("viscous",)),
    offset=(False, True),
)


@cache
def motor() -> Dataset:
    """A motor whose load rubs in every way there is, behind an amplifier with an offset of 0.7 V."""
    system = LagrangianSystem.build(
        MOTOR,
        lambda q, v, p: 0.01 * v[0] ** 2 + 0.01 * v[1] ** 2 + 0.5 * q[0] * v[1] + 0.7 * q[1],
        lambda v, p: (
            0.01 * v[0] ** 2
            + 0.02 * log_cosh(v[0] / 0.4)
            + 0.04 * stribeck(v[0] / 0.8)
            + 1e-4 * ca.fabs(v[0]) ** 3
            + v[1] ** 2
        ),
    )
    time = np.arange(3001) * 2e-3
    return Dataset(simulate(system, multisine(3, (0.2, 3), 20, 0, 1, time)[:, None], 2e-3), MOTOR)


def test_a_structured_model_takes_the_friction_and_the_offset_it_is_told_of() -> None:
    data = motor()
    method = Structured(preset="structured", hidden=4, iterations=60)
    told, untold = (train(*split(data, 0.8, 8, 0), method, 0, structure=s) for s in (STRUCTURE, Structure()))
    error = [np.sqrt(np.mean(force_error(model.system, data) ** 2)) for model in (told, untold)]
    assert error[0] < 1e-5
    assert error[1] > 1e-2
    assert told.weights["lagrangian.offset"] * told.spec.scales.force == pytest.approx([0, 0.7], abs=1e-5)


@pytest.mark.parametrize(
    ("structure", "gone", "kept"),
    [
        (Structure(potential=False), "-1*sin(phi)", "sin(phi)*i"),
        (Structure(coupling="none"), "phi*i", "-1*sin(phi)"),
        (Structure(coupling="electric"), "sin(phi)*i", "0.5*i^2"),
        (Structure(friction=((), ("viscous",))), "0.5*phi_dot^2", "-1*sin(phi)"),
    ],
)
def test_generic_terms_leave_out_what_the_plant_has_not(structure, gone, kept) -> None:
    before, after = generic_basis(motor()), generic_basis(motor(), structure)
    place = "dissipation" if structure.friction else "lagrangian"
    assert gone in getattr(before, place)
    assert gone not in getattr(after, place)
    assert kept in after.terms


def test_an_offset_is_a_term_of_its_own_even_of_a_cyclic_coordinate() -> None:
    basis = generic_basis(motor(), STRUCTURE)
    assert "Q" in basis.lagrangian
    assert entry("Q", MOTOR) == ("F_2", "", 1.0)
    method = Terms(
        preset="terms",
        lagrangian=["0.5*phi_dot^2", "0.5*i^2", "phi*i", "Q", "phi"],
        dissipation=[
            "0.5*phi_dot^2",
            "logcosh(2.5*phi_dot)",
            "stribeck(1.25*phi_dot)",
            "abs(phi_dot)^3",
            "i^2",
        ],
    )
    model = train(*split(motor(), 0.8, 8, 0), method, 0)
    assert model.weights["lagrangian.terms"] == pytest.approx([0.02, 0.02, 0.5, 0.7, 0], rel=1e-8)
    assert model.weights["dissipation.terms"] == pytest.approx([0.02, 0.02, 0.04, 1e-4, 1], rel=1e-7)


def test_a_scenario_says_what_is_known_of_the_plant(tmp_path) -> None:
    text = SCENARIO.replace("      topology: circle\n", "      topology: circle\n      friction: [coulomb]\n")
    text = text.replace("      topology: cyclic\n", "      topology: cyclic\n      offset: true\n")
    text = text.replace("learn:\n", "learn:\n  energies: {potential: false, coupling: magnetic}\n")
    learn = load(tmp_path, text).scenario.learn
    assert learn is not None
    assert learn.structure == Structure(False, "magnetic", (("coulomb",), None), (False, True))
    assert learn.coordinates[0].coordinate() == load(tmp_path).scenario.learn.coordinates[0].coordinate()

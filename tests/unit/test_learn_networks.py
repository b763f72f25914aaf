"""The structured networks: numpy against CasADi, derivatives, physics by construction."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learn_helpers import random_model, random_samples

from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.adjoint import Adjoint
from exlinn_fmi.learn.assembly import data_scales, inverse_assembly
from exlinn_fmi.learn.networks import StructuredNetworks
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import evaluate
from exlinn_fmi.mechanics.learned import ModelSpec, learned_system
from exlinn_fmi.mechanics.structure import Structure

CIRCLE = Coordinate("phi", "rad", topology="circle")
DEGREES = Coordinate("theta", "deg", topology="circle")
LINE = Coordinate("x", "m", topology="line", input="F", input_unit="N")
CHARGE = Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V")
STORED = Coordinate("q_c", "C", "electrical", "line", "j", "A")
SYSTEMS = [(CIRCLE, CHARGE), (LINE, STORED), (CIRCLE, DEGREES, LINE, CHARGE), (CHARGE,), (CHARGE, LINE)]
IDS = ["-".join(c.name for c in system) for system in SYSTEMS]
SEEDS = st.integers(0, 2**31)


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=IDS)
def test_numpy_inverse_model_is_that_of_the_casadi_system(coordinates: tuple[Coordinate, ...]) -> None:
    spec, weights = random_model(1, coordinates)
    samples = random_samples(2, coordinates)
    networks = StructuredNetworks(spec)
    residual = networks.residual(networks.pack(dict(weights)), inverse_assembly(spec, samples))
    force = residual * spec.scales.force + samples.F
    expected = evaluate(learned_system(spec, weights).inverse, *samples[:3], np.zeros(0))
    assert np.abs(force - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=IDS)
def test_jacobian_is_the_derivative_of_the_residual(coordinates: tuple[Coordinate, ...]) -> None:
    spec, weights = random_model(3, coordinates)
    networks = StructuredNetworks(spec)
    theta, data = networks.pack(dict(weights)), inverse_assembly(spec, random_samples(4, coordinates))
    residual, jacobian = networks.jacobian(theta, data)
    assert (residual == networks.residual(theta, data)).all()
    for k, step in enumerate(np.eye(networks.size) * 1e-6):
        difference = (networks.residual(theta + step, data) - networks.residual(theta - step, data)) / 2e-6
        assert jacobian[:, :, k] == pytest.approx(difference, rel=1e-5, abs=1e-7 * np.abs(jacobian).max())


def test_inertial_forces_are_what_accelerations_add() -> None:
    coordinates = SYSTEMS[2]
    spec, weights = random_model(5, coordinates)
    # A constant force is no inertia.
    spec = dataclasses.replace(spec, structure=Structure(offset=(True,) * len(coordinates)))
    weights = {**weights, "lagrangian.offset": np.arange(1.0, len(coordinates) + 1)}
    samples = random_samples(6, coordinates)
    networks = StructuredNetworks(spec)
    theta = networks.pack(dict(weights))
    inertia = networks.residual(theta, inverse_assembly(spec, samples).inertia())
    still = inverse_assembly(spec, samples._replace(a=0 * samples.a))
    whole = networks.residual(theta, inverse_assembly(spec, samples))
    assert inertia == pytest.approx(whole - networks.residual(theta, still), abs=1e-10)


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.sampled_from(SYSTEMS))
def test_mass_matrix_is_positive_definite_for_any_weights(
    seed: int, coordinates: tuple[Coordinate, ...]
) -> None:
    spec, weights = random_model(seed, coordinates, hidden=2)
    samples = random_samples(seed, coordinates, 5)
    mass = evaluate(learned_system(spec, weights).mass_matrix, samples.q, samples.v, np.zeros(0))
    n, speed = len(coordinates), spec.scales.velocity
    scaled = mass.reshape(-1, n, n) * np.outer(speed, speed) / spec.scales.energy
    assert np.linalg.eigvalsh(scaled).min() >= 0.999 * min(spec.epsilon) - 1e-9 * np.abs(scaled).max()


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.sampled_from(SYSTEMS))
def test_dissipation_is_convex_and_least_at_rest_for_any_weights(
    seed: int, coordinates: tuple[Coordinate, ...]
) -> None:
    spec, weights = random_model(seed, coordinates, hidden=4)
    system = learned_system(spec, weights)
    one, other = 5 * np.random.default_rng(seed).standard_normal((2, 20, len(coordinates)))

    def dissipation(v: np.ndarray) -> np.ndarray:
        return evaluate(system.dissipation, v, np.zeros(0))[:, 0]

    assert (dissipation((one + other) / 2) <= (dissipation(one) + dissipation(other)) / 2 + 1e-12).all()
    assert dissipation(np.zeros((1, len(coordinates)))) == pytest.approx(0, abs=1e-15)
    assert (dissipation(one) >= 0).all()


def test_curvature_of_dissipation_is_right_at_rest() -> None:
    spec, weights = random_model(7, (CHARGE,), hidden=3)
    inverse = learned_system(spec, weights).inverse
    force = evaluate(inverse, np.zeros((1, 1)), np.array([[1e-7]]), np.zeros((1, 1)), np.zeros(0))[0, 0]
    curvature = weights["dissipation.viscous"][0] ** 2 + (weights["dissipation.friction"] ** 2).sum()
    unit = spec.scales.energy / spec.scales.time / spec.scales.velocity[0] ** 2
    assert force / 1e-7 == pytest.approx(curvature * unit, rel=1e-4)


def test_electrical_and_mechanical_masses_are_apart() -> None:
    spec, weights = random_model(8, SYSTEMS[2])
    samples = random_samples(9, SYSTEMS[2])
    mass = evaluate(learned_system(spec, weights).mass_matrix, samples.q, samples.v, np.zeros(0))
    assert not mass[:, :3, 3].any()


def test_a_full_turn_changes_nothing_but_the_coupling() -> None:
    spec, weights = random_model(10, (DEGREES, CHARGE))
    samples = random_samples(11, (DEGREES, CHARGE))
    inverse = learned_system(spec, weights).inverse
    turned = samples.q + np.array([360.0, 0.0])
    expected = evaluate(inverse, samples.q, samples.v, samples.a, np.zeros(0))
    assert evaluate(inverse, turned, samples.v, samples.a, np.zeros(0)) == pytest.approx(expected, rel=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.floats(1e-3, 1e3), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_scaled_data_do_not_depend_on_units(second: float, metre: float, ampere: float) -> None:
    coordinates = (LINE, CHARGE)
    samples = random_samples(12, coordinates, 40)
    unit, power = np.array([metre, ampere * second]), metre * 3.0
    scaled = type(samples)(
        samples.q * unit, samples.v * unit / second, samples.a * unit / second**2, samples.F * power / unit
    )
    one, other = (
        inverse_assembly(ModelSpec("structured", coordinates, 2, data_scales(s, coordinates), (0.0, 0.0)), s)
        for s in (samples, scaled)
    )
    for name in ("z", "velocity", "value", "gradient", "target"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("coordinates", SYSTEMS, ids=IDS)
def test_a_spec_survives_json(coordinates: tuple[Coordinate, ...]) -> None:
    import json

    spec, _ = random_model(13, coordinates)
    assert ModelSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


@pytest.mark.parametrize(
    "change",
    [{"form": "other"}, {"coordinates": [{}]}, {"scales": {"time": 1}}, {"surplus": 1}, {"hidden": "8"}],
)
def test_a_damaged_spec_is_refused(change: dict[str, object]) -> None:
    spec, _ = random_model(14, SYSTEMS[0])
    with pytest.raises(ModelError, match=r"unknown form|not the description of a model"):
        ModelSpec.from_dict(spec.to_dict() | change)


def test_a_missing_array_is_named() -> None:
    spec, weights = random_model(15, SYSTEMS[0])
    with pytest.raises(ModelError, match=r"'lagrangian\.output' is missing"):
        learned_system(spec, {k: w for k, w in weights.items() if k != "lagrangian.output"})


def test_an_array_too_many_is_named() -> None:
    spec, weights = random_model(15, SYSTEMS[0])
    with pytest.raises(ModelError, match="'extra' is not part of this form"):
        learned_system(spec, {**weights, "extra": np.zeros(1)})


def test_an_array_of_the_wrong_shape_is_named() -> None:
    spec, weights = random_model(15, SYSTEMS[0])
    with pytest.raises(ModelError, match=r"'dissipation\.viscous' has shape \(3,\), expected \(2,\)"):
        learned_system(spec, {**weights, "dissipation.viscous": np.zeros(3)})


def test_weights_that_are_not_finite_are_refused() -> None:
    spec, weights = random_model(15, SYSTEMS[0])
    with pytest.raises(ModelError, match="not finite"):
        learned_system(spec, {**weights, "dissipation.viscous": np.array([np.nan, 1.0])})


# ── structure that the user knows ────────────────────────────────────────────────────────────────────────

KNOWN = Structure(
    potential=False,
    coupling="magnetic",
    friction=(("viscous", "stribeck", "quadratic"), ("viscous", "coulomb")),
    offset=(True, False),
)


def known_model(seed: int, coordinates: tuple[Coordinate, ...], structure: Structure) -> tuple:
    """A random model of a known structure."""
    spec, _ = random_model(seed, coordinates)
    spec = dataclasses.replace(spec, structure=structure)
    random = np.random.default_rng(seed)
    free = spec.layout.free.items()
    return spec, {name: np.where(mask, random.standard_normal(mask.shape), 0.0) for name, mask in free}


@pytest.mark.parametrize("coordinates", [(LINE, STORED), (CIRCLE, CHARGE)])
def test_numpy_and_casadi_agree_on_any_structure(coordinates: tuple[Coordinate, ...]) -> None:
    spec, weights = known_model(20, coordinates, KNOWN)
    samples = random_samples(21, coordinates)
    networks = StructuredNetworks(spec)
    theta, data = networks.pack(weights), inverse_assembly(spec, samples)
    force = networks.residual(theta, data) * spec.scales.force + samples.F
    assert force == pytest.approx(
        evaluate(learned_system(spec, weights).inverse, *samples[:3], np.zeros(0)), rel=1e-9
    )
    residual, jacobian = networks.jacobian(theta, data)
    gradient = Adjoint(networks, data).mean_square(theta)[1]
    assert gradient == pytest.approx(2 * np.einsum("bn,bnp->p", residual, jacobian) / residual.size)
    for k, step in enumerate(np.eye(networks.size) * 1e-6):
        difference = (networks.residual(theta + step, data) - networks.residual(theta - step, data)) / 2e-6
        assert jacobian[:, :, k] == pytest.approx(difference, rel=1e-5, abs=1e-7 * np.abs(jacobian).max())


def test_energies_that_the_plant_has_not_the_model_has_not_either() -> None:
    spec, weights = known_model(22, (LINE, STORED), KNOWN)
    system, (q, v, _, _) = learned_system(spec, weights), random_samples(23, (LINE, STORED))
    moved, rest, none = q + np.array([0.7, 0.0]), np.zeros_like(v), np.zeros(0)
    energy = [evaluate(system.energy, at, rest, none) for at in (q, moved)]
    pushed = spec.scales.energy / spec.scales.position[0] * weights["lagrangian.offset"][0]
    assert energy[1] - energy[0] == pytest.approx(-0.7 * pushed * np.ones_like(energy[0]))  # no V(x), no C(x)
    charged = q + np.array([0.0, 0.7])
    mass = [evaluate(system.mass_matrix, at, v, none).reshape(-1, 2, 2) for at in (q, charged, moved)]
    assert mass[0][:, 0, 0] == pytest.approx(mass[1][:, 0, 0])  # inertia knows nothing of charges,
    assert np.abs(mass[0][:, 1, 1] - mass[2][:, 1, 1]).max() > 1e-6  # but the inductance is L(x)


def test_without_coupling_the_parts_do_not_know_of_each_other() -> None:
    spec, weights = known_model(24, (LINE, STORED), Structure(coupling="none"))
    system, samples = learned_system(spec, weights), random_samples(25, (LINE, STORED))
    force = [
        evaluate(system.inverse, *(x * np.array([1.0, k]) for x in samples[:3]), np.zeros(0))[:, 0]
        for k in (1.0, 2.0)
    ]
    assert force[0] == pytest.approx(force[1])


@settings(max_examples=20, deadline=None)
@given(SEEDS, st.floats(-50, 50))
def test_all_friction_dissipates_at_any_speed(seed: int, speed: float) -> None:
    kinds = ("viscous", "coulomb", "stribeck", "quadratic")
    spec, weights = known_model(seed, (LINE,), Structure(friction=(kinds,)))
    system = learned_system(spec, weights)
    assert float(system.power([speed], [0.0], [])[1]) >= 0
    assert float(system.dissipation([speed], [])) >= 0

"""Physical parameters from the data themselves: deviations, intervals, and what cannot be told."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from learn_helpers import multisine, simulate
from test_learn_noise_trajectory import COORDINATES, clean, noisy

from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.learn.card import report_card
from exlinn_fmi.learn.estimate import estimate
from exlinn_fmi.learn.identify import identify
from exlinn_fmi.learn.train import train
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.plants import magnetic_levitation
from exlinn_fmi.scenario.learning import Identify, Terms

OPTIONS = Identify(
    lagrangian={
        "j_m": "0.5*alpha_dot^2",
        "m_c*d^2": "0.5*sin(alpha)^2*alpha_dot^2",
        "l": "0.5*i^2",
        "k_e": "i*alpha",
    },
    dissipation={"b_m": "0.5*alpha_dot^2", "r": "0.5*i^2"},
)
TRUTH = {"j_m": 0.1, "m_c": 1.0, "d": 0.2, "l": 1.0, "k_e": 1.0, "b_m": 0.5, "r": 5.0}


@pytest.mark.parametrize(("objective", "width"), [("auto", 0.02), ("weak", 0.4), ("trajectory", 0.02)])
def test_intervals_hold_the_truth_and_are_narrow(objective, width) -> None:
    found = estimate(noisy(0.01, seed=4), OPTIONS, TRUTH, objective).identified
    assert found is not None
    table = found.parameters
    assert np.array(table["high"] - table["low"]) == pytest.approx(np.array(2 * 1.96 * table["std"]))
    assert ((table["high"] - table["low"]) / table["true"]).max() < width
    assert (np.abs(table["identified"] - table["true"]) < 5 * table["std"]).all() or objective == "weak"


def test_clean_data_are_fitted_to_rounding() -> None:
    found = estimate(clean(), OPTIONS, TRUTH, "inverse").identified
    assert found is not None
    assert found.parameters["rel_error"].max() < 1e-9


def test_what_cannot_be_told_apart_is_named_and_has_no_number() -> None:
    options = OPTIONS.model_copy(update={"lagrangian": OPTIONS.lagrangian | {"k_t": "2*alpha*i"}})
    identified, note = estimate(noisy(0.01), options, TRUTH, "auto")
    assert identified is not None
    table = identified.parameters.set_index("name")
    assert "k_e and k_t" in note
    assert table.loc[["k_e", "k_t"], ["identified", "std", "low"]].isna().all(axis=None)
    assert table.loc["j_m", "rel_error"] < 0.01


@pytest.mark.parametrize(
    ("lagrangian", "reason"),
    [
        ({"j_m": "0.5*alpha_dot^2", "l": "0.5*i^2"}, "predict nothing"),
        ({"j_m": "0.5*alpha_dot^2", "l": "0.5*i^2", "k_e": "alpha*i"}, "times the noise"),
    ],
)
def test_monomials_that_do_not_explain_the_data_give_no_estimate(lagrangian, reason) -> None:
    options = Identify(lagrangian=lagrangian, dissipation=OPTIONS.dissipation)
    identified, note = estimate(noisy(0.01), options, TRUTH, "auto")
    assert identified is None
    assert reason in note


def test_the_report_card_says_what_was_done_and_how_noisy_the_data_are() -> None:
    data = noisy(0.01)
    candidates = Terms(
        preset="terms",
        lagrangian=list(OPTIONS.lagrangian.values()),
        dissipation=list(OPTIONS.dissipation.values()),
    )
    model = train(data, data, candidates, seed=0)
    card = report_card(model, data, [clean()], OPTIONS, TRUTH)
    assert card.metrics["learn.noise_i"] == pytest.approx(0.01, rel=0.2)
    assert card.metrics["identify.k_e_std"] == pytest.approx(0.001, rel=0.9)
    assert card.texts["learn.objective"].startswith("trajectory")
    assert card.texts["identify.objective"].startswith("trajectory")
    assert "M_11 = 0.1" in card.texts["learn.terms"] or "M_11 = 0.09" in card.texts["learn.terms"]
    assert card.terms is not None
    assert len(card.terms) == 6


def test_steps_of_different_length_leave_the_linear_objectives() -> None:
    frame = clean().frame.drop(index=range(1000, 1010))
    model = train(Dataset(frame, COORDINATES), clean(), Terms(preset="terms"), seed=0)
    assert "steps differ" in model.provenance["objective"]
    assert model.provenance["validation_loss"] < 1e-15
    rough = noisy(0.01).frame.drop(index=range(1000, 1010))
    assert "weak" in estimate(Dataset(rough, COORDINATES), OPTIONS, TRUTH, "auto").note


# ── shapes and known parameters ──────────────────────────────────────────────────────────────────────────


def coil(noise: float = 0.0) -> Dataset:
    """A ball that falls, and hangs in the field of a coil, L(x) = 0.2 + 0.1/(1 + (x/0.02)²)."""
    system = magnetic_levitation.PLANT.system.with_inputs({"v"})
    time = np.arange(3001) * 1e-3
    voltage = multisine(0.6, (0.2, 6), 20, 8, 2, time)[:, None]
    frame = simulate(system, voltage, 1e-3, np.array([4e-3, 0, 0.9]))
    for k, name in enumerate(("x", "x_dot", "i")):
        frame[name] += noise * frame[name].std() * np.random.default_rng(k).standard_normal(len(frame))
    return Dataset(frame, system.coordinates)


COIL = Identify(
    lagrangian={"m": "0.5*x_dot^2", "m*g": "x", "l_0": "0.5*i^2", "l_1": "0.5*lorentz(x/a)*i^2"},
    dissipation={"b": "0.5*x_dot^2", "r": "0.5*i^2"},
    shapes={"a": 0.01},
)
BALL = {p.name: p.value for p in magnetic_levitation.PLANT.parameters}


def test_a_length_inside_a_function_is_identified_from_a_start_far_away() -> None:
    found = estimate(coil(), COIL, BALL, "inverse").identified
    assert found is not None
    assert found.parameters["rel_error"].max() < 1e-8
    assert found.parameters["name"].tolist()[-1] == "a"


def test_a_length_has_an_interval_from_noisy_data_that_holds_the_truth() -> None:
    found = estimate(coil(0.001), COIL, BALL, "trajectory").identified
    assert found is not None
    table = found.parameters
    assert (np.abs(table["identified"] - table["true"]) < 4 * table["std"]).all()
    assert table["std"].iloc[-1] < 0.02 * table["identified"].iloc[-1]


@pytest.mark.parametrize("objective", ["weak", "trajectory"])
def test_known_parameters_are_held_and_help_the_others(objective) -> None:
    data = noisy(0.01, seed=4)
    options = OPTIONS.model_copy(update={"known": {"l": 1.0, "k_e": 1.0}})
    (free, _), (held, note) = (estimate(data, o, TRUTH, objective) for o in (OPTIONS, options))
    assert free is not None
    assert held is not None
    before, after = (found.parameters.set_index("name") for found in (free, held))
    assert (after.loc[["l", "k_e"], "identified"] == 1).all()
    assert (after.loc[["l", "k_e"], "std"] == 0).all()
    assert after.loc["j_m", "std"] < before.loc["j_m", "std"]
    assert "held: l = 1, k_e = 1" in note


def test_known_coefficients_of_terms_are_held() -> None:
    candidates = Terms(
        preset="terms",
        lagrangian=[*OPTIONS.lagrangian.values(), "-1*cos(alpha)"],
        dissipation=list(OPTIONS.dissipation.values()),
        known={"0.5*i^2": 1.1},
    )
    for objective in ("inverse", "trajectory"):
        model = train(clean(), clean(), candidates, seed=0, objective=objective)
        assert model.weights["lagrangian.terms"][2] == 1.1
        assert model.provenance["deviations"][2] == 0


# ── what data cannot tell ────────────────────────────────────────────────────────────────────────────────


def apart(noise: float = 0.0) -> Dataset:
    """A pendulum that swings by itself beside a circuit that is driven: nothing couples them."""
    coordinates = (
        Coordinate("phi", "rad", topology="circle"),
        Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),
    )
    system = LagrangianSystem.build(
        coordinates,
        lambda q, v, p: 0.5 * v[0] ** 2 + 9.81 * ca.cos(q[0]) + 0.5 * v[1] ** 2,
        lambda v, p: 0.1 * v[0] ** 2 + v[1] ** 2,
    )
    time = np.arange(2001) * 5e-3
    frame = simulate(system, multisine(1, (0.1, 3), 9, 0, 0, time)[:, None], 5e-3, np.array([2.0, 0, 0]))
    for k, name in enumerate(("phi", "phi_dot", "i")):
        frame[name] += noise * frame[name].std() * np.random.default_rng(k).standard_normal(len(frame))
    return Dataset(frame, coordinates)


APART = Identify(
    lagrangian={"j": "0.5*phi_dot^2", "m*g*d": "cos(phi)", "l": "0.5*i^2"},
    dissipation={"b": "0.5*phi_dot^2", "r": "0.5*i^2"},
)


@pytest.mark.parametrize(("objective", "noise"), [("inverse", 0), ("weak", 0.001), ("trajectory", 0.001)])
def test_the_scale_of_a_part_without_input_is_no_number(objective, noise) -> None:
    identified, note = estimate(apart(noise), APART, {}, objective)
    assert identified is not None
    table = identified.parameters.set_index("name")
    assert "the common scale of j and m*g*d and b" in note
    assert "no input acts" in note
    assert table.loc[["j", "m*g*d", "b"], ["identified", "std", "low"]].isna().all(axis=None)
    assert table.loc[["l", "r"], "identified"].to_numpy() == pytest.approx([1, 2], rel=0.02)


def test_a_known_parameter_gives_a_part_without_input_its_scale() -> None:
    options = APART.model_copy(update={"known": {"j": 1.0}})
    identified, note = estimate(apart(), options, {}, "inverse")
    assert identified is not None
    assert "not identifiable" not in note
    found = identified.parameters.set_index("name")["identified"]
    assert found[["m*g*d", "b"]].to_numpy() == pytest.approx([9.81, 0.2], rel=1e-9)


def test_the_scale_of_a_part_without_input_is_not_read_off_a_model_either() -> None:
    data = apart()
    system = MonomialBasis(
        data.coordinates, tuple(APART.lagrangian.values()), tuple(APART.dissipation.values())
    ).system()
    table = identify(system.bound([5, 5 * 9.81, 1, 1, 2]), data, APART, {}).parameters.set_index("name")
    assert table.loc[["j", "m*g*d", "b"], "identified"].isna().all()
    assert table.loc["l", "identified"] == pytest.approx(1)


def test_what_a_coordinate_that_stands_still_would_tell_is_not_seen() -> None:
    frame = clean().frame.assign(alpha=0.0, alpha_dot=0.0, alpha_ddot=0.0)
    i, step = frame["i"].to_numpy(), 1e-3
    frame["v"] = 5.0 * i + np.gradient(i, step)  # the rotor is blocked
    frame["i_dot"] = np.gradient(i, step)
    identified, note = estimate(Dataset(frame, COORDINATES), OPTIONS, TRUTH, "inverse")
    assert identified is not None
    table = identified.parameters.set_index("name")
    gone = ["j_m", "m_c*d^2", "b_m"]
    assert table.loc[gone, "identified"].isna().all()
    assert all(name in note for name in gone)
    assert table.loc[["l", "r"], "identified"].to_numpy() == pytest.approx([1, 5], rel=1e-3)

"""The proposed excitation: information against finite differences, limits kept, worst parameter improved."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from exlinn_fmi.learn.design import Problem, Trial, _kept_within, improve, information_of
from exlinn_fmi.mechanics.coordinates import Parameter
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem, evaluate
from exlinn_fmi.mechanics.family import family
from exlinn_fmi.mechanics.learned import learned_system
from exlinn_fmi.mechanics.monomials import MonomialBasis
from exlinn_fmi.plants.dc_motor_cart import PLANT
from exlinn_fmi.scenario.signals import Multisine, Sine
from tests.learn_helpers import MOTOR_CART, random_model, simulate

NAMES = ("j_m", "m_c*d^2", "l", "k_e", "b_m", "r")
VALUES = (0.1, 0.04, 1.0, 1.0, 0.5, 5.0)
LAGRANGIAN = ("0.5*alpha_dot^2", "0.5*sin(alpha)^2*alpha_dot^2", "0.5*i^2", "i*alpha")
DISSIPATION = ("0.5*alpha_dot^2", "0.5*i^2")
STEP = 5e-3
PAPER = Trial({"v": Sine(signal="sine", offset=4, amplitude=1, frequency=1 / np.pi)}, np.zeros(3), 10.0)


def motor(
    lagrangian: tuple[str, ...] = LAGRANGIAN, dissipation: tuple[str, ...] = DISSIPATION
) -> LagrangianSystem:
    base = PLANT.system.with_inputs({"v"})
    terms = MonomialBasis(base.coordinates, lagrangian, dissipation)
    known = dict(
        zip(LAGRANGIAN + tuple(f"D {t}" for t in DISSIPATION), zip(NAMES, VALUES, strict=True), strict=True)
    )
    chosen = [known[t] for t in lagrangian] + [known[f"D {t}"] for t in dissipation]
    return family(base, terms, tuple(Parameter(n, v, "") for n, v in chosen))


def problem(system: LagrangianSystem | None = None) -> Problem:
    """The paper's excitation, 1 % noise on all states, ±12 V and ±4 A."""
    free = [-np.inf, np.inf]
    found = Problem(
        system or motor(),
        np.ones(3),
        np.array([[-12.0, 12.0]]),
        np.array([free, free, [-4.0, 4.0]]),
        (0.1, 5.0),
        STEP,
        Path(),
    )
    states, _ = found.simulate([PAPER])
    return replace(found, sigma=0.01 * states[0].std(axis=0))


@lru_cache
def proposal() -> Trial:
    found = improve(problem(), PAPER, 100, 0)
    assert found is not None
    return found


def bound_by_differences(at: Problem, trial: Trial) -> NDArray:
    """Cramér–Rao bound of the plant page's own parameters, from simulations alone.

    m_c*d^2 is varied through m_c: d is held.
    """
    inputs = at.held(trial)
    inputs = np.column_stack([np.zeros(len(inputs) + 1), np.append(inputs[:, 0], inputs[-1, 0])])
    names = ("j_m", "m_c", "l", "k_e", "b_m", "r")

    def states(start: NDArray, factors: dict[str, float]) -> NDArray:
        changed = tuple(replace(p, value=p.value * factors.get(p.name, 1.0)) for p in PLANT.system.parameters)
        system = replace(PLANT.system, parameters=changed)
        return simulate(system, inputs, at.step, start)[system.state_names].to_numpy() / at.sigma

    h = 1e-5
    columns = [states(trial.start, {n: 1 + h}) - states(trial.start, {n: 1 - h}) for n in names]
    columns += [states(trial.start + h * e, {}) - states(trial.start - h * e, {}) for e in np.eye(3)]
    jacobian = np.stack(columns, axis=-1).reshape(-1, 9) / (2 * h)
    triangle = np.linalg.qr(jacobian, mode="r")
    return np.linalg.norm(np.linalg.inv(triangle), axis=1)[:6]


@pytest.mark.parametrize("trial", [PAPER, None], ids=["paper", "proposed"])
def test_deviations_are_those_of_simulated_differences(trial: Trial | None) -> None:
    trial, at = trial or proposal(), problem()
    found = at.judge(information_of(at, [trial])).deviation
    np.testing.assert_allclose(found, bound_by_differences(at, trial), rtol=1e-3)


def test_the_worst_parameter_is_known_at_least_three_times_better() -> None:
    before, after = (bound_by_differences(problem(), trial).max() for trial in (PAPER, proposal()))
    assert after < before / 3


def test_a_proposal_keeps_all_limits_along_the_way() -> None:
    states, inputs = problem().simulate([proposal()])
    assert np.abs(inputs).max() <= 12
    assert np.abs(states[0, :, 2]).max() <= 4


def test_linearised_fits_scatter_as_predicted() -> None:
    """Forty noisy recordings of the proposed experiment, one Gauss–Newton step from the truth in each."""
    at, random = problem(), np.random.default_rng(0)
    states, inputs = at.simulate([proposal()])
    rows = np.stack(list(at.propagator.sensitivities(states, inputs, at.system.parameter_values)), axis=1)[0]
    jacobian = (rows / at.sigma[:, None]).reshape(-1, rows.shape[2])
    noise = random.standard_normal((len(jacobian), 40))
    steps = np.linalg.lstsq(jacobian, noise, rcond=None)[0][3:] / np.array(VALUES)[:, None]
    deviation = at.judge(information_of(at, [proposal()])).deviation
    np.testing.assert_allclose(np.sqrt(np.mean(steps**2, axis=1)), deviation, rtol=0.4)


def test_the_family_moves_as_the_system_it_was_made_of() -> None:
    random = np.random.default_rng(0)
    q, v, u = (
        random.standard_normal((20, 2)),
        random.standard_normal((20, 2)),
        random.standard_normal((20, 1)),
    )
    spec, weights = random_model(1, MOTOR_CART)
    learned = learned_system(spec, weights)
    terms = MonomialBasis(MOTOR_CART, ("0.5*i^2",), ("0.5*i^2",))
    known = family(learned, terms, (Parameter("l", 3.0, ""), Parameter("r", 7.0, "")))
    same = evaluate(known.forward, q, v, u, known.parameter_values)
    np.testing.assert_allclose(same, evaluate(learned.forward, q, v, u, np.zeros(0)), rtol=1e-12)


def test_parameters_of_a_family_are_the_factors_of_their_terms() -> None:
    system = motor(("0.5*i^2",), ())
    q, v, a = np.zeros((1, 2)), np.zeros((1, 2)), np.ones((1, 2))
    one, two = (evaluate(system.inverse, q, v, a, np.array([p])) for p in (1.0, 1.5))
    np.testing.assert_allclose(two - one, [[0, 0.5]], atol=1e-12)


def test_a_parameter_that_nothing_moves_is_not_seen() -> None:
    at = problem()
    rest = replace(PAPER, inputs={"v": Sine(signal="sine", amplitude=0.0, frequency=1.0)})
    assert np.isinf(at.judge(information_of(at, [rest])).deviation).all()


def test_parameters_that_cannot_be_told_apart_are_both_not_seen() -> None:
    base, twice = PLANT.system.with_inputs({"v"}), ("0.5*i^2", "2*i^2", "i*alpha")
    named = (Parameter("l", 1.0, ""), Parameter("l_2", 1.0, ""), Parameter("k_e", 1.0, ""))
    at = problem(family(base, MonomialBasis(base.coordinates, twice, ()), named))
    seen = np.isfinite(at.judge(information_of(at, [PAPER])).deviation)
    assert seen.tolist() == [False, False, True]


def test_a_state_that_is_not_measured_tells_nothing() -> None:
    at = problem()
    less = replace(at, sigma=np.array([np.inf, np.inf, at.sigma[2]]))
    full, part = (p.judge(information_of(p, [PAPER])).worst for p in (at, less))
    assert full < part < np.inf


def test_experiments_add_up() -> None:
    at = problem()
    np.testing.assert_allclose(
        at.judge(information_of(at, [PAPER] * 4)).deviation,
        at.judge(information_of(at, [PAPER])).deviation / 2,
    )


def test_a_coarse_grid_tells_about_the_same() -> None:
    at = problem()
    fine, coarse = (p.judge(information_of(p, [PAPER])).worst for p in (at, at.coarse()))
    assert coarse == pytest.approx(fine, rel=0.02)


def test_criteria_are_those_of_the_covariance() -> None:
    at = problem(motor(("0.5*i^2",), ("0.5*i^2",)))
    matrix = information_of(at, [PAPER])
    value = at.system.parameter_values
    relative = np.linalg.inv(matrix * np.outer(value, value))
    found = at.judge(matrix)
    assert found.worst == pytest.approx(np.sqrt(np.diag(relative).max()))
    assert found.a == pytest.approx(np.sqrt(np.trace(relative) / 2))
    assert found.d == pytest.approx(np.linalg.det(relative) ** (1 / 4))


def test_the_same_seed_finds_the_same() -> None:
    one, two = (improve(problem().coarse(), PAPER, 10, 3) for _ in range(2))
    assert one is not None
    assert two is not None
    assert one.inputs == two.inputs


def test_limits_that_nothing_keeps_give_nothing() -> None:
    at = problem().coarse()
    tight = replace(at, states=np.array([[5.0, 6.0]] * 3))
    assert improve(tight, PAPER, 10, 0) is None


def test_a_stopped_search_gives_its_best_so_far() -> None:
    asked: list[float] = []
    found = improve(
        problem(), PAPER, 60, 0, lambda fraction, best: asked.append(fraction), lambda: len(asked) >= 1
    )
    assert len(asked) == 1
    assert found is not None


def test_progress_ends_at_one() -> None:
    told: list[float] = []
    improve(problem().coarse(), PAPER, 30, 0, lambda fraction, best: told.append(fraction))
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_proposal_that_breaks_a_limit_at_a_close_look_is_made_smaller() -> None:
    at = problem()
    wide = Multisine(signal="multisine", rms=6.0, band=(0.1, 1.0), seed=1)
    kept = _kept_within(at, replace(PAPER, inputs={"v": wide}))
    assert kept is not None
    signal = kept.inputs["v"]
    assert isinstance(signal, Multisine)
    assert 0 < signal.rms < 6
    assert at.excess(*at.simulate([kept]))[0] == 0


def test_information_that_cancels_to_less_than_nothing_tells_nothing() -> None:
    at = problem()
    matrix = information_of(at, [PAPER])
    matrix[0] = matrix[:, 0] = 0
    matrix[0, 0] = -1e-3
    found = at.judge(matrix)
    assert np.isinf(found.deviation[0])
    assert np.isfinite(found.deviation[1:]).all()


def test_a_candidate_whose_sensitivities_overflow_is_hopeless(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Problem, "information", lambda self, x, u: np.full((len(x), 6, 6), np.inf))
    assert improve(problem(), PAPER, 10, 0) is None

"""Plant pages against equations written out by hand, closed forms and conservation laws."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pandas import DataFrame
from plant_helpers import CASES, column, parameters, random_points, start_state
from scipy.integrate import solve_ivp

from exlinn_fmi.components.lagrangian import LagrangianComponent
from exlinn_fmi.data.dataset import Dataset
from exlinn_fmi.errors import ModelError
from exlinn_fmi.export.model import plant_model
from exlinn_fmi.learn.rollout import free_run
from exlinn_fmi.mechanics.coordinates import Coordinate
from exlinn_fmi.mechanics.euler_lagrange import MAX_INTERNAL_STEP, LagrangianSystem, evaluate
from exlinn_fmi.mechanics.friction import log_cosh
from exlinn_fmi.mechanics.plant import Plant
from exlinn_fmi.plants import PLANTS, plant

LEVITATION, MEMS = plant("magnetic_levitation"), plant("mems_actuator")
PENDULUM, ARM = plant("motor_pendulum"), plant("two_link_arm")

every_plant = pytest.mark.parametrize("page", PLANTS.values(), ids=PLANTS)


def poles(page: Plant, x: list[float], **other: float) -> Any:
    """Eigenvalues of the linearisation at a state."""
    none = np.zeros(len(page.system.input_names))
    return np.linalg.eigvals(page.system.state_jacobian(x, none, column(page, **other)).full())


def slope(page: Plant, x: list[float], u: list[float], **other: float) -> Any:
    """ẋ at a state under an input."""
    return evaluate(page.system.derivative, x, u, column(page, **other))[0]


def output(page: Plant, name: str, x: list[float], u: list[float] | None = None) -> float:
    """An output at a state."""
    names = [o.name for o in page.output_list]
    inputs = u or np.zeros(len(page.system.input_names))
    return float(evaluate(page.output, x, inputs, column(page))[0][names.index(name)])


# ── all plants ───────────────────────────────────────────────────────────────────────────────────────────


@every_plant
def test_the_page_gives_the_equations_written_out_by_hand(page: Plant) -> None:
    x, u = random_points(page.name, 200)
    given = evaluate(page.system.derivative, x, u, column(page))
    expected = np.stack(CASES[page.name].equations(x.T, u.T, parameters(page)), 1)
    np.testing.assert_allclose(
        given / np.abs(expected).max(0), expected / np.abs(expected).max(0), atol=1e-12
    )


@every_plant
def test_parameters_act_as_in_the_equations_written_out_by_hand(page: Plant) -> None:
    x, u = random_points(page.name, 20)
    for name in [p.name for p in page.parameters]:
        other = {name: 1.3 * vars(parameters(page))[name]}
        given = evaluate(page.system.derivative, x, u, column(page, **other))
        expected = np.stack(CASES[page.name].equations(x.T, u.T, parameters(page, **other)), 1)
        size = np.abs(expected).max(0)
        np.testing.assert_allclose(given / size, expected / size, atol=1e-12, err_msg=name)


@every_plant
def test_mass_matrix_is_positive_definite_everywhere(page: Plant) -> None:
    x, _ = random_points(page.name, 200)
    n = page.system.n
    q = np.array([page.system.split_state(ca.DM(row))[0].full().ravel() for row in x])
    mass = evaluate(page.system.mass_matrix, q, x[:, -n:], column(page))
    assert np.linalg.eigvalsh(mass).min() > 0


@every_plant
def test_stored_energy_grows_by_what_is_supplied_less_what_is_lost(page: Plant) -> None:
    system, p = page.system, column(page)
    s, u = ca.SX.sym("x", len(system.state_names)), ca.SX.sym("u", len(system.input_names))
    q, v = system.split_state(s)
    rate = ca.jtimes(system.energy(q, v, p), s, system.derivative(s, u, p))
    supplied, lost = system.power(v, u, p)
    balance = ca.Function("balance", [s, u], [ca.vertcat(rate, supplied, lost)])
    rate, supplied, lost = evaluate(balance, *random_points(page.name, 200)).T
    size = np.abs(supplied) + np.abs(lost)
    np.testing.assert_allclose(rate / size, (supplied - lost) / size, atol=1e-11)
    assert (lost > 0).all()


@every_plant
def test_without_losses_energy_is_kept(page: Plant) -> None:
    """Half a second without inputs, up to what Runge–Kutta loses at the plant's own step."""
    system, p = page.system, column(page, **dict.fromkeys(CASES[page.name].losses, 0.0))
    x0, u = start_state(page.name), np.zeros(len(system.input_names))
    steps = round(0.5 / system.solver_step(page.start))
    x = system.rk4().fold(steps)(x0, u, p, 0.5 / steps).full().ravel()

    def energy(x: Any) -> float:
        return float(system.energy(*system.split_state(ca.DM(x)), p))

    moved = np.abs(x - x0)[-system.n :].max()
    assert moved > 1e-3 * np.abs(x0).max()
    assert abs(energy(x) - energy(x0)) < 1e-9 * abs(energy(x0) - energy(0 * x0))


@every_plant
def test_lagrangian_is_the_sum_of_its_energy_terms(page: Plant) -> None:
    names = [o.name for o in page.output_list]
    y = dict(zip(names, evaluate(page.output, *random_points(page.name, 50), column(page)).T, strict=True))
    total = sum(sign * y.get(term, 0) for term, sign in
                {"T": 1, "V": -1, "W_m": 1, "W_e": -1, "W_star": 1}.items())  # fmt: skip
    np.testing.assert_allclose(y["L"], total, rtol=1e-12)


@every_plant
def test_coupling_force_is_the_slope_of_the_coupling_energy(page: Plant) -> None:
    """At held currents and charges, for outputs f_e and tau_e…: ∂W*/∂q by central differences."""
    names = [o.name for o in page.output_list]
    forces = [name for name in names if name.startswith(("f_e", "tau_e"))]
    x, u = random_points(page.name, 50)
    y = evaluate(page.output, x, u, column(page))
    assert forces
    for k, name in enumerate(forces):
        step = np.zeros(x.shape[1])
        step[k] = 1e-4 * CASES[page.name].sizes[k]
        ahead, behind = (
            evaluate(page.output, x + sign * step, u, column(page))[:, names.index("W_star")]
            for sign in (1, -1)
        )
        force = y[:, names.index(name)]
        difference = (ahead - behind) / (2 * step[k])
        np.testing.assert_allclose(difference, force, atol=1e-6 * np.abs(force).max())


@every_plant
def test_every_output_has_a_description_beyond_states_and_accelerations(page: Plant) -> None:
    own = page.output_list[len(page.system.state_names) + page.system.n :]
    assert all(o.description for o in own)
    assert all(p.description for p in page.parameters)


@every_plant
def test_the_readme_lists_each_variable_of_the_fmu_with_unit_and_start(page: Plant, root: Path) -> None:
    text = (root / "fmus" / "README.md").read_text(encoding="utf-8")
    section = text.split(f"## {page.model_name}.fmu\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \| (\S*) ?\|", section, re.MULTILINE)
    model = plant_model(page)
    shown = [q for q in model.variables if not q.name.startswith("der(") and q.role != "time"]
    expected = {(q.name, q.unit) for q in shown}
    assert {(name, unit) for name, unit, _ in rows} == expected
    starts = {q.name: q.start for q in (*model.known, *model.settings)}
    assert {n: float(s) for n, _, s in rows if s} == pytest.approx(starts, rel=1e-5)


# ── magnetic levitation ──────────────────────────────────────────────────────────────────────────────────


def hanging(p: Any) -> float:
    """The nearer depth at which the current that levitates at x = a carries the ball: z/(1 + z²)² = 1/4."""
    roots = np.roots([1, 0, 2, -4, 1])
    nearer = min(r.real for r in roots if abs(r.imag) < 1e-9 and r.real > 0)
    return float(nearer * p.a)


@pytest.mark.parametrize("depth", [1.0, None])
def test_the_ball_is_at_rest_at_both_depths_that_the_page_names(depth: float | None) -> None:
    p, i = parameters(LEVITATION), LEVITATION.start["i"]
    x = p.a if depth else hanging(p)
    np.testing.assert_allclose(slope(LEVITATION, [x, 0.0, i], [0.0, p.r * i]), 0, atol=1e-12)


def test_the_figures_that_the_page_of_the_ball_names() -> None:
    i = LEVITATION.start["i"]
    assert i == pytest.approx(0.6264, abs=5e-5)
    assert hanging(parameters(LEVITATION)) == pytest.approx(5.91e-3, abs=5e-6)
    assert max(poles(LEVITATION, [0.02, 0.0, i]).real) == pytest.approx(21.5, abs=0.05)


def test_levitation_is_unstable_and_hanging_stable() -> None:
    i = LEVITATION.start["i"]
    assert sorted(poles(LEVITATION, [LEVITATION.start["x"], 0.0, i]).real > 0) == [False, False, True]
    assert max(poles(LEVITATION, [hanging(parameters(LEVITATION)), 0.0, i]).real) < 0


@pytest.mark.parametrize(("nudge", "ends_inside"), [(-1e-6, True), (1e-6, False)])
def test_from_the_operating_point_the_ball_falls_or_is_drawn_in(nudge: float, ends_inside: bool) -> None:
    p, i = column(LEVITATION), LEVITATION.start["i"]
    end = LEVITATION.system.rk4().fold(10_000)([0.02 + nudge, 0.0, i], [0.0, 10 * i], p, 2e-4).full().ravel()
    if ends_inside:
        assert end[0] == pytest.approx(hanging(parameters(LEVITATION)), abs=1e-4)
    else:
        assert end[0] > 1.0


def test_the_ball_falls_freely_without_current_and_friction() -> None:
    march = LEVITATION.system.rk4().fold(1000)
    x, x_dot, i = march([0.0, 0.1, 0.0], [0.0, 0.0], column(LEVITATION, b=0.0), 1e-3).full().ravel()
    assert (x, x_dot, i) == pytest.approx((0.1 + 9.81 / 2, 0.1 + 9.81, 0.0), rel=1e-12)


# ── electrostatic actuator ───────────────────────────────────────────────────────────────────────────────


def pull_in(p: Any) -> float:
    """√(8 k gap³/(27 ε A))."""
    return float(np.sqrt(8 * p.k * p.gap**3 / (27 * p.epsilon * p.area)))


def plate_at(voltage: float) -> list[list[float]]:
    """States of rest with 0 < x < gap under a voltage: k x (gap − x)² = ε A v²/2, the nearer one first."""
    p = parameters(MEMS)
    found = np.roots([p.k, -2 * p.k * p.gap, p.k * p.gap**2, -p.epsilon * p.area * voltage**2 / 2])
    positions = sorted(r.real for r in found if abs(r.imag) < 1e-9 * p.gap and 0 < r.real < p.gap)
    return [[x, p.epsilon * p.area / (p.gap - x) * voltage, 0.0, 0.0] for x in positions]


def test_the_plate_rests_where_spring_and_attraction_balance() -> None:
    for voltage in (200.0, 1000.0, 1400.0):
        for x in plate_at(voltage):
            size = [1.0, 1e-6, 9.81, voltage / parameters(MEMS).l]
            np.testing.assert_allclose(slope(MEMS, x, [0.0, voltage]) / size, 0, atol=1e-9)


def test_the_nearer_state_of_rest_is_stable_and_the_farther_one_is_not() -> None:
    near, far = plate_at(1000.0)
    assert max(poles(MEMS, near).real) < 0 < max(poles(MEMS, far).real)


def test_the_states_of_rest_meet_at_a_third_of_the_gap_under_the_pull_in_voltage() -> None:
    p = parameters(MEMS)
    assert pull_in(p) == pytest.approx(1446, abs=0.5)
    near, far = plate_at((1 - 1e-9) * pull_in(p))
    assert near[0] < p.gap / 3 < far[0]
    assert far[0] - near[0] < 1e-4 * p.gap
    assert plate_at((1 + 1e-9) * pull_in(p)) == []
    at = [p.gap / 3, p.epsilon * p.area / (2 / 3 * p.gap) * pull_in(p), 0.0, 0.0]
    assert min(abs(poles(MEMS, at))) < 1e-6 * max(abs(poles(MEMS, at)))


@pytest.mark.parametrize(("share", "stays"), [(0.999, True), (1.001, False)])
def test_a_slowly_rising_voltage_pulls_the_plate_in_at_the_pull_in_voltage(share: float, stays: bool) -> None:
    p, h = parameters(MEMS), 1e-3
    ramp = np.minimum(np.arange(40_000) * h / 20, 1) * share * pull_in(p)
    march = MEMS.system.rk4().mapaccum(len(ramp))
    x = march(np.zeros(4), np.vstack([0 * ramp, ramp]), column(MEMS, b=1.0), h).full()[0]
    reached = np.flatnonzero(x > 0.9 * p.gap)
    assert (reached.size == 0) == stays
    if stays:
        assert x[-1] < p.gap / 3


def test_without_an_inductance_the_charge_has_no_euler_lagrange_equation() -> None:
    with pytest.raises(ModelError, match="not finite at the start state and these parameters"):
        MEMS.system.solver_step({}, column(MEMS, l=0.0))


def test_an_actuator_of_another_size_moves_alike_in_its_own_units() -> None:
    """µm, pF and µs: x by 1/1000, t by 1/1000, mass and stiffness by their own; the shape of motion stays."""
    p = parameters(MEMS)
    small = {"gap": p.gap * 1e-3, "m": p.m * 1e-9, "k": p.k * 1e-3, "b": p.b * 1e-6, "area": p.area * 1e-6}
    small |= {"r": p.r, "l": p.l * 1e-3}
    voltages = [0.9 * pull_in(parameters(MEMS, **values)) for values in ({}, small)]
    ends = []
    for values, scale, voltage in zip(({}, small), (1.0, 1e-3), voltages, strict=True):
        march = MEMS.system.rk4().fold(5000)
        ends.append(march(np.zeros(4), [0.0, voltage], column(MEMS, **values), 2e-5 * scale).full().ravel())
    assert ends[1][0] / small["gap"] == pytest.approx(ends[0][0] / p.gap, rel=1e-9)


# ── pendulum ─────────────────────────────────────────────────────────────────────────────────────────────


def test_the_motor_holds_the_pendulum_at_any_angle() -> None:
    p = parameters(PENDULUM)
    for phi in np.linspace(-np.pi, np.pi, 9):
        i = p.m * p.g * p.d * np.sin(phi) / p.k_e
        np.testing.assert_allclose(slope(PENDULUM, [phi, 0.0, i], [0.0, p.r * i]), 0, atol=1e-12)


def test_hanging_is_stable_and_standing_is_not() -> None:
    assert max(poles(PENDULUM, [0.0, 0.0, 0.0]).real) < 0 < max(poles(PENDULUM, [np.pi, 0.0, 0.0]).real)


def test_small_swings_without_motor_and_friction_have_the_closed_forms_frequency() -> None:
    p = parameters(PENDULUM)
    found = poles(PENDULUM, [0.0, 0.0, 0.0], k_e=0.0, b=0.0, tau_c=0.0)
    expected = np.sqrt(p.m * p.g * p.d / (p.j_m + p.m * p.d**2))
    assert max(found.imag) == pytest.approx(expected, rel=1e-12)


def test_a_large_swing_has_the_period_of_the_elliptic_integral() -> None:
    """T = 4 K(sin(φ₀/2))/ω₀ by the arithmetic-geometric mean; after it the pendulum is back."""
    p = column(PENDULUM, k_e=0.0, b=0.0, tau_c=0.0)
    named = parameters(PENDULUM)
    omega = np.sqrt(named.m * named.g * named.d / (named.j_m + named.m * named.d**2))
    mean, other = 1.0, np.cos(2.5 / 2)
    for _ in range(8):
        mean, other = (mean + other) / 2, np.sqrt(mean * other)
    period = 2 * np.pi / omega / mean
    end = PENDULUM.system.rk4().fold(20_000)([2.5, 0.0, 0.0], [0.0, 0.0], p, period / 20_000).full().ravel()
    np.testing.assert_allclose(end, [2.5, 0.0, 0.0], atol=1e-9)


def test_coulomb_friction_tends_to_its_value_and_changes_sign_with_the_motion() -> None:
    p = parameters(PENDULUM)
    for speed in (-50.0, 50.0):
        friction = output(PENDULUM, "tau_f", [0.0, speed, 0.0])
        assert friction == pytest.approx(p.b * speed + np.sign(speed) * p.tau_c, rel=1e-12)
    assert output(PENDULUM, "tau_f", [0.0, 0.0, 0.0]) == 0


def test_friction_output_is_the_slope_of_the_dissipation() -> None:
    x, u = random_points("motor_pendulum", 100)
    names = [o.name for o in PENDULUM.output_list]
    given = evaluate(PENDULUM.output, x, u, column(PENDULUM))[:, names.index("tau_f")]
    v = ca.SX.sym("v", 2)
    force = ca.Function("f", [v], [ca.gradient(PENDULUM.system.dissipation(v, column(PENDULUM)), v)])
    np.testing.assert_allclose(given, evaluate(force, x[:, 1:])[:, 0], rtol=1e-12)


@given(x=st.floats(-300, 300))
def test_log_cosh_is_what_it_says(x: float) -> None:
    assert float(log_cosh(ca.DM(x))) == pytest.approx(np.log(np.cosh(x)), rel=1e-12, abs=1e-15)


@given(x=st.floats(-1e6, 1e6))
def test_slope_and_curvature_of_log_cosh_are_tanh_and_its_slope(x: float) -> None:
    s = ca.SX.sym("s")
    first = ca.gradient(log_cosh(s), s)
    both = ca.Function("d", [s], [ca.vertcat(first, ca.gradient(first, s))])
    given = both(x).full().ravel()
    np.testing.assert_allclose(given, [np.tanh(x), 1 - np.tanh(x) ** 2], atol=1e-15)


# ── two-link arm ─────────────────────────────────────────────────────────────────────────────────────────


def test_the_motors_hold_the_arm_in_any_pose() -> None:
    p = parameters(ARM)
    for phi_1, phi_2 in np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 2)):
        second = p.m_2 * p.g * p.d_2 / 2 * np.sin(phi_1 + phi_2)
        first = (p.m_1 / 2 + p.m_2) * p.g * p.d_1 * np.sin(phi_1) + second
        i = np.array([first, second]) / (p.n * p.k_e)
        x = [phi_1, phi_2, 0.0, 0.0, *i]
        np.testing.assert_allclose(slope(ARM, x, [0.0, 0.0, *(p.r * i)]), 0, atol=1e-11)


def test_of_the_four_upright_and_hanging_poses_one_is_stable() -> None:
    poses = [[a, b, 0.0, 0.0, 0.0, 0.0] for a in (0.0, np.pi) for b in (0.0, np.pi)]
    assert [max(poles(ARM, x).real) < 0 for x in poses] == [True, False, False, False]


def test_kinetic_energy_of_the_arm_is_that_of_its_rods_mass_by_mass() -> None:
    """Rods summed by Gauss points that move in the complex plane; rotors by their turning speeds."""
    p = parameters(ARM)
    names = [o.name for o in ARM.output_list]
    x, u = random_points("two_link_arm", 5)
    given = evaluate(ARM.output, x, u, column(ARM))[:, names.index("T")]
    phi_1, phi_2, w_1, w_2 = x[:, :4].T
    s, weights = np.polynomial.legendre.leggauss(4)
    s, weights = (s + 1) / 2, weights / 2
    total = p.j_m * ((p.n * w_1) ** 2 + (w_1 + p.n * w_2) ** 2) / 2
    for at, share in zip(s, weights, strict=True):
        first = 1j * p.d_1 * w_1 * np.exp(1j * phi_1)
        tip = first + 1j * at * p.d_2 * (w_1 + w_2) * np.exp(1j * (phi_1 + phi_2))
        total = total + share * (p.m_1 * abs(at * first) ** 2 + p.m_2 * abs(tip) ** 2) / 2
    np.testing.assert_allclose(given, total, rtol=1e-12)


def test_power_goes_round_between_motor_and_joint() -> None:
    """What the back-EMF takes from the circuit, the torque gives to the joint: at no moment is any lost."""
    p = parameters(ARM)
    x, _ = random_points("two_link_arm", 50)
    names = [o.name for o in ARM.output_list]
    y = dict(zip(names, evaluate(ARM.output, x, np.zeros(4), column(ARM)).T, strict=True))
    for k in (1, 2):
        emf = -(p.l * y[f"i_{k}_dot"] + p.r * y[f"i_{k}"])  # v = 0
        np.testing.assert_allclose(emf * y[f"i_{k}"], y[f"tau_e{k}"] * y[f"phi_{k}_dot"], atol=1e-11)


# ── the internal step ────────────────────────────────────────────────────────────────────────────────────


@every_plant
def test_no_pole_at_the_start_is_faster_than_the_step_allows(page: Plant) -> None:
    x = [page.start.get(name, 0.0) for name in page.system.state_names]
    step, fastest = page.system.solver_step(page.start), max(abs(poles(page, x)))
    assert fastest * step <= 0.01 * (1 + 1e-9)
    assert step == MAX_INTERNAL_STEP or fastest * step > 0.01 / 2.5


def steps_of(component: LagrangianComponent, **starts: float) -> float:
    """End state of one millisecond."""
    component.enter_initialization(0.0, 1.0, starts)
    component.exit_initialization()
    component.step(0.0, 1e-3)
    return component["i"]


def test_a_component_steps_as_finely_as_the_parameters_of_its_run_ask() -> None:
    """An inductance of 0.2 mH puts a pole at −10⁴ 1/s: the current decays in closed form."""
    heavy = {"l": 2e-4, "i": 1.0, "m": 1e9, "k_e": 0.0}
    fine = steps_of(LagrangianComponent("p", PENDULUM), **heavy)
    assert fine == pytest.approx(np.exp(-10.0), rel=1e-7)
    assert steps_of(LagrangianComponent("p", PENDULUM, max_step=1e-4), **heavy) != pytest.approx(
        fine, rel=1e-3
    )


def test_a_system_singular_at_rest_runs_with_the_longest_step() -> None:
    """As a learned model may be whose units are silent there: M = q."""
    system = LagrangianSystem.build(
        (Coordinate("q", "m", input="F", input_unit="N"),),
        lambda q, v, p: q[0] * v[0] ** 2 / 2,
        lambda v, p: ca.SX(0),
    )
    with pytest.raises(ModelError, match="not finite at the start state and default parameters"):
        system.solver_step({})
    component = LagrangianComponent("c", system)
    component.enter_initialization(0.0, 1.0, {"q": 1.0})
    component.exit_initialization()
    component.set(component.indices("input"), np.array([1.0]))
    component.step(0.0, 1e-3)
    march = solve_ivp(lambda _, x: [x[1], (1 - x[1] ** 2 / 2) / x[0]], (0, 1e-3), [1.0, 0.0], rtol=1e-12)
    assert (component["q"], component["q_dot"]) == pytest.approx(tuple(march.y[:, -1]), rel=1e-9)


def test_the_step_follows_the_start_state_of_the_plant() -> None:
    """A current of 100 A makes the field stiff for the ball: ω ≈ i √(l_1/m)/a."""
    strong = replace(LEVITATION, start={"x": 0.0, "i": 100.0})
    assert strong.system.solver_step(strong.start) < LEVITATION.system.solver_step(LEVITATION.start) / 10


def test_a_free_run_follows_a_pole_faster_than_the_rows() -> None:
    """A coil with l/r = 0.2 ms, seen every millisecond: Runge–Kutta steps of that length would diverge."""
    coil = LagrangianSystem.build(
        (Coordinate("Q", "C", "electrical", "cyclic", "i", "A", input="v", input_unit="V"),),
        lambda q, v, p: v[0] ** 2 / 2,
        lambda v, p: 5e3 * v[0] ** 2 / 2,
    )
    time = np.linspace(0, 3e-3, 4)
    i = 1 - np.exp(-5e3 * time)
    frame = DataFrame({"trajectory": 0, "time": time, "i": i, "i_dot": 5e3 * (1 - i), "v": 5e3})
    np.testing.assert_allclose(free_run(coil, Dataset(frame, coil.coordinates))[:, 0], i, atol=1e-9)

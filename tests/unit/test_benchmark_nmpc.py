"""What the benchmark of the controller compares: contestants of one problem, networks of one function."""

from __future__ import annotations

import agreement
import nmpc
import numpy as np
import pytest
from baselines.do_mpc import DoMpc

from exlinn_fmi.control.compiled import Kernel
from exlinn_fmi.control.gauss_newton import GaussNewton
from exlinn_fmi.control.solver import Plan, make_solver


@pytest.fixture(scope="module")
def given() -> nmpc.Problem:
    return nmpc.problem()


def test_do_mpc_solves_the_same_problem(given):
    peer, aim = DoMpc(given.ocp), given.aim(0.0, nmpc.START)
    mpc = peer.controller(aim)
    mpc.x0 = nmpc.START
    mpc.set_initial_guess()
    u = mpc.make_step(nmpc.START.reshape(-1, 1))
    ours = make_solver(given.ocp, "sqp", 50, 1e-9).solve(nmpc.START, aim)
    np.testing.assert_allclose(u[0], ours.u[0], atol=1e-4)


def test_the_recorded_loop_tracks_and_every_contestant_takes_it(given):
    kernel = Kernel(given.ocp, 50, 1e-8, real_time=True)
    loop = nmpc.closed_loop(given, kernel, 150)
    error = 0.2 * np.abs(np.cos(loop.states[-10:, 0]) - np.cos([aim.x[0, 0] for aim in loop.aims[-10:]]))
    assert error.max() < 1e-4
    few = nmpc.Loop(loop.states[:3], loop.aims[:3])
    for name, times in nmpc.peers(given, few):
        assert name
        assert times.shape == (2,)


def test_the_exact_step_leaves_a_converged_plan_and_mends_another(given):
    plain = make_solver(given.ocp, "sqp", 50, 1e-9, "casadi")
    assert isinstance(plain, GaussNewton)
    aim = given.aim(0.0, nmpc.START)
    found = make_solver(given.ocp, "sqp", 50, 1e-9).solve(nmpc.START, aim)
    exact = agreement.Exact(plain)
    assert exact.step(Plan(found.x, found.u), found.targets) < 1e-8
    other = found.u.copy()
    other[20] += 1e-3
    assert exact.step(Plan(found.x, other), found.targets) == pytest.approx(1e-3, rel=1e-3)


def test_a_plan_of_another_minimum_is_counted_as_such(given):
    found = make_solver(given.ocp, "sqp", 50, 1e-9).solve(nmpc.START, given.aim(0.0, nmpc.START))
    peer = agreement.Peer("peer", lambda: None)
    assert peer.compare(given.ocp, found, Plan(found.x, found.u + 1e-7)) == pytest.approx(1e-7)
    assert peer.compare(given.ocp, found, Plan(found.x + 0.1, found.u)) == 0.0
    assert peer.compare(given.ocp, found, None) == 0.0
    counted = peer.figures()
    assert counted["agree.max_dv_whole_peer"] == pytest.approx(1e-7)
    assert counted["agree.lower_minima_than_peer"] == counted["agree.peer_failures"] == 1


def test_a_wider_network_is_the_same_function(given):
    wide, x, u = nmpc.problem(factor=8), np.tile([0.7, 2.0, -1.0], (31, 1)), np.full((30, 1), 3.0)
    force = np.zeros(2)
    np.testing.assert_allclose(wide.ocp.predict(x, u, force), given.ocp.predict(x, u, force), atol=1e-12)


def test_the_fast_path_creates_nothing():
    assert nmpc.memory(True)["memory.blocks_per_step"] == 0

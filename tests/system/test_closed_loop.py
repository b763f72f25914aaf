"""The controller around the true motor with cart, which is stepped at 1 ms while it runs at 10 ms."""

from __future__ import annotations

import numpy as np
import pytest
from control_helpers import CART, arm, close_loop, constant, controller, levitation, measure, motor_cart

from exlinn_fmi.components.base import Status
from exlinn_fmi.control.batch import Batch
from exlinn_fmi.plants import plant
from exlinn_fmi.scenario.control import Reference, ScotchYoke, Weights
from exlinn_fmi.scenario.signals import Sine, Step
from exlinn_fmi.scenario.spec import Bounds

START = np.array([np.pi / 2, 0.0, 0.0])


def error(rows: dict[str, np.ndarray], settle: int = 200) -> np.ndarray:
    """Cart position less its reference [m] after settling."""
    return (0.2 * np.cos(rows["alpha"]) - rows["reference"])[settle:]


def rmse(rows: dict[str, np.ndarray], settle: int = 200) -> float:
    return float(np.sqrt(np.mean(error(rows, settle) ** 2)))


def test_tracking_with_the_true_model_is_good_to_a_micrometre():
    rows = close_loop(controller(), START, 10.0)
    assert rmse(rows) < 1e-6
    assert np.abs(rows["v"]).max() <= 24.0
    assert np.abs(rows["i"]).max() <= 4.0
    assert np.all(rows["solve_status"] == 0)
    assert rows["fallbacks"][-1] == 0


def test_tracking_keeps_a_tight_current_bound():
    made = controller(inputs={"v": Bounds(min=-24.0, max=24.0)}, states={"i": Bounds(min=-1.3, max=1.3)})
    rows = close_loop(made, START, 4.0)
    assert 1.25 < np.abs(rows["i"]).max() <= 1.3
    assert rmse(rows) < 1e-4


def test_a_bound_holds_at_the_samples_and_with_room_between_them_too():
    # The current of this motor moves within 2 ms, which is fast for samples of 10 ms.
    system = plant("motor_pendulum").system.with_inputs(["v"])
    path = Reference(coordinate="phi", trajectory=Sine(signal="sine", amplitude=1.5, frequency=0.5))
    bounds = {"inputs": {"v": Bounds(min=-12.0, max=12.0)}, "states": {"i": Bounds(min=-1.0, max=1.0)}}

    def currents(**options: float) -> np.ndarray:
        made = controller(system, reference=path, **bounds, **options)
        moved, p, x, rows = Batch(system.rk4(2), 1), system.parameter_values, np.zeros(3), []
        for k in range(15):
            outputs, _ = measure(made, *x)
            made.step(k * 0.01, 0.01)
            for _ in range(10):
                x = moved(x, np.array([outputs["v"]]), p, 1e-3)[0][0, :, 0].copy()
                rows.append(x[-1])
        return np.abs(rows).reshape(15, 10)

    tight, roomy = currents(), currents(back_off=0.01)
    assert 0.994 < tight[:, -1].max() < 0.9955  # half a percent is kept free, exactly
    assert 1.0 < tight.max() < 1.005
    assert 0.99 < roomy.max() < 1.0


def test_cost_of_the_paper_tracks_to_some_millimetres_and_ipopt_does_the_same():
    sqp = close_loop(controller(cost="paper", solver="sqp"), START, 4.0)
    ipopt = close_loop(controller(cost="paper", solver="ipopt", iterations=100), START, 4.0)
    assert 1e-3 < rmse(sqp) < 4e-3
    np.testing.assert_allclose(sqp["v"], ipopt["v"], atol=1e-4)


def test_from_the_other_side_of_the_circle_the_cart_is_tracked_on_that_branch():
    rows = close_loop(controller(), np.array([-np.pi / 2, 0.0, 0.0]), 4.0)
    assert rmse(rows) < 1e-6
    assert np.all(rows["alpha"] < 0.0)


@pytest.mark.parametrize(
    "trajectory",
    [
        Step(signal="step", time=0.5, before=-0.1, after=0.1, unit="m"),
        Sine(signal="sine", amplitude=0.5, frequency=0.4, unit="m"),
        Sine(signal="sine", amplitude=0.15, frequency=20.0, unit="m"),
    ],
    ids=["step", "beyond the stroke", "too fast"],
)
def test_references_that_cannot_be_followed_do_no_harm(trajectory):
    rows = close_loop(controller(reference=CART.model_copy(update={"trajectory": trajectory})), START, 1.5)
    assert np.all(rows["solve_status"] == 0)
    assert np.abs(rows["v"]).max() <= 24.0
    assert np.abs(rows["i"]).max() <= 4.0 * 1.01
    assert np.isfinite(rows["alpha"]).all()


def test_a_step_is_reached_and_begun_before_it_comes():
    step = Step(signal="step", time=0.5, before=-0.05, after=0.05, unit="m")
    rows = close_loop(controller(reference=CART.model_copy(update={"trajectory": step})), START, 2.0)
    assert np.abs(error(rows, 190)).max() < 1e-4
    moving = np.abs(np.diff(rows["alpha"])) > 1e-4
    assert moving[40:49].any()


def test_speed_is_controlled_too():
    reference = Reference(
        coordinate="alpha_dot",
        trajectory=Sine(signal="sine", amplitude=1.0, frequency=0.4, offset=3.0, unit="rad/s"),
    )
    rows = close_loop(controller(reference=reference), START, 4.0)
    assert np.abs(rows["alpha_dot"] - rows["reference"])[200:].max() < 1e-3


def test_one_sampling_time_of_a_millisecond_works_with_the_reference_found_by_inversion():
    rows = close_loop(controller(step=1e-3), START, 1.5, step=1e-3)
    assert rmse(rows, 1300) < 1e-4


def test_a_sensor_that_drops_out_for_five_ticks_is_survived():
    made, states, x, missing = controller(), [], START, 0
    plant, p = Batch(motor_cart().rk4(10), 1), motor_cart().parameter_values
    for k in range(300):
        seen = x if not 150 <= k < 155 else x * np.nan
        outputs, status = measure(made, *seen)
        assert status == (Status.WARNING if 150 <= k < 155 else Status.OK)
        made.step(k * 0.01, 0.01)
        x = plant(x, np.array([outputs["v"]]), p, 0.01)[0][0, :, 0].copy()
        states.append(0.2 * np.cos(x[0]) - 0.15 * np.sin(2 * np.pi * 0.4 * 0.01 * (k + 1)))
        missing += outputs["missing"]
    assert (outputs["fallbacks"], missing) == (0, 15)
    assert np.abs(states[150:]).max() < 1e-4


def test_the_stroke_is_kept_with_its_margin():
    wide = CART.model_copy(
        update={
            "trajectory": Sine(signal="sine", amplitude=0.3, frequency=0.2, unit="m"),
            "through": ScotchYoke(map="scotch_yoke", crank=0.2, margin=0.05),
        }
    )
    rows = close_loop(controller(reference=wide), START, 5.0)
    assert np.abs(0.2 * np.cos(rows["reference_alpha"])).max() == pytest.approx(0.2 * 0.95)
    assert np.all((rows["alpha"] > 0.0) & (rows["alpha"] < np.pi))


def test_a_ball_that_falls_by_itself_is_levitated_along_a_path():
    path = Sine(signal="sine", amplitude=0.01, frequency=1.0, offset=0.05)
    reference = Reference(coordinate="x", trajectory=path)
    bounds = {"u": Bounds(min=0.0, max=100.0)}
    made = controller(levitation(), reference=reference, inputs=bounds, weights=Weights(states=1e4))
    rows = close_loop(made, np.array([0.055, 0.0, 1.0]), 3.0, system=levitation())
    assert np.abs(rows["x"] - rows["reference"])[200:].max() < 1e-5
    assert np.all(rows["solve_status"] == 0)


def test_two_inputs_move_what_has_steady_references_only():
    bounds = {"ta": Bounds(min=-3.0, max=3.0), "tb": Bounds(min=-3.0, max=3.0)}
    made = controller(arm(), reference=constant("a", 0.4), inputs=bounds)
    rows = close_loop(made, np.zeros(4), 4.0, system=arm())
    assert np.abs(rows["a"] - 0.4)[-50:].max() < 1e-3
    assert np.all(rows["solve_status"] == 0)

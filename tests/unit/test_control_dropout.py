"""Measurements that are lost: found, predicted, and given up after a while."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from control_helpers import STEP, constant, controller, measure, motor_cart, oscillator

from exlinn_fmi.components.base import Status
from exlinn_fmi.control.batch import Batch
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.scenario.control import Dropout

START = np.array([np.pi / 2, 0.0, 0.0])
EKF = {"type": "ekf", "measured": ["alpha", "i"]}


def tracked(
    made: NmpcController, lost: range, value: float | None = None, ticks: int = 150
) -> dict[str, np.ndarray]:
    """The motor with cart in the loop; its angle sensor holds, or gives another value, for a while."""
    plant, p = Batch(motor_cart().rk4(10), 1), motor_cart().parameter_values
    x, seen, rows = START, START[0], []
    for k in range(ticks):
        if k not in lost:
            seen = x[0]
        elif value is not None:
            seen = value
        outputs, status = measure(made, seen, *x[1:])
        rows.append(outputs | {"alpha": x[0], "ok": float(status == Status.OK)})
        made.step(k * STEP, STEP)
        x = plant(x, np.array([outputs["v"]]), p, STEP)[0][0, :, 0].copy()
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def wrong(rows: dict[str, np.ndarray], after: int = 60) -> float:
    """Largest distance of the angle from its reference."""
    return float(np.abs(rows["alpha"] - rows["reference_alpha"])[after:].max())


@pytest.mark.parametrize("estimator", ["none", EKF], ids=["none", "ekf"])
def test_a_sensor_that_holds_its_last_value_is_found_and_predicted(estimator: Any) -> None:
    held = range(80, 110)
    blind = tracked(controller(estimator=estimator), held)
    aware = tracked(controller(estimator=estimator, dropout=Dropout(stale=1)), held)
    assert blind["missing"].sum() == 0
    np.testing.assert_array_equal(np.flatnonzero(aware["missing"]), held)
    np.testing.assert_array_equal(np.flatnonzero(1.0 - aware["ok"]), held)
    assert wrong(aware) < 0.01 * wrong(blind)


def test_the_first_repeats_are_believed_where_so_told() -> None:
    rows = tracked(controller(dropout=Dropout(stale=3)), range(80, 90))
    np.testing.assert_array_equal(np.flatnonzero(rows["missing"]), range(82, 90))


def test_a_plant_at_rest_repeats_itself_and_is_believed() -> None:
    made = controller(oscillator(), reference=constant("x", 0.0), dropout=Dropout(stale=1, timeout=0.02))
    for k in range(10):
        outputs, status = measure(made, 0.0, 0.0)
        assert (outputs["missing"], outputs["solve_status"], status) == (0, 0, Status.OK)
        made.step(k * STEP, STEP)


@pytest.mark.parametrize("value", [None, np.nan], ids=["held", "nan"])
def test_after_the_timeout_the_safe_input_is_applied_until_measurements_are_back(value: float | None) -> None:
    made = controller(dropout=Dropout(stale=1, timeout=0.1), safe_input={"v": 0.5}, estimator=EKF)
    rows = tracked(made, range(80, 110), value, ticks=200)
    lost = range(90, 110)  # the first 10 samples, 0.1 s, are predicted
    np.testing.assert_array_equal(np.flatnonzero(rows["solve_status"] == 3), lost)
    np.testing.assert_array_equal(rows["v"][90:110], 0.5)
    assert np.all(rows["v"][80:90] != 0.5)
    assert rows["fallbacks"][-1] == 20
    assert np.all(rows["solve_status"][110:] == 0)
    assert wrong(rows, 180) < 1e-3
    assert np.isfinite(np.vstack(list(rows.values()))).all()


def test_the_message_names_what_is_lost_and_what_was_done() -> None:
    made = controller(dropout=Dropout(timeout=0.015))
    for k in range(2):
        measure(made, np.nan, 0.0, 0.0)
        made.step(k * STEP, STEP)
    outputs, status = measure(made, np.nan, np.nan, 0.0)
    assert status == Status.WARNING
    assert (outputs["solve_status"], outputs["missing"]) == (3, 2)
    assert made.message == (
        "t = 0.02 s: measurement of alpha is not finite; measurement of alpha_dot is not finite; "
        "no measurement of alpha for longer than dropout.timeout (0.015 s); applied the safe input"
    )


def test_losses_that_come_and_go_do_not_add_up() -> None:
    made = controller(dropout=Dropout(timeout=0.015))
    measure(made, *START)
    made.step(0.0, STEP)
    for k in range(1, 9):
        outputs, _ = measure(made, np.nan if k % 2 else np.pi / 2, 0.0, 0.0)
        assert outputs["solve_status"] == 0
        made.step(k * STEP, STEP)


def test_what_was_heard_is_part_of_the_state() -> None:
    made, other = (controller(dropout=Dropout(stale=1, timeout=0.05), estimator=EKF) for _ in range(2))
    tracked(made, range(80, 200), ticks=83)
    saved = made.serialize_state(made.save_state())
    other.restore_state(other.deserialize_state(saved))
    for k in range(83, 90):
        one, two = (measure(c, 1.5, 0.1, 0.2)[0] for c in (made, other))
        assert {n: v for n, v in one.items() if "time" not in n} == {
            n: v for n, v in two.items() if "time" not in n
        }
        made.step(k * STEP, STEP), other.step(k * STEP, STEP)

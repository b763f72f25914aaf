"""Sensors: noise, offset, resolution and delay."""

from __future__ import annotations

import numpy as np
import pytest

from exlinn_fmi.components.sensor import Sensor
from exlinn_fmi.results.metrics import control_loops
from exlinn_fmi.scenario.document import parse
from exlinn_fmi.scenario.schema import Scenario
from exlinn_fmi.scenario.signals import Channel

STEP = 0.01


def sensor(seed: int = 0, **channels: Channel) -> Sensor:
    made = Sensor("sensor", channels, seed)
    made.enter_initialization(0.0, 1.0, {})
    made.exit_initialization()
    return made


def read(made: Sensor, *values: float) -> np.ndarray:
    """What is measured of these values now."""
    made.set(made.indices("input"), np.array(values))
    outputs = made.indices("output")
    measured = np.zeros(len(outputs))
    made.get(outputs, measured)
    return measured


def record(made: Sensor, values: np.ndarray) -> np.ndarray:
    """What is measured of a signal, tick by tick."""
    found = []
    for k, value in enumerate(values):
        found.append(read(made, value)[0])
        made.step(k * STEP, STEP)
    return np.array(found)


def test_an_ideal_sensor_shows_what_is():
    assert read(sensor(a=Channel(), b=Channel()), 1.5, -2.0).tolist() == [1.5, -2.0]


def test_offset_and_resolution():
    made = sensor(a=Channel(offset=0.3, resolution=0.25))
    assert record(made, np.array([0.0, 0.1, 0.6])).tolist() == [0.25, 0.5, 1.0]


def test_noise_is_white_of_its_deviation_and_the_same_in_each_run():
    made, still = sensor(a=Channel(noise=0.2)), np.full(4000, 3.0)
    first = record(made, still)
    assert first.std() == pytest.approx(0.2, rel=0.05)
    assert first.mean() == pytest.approx(3.0, abs=0.02)
    assert abs(np.corrcoef(first[1:], first[:-1])[0, 1]) < 0.05
    made.enter_initialization(0.0, 1.0, {})
    made.exit_initialization()
    np.testing.assert_array_equal(record(made, still), first)
    assert not np.array_equal(record(sensor(1, a=Channel(noise=0.2)), still), first)


def test_reading_twice_in_a_tick_reads_the_same():
    made = sensor(a=Channel(noise=0.2))
    assert read(made, 1.0) == read(made, 1.0)


@pytest.mark.parametrize("delay", [1, 3])
def test_a_late_signal_is_that_of_some_samples_before(delay):
    values = np.arange(10.0)
    late = record(sensor(a=Channel(delay=delay)), values)
    np.testing.assert_array_equal(late[delay:], values[:-delay])
    np.testing.assert_array_equal(late[:delay], 0.0)


def test_what_is_late_does_not_depend_on_what_is_now():
    variables = sensor(a=Channel(delay=1), b=Channel()).variables
    assert {v.name: v.depends_on for v in variables if v.causality == "output"} == {
        "a_measured": (),
        "b_measured": ("b",),
    }


def test_a_restored_sensor_goes_on_as_the_saved_one_did():
    made = sensor(a=Channel(noise=0.2, delay=2))
    record(made, np.arange(5.0))
    saved = made.save_state()
    first = record(made, np.arange(5.0))
    made.restore_state(saved)
    np.testing.assert_array_equal(record(made, np.arange(5.0)), first)


LOOP = """\
name: loop
components:
  plant: {plant: dc_motor_cart}
  sensor: {step: 0.01, sensor: {alpha: {noise: 1e-4, unit: rad}, v: {delay: 1, unit: V}}}
  controller:
    step: 0.01
    nmpc:
      model: plant:dc_motor_cart
      reference: {coordinate: alpha, trajectory: {signal: constant, value: 1}}
connections:
  plant.alpha: sensor.alpha
  sensor.alpha_measured: controller.alpha
  controller.v: sensor.v
  sensor.v_measured: plant.v
simulate: {stop: 1}
"""


def test_a_loop_is_judged_by_the_plants_variables_behind_the_sensor():
    loop = control_loops(Scenario.model_validate(parse(LOOP).data))[0]
    assert loop.states == {"alpha": "plant.alpha"}
    assert loop.inputs == {"v": "plant.v"}
    assert loop.outputs == {"reference": "plant.alpha"}

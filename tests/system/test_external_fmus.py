"""FMUs that others made (OpenModelica, PythonFMU3) and our own, against values known beforehand."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest
from fmu_helpers import Driver, other_fmus
from hypothesis import given, settings
from hypothesis import strategies as st

from exlinn_fmi.components.fmu import FmuComponent, read_variables
from exlinn_fmi.components.lagrangian import LagrangianComponent
from exlinn_fmi.errors import InputError
from exlinn_fmi.plants import plant


@pytest.fixture
def open_fmu() -> Iterator:
    """Opens an FMU by name, closed at the end."""
    with ExitStack() as stack:
        yield lambda name: Driver(stack.enter_context(closing(FmuComponent(name, other_fmus()[name]))))


@pytest.fixture(scope="module")
def adder() -> Iterator[Driver]:
    with closing(FmuComponent("add", other_fmus()["add"])) as component:
        yield Driver(component).begin(stop=1e6)


# ── OpenModelica, FMI 2.0 ────────────────────────────────────────────────────────────────────────────────


@given(u1=st.floats(-1e9, 1e9), u2=st.floats(-1e9, 1e9))
@settings(max_examples=50, deadline=None)
def test_openmodelica_adds_two_inputs(adder: Driver, u1: float, u2: float) -> None:
    adder.set(u1=u1, u2=u2)
    assert adder.get("y") == [u1 + u2]


def test_openmodelica_takes_parameters_as_start_values(open_fmu) -> None:
    driver = open_fmu("add").begin(**{"add.k1": 3.0, "add.k2": -1.0})
    driver.set(u1=2.0, u2=5.0)
    driver.run(1)
    assert driver.get("y", "add.u1") == [1.0, 2.0]


def test_openmodelica_follows_time(open_fmu) -> None:
    starts = {"ramp.height": 4.0, "ramp.duration": 2.0, "ramp.startTime": 0.5, "ramp.offset": 1.0}
    driver = open_fmu("ramp").begin(h=0.25, stop=4.0, **starts)
    values = []
    for _ in range(16):
        values += driver.get("out")
        driver.step()
    times = np.arange(16) * 0.25
    assert values == pytest.approx((1.0 + 4.0 * np.clip((times - 0.5) / 2.0, 0.0, 1.0)).tolist(), abs=1e-9)


def springs(h: float, steps: int) -> np.ndarray:
    """Two masses and three springs, all 1, by the explicit Euler method that OpenModelica's FMUs use."""
    x, v = np.array([0.0, 1.0]), np.array([1.0, 0.0])
    for _ in range(steps):
        x, v = x + h * v, v + h * (np.array([[-2.0, 1.0], [1.0, -2.0]]) @ x)
    return np.concatenate([x, v])


def test_openmodelica_integrates_as_its_method_does(open_fmu) -> None:
    driver = open_fmu("MassSpringSystem").begin(h=0.01, stop=1.0)
    driver.run(100)
    assert driver.get("x1", "x2", "v1", "v2") == pytest.approx(springs(0.01, 100).tolist(), abs=1e-10)


def test_two_coupled_openmodelica_fmus_move_as_the_whole_does(open_fmu) -> None:
    h = 0.01
    one = open_fmu("MassSpringSubSystem1").begin(h=h, stop=1.0)
    two = open_fmu("MassSpringSubSystem2").begin(h=h, stop=1.0)
    for _ in range(100):
        (x1,), (x2,) = one.get("x1"), two.get("x2")
        one.set(x2=x2)
        two.set(x1=x1)
        one.run(1)
        two.run(1)
    assert one.get("x1") + two.get("x2") == pytest.approx(springs(h, 100)[:2].tolist(), abs=1e-10)


def test_a_damped_openmodelica_mass_comes_to_rest_where_its_spring_says(open_fmu) -> None:
    # m ẍ = f − c x − d ẋ, critically damped: poles at −10 1/s.
    starts = {"spring.c": 100.0, "damper.d": 20.0}
    driver = open_fmu("Mass_Damper").begin(h=1e-3, stop=10.0, **starts)
    driver.set(f=50.0)
    driver.run(5000)
    (rest,) = driver.get("mass.s")
    driver.set(f=0.0)
    driver.run(4000)
    (free,) = driver.get("mass.s")
    assert rest - free == pytest.approx(50.0 / 100.0, rel=1e-6)
    assert driver.get("mass.v") == pytest.approx([0.0], abs=1e-6)


def test_units_types_and_dependencies_of_openmodelica_are_read() -> None:
    found = {v.name: v for v in read_variables(other_fmus()["Mass_Damper"])}
    assert (found["f"].causality, found["f"].unit, found["f"].start) == ("input", "N", 0.0)
    assert (found["mass.m"].variability, found["mass.m"].unit, found["mass.m"].min) == ("fixed", "kg", 0.0)
    adder = {v.name: v for v in read_variables(other_fmus()["add"])}
    assert adder["y"].depends_on == ("u1", "u2")
    springs_found = {v.name: v for v in read_variables(other_fmus()["MassSpringSystem"])}
    assert springs_found["x1"].depends_on == ()


def test_an_openmodelica_fmu_can_run_again(open_fmu) -> None:
    driver = open_fmu("MassSpringSystem")
    ends = []
    for _ in range(2):
        driver.begin(h=0.1, stop=1.0)
        driver.run(10)
        ends.append(driver.get("x1", "x2", "v1", "v2"))
    assert ends[0] == ends[1] == pytest.approx(springs(0.1, 10).tolist(), abs=1e-10)


def test_a_wrong_name_in_a_foreign_fmu_is_told_with_the_nearest(open_fmu) -> None:
    with pytest.raises(InputError, match=r"add\.add\.k3: no such variable; did you mean 'add\.k"):
        open_fmu("add").begin(**{"add.k3": 1.0})


# ── PythonFMU3, FMI 3.0 ──────────────────────────────────────────────────────────────────────────────────


def test_an_fmi3_fmu_counts_with_its_increment(open_fmu) -> None:
    # On leaving initialisation output = 3 + increment · input, then one increment a step.
    driver = open_fmu("FMU3Model").begin(h=1.0, increment=2.0, input=5.0)
    assert driver.get("output") == [13.0]
    driver.run(4)
    assert driver.get("output") == [21.0]


def test_an_fmi3_fmu_has_values_of_several_types(open_fmu) -> None:
    driver = open_fmu("FMU3Model").begin(int32=-7, int64=2**40, boolean=0.0)
    assert driver.get("int32", "int64", "float64", "boolean") == [-7.0, 2.0**40, 7.23, 0.0]


def test_an_fmi3_fmu_shows_its_arrays_and_strings() -> None:
    found = {v.name: v for v in read_variables(other_fmus()["FMU3Model"])}
    assert [found[f"vector[{k}]"].causality for k in range(1, 6)] == ["output"] * 5
    assert found["string"].type == "String"


# ── the plant of the paper ───────────────────────────────────────────────────────────────────────────────


def test_the_plants_fmu_and_its_python_component_move_alike(root: Path) -> None:
    """At 10 ms, so that the rule for internal steps counts as well; v is chosen to sweep the circle."""
    page = plant("dc_motor_cart")
    names = [output.name for output in page.output_list]
    with closing(FmuComponent("fmu", root / "fmus" / "DCMotorCart.fmu")) as fmu:
        pair = [
            Driver(c).begin(h=0.01, stop=1.0, alpha=0.3, m_c=1.5)
            for c in (fmu, LagrangianComponent("py", page))
        ]
        for k in range(100):
            for driver in pair:
                driver.set(v=12.0 + 10.0 * np.sin(0.2 * k), tau_ext=0.05 * k)
                driver.run(1)
            one, other = (np.array(driver.get(*names)) for driver in pair)
            assert np.abs(one - other).max() < 1e-9
    assert abs(one[0] - 0.3) > 1.0

"""Components written in Python: the base class, what its errors say, and finding a user's class."""

from __future__ import annotations

import math
import re
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from fmu_helpers import Driver
from hypothesis import given
from hypothesis import strategies as st

from exlinn_fmi.components import python as module_under_test
from exlinn_fmi.components.base import Status, Variable
from exlinn_fmi.components.python import PythonComponent, load_python_component
from exlinn_fmi.errors import DataError, InputError


class Gain(PythonComponent):
    variables = (
        Variable("u", "input"),
        Variable("k", "parameter", "fixed", start=2.0),
        Variable("trim", "parameter", "tunable", start=0.0),
        Variable("y", "output", depends_on=("u",)),
    )
    calls = 0

    def outputs(self, t: float) -> None:
        self.calls += 1
        self["y"] = self["k"] * self["u"] + self["trim"]


class Counter(PythonComponent):
    """Keeps its state beside the variables."""

    def __init__(self, name: str) -> None:
        super().__init__(name, (Variable("n", "output"), Variable("t", "output")))

    def initialize(self, start_time: float, stop_time: float) -> None:
        self.steps = 0

    def advance(self, t: float, h: float) -> None:
        self.steps += 1

    def outputs(self, t: float) -> None:
        self["n"], self["t"] = self.steps, t

    def get_state(self) -> object:
        return self.steps

    def set_state(self, state: object) -> None:
        self.steps = state


class Faulty(PythonComponent):
    """Raises what it is given, where it is told to."""

    variables = (Variable("y", "output"),)

    def __init__(self, name: str, where: str, error: Exception) -> None:
        super().__init__(name)
        self.where, self.error = where, error

    def _maybe(self, where: str) -> None:
        if self.where == where:
            raise self.error

    def initialize(self, start_time: float, stop_time: float) -> None:
        self._maybe("initialize")

    def outputs(self, t: float) -> None:
        self._maybe("outputs")

    def advance(self, t: float, h: float) -> None:
        self._maybe("advance")


# ── the base class ───────────────────────────────────────────────────────────────────────────────────────


@given(u=st.floats(-1e6, 1e6), k=st.floats(-1e6, 1e6))
def test_a_gain_multiplies(u: float, k: float) -> None:
    driver = Driver(Gain("gain")).begin(k=k)
    driver.set(u=u)
    assert driver.get("y") == [k * u]


def test_the_example_in_the_docstring_works() -> None:
    text = textwrap.dedent(module_under_test.__doc__.split("::\n")[1].split("\nA scenario names")[0])
    names: dict = {}
    exec(text.replace("from exlinn_fmi import", "from exlinn_fmi.components.python import"), names)
    gain, lag = Driver(names["Gain"]("gain")).begin(k=3.0), Driver(names["Lag"]("lag", 0.2)).begin(h=0.1)
    gain.set(u=2.0)
    assert gain.get("y") == [6.0]
    lag.set(u=1.0)
    lag.run(5)
    assert lag.get("y") == pytest.approx([1 - math.exp(-0.5 / 0.2)])


def test_outputs_are_computed_once_after_each_change() -> None:
    gain = Gain("gain")
    driver = Driver(gain).begin()
    for _ in range(3):
        driver.get("y")
        driver.get("u", "y")
    assert gain.calls == 1
    driver.set(u=1.0)
    driver.get("y")
    driver.step()
    driver.get("y")
    assert gain.calls == 3


def test_outputs_see_the_present_time() -> None:
    driver = Driver(Counter("counter")).begin(start=2.0, h=0.5)
    assert driver.get("n", "t") == [0.0, 2.0]
    driver.run(3)
    assert driver.get("n", "t") == [3.0, 3.5]


def test_a_second_run_begins_afresh() -> None:
    driver = Driver(Gain("gain")).begin(k=5.0)
    driver.set(u=3.0, trim=1.0)
    driver.begin()
    assert driver.get("u", "k", "trim", "y") == [0.0, 2.0, 0.0, 0.0]


def test_a_restored_state_gives_the_same_future() -> None:
    component = Counter("counter")
    driver = Driver(component).begin()
    driver.run(3)
    assert component.can_save_state
    state = component.save_state()
    driver.run(4)
    component.restore_state(state)
    assert driver.get("n", "t") == pytest.approx([3.0, 0.3])


def test_saved_variables_are_a_copy() -> None:
    component = Gain("gain")
    driver = Driver(component).begin(u=1.0)
    state = component.save_state()
    driver.set(u=2.0)
    component.restore_state(state)
    assert driver.get("u", "y") == [1.0, 2.0]


def test_during_a_run_inputs_and_tunable_parameters_can_be_set() -> None:
    driver = Driver(Gain("gain")).begin()
    assert driver.set(u=1.0, trim=0.5) == Status.OK
    assert driver.get("y") == [2.5]


@pytest.mark.parametrize("name", ["k", "y"])
def test_during_a_run_nothing_else_can_be_set(name: str) -> None:
    driver = Driver(Gain("gain")).begin()
    assert driver.set(**{name: 1.0}) == Status.ERROR
    assert driver.component.message == f"{name} cannot be set during a run"


def test_parameters_can_be_set_until_the_run_begins() -> None:
    component = Gain("gain")
    driver = Driver(component)
    component.enter_initialization(0.0, 1.0, {})
    assert driver.set(k=7.0, u=1.0) == Status.OK
    assert driver.set(y=7.0) == Status.ERROR
    assert component.message == "y cannot be set"
    component.exit_initialization()
    assert driver.get("y") == [7.0]


def test_a_component_may_be_closed_twice() -> None:
    component = Gain("gain")
    component.close()
    component.close()


def test_a_component_is_not_sampled_unless_it_says_so() -> None:
    assert not Gain("gain").sampled


def test_unknown_start_values_are_refused() -> None:
    with pytest.raises(InputError, match=r"gain\.trmi: no such variable; did you mean 'trim'"):
        Driver(Gain("gain")).begin(trmi=1.0)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ((Variable("a"), Variable("a")), r"c\.a: two variables have this name"),
        (
            (Variable("u", "input"), Variable("y", "output", depends_on=("v",))),
            r"c\.y: depends_on names 'v', no input; the inputs are: u",
        ),
    ],
)
def test_variables_that_cannot_be_connected_are_refused(variables: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PythonComponent("c", variables)


# ── exceptions in user code ──────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("where", ["initialize", "outputs", "advance"])
def test_an_exception_is_a_status_that_names_it_with_file_and_line(where: str) -> None:
    component = Faulty("faulty", where, ZeroDivisionError("division by zero"))
    status = component.enter_initialization(0.0, 1.0, {})
    if where == "outputs":
        status = component.get(np.array([0]), np.zeros(1))
    if where == "advance":
        status = component.step(0.0, 0.1)
    assert status == Status.ERROR
    line = r"test_components_python\.py:\d+, in _maybe"
    assert re.fullmatch(rf"ZeroDivisionError: division by zero \(.*{line}\)", component.message)


def test_the_line_named_is_the_users_own_not_the_librarys() -> None:
    class Late(PythonComponent):
        variables = (Variable("y", "output"),)

        def outputs(self, t: float) -> None:
            np.linalg.inv(np.zeros((2, 2)))

    component = Late("late")
    component.get(np.array([0]), np.zeros(1))
    assert re.match(r"LinAlgError: Singular matrix \(.*test_components_python\.py:\d+", component.message)


def test_an_error_of_ours_keeps_its_own_words() -> None:
    component = Faulty("faulty", "outputs", DataError("table.csv: no value at t = 3 s"))
    component.get(np.array([0]), np.zeros(1))
    assert component.message == "table.csv: no value at t = 3 s"


def test_an_input_error_at_the_beginning_is_the_users_to_see() -> None:
    with pytest.raises(DataError, match="too short"):
        Faulty("faulty", "initialize", DataError("too short")).enter_initialization(0.0, 1.0, {})


def test_keyboard_interrupt_is_not_swallowed() -> None:
    class Slow(PythonComponent):
        def advance(self, t: float, h: float) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Slow("slow").step(0.0, 0.1)


# ── finding a user's class ───────────────────────────────────────────────────────────────────────────────

MINE = """
from exlinn_fmi.components.python import PythonComponent, Variable

class Lag(PythonComponent):
    variables = (Variable("u", "input"), Variable("y", "output", start=0.0))

    def __init__(self, name, time_constant, gain=2.0):
        super().__init__(name)
        if time_constant <= 0:
            raise ValueError("time_constant must be positive")
        self.time_constant, self.gain = time_constant, gain

class Plain(PythonComponent):
    variables = (Variable("y", "output"),)

class Deaf(PythonComponent):
    def __init__(self):
        super().__init__("deaf", ())

class Refusing(PythonComponent):
    def __init__(self, name):
        from exlinn_fmi.errors import InputError
        raise InputError("no sensor on this machine")

class Orphan(PythonComponent):
    def __init__(self, name):
        self.gain = 1.0

class Stranger:
    pass
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.py").write_text(MINE)
    return tmp_path


def load(folder: Path, reference: str, **options: object):
    return load_python_component(reference, "lag", options, folder)


def test_a_class_beside_the_scenario_is_found(folder: Path) -> None:
    component = load(folder, "mine:Lag", time_constant=0.1)
    assert (component.name, component.time_constant, component.gain) == ("lag", 0.1, 2.0)


def test_an_installed_class_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "site" / "lab_parts"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "drives.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    assert load(tmp_path, "lab_parts.drives:Plain").name == "lag"


def test_a_class_in_a_package_beside_the_scenario_is_found(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "drives.py").write_text(MINE)
    assert load(tmp_path, "parts.drives:Plain").name == "lag"


def test_a_module_may_import_its_neighbours(folder: Path) -> None:
    (folder / "helper_of_mine.py").write_text("FACTOR = 3")
    (folder / "other.py").write_text(f"from helper_of_mine import FACTOR\n{MINE}")
    assert load(folder, "other:Plain").name == "lag"
    del sys.modules["helper_of_mine"]


def test_the_folder_is_on_the_path_only_while_importing(folder: Path) -> None:
    before = list(sys.path)
    load(folder, "mine:Plain")
    assert sys.path == before


def test_modules_of_one_name_in_two_folders_are_kept_apart(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.py").write_text(MINE.replace("gain=2.0", "gain=5.0"))
    gains = [load(where, "mine:Lag", time_constant=1).gain for where in (folder, other, folder)]
    assert gains == [2.0, 5.0, 2.0]


def test_a_module_beside_the_scenario_does_not_shadow_the_standard_library(tmp_path: Path) -> None:
    import json

    (tmp_path / "json.py").write_text(MINE)
    assert load(tmp_path, "json:Plain").name == "lag"
    assert sys.modules["json"] is json


def test_two_components_share_their_class(folder: Path) -> None:
    assert type(load(folder, "mine:Plain")) is type(load(folder, "mine:Plain"))


@pytest.mark.parametrize(
    ("reference", "options", "message"),
    [
        ("mien:Lag", {}, r"no module .*mien\.py, nor one installed; did you mean 'mine'\?"),
        ("mine:Leg", {}, r"mine\.py has no 'Leg'; did you mean 'Lag'\?"),
        ("mine:Stranger", {}, r"mine:Stranger: is no component; derive the class from exlinn_fmi\.Python"),
        ("mine:PythonComponent", {}, "is no component"),
        (
            "mine:Lag",
            {"time_constnat": 1},
            r"options do not fit \(unknown: 'time_constnat'\); "
            r"it takes: time_constant \(required\), gain \(default 2\.0\)",
        ),
        ("mine:Lag", {}, r"options do not fit \(missing a required argument: 'time_constant'\)"),
        ("mine:Plain", {"x": 1}, r"options do not fit .*; it takes: variables \(default None\)"),
        ("mine:Deaf", {}, r"options do not fit \(too many positional arguments\); it takes none"),
        (
            "mine:Lag",
            {"time_constant": -1},
            r"making it failed: ValueError: time_constant must be positive \(.*mine\.py:10, in __init__\)",
        ),
        ("mine:Orphan", {}, r"mine:Orphan: its __init__ must call super\(\)\.__init__\(name\)"),
        ("mine:Refusing", {}, r"^no sensor on this machine$"),
    ],
)
def test_a_class_that_cannot_be_made_is_told(
    folder: Path, reference: str, options: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        load(folder, reference, **options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import numpyx\n", r"it imports what is not installed: .*numpyx.*bad\.py:1"),
        ("x = 1\ny = x / 0\n", r"importing it failed: ZeroDivisionError: division by zero \(.*bad\.py:2"),
        ("def f(:\n", r"importing it failed: SyntaxError: .*bad\.py:1"),
        ("raise ModuleNotFoundError('odd')\n", r"no module|importing it failed"),
    ],
)
def test_a_module_that_cannot_be_imported_is_told(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.py").write_text(text)
    with pytest.raises(InputError, match=message):
        load(tmp_path, "bad:Thing")
    assert not [name for name in sys.modules if name.endswith("_bad")]

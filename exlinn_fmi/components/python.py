"""Components written in Python: a short base class, and finding a user's class.

A component states its variables and fills in what it needs of three methods. Everything that is kept in a
variable starts afresh with each run and is saved and restored by itself::

    from math import exp

    from exlinn_fmi import PythonComponent, Variable


    class Gain(PythonComponent):
        variables = (
            Variable("u", "input"),
            Variable("k", "parameter", "fixed", start=2.0),
            Variable("y", "output", depends_on=("u",)),
        )

        def outputs(self, t):
            self["y"] = self["k"] * self["u"]


    class Lag(PythonComponent):
        def __init__(self, name, time_constant=0.5):
            super().__init__(name, (Variable("u", "input"), Variable("y", "output", start=0.0)))
            self.time_constant = time_constant

        def advance(self, t, h):
            self["y"] += (1 - exp(-h / self.time_constant)) * (self["u"] - self["y"])

A scenario names it as ``python: my_module:Lag`` with ``options: {time_constant: 0.2}``, where `my_module.py`
lies beside the scenario.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from exlinn_fmi.components.base import Component, Indices, Number, Status, Values, Variable
from exlinn_fmi.components.packing import pack, unpack
from exlinn_fmi.components.starts import check_starts, takes_start
from exlinn_fmi.components.texts import handle, text
from exlinn_fmi.errors import ExlinnError, InputError, nearest


class PythonComponent(Component):
    """Base of components written in Python; override `initialize`, `outputs` and `advance` as needed.

    Variables are read and written as ``self["name"]``, or all at once in `values`. Give variables as a class
    attribute or to the constructor. An output that has a start value can be given another (a state).

    Args:
        name: name in the scenario.
        variables: its variables, where the class states none.
    """

    variables: tuple[Variable, ...] = ()

    def __init__(self, name: str, variables: Sequence[Variable] | None = None) -> None:
        self.name = name
        if variables is not None:
            self.variables = tuple(variables)
        _check_variables(self.name, self.variables)
        self._index = {v.name: k for k, v in enumerate(self.variables)}
        self.values: Values = np.zeros(len(self.variables))
        self._reset({})

    # ── what a component may override ────────────────────────────────────────────────────────────────────

    def initialize(self, start_time: float, stop_time: float) -> None:
        """Begin a run: start values are in force, inputs are not connected yet.

        Args:
            start_time: [s].
            stop_time: [s].
        """

    def outputs(self, t: float) -> None:
        """Compute the outputs at time t [s] from inputs, parameters and states; no state may change here."""

    def advance(self, t: float, h: float) -> None:
        """Carry the states from t to t + h [s] with the inputs held."""

    def get_state(self) -> object:
        """A copy of what is kept beside the variables."""
        return None

    def set_state(self, state: object) -> None:
        """Put back what `get_state` returned."""

    # ── by name ──────────────────────────────────────────────────────────────────────────────────────────

    def __getitem__(self, name: str) -> float:
        return float(self.values[self._index[name]])

    def __setitem__(self, name: str, value: float | str | bytes) -> None:
        self.values[self._index[name]] = handle(value) if isinstance(value, str | bytes) else value

    def text(self, name: str) -> str | bytes:
        """The value of a variable of type String or Binary."""
        return text(self[name])

    # ── the contract ─────────────────────────────────────────────────────────────────────────────────────

    @property
    def can_save_state(self) -> bool:
        """Always."""
        return True

    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """Take all start values and begin.

        Raises:
            InputError: a name in `starts` is unknown or cannot be set.
        """
        self._reset(check_starts(self.name, self.variables, starts))
        self._time = start_time
        try:
            self.initialize(start_time, stop_time)
        except InputError:
            raise
        except Exception as error:
            return self._failed(error)
        return Status.OK

    def exit_initialization(self) -> Status:
        """From now on only inputs and tunable parameters can be set."""
        self._running = True
        self._may_set.clear()
        return Status.OK

    def set(self, indices: Indices, values: Values) -> Status:
        """Set variables; outputs are computed anew when they are next read."""
        key = indices.tobytes()
        if key not in self._may_set:
            for k in indices:
                if not self._settable(self.variables[k]):
                    when = " during a run" if self._running else ""
                    self.message = f"{self.variables[k].name} cannot be set{when}"
                    return Status.ERROR
            self._may_set.add(key)
        self.values[indices] = values
        self._outdated = True
        return Status.OK

    def get(self, indices: Indices, values: Values) -> Status:
        """Read variables, with outputs that are up to date."""
        if self._outdated:
            try:
                self.outputs(self._time)
            except Exception as error:
                return self._failed(error)
            self._outdated = False
        self.values.take(indices, out=values)
        return Status.OK

    def step(self, t: float, h: float) -> Status:
        """Advance from t to t + h."""
        try:
            self.advance(t, h)
        except Exception as error:
            return self._failed(error)
        self._time = t + h
        self._outdated = True
        return Status.OK

    def save_state(self) -> object:
        """All variables, the time, and what `get_state` adds."""
        return self.values.copy(), self._time, self._outdated, self.get_state()

    def restore_state(self, state: object) -> None:
        """Go back to what `save_state` returned."""
        assert isinstance(state, tuple)
        self.values[:], self._time, self._outdated, own = state
        self.set_state(own)

    @property
    def can_serialize_state(self) -> bool:
        """If `get_state` returns plain values: numbers, texts, arrays, lists, tuples, dictionaries."""
        return True

    def serialize_state(self, state: object) -> bytes:
        """A state as bytes.

        Raises:
            NotImplementedError: `get_state` returned something else.
        """
        return pack(state)

    def deserialize_state(self, data: bytes) -> object:
        """A state from bytes."""
        return unpack(data)

    def close(self) -> None:
        """Nothing is held."""

    # ── inside ───────────────────────────────────────────────────────────────────────────────────────────

    def _reset(self, starts: Mapping[int, float]) -> None:
        """All variables at their start values, 0 where there is none."""
        self.values[:] = [0.0 if v.start is None else v.start for v in self.variables]
        for k, value in starts.items():
            self.values[k] = value
        self.message = ""
        self._time = 0.0
        self._outdated = True
        self._running = False
        self._may_set: set[bytes] = set()

    def _settable(self, variable: Variable) -> bool:
        if self._running:
            tunable = variable.causality == "parameter" and variable.variability == "tunable"
            return tunable or variable.causality == "input"
        return takes_start(variable)

    def _failed(self, error: Exception) -> Status:
        """An exception as a status, with a message that says where it came from."""
        self.message = _describe(error, inspect.getfile(type(self)))
        return Status.ERROR


def load_python_component(reference: str, name: str, options: Mapping[str, Any], folder: Path) -> Component:
    """Make a user's component.

    Args:
        reference: ``module:Class``; the module lies in `folder`, or is installed.
        name: name of the component in the scenario.
        options: further arguments of the class.
        folder: folder of the scenario.

    Raises:
        InputError: no such module or class, it is no component, or it does not take the options.
    """
    module_name, class_name = reference.split(":")
    module = _import(module_name, folder)
    candidates = {n: c for n, c in vars(module).items() if _is_component(c)}
    found = vars(module).get(class_name)
    if found is None:
        hint = nearest(class_name, candidates, "components in it")
        raise InputError(f"python: {reference}: {module.__file__} has no {class_name!r}; {hint}")
    if class_name not in candidates:
        raise InputError(
            f"python: {reference}: is no component; derive the class from exlinn_fmi.PythonComponent"
        )
    component_class = candidates[class_name]
    signature = inspect.signature(component_class)
    try:
        signature.bind(name, **options)
    except TypeError as error:
        taken = list(signature.parameters.values())[1:]
        takes = f"it takes: {', '.join(map(_option, taken))}" if taken else "it takes none"
        unknown = [repr(o) for o in options if o not in [p.name for p in taken]]
        why = f"unknown: {', '.join(unknown)}" if unknown else str(error)
        raise InputError(f"python: {reference}: options do not fit ({why}); {takes}") from error
    try:
        component: Component = component_class(name, **options)
    except InputError:
        raise
    except Exception as error:
        where = _describe(error, str(module.__file__))
        raise InputError(f"python: {reference}: making it failed: {where}") from error
    if isinstance(component, PythonComponent) and "values" not in vars(component):
        raise InputError(f"python: {reference}: its __init__ must call super().__init__(name)")
    _check_variables(name, component.variables)
    return component


def _is_component(value: object) -> bool:
    own = (Component, PythonComponent)
    return isinstance(value, type) and issubclass(value, Component) and value not in own


def _option(parameter: inspect.Parameter) -> str:
    required = parameter.default is inspect.Parameter.empty
    return f"{parameter.name} (required)" if required else f"{parameter.name} (default {parameter.default!r})"


def _import(name: str, folder: Path) -> ModuleType:
    """The module of that name, from the folder where it is there, else installed.

    Raises:
        InputError: there is none, or it fails while it is imported.
    """
    beside = folder / f"{name.replace('.', '/')}.py"
    try:
        with _first_on_path(folder):
            return _import_file(beside) if beside.is_file() else importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and name != error.name and not name.startswith(f"{error.name}."):
            where = _describe(error, str(beside))
            raise InputError(f"python: {name}: it imports what is not installed: {where}") from error
        modules = [p.stem for p in folder.glob("*.py")]
        hint = nearest(name, modules, "modules there")
        raise InputError(f"python: {name}: no module {beside}, nor one installed; {hint}") from error
    except Exception as error:
        where = _describe(error, str(beside))
        raise InputError(f"python: {name}: importing it failed: {where}") from error


def _import_file(path: Path) -> ModuleType:
    """A module from a file, under a name of its own: other folders may have one called the same."""
    stamp = f"{path.resolve()}:{path.stat().st_mtime_ns}"
    own_name = f"_exlinn_{hashlib.sha256(stamp.encode()).hexdigest()[:12]}_{path.stem}"
    if own_name in sys.modules:
        return sys.modules[own_name]
    spec = importlib.util.spec_from_file_location(own_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[own_name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[own_name]
        raise
    return module


@contextmanager
def _first_on_path(folder: Path) -> Iterator[None]:
    """Let imports find modules in the folder for a while."""
    entry = str(folder.resolve())
    sys.path.insert(0, entry)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(entry)


def _check_variables(name: str, variables: Sequence[Variable]) -> None:
    """Refuse variables that no master could connect.

    Raises:
        InputError: two names are alike, or an output depends on what is no input.
    """
    names = [v.name for v in variables]
    inputs = [v.name for v in variables if v.causality == "input"]
    for variable in variables:
        if names.count(variable.name) > 1:
            raise InputError(f"{name}.{variable.name}: two variables have this name; rename one of them")
        for other in variable.depends_on or ():
            if other not in inputs:
                hint = nearest(other, inputs, "inputs")
                raise InputError(f"{name}.{variable.name}: depends_on names {other!r}, no input; {hint}")


def _describe(error: Exception, file: str) -> str:
    """An exception in one line: what it is, and the last line of the user's file that led to it."""
    if isinstance(error, ExlinnError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if f.filename == file] or frames
    if isinstance(error, SyntaxError):
        place = f"{error.filename}:{error.lineno}"
        return f"{type(error).__name__}: {error.msg} ({place})"
    return f"{type(error).__name__}: {error} ({own[-1].filename}:{own[-1].lineno}, in {own[-1].name})"

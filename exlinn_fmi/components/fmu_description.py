"""What an FMU says of itself: its model description, as FMPy reads it, in our words.

Arrays are taken apart: each element is a variable of its own, ``x[1]``, ``A[2,1]``, counted from 1. Their
sizes may come from structural parameters, whose values are therefore needed to list the variables at all.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import fmpy

from exlinn_fmi.components.base import Causality, Number, SiUnit, Variability, Variable, VariableType
from exlinn_fmi.components.fmu_interfaces import Interface, Kind, choose_interface, read_interfaces
from exlinn_fmi.components.texts import handle
from exlinn_fmi.components.wide import exact
from exlinn_fmi.errors import FmuError

MOST_ELEMENTS = 1_000_000
"""Elements of all arrays together that an FMU may have."""

_Key = tuple[str, int]
"""Accessor and value reference of a variable."""

_SI_BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_INTEGERS = ("Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_TYPES: dict[str, VariableType] = {
    "Real": "Real",
    "Float32": "Real",
    "Float64": "Real",
    "Integer": "Integer",
    **dict.fromkeys(_INTEGERS, "Integer"),
    "Boolean": "Boolean",
    "Enumeration": "Enumeration",
    "String": "String",
    "Binary": "Binary",
}


_WIDE: dict[str, Literal["int64", "uint64"]] = {"Int64": "int64", "UInt64": "uint64"}


@dataclass(frozen=True)
class Clock:
    """A clock of an FMI 3 FMU.

    Args:
        name: its name.
        reference: its value reference.
        causality: as in FMI.
        kind: its interval variability: ``constant``, ``fixed``, ``tunable``, ``changing``, ``countdown`` or
            ``triggered``.
        interval: [s] where the description states one.
        shift: [s] time of the first tick.
    """

    name: str
    reference: int
    causality: str
    kind: str
    interval: float | None
    shift: float


@dataclass(frozen=True)
class StateNames:
    """Continuous states of Model Exchange, where the model description tells them one by one.

    Args:
        references: value references of the states.
        rates: value references of their derivatives.
    """

    references: tuple[int, ...] = ()
    rates: tuple[int, ...] = ()


@dataclass(frozen=True)
class DefaultExperiment:
    """The run that an FMU proposes, as far as it does.

    Args:
        start: start time [s].
        stop: stop time [s], None where it states none.
        step: step [s], None where it states none.
        tolerance: relative tolerance, None where it states none.
    """

    start: float = 0.0
    stop: float | None = None
    step: float | None = None
    tolerance: float | None = None


@dataclass(frozen=True)
class FmuDescription:
    """What an FMU says of itself, as far as a master needs it, for one way of using it.

    Args:
        path: the file.
        version: FMI major version.
        interface: how it is used.
        interfaces: all ways in which it can be used.
        token: GUID (FMI 1 and 2) or instantiation token (FMI 3).
        tool: the tool that made it.
        variables: its variables, arrays element by element; clocks are left out.
        accessors: for each variable, the name of its get and set functions less the prefix, e.g. ``Real``.
        references: for each variable, its value reference.
        elements: for each variable, its place in the array that the reference stands for, 0 for a scalar.
        sizes: for each variable, the number of elements that its reference stands for.
        arrays: dimensions of the arrays, by name.
        structural: names of structural parameters.
        structure: value references and values of structural parameters that differ from the description's.
        states: continuous states and their derivatives; none where arrays are among them.
        state_count: number of continuous states; FMI 3 FMUs are asked for it.
        indicator_count: number of event indicators; FMI 3 FMUs are asked for it.
        clocks: its clocks.
        experiment: the run that it proposes.
        log_categories: names of the log categories that it has.
    """

    path: Path
    version: Literal[1, 2, 3]
    interface: Interface
    interfaces: tuple[Interface, ...]
    token: str
    tool: str
    variables: tuple[Variable, ...]
    accessors: tuple[str, ...]
    references: tuple[int, ...]
    elements: tuple[int, ...]
    sizes: tuple[int, ...]
    arrays: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    structural: frozenset[str] = frozenset()
    structure: Mapping[_Key, float] = field(default_factory=dict)
    states: StateNames = StateNames()
    state_count: int = 0
    indicator_count: int = 0
    clocks: tuple[Clock, ...] = ()
    experiment: DefaultExperiment = DefaultExperiment()
    log_categories: tuple[str, ...] = ()

    @property
    def identifier(self) -> str:
        """Name of the binary."""
        return self.interface.identifier

    @property
    def platform(self) -> str:
        """Name of this machine's folder in ``binaries``."""
        return str(fmpy.platform_tuple if self.version == 3 else fmpy.platform)


def describe(
    path: Path,
    model: Any,
    root: ElementTree.Element,
    kind: Kind | None = None,
    starts: Mapping[str, Number] | None = None,
) -> FmuDescription:
    """Our description from FMPy's.

    Args:
        path: the file.
        model: as FMPy reads it.
        root: the XML, for what FMPy does not read.
        kind: how the FMU is to be used; Co-Simulation if it can, else Model Exchange, if not given.
        starts: start values by name; those of structural parameters decide on the sizes of arrays.

    Raises:
        FmuError: something in it cannot be used.
    """
    version: Literal[1, 2, 3] = {"1": 1, "2": 2}.get(model.fmiVersion[0], 3)  # type: ignore[assignment]
    interfaces = tuple(read_interfaces(path, version, model, root))
    interface = choose_interface(path, version, interfaces, kind, model)
    structure = {
        v.name: float((starts or {}).get(v.name, v.start))
        for v in model.modelVariables
        if v.causality == "structuralParameter" and v.start is not None
    }
    negated = {v.get("name") for v in root.iterfind("ModelVariables/*[@alias='negatedAlias']")}
    known = [v for v in model.modelVariables if v.type in _TYPES and v.name not in negated]
    parts = list(_parts(path, version, known, structure, root))
    names = [variable.name for variable, _, _, _ in parts]
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise FmuError(f"{path}: two variables are called {twice!r}")
    variables, keys, elements, sizes = (
        zip(*_with_dependencies(version, model, parts), strict=True) if parts else ([],) * 4
    )
    states, rates = _states(version, model)
    return FmuDescription(
        path=path,
        version=version,
        interface=interface,
        interfaces=interfaces,
        token=model.guid or "",
        tool=model.generationTool or "the tool that made it",
        variables=tuple(variables),
        accessors=tuple(key[0] for key in keys),
        references=tuple(key[1] for key in keys),
        elements=tuple(elements),
        sizes=tuple(sizes),
        arrays={v.name: _shape(v, structure) for v in known if v.dimensions},
        structural=frozenset(structure),
        structure={
            _key(version, v): structure[v.name]
            for v in known
            if v.name in structure and structure[v.name] != float(v.start)
        },
        states=StateNames(states, rates),
        state_count=model.numberOfContinuousStates,
        indicator_count=model.numberOfEventIndicators,
        clocks=tuple(_clocks(root)),
        experiment=_experiment(model.defaultExperiment),
        log_categories=tuple(category.name for category in model.logCategories),
    )


# ── variables ────────────────────────────────────────────────────────────────────────────────────────────


def _key(version: int, v: Any) -> _Key:
    """Value references of FMI 1 and 2 are unique within a type only; aliases share one."""
    return ("Int64" if version == 3 else "Integer") if v.type == "Enumeration" else v.type, v.valueReference


def _shape(v: Any, structure: Mapping[str, Number]) -> tuple[int, ...]:
    """Dimensions of an array; none for a scalar."""
    return tuple(
        int(d.start) if d.start is not None else int(structure[d.variable.name]) for d in v.dimensions
    )


_Part = tuple[Variable, _Key, int, int]


def _parts(
    path: Path, version: int, known: Iterable[Any], structure: Mapping[str, Number], root: ElementTree.Element
) -> Iterator[_Part]:
    """Every scalar and every element of an array: variable, key, place and size.

    Raises:
        FmuError: a start value or range is no number, or arrays are too large.
    """
    total, units = 0, _units(root)
    texts = {
        e.get("name"): [s.get("value") or "" for s in e.findall("Start")]
        for tag in ("String", "Binary")
        for e in root.iterfind(f"ModelVariables/{tag}")
    }
    for v in known:
        shape = _shape(v, structure)
        size = math.prod(shape)
        total += size
        if size < 0 or total > MOST_ELEMENTS:
            raise FmuError(f"{path}: variable {v.name!r} has dimensions {shape}: more than can be held")
        try:
            given = texts[v.name] if v.name in texts else (v.start or "").split() if shape else [v.start]
            starts: list[Number | None] = [_start(v, text) for text in given]
            if len(starts) != size:
                starts = starts * size if len(starts) == 1 else [None] * size
            if v.causality == "structuralParameter":
                starts = [structure[v.name]]
            one = _variable(v, units)
        except ValueError as error:
            raise FmuError(f"{path}: variable {v.name!r} (line {v.sourceline}): {error}") from error
        for k, place in enumerate(itertools.product(*(range(1, n + 1) for n in shape))):
            name = f"{v.name}[{','.join(map(str, place))}]" if shape else v.name
            yield one(name, starts[k]), _key(version, v), k, size


def _start(v: Any, text: str | None) -> Number | None:
    if text is None:
        return None
    if v.type == "String":
        return handle(text)
    return handle(bytes.fromhex(text)) if v.type == "Binary" else _number(text)


def _units(root: ElementTree.Element) -> dict[str, SiUnit]:
    """The units that the FMU defines in SI base units, by name.

    Raises:
        ValueError: an exponent, factor or offset is no number.
    """
    found = {}
    for unit in root.iterfind("UnitDefinitions/Unit"):
        base = unit.find("BaseUnit")
        if base is not None:
            kg, m, s, A, K, mol, cd, rad = (int(base.get(name, "0")) for name in _SI_BASES)
            factor, offset = float(base.get("factor", "1")), float(base.get("offset", "0"))
            found[unit.get("name", "")] = SiUnit((kg, m, s, A, K, mol, cd, rad), factor, offset)
    return found


def _variable(v: Any, units: Mapping[str, SiUnit]) -> Any:
    """What makes a variable of a name and a start value, all else as the description has it.

    Args:
        v: FMPy's variable.
        units: definitions of units by name.

    Raises:
        ValueError: its range is no number.
    """
    declared = v.declaredType
    causality: Causality = v.causality
    variability: Variability = v.variability
    clocked = False
    if v.causality in ("calculatedParameter", "none"):
        causality = "local"
    elif v.causality == "structuralParameter":
        causality, variability = "parameter", "fixed"
    elif v.causality == "input" and getattr(v, "clocks", None):
        causality, clocked = "local", True  # it may be set in the instant of its clock's tick alone
    low, high = v.min or getattr(declared, "min", None), v.max or getattr(declared, "max", None)
    if v.type == "Enumeration" and declared is not None and declared.items:
        items = [int(item.value) for item in declared.items]
        low, high = min(items), max(items)
    unit = v.unit or getattr(declared, "unit", None)
    si = units.get(unit or "")
    if si is not None and si.offset and (v.relativeQuantity or getattr(declared, "relativeQuantity", None)):
        si = replace(si, offset=0.0)  # a difference of temperatures
    least, most = _number(low), _number(high)

    def make(name: str, start: Number | None) -> Variable:
        return Variable(
            name=name,
            causality=causality,
            variability=variability,
            unit=unit,
            type=_TYPES[v.type],
            start=start,
            description=v.description or "",
            min=least,
            max=most,
            si=si,
            wide=_WIDE.get(v.type),
            clocked=clocked,
        )

    return make


def _with_dependencies(version: int, model: Any, parts: Sequence[_Part]) -> Iterator[_Part]:
    """The parts, with the inputs that each output depends on directly; an array depends as a whole."""
    inputs: dict[_Key, list[str]] = {}
    seen: set[tuple[_Key, int]] = set()
    for variable, key, place, _ in parts:
        if variable.causality == "input" and (key, place) not in seen:  # the first of several aliases
            seen.add((key, place))
            inputs.setdefault(key, []).append(variable.name)
    depends: dict[_Key, tuple[str, ...] | None] = {}
    for unknown in model.outputs:
        said = unknown.dependencies
        names = (
            None if said is None else dict.fromkeys(n for d in said for n in inputs.get(_key(version, d), ()))
        )
        depends[_key(version, unknown.variable)] = None if names is None else tuple(names)
    for variable, key, place, size in parts:
        if variable.causality == "output":
            variable = replace(variable, depends_on=depends.get(key))
        yield variable, key, place, size


def _states(version: int, model: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Value references of states and their derivatives, none where arrays are among them."""
    rates = [u.variable for u in model.derivatives]
    if any(v.dimensions or v.derivative is None for v in rates):
        return (), ()
    return tuple(v.derivative.valueReference for v in rates), tuple(v.valueReference for v in rates)


def _number(text: str | int | None) -> Number | None:
    """A start value or bound of the XML: an int where float64 may not hold it, booleans as 0 and 1."""
    if text is None:
        return None
    if text in ("true", "false"):
        return float(text == "true")
    return exact(int(text) if str(text).lstrip("+-").isdecimal() else float(text))


def _experiment(stated: Any) -> DefaultExperiment:
    """The default experiment; numbers that make no sense count as not stated."""
    if stated is None:
        return DefaultExperiment()
    start, stop, step, tolerance = (
        _number(getattr(stated, key, None) or None)
        for key in ("startTime", "stopTime", "stepSize", "tolerance")
    )
    start = start or 0.0
    return DefaultExperiment(
        start,
        stop if stop is not None and start < stop < math.inf else None,
        step if step is not None and 0 < step < math.inf else None,
        tolerance or None,
    )


# ── clocks ───────────────────────────────────────────────────────────────────────────────────────────────


def _clocks(root: ElementTree.Element) -> Iterator[Clock]:
    """The clocks, with intervals in seconds."""
    for element in root.iterfind("ModelVariables/Clock"):
        resolution = float(element.get("resolution", "1"))

        def seconds(name: str, e: ElementTree.Element = element, r: float = resolution) -> float | None:
            if (decimal := e.get(f"{name}Decimal")) is not None:
                return float(decimal)
            counter = e.get(f"{name}Counter")
            return None if counter is None else float(counter) / r

        yield Clock(
            element.get("name", ""),
            int(element.get("valueReference", "0")),
            element.get("causality", "local"),
            element.get("intervalVariability", "triggered"),
            seconds("interval"),
            seconds("shift") or 0.0,
        )

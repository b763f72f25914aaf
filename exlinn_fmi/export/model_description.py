"""modelDescription.xml of FMI 2.0 and 3.0 for a `StateSpaceModel`.

Parameters are ``tunable``: they may be set before the start and at communication points. Settings are
``fixed``. States are outputs with ``initial="exact"``, so the initial state can be set before the start.

With `arrays` (FMI 3) the state vector and its derivative are two array variables, ``state`` and
``der(state)``; single states are outputs that are read by their own names.

References: FMI 2.0.4, section 2.2; FMI 3.0.1, section 2.4.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree as ET

from exlinn_fmi.export.c_code import SOURCE
from exlinn_fmi.export.model import Quantity, Ranges, StateSpaceModel
from exlinn_fmi.export.units import DISPLAY, base_exponents

Version = Literal[2, 3]

CAPABILITIES: dict[Version, tuple[str, ...]] = {
    2: (
        "canNotUseMemoryManagementFunctions",
        "canGetAndSetFMUstate",
        "canSerializeFMUstate",
        "providesDirectionalDerivative",
    ),
    3: (
        "canGetAndSetFMUState",
        "canSerializeFMUState",
        "providesDirectionalDerivatives",
        "providesAdjointDerivatives",
    ),
}
"""What both interfaces can do."""

CO_SIMULATION: dict[Version, dict[str, str]] = {
    2: {
        "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "true",
        "maxOutputDerivativeOrder": "1",
    },
    3: {
        "canHandleVariableCommunicationStepSize": "true",
        "maxOutputDerivativeOrder": "1",
        "providesIntermediateUpdate": "true",
        "canReturnEarlyAfterIntermediateUpdate": "true",
    },
}
"""What Co-Simulation can do beside that."""

CATEGORIES = {
    "logStatusError": "what a status of error means",
    "logStatusWarning": "the model leaves the range that it was trained in",
}

STATE, DERIVATIVE = "state", "der(state)"
"""Names of the arrays."""


def model_description(model: StateSpaceModel, token: str, fmi: Version = 2, arrays: bool = False) -> str:
    """The XML text.

    Args:
        model: what to describe.
        token: the guid or instantiation token, which the binary knows too.
        fmi: major version of FMI.
        arrays: whether states form an array (FMI 3).

    Raises:
        ModelError: a unit is no SI unit.
    """
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{fmi}.0",
            "modelName": model.identifier,
            "guid" if fmi == 2 else "instantiationToken": token,
            "description": model.description,
            "generationTool": "exlinn_fmi",
            "variableNamingConvention": "structured",
        },
    )
    if fmi == 2:
        root.set("numberOfEventIndicators", str(int(bool(model.ranges))))
    for element, able in _interfaces(model, fmi):
        kind = ET.SubElement(root, element, {"modelIdentifier": model.identifier, **able})
        if fmi == 2:
            ET.SubElement(ET.SubElement(kind, "SourceFiles"), "File", name=SOURCE)
    _units(root, model.variables)
    categories = ET.SubElement(root, "LogCategories")
    for name, text in CATEGORIES.items():
        ET.SubElement(categories, "Category", name=name, description=text)
    step = repr(model.sample or 0.001)
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize=step)
    parts = _entries(model, arrays)
    {2: _variables_2, 3: _variables_3}[fmi](root, model, parts)
    {2: _structure_2, 3: _structure_3}[fmi](root, model, _structure(model, parts, arrays))
    return xml_text(root)


def _interfaces(model: StateSpaceModel, fmi: Version) -> list[tuple[str, dict[str, str]]]:
    """The interfaces and what each can do."""
    able = dict.fromkeys(CAPABILITIES[fmi], "true")
    if model.sample is None:
        return [("ModelExchange", able), ("CoSimulation", able | CO_SIMULATION[fmi])]
    kept = {name: value for name, value in able.items() if "Derivative" not in name}
    fixed = {"fixedInternalStepSize": repr(model.sample)} if fmi == 3 else {}
    return [("CoSimulation", {**kept, "canHandleVariableCommunicationStepSize": "true", **fixed})]


def xml_text(root: ET.Element) -> str:
    """An XML document."""
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _units(root: ET.Element, variables: Iterable[Quantity]) -> None:
    """Each unit once, with its exponents of the base units, and what it is shown in."""
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(v.unit for v in variables if v.unit):
        element = ET.SubElement(definitions, "Unit", name=unit)
        exponents = {base: str(exponent) for base, exponent in base_exponents(unit).items()}
        ET.SubElement(element, "BaseUnit", exponents)
        if unit in DISPLAY:
            name, factor = DISPLAY[unit]
            ET.SubElement(element, "DisplayUnit", name=name, factor=repr(factor))


@dataclass(frozen=True)
class _Entry:
    """A variable as the XML says it.

    Args:
        reference: its value reference.
        quantity: what it is.
        causality: of FMI; so are variability and initial.
        derivative: value reference of the state that it is the derivative of.
        count: how many values an array has, 0 for none.
    """

    reference: int
    quantity: Quantity
    causality: str
    variability: str
    initial: str
    derivative: int | None = None
    count: int = 0

    def limits(self, ranges: Ranges) -> dict[str, str]:
        """Attributes min and max, where the range is known, and nominal; the start value is always inside."""
        found = {}
        if self.quantity.name in ranges and self.quantity.limits is not None:
            low, high = self.quantity.limits
            found = {"min": repr(min(low, self.quantity.start)), "max": repr(max(high, self.quantity.start))}
        return found | ({"nominal": repr(self.quantity.nominal)} if self.quantity.nominal != 1.0 else {})

    def attributes(self) -> dict[str, str]:
        """What both versions write alike, beside limits and start value."""
        unit = self.quantity.unit
        shown = {"displayUnit": DISPLAY[unit][0]} if unit in DISPLAY else {}
        return ({"unit": unit} if unit else {}) | shown


def _entries(model: StateSpaceModel, arrays: bool) -> list[_Entry]:
    """All variables, value reference = position."""
    n, found = len(model.states), []
    for reference, quantity in enumerate(model.variables):
        causality, variability, initial = _class(quantity, arrays)
        state = None
        if quantity.role == "derivative" and not arrays:
            state = model.derivatives.index(quantity)
        found.append(_Entry(reference, quantity, causality, variability, initial, state))
    if arrays:
        names = ", ".join(f"{q.name} [{q.unit or 1}]" for q in model.states)
        vector = Quantity(STATE, "", f"state vector: {names}")
        change = Quantity(DERIVATIVE, "", "time derivative of the state vector")
        found.append(_Entry(len(found), vector, "local", "continuous", "exact", None, n))
        found.append(_Entry(len(found), change, "local", "continuous", "calculated", len(found) - 1, n))
    return found


def _class(quantity: Quantity, arrays: bool) -> tuple[str, str, str]:
    """Causality, variability and initial of a variable; FMI gives inputs no attribute `initial`."""
    if quantity.role == "state":
        return "output", "continuous", "calculated" if arrays else "exact"
    if quantity.role == "input":
        return "input", "continuous", ""
    if quantity.role == "parameter":
        return "parameter", "tunable", "exact"
    if quantity.role == "setting":
        return "parameter", "fixed", "exact"
    if quantity.role == "time":
        return "independent", "continuous", ""
    causality = "local" if quantity.name.startswith("der(") else "output"
    return causality, "discrete" if quantity.boolean or quantity.sampled else "continuous", "calculated"


def _start(entry: _Entry, model: StateSpaceModel) -> dict[str, str]:
    """The start value, where there is one."""
    if entry.initial == "calculated" or entry.causality == "independent":
        return {}
    if entry.quantity.boolean:
        return {"start": "true" if entry.quantity.start else "false"}
    if entry.count:
        return {"start": " ".join(repr(float(q.start)) for q in model.states)}
    return {"start": repr(float(entry.quantity.start))}


def _heading(entry: _Entry) -> dict[str, str]:
    """Name, reference, description and class."""
    attributes = {"name": entry.quantity.name, "valueReference": str(entry.reference)}
    if entry.quantity.description:
        attributes["description"] = entry.quantity.description
    attributes |= {"causality": entry.causality, "variability": entry.variability}
    return attributes | ({"initial": entry.initial} if entry.initial else {})


def _variables_2(root: ET.Element, model: StateSpaceModel, entries: list[_Entry]) -> None:
    variables = ET.SubElement(root, "ModelVariables")
    for entry in entries:
        if entry.causality == "independent":
            continue
        scalar = ET.SubElement(variables, "ScalarVariable", _heading(entry))
        if entry.quantity.boolean:
            ET.SubElement(scalar, "Boolean", _start(entry, model))
            continue
        real = entry.attributes() | entry.limits(model.ranges) | _start(entry, model)
        if entry.derivative is not None:
            real["derivative"] = str(entry.derivative + 1)
        ET.SubElement(scalar, "Real", real)


def _variables_3(root: ET.Element, model: StateSpaceModel, entries: list[_Entry]) -> None:
    variables = ET.SubElement(root, "ModelVariables")
    for entry in entries:
        attributes = _heading(entry)
        if entry.quantity.boolean:
            ET.SubElement(variables, "Boolean", attributes | _start(entry, model))
            continue
        if entry.variability == "continuous" and entry.causality != "independent":
            attributes["intermediateUpdate"] = "true"
        attributes |= entry.attributes() | entry.limits(model.ranges) | _start(entry, model)
        if entry.derivative is not None:
            attributes["derivative"] = str(entry.derivative)
        element = ET.SubElement(variables, "Float64", attributes)
        if entry.count:
            ET.SubElement(element, "Dimension", start=str(entry.count))


_Dependencies = dict[int, tuple[int, ...]]


def _structure(
    model: StateSpaceModel, entries: list[_Entry], arrays: bool
) -> tuple[_Dependencies, _Dependencies, _Dependencies]:
    """Outputs, derivatives and initial unknowns with what they depend on, by value reference."""
    n, end = len(model.states), len(model.variables)
    first = len(model.known) + len(model.settings)

    def running(known: tuple[int, ...]) -> tuple[int, ...]:
        # While the model runs, parameters are not among what outputs and derivatives may list.
        return tuple(i for i in known if i < n + len(model.inputs) or i >= end)

    def state(i: int) -> int:
        return end if arrays and i < n else i

    every: _Dependencies = {i: (state(i),) for i, q in enumerate(model.known) if q.role == "state"}
    every |= {
        first + k: tuple(sorted({state(i) for i in known})) for k, known in enumerate(model.dependencies)
    }
    derivatives = {first + k: every[first + k] for k in range(n)}
    if arrays:
        derivatives = {end + 1: tuple(sorted({i for known in derivatives.values() for i in known}))}
    outputs = {k: running(d) for k, d in every.items() if entries[k].causality == "output"}
    initial = {k: d for k, d in (every | derivatives).items() if entries[k].initial == "calculated"}
    asked = {k: d for k, d in initial.items() if k in derivatives or k in outputs}
    return outputs, {k: running(d) for k, d in derivatives.items()}, asked


def _structure_2(
    root: ET.Element, model: StateSpaceModel, found: tuple[_Dependencies, _Dependencies, _Dependencies]
) -> None:
    """FMI 2 counts variables from 1."""
    structure = ET.SubElement(root, "ModelStructure")
    sections = zip(("Outputs", "Derivatives", "InitialUnknowns"), found, strict=True)
    for name, entries in ((name, entries) for name, entries in sections if entries):
        section = ET.SubElement(structure, name)
        for k, known in entries.items():
            dependencies = " ".join(str(i + 1) for i in known)
            ET.SubElement(section, "Unknown", index=str(k + 1), dependencies=dependencies)


def _structure_3(
    root: ET.Element, model: StateSpaceModel, found: tuple[_Dependencies, _Dependencies, _Dependencies]
) -> None:
    """FMI 3 names value references."""
    structure = ET.SubElement(root, "ModelStructure")
    names = ("Output", "ContinuousStateDerivative", "InitialUnknown")
    sections = [*zip(names, found, strict=True)]
    if model.ranges:
        margin = next(k for k, q in enumerate(model.variables) if q.name == "range_margin")
        sections.append(("EventIndicator", {margin: found[0][margin]}))
    for name, entries in sections:
        for k, known in entries.items():
            dependencies = " ".join(map(str, known))
            ET.SubElement(structure, name, valueReference=str(k), dependencies=dependencies)

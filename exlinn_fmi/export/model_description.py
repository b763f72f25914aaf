"""modelDescription.xml of FMI 2.0 for a `StateSpaceModel`.

Parameters are ``tunable``: they may be set before the start and at communication points. `solver_step` is
``fixed``. States are outputs with ``initial="exact"``, so the initial state can be set before the start.

References: FMI 2.0.4, section 2.2.
"""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree as ET

from exlinn_fmi.export.model import SOLVER_STEP, Quantity, StateSpaceModel
from exlinn_fmi.export.units import base_exponents

SOURCE = "all.c"
"""The one file to compile."""

CAPABILITIES = (
    "canNotUseMemoryManagementFunctions",
    "canGetAndSetFMUstate",
    "canSerializeFMUstate",
    "providesDirectionalDerivative",
)
"""What both interfaces can do."""


def model_description(model: StateSpaceModel, token: str) -> str:
    """The XML text.

    Args:
        model: what to describe.
        token: the guid, which the binary knows too.

    Raises:
        ModelError: a unit is no SI unit.
    """
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=model.identifier,
        guid=token,
        description=model.description,
        generationTool="exlinn_fmi",
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    for element, only in (
        ("ModelExchange", ()),
        ("CoSimulation", ("canHandleVariableCommunicationStepSize",)),
    ):
        able = dict.fromkeys((*CAPABILITIES, *only), "true")
        kind = ET.SubElement(root, element, {"modelIdentifier": model.identifier, **able})
        ET.SubElement(ET.SubElement(kind, "SourceFiles"), "File", name=SOURCE)
    _units(root, model.variables)
    categories = ET.SubElement(root, "LogCategories")
    ET.SubElement(categories, "Category", name="logStatusError", description="what a status fmi2Error means")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize="0.001")
    _variables(root, model)
    _structure(root, model)
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _units(root: ET.Element, variables: Iterable[Quantity]) -> None:
    """Each unit once, with its exponents of the base units."""
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(v.unit for v in variables if v.unit):
        exponents = {base: str(exponent) for base, exponent in base_exponents(unit).items()}
        ET.SubElement(ET.SubElement(definitions, "Unit", name=unit), "BaseUnit", exponents)


def _variables(root: ET.Element, model: StateSpaceModel) -> None:
    """The variables, value reference = position."""
    variables = ET.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(model.variables):
        causality, variability, initial = _class(model, variable)
        attributes = {"name": variable.name, "valueReference": str(reference)}
        if variable.description:
            attributes["description"] = variable.description
        attributes |= {"causality": causality, "variability": variability}
        if initial:
            attributes["initial"] = initial
        real = {"unit": variable.unit} if variable.unit else {}
        if initial != "calculated":
            real["start"] = repr(float(variable.start))
        if variable in model.derivatives:
            real["derivative"] = str(model.derivatives.index(variable) + 1)
        ET.SubElement(ET.SubElement(variables, "ScalarVariable", attributes), "Real", real)


def _class(model: StateSpaceModel, variable: Quantity) -> tuple[str, str, str]:
    """Causality, variability and initial of a variable; FMI gives inputs no attribute `initial`."""
    if variable in model.states:
        return "output", "continuous", "exact"
    if variable in model.inputs:
        return "input", "continuous", ""
    if variable in model.parameters:
        return "parameter", "tunable", "exact"
    if variable.name == SOLVER_STEP:
        return "parameter", "fixed", "exact"
    return "local" if variable.name.startswith("der(") else "output", "continuous", "calculated"


def _structure(root: ET.Element, model: StateSpaceModel) -> None:
    """Outputs, derivatives and initial unknowns with what they depend on; FMI counts variables from 1."""
    n = len(model.states)
    first = len(model.known) + 1  # solver_step lies between
    initial = {first + k: known for k, known in enumerate(model.dependencies)}
    # While the model runs, parameters are not among what outputs and derivatives may list.
    running = {k: tuple(i for i in known if i < n + len(model.inputs)) for k, known in initial.items()}
    outputs: dict[int, tuple[int, ...]] = {k: (k,) for k in range(n)}
    outputs |= {k: d for k, d in running.items() if _class(model, model.variables[k])[0] == "output"}
    derivatives = {k: running[k] for k in range(first, first + n)}

    structure = ET.SubElement(root, "ModelStructure")
    sections = {"Outputs": outputs, "Derivatives": derivatives, "InitialUnknowns": initial}
    for name, entries in sections.items():
        section = ET.SubElement(structure, name)
        for k, known in entries.items():
            dependencies = " ".join(str(i + 1) for i in known)
            ET.SubElement(section, "Unknown", index=str(k + 1), dependencies=dependencies)

"""A system structure package (SSP 1.0): FMUs and how they are connected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

from exlinn_fmi.export.archive import pack
from exlinn_fmi.export.model import StateSpaceModel
from exlinn_fmi.export.model_description import xml_text

SSD = "http://ssp-standard.org/SSP1/SystemStructureDescription"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"


@dataclass(frozen=True)
class Part:
    """One FMU of a structure.

    Args:
        model: what it was made from.
        fmu: the file's content.
    """

    model: StateSpaceModel
    fmu: bytes


def structure(name: str, parts: Mapping[str, Part], connections: Sequence[tuple[str, str]]) -> bytes:
    """The content of an ``.ssp`` file.

    Args:
        name: of the system.
        parts: FMUs by the name of their component.
        connections: (from, to), each ``component.variable``.
    """
    for prefix, space in (("ssd", SSD), ("ssc", SSC)):
        ET.register_namespace(prefix, space)
    root = ET.Element(
        f"{{{SSD}}}SystemStructureDescription", name=name, version="1.0", generationTool="exlinn_fmi"
    )
    system = ET.SubElement(root, f"{{{SSD}}}System", name=name)
    elements = ET.SubElement(system, f"{{{SSD}}}Elements")
    for component, part in parts.items():
        source = f"resources/{part.model.identifier}.fmu"
        attributes = {"name": component, "type": "application/x-fmu-sharedlibrary", "source": source}
        element = ET.SubElement(elements, f"{{{SSD}}}Component", attributes)
        connectors = ET.SubElement(element, f"{{{SSD}}}Connectors")
        for kind, quantities in _connectors(part.model).items():
            for quantity in quantities:
                connector = ET.SubElement(connectors, f"{{{SSD}}}Connector", name=quantity, kind=kind)
                ET.SubElement(connector, f"{{{SSC}}}Real")
    wires = ET.SubElement(system, f"{{{SSD}}}Connections")
    for source, target in connections:
        (one, out), (other, into) = source.split("."), target.split(".")
        attributes = {"startElement": one, "startConnector": out, "endElement": other, "endConnector": into}
        ET.SubElement(wires, f"{{{SSD}}}Connection", attributes)
    experiment = {"startTime": "0", "stopTime": "10"}
    ET.SubElement(root, f"{{{SSD}}}DefaultExperiment", experiment)
    files = {f"resources/{part.model.identifier}.fmu": part.fmu for part in parts.values()}
    return pack({"SystemStructure.ssd": xml_text(root).encode(), **files})


def _connectors(model: StateSpaceModel) -> dict[str, list[str]]:
    """Names of inputs and outputs."""
    told = [q.name for q in (*model.states, *model.outputs)]
    return {"input": [q.name for q in model.inputs], "output": told}

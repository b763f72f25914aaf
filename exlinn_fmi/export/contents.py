"""What is inside an FMU beside its binaries, file by file; the same input gives the same text."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib import resources
from xml.etree import ElementTree as ET

from exlinn_fmi.export.c_code import SOURCE, sources
from exlinn_fmi.export.card import Card, card_page
from exlinn_fmi.export.model import StateSpaceModel
from exlinn_fmi.export.model_description import Version, model_description, xml_text
from exlinn_fmi.export.reference import reference_files

EXTRA = "extra/org.exlinn.fmi"
"""Folder of what is this tool's own: provenance and reference trajectories."""


def fmu_members(
    model: StateSpaceModel, fmi: Version = 2, arrays: bool = False, card: Card | None = None
) -> dict[str, bytes]:
    """Every file of the FMU but its binaries, by its path.

    modelDescription.xml and sources are bound together by a token, a hash of them all: with this
    modelDescription.xml no binary of other sources will work.

    Args:
        model: what to export.
        fmi: major version of FMI.
        arrays: whether states form an array (FMI 3).
        card: where the model came from and how good it is.
    """
    card = card or Card()
    digest = hashlib.sha256(model_description(model, "", fmi, arrays).encode())
    for name, text in sorted(sources(model, fmi, "").items()):
        digest.update(f"{name}\n{text}".encode())
    token = f"{{{digest.hexdigest()[:32]}}}"
    texts = {f"sources/{name}": text for name, text in sources(model, fmi, token).items()}
    texts["modelDescription.xml"] = model_description(model, token, fmi, arrays)
    texts["documentation/index.html"] = card_page(model, card, fmi)
    if model.states:
        texts |= {f"{EXTRA}/{name}": text for name, text in reference_files(model).items()}
    texts[f"{EXTRA}/provenance.json"] = card.provenance_text()
    if fmi == 3:
        texts["sources/buildDescription.xml"] = _build_description(model)
        texts["terminalsAndIcons/terminalsAndIcons.xml"] = _terminals(model)
    icon = (resources.files("exlinn_fmi.export") / "templates" / "icon.png").read_bytes()
    return {
        **{name: text.encode() for name, text in texts.items()},
        {2: "model.png", 3: "terminalsAndIcons/icon.png"}[fmi]: icon,
    }


def _build_description(model: StateSpaceModel) -> str:
    """How to compile the sources (FMI 3)."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    attributes = {"modelIdentifier": model.identifier, "description": "any C99 compiler, no options needed"}
    build = ET.SubElement(root, "BuildConfiguration", attributes)
    files = ET.SubElement(build, "SourceFileSet", language="C99")
    ET.SubElement(files, "SourceFile", name=SOURCE)
    return xml_text(root)


def _terminals(model: StateSpaceModel) -> str:
    """A terminal for each coordinate: its position and velocity, and what acts on it (FMI 3)."""
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    corners: Mapping[str, str] = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    picture = ET.SubElement(root, "GraphicalRepresentation")
    ET.SubElement(picture, "CoordinateSystem", {**corners, "suggestedScalingFactorTo_mm": "0.1"})
    ET.SubElement(picture, "Icon", {**corners})
    if not model.terminals:
        return xml_text(root)
    terminals = ET.SubElement(root, "Terminals")
    for name, kind, members in model.terminals:
        attributes = {"name": name, "matchingRule": "plug", "terminalKind": f"org.exlinn.{kind}"}
        terminal = ET.SubElement(terminals, "Terminal", attributes)
        for member in members:
            ET.SubElement(
                terminal,
                "TerminalMemberVariable",
                variableName=member,
                memberName=member,
                variableKind="signal",
            )
    return xml_text(root)

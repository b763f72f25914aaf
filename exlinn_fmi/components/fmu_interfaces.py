"""The ways in which an FMU can be used, and what it is capable of in each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

from exlinn_fmi.errors import FmuError

Kind = Literal["co_simulation", "model_exchange"]
KINDS: tuple[Kind, ...] = ("co_simulation", "model_exchange")


@dataclass(frozen=True)
class Interface:
    """One of the ways in which an FMU can be used, and what it is capable of then.

    Args:
        kind: which way.
        identifier: name of the binary.
        equal_steps: whether all communication steps must be equally long.
        saves_state: whether its state can be saved and restored.
        serializes_state: whether a saved state can be turned into bytes.
        directional_derivatives: whether it gives directional derivatives.
        once: whether the binary may be instantiated only once per process.
        needs_tool: whether it needs the tool that made it.
        input_derivatives: whether Co-Simulation takes derivatives of inputs (FMI 1 and 2).
        output_derivatives: order up to which Co-Simulation gives derivatives of outputs.
        event_mode: whether Co-Simulation can stop for events (FMI 3).
        intermediate_update: whether Co-Simulation calls back within a step (FMI 3).
        completed_step: whether Model Exchange wants to hear of every step of the solver.
    """

    kind: Kind
    identifier: str
    equal_steps: bool = False
    saves_state: bool = False
    serializes_state: bool = False
    directional_derivatives: bool = False
    once: bool = False
    needs_tool: bool = False
    input_derivatives: bool = False
    output_derivatives: int = 0
    event_mode: bool = False
    intermediate_update: bool = False
    completed_step: bool = True

    def capabilities(self) -> list[tuple[str, bool]]:
        """What it can do beyond the least, in words, and whether it can."""
        return [
            ("steps of any length", self.kind == "co_simulation" and not self.equal_steps),
            ("saves its state", self.saves_state),
            ("serialises it", self.serializes_state),
            ("directional derivatives", self.directional_derivatives),
            ("input derivatives", self.input_derivatives),
            (f"output derivatives up to order {self.output_derivatives}", self.output_derivatives > 0),
            ("Event Mode", self.event_mode),
            ("intermediate update", self.intermediate_update),
            ("one instance per process only", self.once),
            ("needs the tool that made it", self.needs_tool),
        ]


def read_interfaces(path: Path, version: int, model: Any, root: ElementTree.Element) -> Iterator[Interface]:
    """What the FMU can be used as.

    Raises:
        FmuError: a binary's name is no file name.
    """
    for kind, use in zip(KINDS, (model.coSimulation, model.modelExchange), strict=True):
        if use is None or (version == 1 and kind == "model_exchange"):
            continue
        identifier = use.modelIdentifier or ""
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,199}", identifier):
            raise FmuError(f"{path}: the model identifier {identifier!r} is no C identifier, as FMI demands")
        element = root.find("Implementation//Capabilities" if version == 1 else _TAGS[kind])

        def says(attribute: str, element: ElementTree.Element | None = element) -> bool:
            return element is not None and element.get(attribute) in ("true", "1")

        state = "State" if version == 3 else "state"
        plural = "s" if version == 3 else ""
        yield Interface(
            kind=kind,
            identifier=identifier,
            equal_steps=kind == "co_simulation" and not says("canHandleVariableCommunicationStepSize"),
            saves_state=says(f"canGetAndSetFMU{state}"),
            serializes_state=says(f"canSerializeFMU{state}"),
            directional_derivatives=says(f"providesDirectionalDerivative{plural}"),
            once=says("canBeInstantiatedOnlyOncePerProcess"),
            needs_tool=says("needsExecutionTool"),
            input_derivatives=says("canInterpolateInputs"),
            output_derivatives=int(
                (element.get("maxOutputDerivativeOrder") if element is not None else 0) or 0
            ),
            event_mode=says("hasEventMode"),
            intermediate_update=says("providesIntermediateUpdate"),
            completed_step=says("needsCompletedIntegratorStep")
            if version == 3
            else not says("completedIntegratorStepNotNeeded"),
        )


_TAGS = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
_WORDS = {"co_simulation": "Co-Simulation", "model_exchange": "Model Exchange"}


def choose_interface(
    path: Path, version: int, interfaces: Sequence[Interface], kind: Kind | None, model: Any
) -> Interface:
    """The interface to use.

    Raises:
        FmuError: it does not have it.
    """
    for interface in interfaces:
        if kind in (None, interface.kind):
            return interface
    found = [_WORDS[interface.kind] for interface in interfaces]
    if model.scheduledExecution is not None:
        found.append("Scheduled Execution")
    if version == 1 and model.modelExchange is not None:
        found.append("Model Exchange of FMI 1.0")
    there = f"it is for {' and '.join(found)} only" if found else "it names no kind of use"
    wanted = _WORDS[kind] if kind else "Co-Simulation and no Model Exchange of FMI 2.0 or 3.0"
    raise FmuError(
        f"{path}: no {wanted}: {there}; export it again for {_WORDS[kind or 'co_simulation']}"
        + (", or change `interface`" if kind and interfaces else "")
    )

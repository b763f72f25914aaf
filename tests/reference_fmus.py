"""Small FMUs that behave as the Modelica Association's reference FMUs, built from sources in tests/fmus."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import fmpy
from fmu_helpers import BUILT, TESTS, pack


@dataclass(frozen=True)
class Real:
    """A real variable: value reference, causality, variability, start, and the variable whose rate it is."""

    reference: int
    causality: str = "local"
    variability: str = "continuous"
    start: float | None = None
    rate_of: str | None = None


@dataclass(frozen=True)
class Model:
    """A model of models.h: its number there, its reals and integers, and how many event indicators it has."""

    number: int
    reals: Mapping[str, Real]
    integers: tuple[str, ...] = ()
    indicators: int = 0
    directional: bool = False


def _parameter(reference: int, start: float, variability: str = "fixed") -> Real:
    return Real(reference, "parameter", variability, start)


MODELS = {
    "BouncingBall": Model(
        1,
        {
            "h": Real(1, "output", start=1.0),
            "der(h)": Real(2, rate_of="h"),
            "v": Real(3, "output", start=0.0),
            "der(v)": Real(4, rate_of="v"),
            "g": _parameter(5, -9.81),
            "e": _parameter(6, 0.7, "tunable"),
        },
        indicators=1,
    ),
    "Stair": Model(2, {}, ("counter",)),
    "VanDerPol": Model(
        3,
        {
            "x0": Real(1, "output", start=2.0),
            "der(x0)": Real(2, rate_of="x0"),
            "x1": Real(3, "output", start=0.0),
            "der(x1)": Real(4, rate_of="x1"),
            "mu": _parameter(5, 1.0),
        },
        directional=True,
    ),
    "Dahlquist": Model(
        4,
        {
            "x": Real(1, "output", start=1.0),
            "der(x)": Real(2, rate_of="x"),
            "k": _parameter(3, 1.0),
        },
    ),
    "Resource": Model(5, {}, ("y",)),
    "Switch": Model(
        6,
        {
            "x": Real(1, "output", start=0.0),
            "der(x)": Real(2, rate_of="x"),
            "set": _parameter(3, 1.0),
            "band": _parameter(4, 0.1),
            "load": Real(5, "input", start=0.0),
            "offset": Real(6, "input", "discrete", 0.0),
            "heat": _parameter(7, 3.0),
        },
        ("on", "switched"),
        indicators=2,
    ),
}


def description_2(model: Model) -> str:
    """The model description for FMI 2.0."""
    order, lines = list(model.reals), []
    for name, v in model.reals.items():
        start = "" if v.start is None else f' start="{v.start}"'
        rate = "" if v.rate_of is None else f' derivative="{order.index(v.rate_of) + 1}"'
        exact = ' initial="exact"' if v.causality in ("output", "parameter") else ""
        lines.append(
            f'<ScalarVariable name="{name}" valueReference="{v.reference}" causality="{v.causality}" '
            f'variability="{v.variability}"{exact}><Real{start}{rate}/></ScalarVariable>'
        )
    for k, name in enumerate(model.integers):
        lines.append(
            f'<ScalarVariable name="{name}" valueReference="{k}" causality="output" variability="discrete">'
            "<Integer/></ScalarVariable>"
        )
    outputs = [k for k, v in enumerate(model.reals.values(), 1) if v.causality == "output"]
    outputs += range(len(order) + 1, len(lines) + 1)
    rates = [k for k, v in enumerate(model.reals.values(), 1) if v.rate_of]
    directional = f'providesDirectionalDerivative="{str(model.directional).lower()}"'
    state = 'canGetAndSetFMUstate="true" canSerializeFMUstate="true"'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Model" guid="g" numberOfEventIndicators="{model.indicators}">
<ModelExchange modelIdentifier="Model" {state} {directional}/>
<CoSimulation modelIdentifier="Model" canHandleVariableCommunicationStepSize="true"
  canInterpolateInputs="true" {state} {directional}/>
<LogCategories><Category name="logStatusError"/></LogCategories>
<ModelVariables>{"".join(lines)}</ModelVariables>
<ModelStructure><Outputs>{"".join(f'<Unknown index="{k}" dependencies=""/>' for k in outputs)}</Outputs>
<Derivatives>{"".join(f'<Unknown index="{k}"/>' for k in rates)}</Derivatives></ModelStructure>
</fmiModelDescription>"""


def description_3(model: Model) -> str:
    """The model description for FMI 3.0."""
    lines = ['<Float64 name="time" valueReference="0" causality="independent"/>']
    for name, v in model.reals.items():
        start = "" if v.start is None else f' start="{v.start}"'
        rate = "" if v.rate_of is None else f' derivative="{model.reals[v.rate_of].reference}"'
        exact = ' initial="exact"' if v.causality in ("output", "parameter") else ""
        lines.append(
            f'<Float64 name="{name}" valueReference="{v.reference}" causality="{v.causality}" '
            f'variability="{v.variability}"{exact}{start}{rate}/>'
        )
    for k, name in enumerate(model.integers, 20):
        lines.append(f'<Int32 name="{name}" valueReference="{k}" causality="output"/>')
    structure = [v.reference for v in model.reals.values() if v.causality == "output"]
    structure += range(20, 20 + len(model.integers))
    outputs = "".join(f'<Output valueReference="{r}" dependencies=""/>' for r in structure)
    rates = [v.reference for v in model.reals.values() if v.rate_of]
    outputs += "".join(f'<ContinuousStateDerivative valueReference="{r}"/>' for r in rates)
    directional = f'providesDirectionalDerivatives="{str(model.directional).lower()}"'
    state = 'canGetAndSetFMUState="true"'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Model" instantiationToken="g">
<ModelExchange modelIdentifier="Model" needsCompletedIntegratorStep="true" {state} {directional}/>
<CoSimulation modelIdentifier="Model" hasEventMode="true" {state}
  canHandleVariableCommunicationStepSize="true"/>
<LogCategories><Category name="logStatusError"/></LogCategories>
<ModelVariables>{"".join(lines)}</ModelVariables><ModelStructure>{outputs}</ModelStructure>
</fmiModelDescription>"""


@functools.cache
def binary(version: int, source: str, *defines: str) -> bytes:
    """A shared library of a source and the stubs for all functions that it leaves out."""
    target = BUILT / f"reference{len(list(BUILT.iterdir()))}.so"
    headers = Path(fmpy.__file__).parent / "c-code"
    flags = ["-O1", "-std=c99", "-D_GNU_SOURCE", "-shared", "-fPIC", "-fvisibility=hidden", f"-I{headers}"]
    sources = [str(TESTS / "fmus" / name) for name in (source, "stubs.c")]
    defined = [f"-D{d}" for d in (f"FMI={version}", *defines)]
    subprocess.run(["cc", *flags, *defined, *sources, "-o", str(target), "-lm"], check=True)
    return target.read_bytes()


def packed(
    folder: Path, version: int, text: str, library: bytes, resources: Mapping[str, str] | None = None
) -> Path:
    """An FMU of a description and a binary."""
    platform = fmpy.platform_tuple if version == 3 else fmpy.platform
    members: dict[str, str | bytes] = {
        "modelDescription.xml": text,
        f"binaries/{platform}/Model{fmpy.sharedLibraryExtension}": library,
    }
    members |= {f"resources/{name}": content for name, content in (resources or {}).items()}
    return pack(folder / "Model.fmu", members)


def reference(folder: Path, name: str, version: int, *defines: str) -> Path:
    """One of `MODELS` as an FMU of FMI 2 or 3 for both kinds of use, written into the folder."""
    model = MODELS[name]
    text = description_2(model) if version == 2 else description_3(model)
    library = binary(version, f"reference{version}.c", f"MODEL={model.number}", *defines)
    return packed(folder, version, text, library, {"y.txt": "a"} if name == "Resource" else None)


TYPES = {
    "Float32": 10,
    "Int8": 20,
    "UInt8": 30,
    "Int16": 40,
    "UInt16": 50,
    "Int32": 60,
    "UInt32": 70,
    "Int64": 80,
    "UInt64": 90,
    "Boolean": 100,
}


def _matrix(name: str, reference: int, dimensions: tuple[int, ...], start: str, more: str = "") -> str:
    """An array of FMI 3 whose dimensions are structural parameters."""
    inner = "".join(f'<Dimension valueReference="{d}"/>' for d in dimensions)
    given = f' start="{start}"' if start else ""
    return f'<Float64 name="{name}" valueReference="{reference}"{more}{given}>{inner}</Float64>'


def feedthrough(folder: Path) -> Path:
    """All types passed through, a state-space model and clocks, FMI 3 Co-Simulation (feedthrough3.c)."""
    fixed = ' causality="parameter" variability="tunable"'
    lines = [
        f'<UInt64 name="{name}" valueReference="{k}" causality="structuralParameter" start="2"/>'
        for k, name in enumerate("mnr", 1)
    ]
    lines += [
        _matrix("A", 4, (2, 2), "-1 0 0 -1", fixed),
        _matrix("B", 5, (2, 1), "1 0 0 1", fixed),
        _matrix("C", 6, (3, 2), "1 0 0 1", fixed),
        _matrix("D", 7, (3, 1), "0 0 0 0", fixed),
        _matrix("x0", 8, (2,), "0 0", fixed),
        _matrix("u", 9, (1,), "0 0", ' causality="input"'),
        _matrix("y", 0, (3,), "", ' causality="output"'),
        _matrix("x", 14, (2,), "", ' causality="output"'),
    ]
    for kind, reference in TYPES.items():
        start = "false" if kind == "Boolean" else "0"
        lines.append(
            f'<{kind} name="{kind}_in" valueReference="{reference}" causality="input" start="{start}"/>'
        )
        lines.append(f'<{kind} name="{kind}_out" valueReference="{reference + 1}" causality="output"/>')
    lines += [
        '<String name="String_in" valueReference="110" causality="input"><Start value="a"/></String>',
        '<String name="String_out" valueReference="111" causality="output"/>',
        '<Binary name="Binary_in" valueReference="120" causality="input"><Start value="00ff"/></Binary>',
        '<Binary name="Binary_out" valueReference="121" causality="output"/>',
        '<String name="names" valueReference="130" causality="input"><Dimension start="2"/><Start value="p"/>'
        '<Start value="q"/></String>',
        '<String name="names_out" valueReference="131" causality="output"><Dimension start="2"/></String>',
        '<Clock name="tick" valueReference="140" causality="input" intervalVariability="constant" '
        'intervalDecimal="0.1" shiftDecimal="0.05"/>',
        '<Int32 name="ticks" valueReference="141" causality="output"/>',
        '<Clock name="countdown" valueReference="142" causality="input" intervalVariability="countdown"/>',
        '<Int32 name="counted" valueReference="143" causality="output"/>',
    ]
    outputs = [r + 1 for r in (*TYPES.values(), 110, 120, 130, 140, 142)] + [14]
    structure = '<Output valueReference="0" dependencies="9 14"/>'
    structure += "".join(f'<Output valueReference="{r}"/>' for r in outputs)
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Model" instantiationToken="g">
<CoSimulation modelIdentifier="Model" hasEventMode="true" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>{"".join(lines)}</ModelVariables><ModelStructure>{structure}</ModelStructure>
</fmiModelDescription>"""
    return packed(folder, 3, text, binary(3, "feedthrough3.c"))


def slave(folder: Path, *defines: str) -> Path:
    """An FMI 1.0 Co-Simulation FMU (slave1.c)."""
    text = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="Model" modelIdentifier="Model" guid="g"
  numberOfContinuousStates="0" numberOfEventIndicators="0">
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="gain" valueReference="1" variability="parameter"><Real start="2"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="minus_x" valueReference="2" alias="negatedAlias" causality="output">
<Real/></ScalarVariable>
<ScalarVariable name="n" valueReference="0" causality="input"><Integer start="0"/></ScalarVariable>
<ScalarVariable name="on" valueReference="0" causality="input"><Boolean start="false"/></ScalarVariable>
<ScalarVariable name="label" valueReference="0" causality="input"><String start=""/></ScalarVariable>
</ModelVariables>
<Implementation><CoSimulation_StandAlone><Capabilities canHandleVariableCommunicationStepSize="true"/>
</CoSimulation_StandAlone></Implementation></fmiModelDescription>"""
    return packed(folder, 1, text, binary(1, "slave1.c", *defines))

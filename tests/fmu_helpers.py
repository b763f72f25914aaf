"""FMUs for tests: other people's from PyPI, and small strict ones of our own, compiled from tests/fmus."""

from __future__ import annotations

import atexit
import functools
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import fmpy
import numpy as np

from exlinn_fmi.components.base import Component, Status

TESTS = Path(__file__).parent
CACHE = TESTS.parent / ".pytest_cache" / "fmus"
WHEEL = "gemseo-fmu==3.1.1"

BUILT = Path(tempfile.mkdtemp(prefix="exlinn-tests-"))
"""Binaries of this test process. Made here, as some tests change where temporary folders go."""
atexit.register(shutil.rmtree, BUILT, ignore_errors=True)


@functools.cache
def other_fmus() -> dict[str, Path]:
    """FMUs that others made, by name: OpenModelica's (FMI 2.0) and PythonFMU3's `FMU3Model` (FMI 3.0).

    They lie in a wheel on PyPI, which is kept in .pytest_cache.
    """
    folder = CACHE / WHEEL
    if not folder.is_dir():
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=CACHE) as work:
            command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", work, WHEEL]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise RuntimeError(f"this test needs the FMUs of {WHEEL}; pip cannot fetch it: {done.stderr}")
            (wheel,) = Path(work).glob("*.whl")
            unpacked = Path(work) / "fmus"
            unpacked.mkdir()
            with zipfile.ZipFile(wheel) as archive:
                for name in archive.namelist():
                    if "/linux/" in name and name.endswith(".fmu"):
                        (unpacked / Path(name).name).write_bytes(archive.read(name))
            if not folder.is_dir():  # another test process may have been faster
                unpacked.rename(folder)
    return {path.stem: path for path in folder.glob("*.fmu")}


# ── our own ──────────────────────────────────────────────────────────────────────────────────────────────

VARIABLES_2 = """
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="m/s"/></ScalarVariable>
<ScalarVariable name="gain" valueReference="1" causality="parameter" variability="fixed">
  <Real start="2" min="0" max="10"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="output" initial="exact">
  <Real declaredType="Length" start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="3" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="trim" valueReference="4" causality="parameter" variability="tunable">
  <Real start="0"/></ScalarVariable>
<ScalarVariable name="n_in" valueReference="0" causality="input" variability="discrete">
  <Integer start="0"/></ScalarVariable>
<ScalarVariable name="n_out" valueReference="1" causality="output" variability="discrete">
  <Integer/></ScalarVariable>
<ScalarVariable name="mode_in" valueReference="2" causality="input" variability="discrete">
  <Enumeration declaredType="Mode" start="1"/></ScalarVariable>
<ScalarVariable name="mode_out" valueReference="3" causality="output" variability="discrete">
  <Enumeration declaredType="Mode"/></ScalarVariable>
<ScalarVariable name="on" valueReference="0" causality="input" variability="discrete">
  <Boolean start="true"/></ScalarVariable>
<ScalarVariable name="off" valueReference="1" causality="output" variability="discrete">
  <Boolean/></ScalarVariable>
<ScalarVariable name="pi" valueReference="5" causality="local" variability="constant">
  <Real start="3.14"/></ScalarVariable>
<ScalarVariable name="doubled" valueReference="6" causality="calculatedParameter" variability="fixed">
  <Real/></ScalarVariable>
<ScalarVariable name="label" valueReference="0" causality="parameter" variability="fixed">
  <String start="a"/></ScalarVariable>
"""

DESCRIPTION_2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{version}" modelName="Probe" guid="{{probe}}" generationTool="Probe maker">
<{use} modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="{variable_step}"
  needsExecutionTool="{needs_tool}" canBeInstantiatedOnlyOncePerProcess="{once}" canGetAndSetFMUstate="true"/>
<UnitDefinitions><Unit name="m"><BaseUnit m="1"/></Unit><Unit name="m/s"><BaseUnit m="1" s="-1"/></Unit>
</UnitDefinitions>
<TypeDefinitions>
<SimpleType name="Length"><Real unit="m"/></SimpleType>
<SimpleType name="Mode"><Enumeration><Item name="slow" value="1"/><Item name="fast" value="2"/></Enumeration>
</SimpleType></TypeDefinitions>
<LogCategories><Category name="logStatusError"/></LogCategories>
<ModelVariables>{variables}</ModelVariables>
<ModelStructure><Outputs>
<Unknown index="3" dependencies=""/><Unknown index="4" dependencies="1 2 3"/><Unknown index="7"/>
<Unknown index="9" dependencies="8"/><Unknown index="11" dependencies="10"/>
</Outputs></ModelStructure></fmiModelDescription>
"""

TYPES_3 = {
    "Float32": 100,
    "Int8": 200,
    "UInt8": 300,
    "Int16": 400,
    "UInt16": 500,
    "Int32": 600,
    "UInt32": 700,
    "Int64": 800,
    "UInt64": 900,
    "Boolean": 1000,
}

DESCRIPTION_3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Probe" instantiationToken="{{probe}}">
<CoSimulation modelIdentifier="Probe" canHandleVariableCommunicationStepSize="true"
  canGetAndSetFMUState="true"/>
<UnitDefinitions><Unit name="m/s"><BaseUnit m="1" s="-1"/></Unit></UnitDefinitions>
<TypeDefinitions><EnumerationType name="Mode"><Item name="slow" value="1"/><Item name="fast" value="3"/>
</EnumerationType></TypeDefinitions>
<ModelVariables>
<Float64 name="time" valueReference="0" causality="independent"/>
<Float64 name="u" valueReference="1" causality="input" start="0" unit="m/s"><Alias name="speed"/></Float64>
<Float64 name="gain" valueReference="2" causality="parameter" variability="fixed" start="2"/>
<Float64 name="x" valueReference="3" causality="output" initial="exact" start="0"/>
<Float64 name="y" valueReference="4" causality="output"/>
<Float64 name="vector" valueReference="5" causality="output"><Dimension start="3"/></Float64>
<String name="label" valueReference="9" causality="parameter" variability="fixed"><Start value="a"/></String>
<UInt64 name="size" valueReference="10" causality="structuralParameter" start="3"/>
<Enumeration name="mode_in" valueReference="802" declaredType="Mode" causality="input" start="1"/>
<Enumeration name="mode_out" valueReference="803" declaredType="Mode" causality="output"/>
{variables}
</ModelVariables>
<ModelStructure><Output valueReference="3" dependencies=""/><Output valueReference="4" dependencies="1"/>
<Output valueReference="5"/>{outputs}</ModelStructure></fmiModelDescription>
"""


def description_2(
    *,
    version: str = "2.0",
    use: str = "CoSimulation",
    identifier: str = "Probe",
    variable_step: str = "true",
    needs_tool: str = "false",
    once: str = "false",
    variables: str = VARIABLES_2,
) -> str:
    """The model description of probe2.c, with changes."""
    return DESCRIPTION_2.format(
        version=version,
        use=use,
        identifier=identifier,
        variable_step=variable_step,
        needs_tool=needs_tool,
        once=once,
        variables=variables,
    )


def description_3() -> str:
    """The model description of probe3.c."""
    variables, outputs = "", ""
    for kind, reference in TYPES_3.items():
        start = "false" if kind == "Boolean" else "0"
        variables += (
            f'<{kind} name="{kind}_in" valueReference="{reference}" causality="input" start="{start}"/>'
        )
        variables += f'<{kind} name="{kind}_out" valueReference="{reference + 1}" causality="output"/>'
        outputs += f'<Output valueReference="{reference + 1}" dependencies="{reference}"/>'
    return DESCRIPTION_3.format(variables=variables, outputs=outputs)


@functools.cache
def library(source: str, *defines: str) -> bytes:
    """The compiled binary of a source in tests/fmus, with these macros defined."""
    target = BUILT / f"{len(list(BUILT.iterdir()))}.so"
    headers = Path(fmpy.__file__).parent / "c-code"
    subprocess.run(
        ["cc", "-O1", "-std=c99", "-D_GNU_SOURCE", "-shared", "-fPIC", "-fvisibility=hidden", f"-I{headers}"]
        + [f"-D{define}" for define in defines]
        + [str(TESTS / "fmus" / source), "-o", str(target), "-lm"],
        check=True,
    )
    return target.read_bytes()


def pack(path: Path, members: Mapping[str, str | bytes]) -> Path:
    """A zip archive with these members."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def probe(folder: Path, *defines: str, version: int = 2, description: str | None = None) -> Path:
    """One of our own FMUs, written into the folder.

    Args:
        folder: where to.
        defines: macros of the C source, which say how it fails.
        version: FMI major version.
        description: its modelDescription.xml, where it is to differ.
    """
    platform = fmpy.platform if version == 2 else fmpy.platform_tuple
    text = description or (description_2() if version == 2 else description_3())
    binary = f"binaries/{platform}/Probe{fmpy.sharedLibraryExtension}"
    return pack(
        folder / "Probe.fmu",
        {"modelDescription.xml": text, binary: library(f"probe{version}.c", *defines)},
    )


# ── driving a component ──────────────────────────────────────────────────────────────────────────────────


class Driver:
    """Any component, addressed by variable names and stepped with a fixed step."""

    def __init__(self, component: Component) -> None:
        self.component = component
        self.ticks, self.h, self.start = 0, 0.1, 0.0

    def begin(self, stop: float = 10.0, h: float = 0.1, start: float = 0.0, **starts: float) -> Driver:
        """Initialise with these start values."""
        assert self.component.enter_initialization(start, stop, starts) == Status.OK, self.component.message
        assert self.component.exit_initialization() == Status.OK, self.component.message
        self.ticks, self.h, self.start = 0, h, start
        return self

    def set(self, **values: float) -> Status:
        """Set variables."""
        indices = np.array([self.component.index(name) for name in values], dtype=np.intp)
        return self.component.set(indices, np.array(list(values.values()), dtype=float))

    def get(self, *names: str) -> list[float]:
        """Read variables."""
        indices = np.array([self.component.index(name) for name in names], dtype=np.intp)
        values = np.full(len(names), np.nan)
        status = self.component.get(indices, values)
        assert status == Status.OK, self.component.message
        return [float(value) for value in values]

    def step(self) -> Status:
        """One step."""
        status = self.component.step(self.start + self.ticks * self.h, self.h)
        self.ticks += 1
        return status

    def run(self, steps: int) -> None:
        """Several steps, all of which must be OK."""
        for _ in range(steps):
            assert self.step() == Status.OK, self.component.message

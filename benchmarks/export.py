"""Exported FMUs: are they valid, who runs them, how exact and fast are they, can they be made to fail?

    python benchmarks/export.py [--quick] [--only NAME …] [--json FILE]

Times are CPU times of raw C where not said otherwise. Needs a C compiler; five platforms need ziglang, the
windows and aarch64 binaries run where Debian's `wine64`, `qemu-user` and `libc6-arm64-cross` are installed.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import casadi as ca
import fmpy
import numpy as np

from exlinn_fmi import Run
from exlinn_fmi.components.fmu import FmuComponent
from exlinn_fmi.components.lagrangian import LagrangianComponent
from exlinn_fmi.control.controller import NmpcController
from exlinn_fmi.export.build import Options, export_learned, export_plant
from exlinn_fmi.export.card import read_card
from exlinn_fmi.export.check import check_fmu
from exlinn_fmi.export.platforms import FLAGS, PLATFORMS, has_zig
from exlinn_fmi.learn.weights import load_model
from exlinn_fmi.mechanics.euler_lagrange import LagrangianSystem
from exlinn_fmi.mechanics.learned import ModelSpec, Scales, Weights, learned_system
from exlinn_fmi.pipeline import train
from exlinn_fmi.plants import PLANTS, plant
from exlinn_fmi.shipping import Origin, ship_controller, ship_loop
from exlinn_fmi.toolchain import find_compiler

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent
Figures = dict[str, float | str]
FOLDER = tempfile.TemporaryDirectory(prefix="exlinn-bench-")
PAPER = (("alpha_dot^2", "sin(alpha)^2*alpha_dot^2", "i^2", "alpha*i"), ("alpha_dot^2", "i^2"))


def folder(name: str) -> Path:
    path = Path(FOLDER.name) / name
    path.mkdir(exist_ok=True)
    return path


# ── models ───────────────────────────────────────────────────────────────────────────────────────────────


@cache
def trained() -> Path:
    """The run folder of the motor's model, trained here."""
    out = folder("trained")
    train(Run.open(ROOT / "scenarios" / "dcwc_tracking.yaml", out))
    return out


def learned(fmi: int = 2, arrays: bool = False, platforms: tuple[str, ...] = ()) -> Path:
    """The trained model as an FMU."""
    model = load_model(trained())
    path = folder("fmus") / f"Learned{fmi}{'a' * arrays}{len(platforms)}.fmu"
    options = Options(3 if fmi == 3 else 2, arrays, platforms)
    return export_learned(
        model.spec,
        model.weights,
        path,
        name="Learned",
        ranges=model.provenance["ranges"],
        card=read_card(trained()),
        options=options,
    )


def network(hidden: int, depth: int, seed: int = 0) -> tuple[ModelSpec, Weights]:
    """A structured model of the motor of any size with random weights."""
    scales = Scales(0.2, 1.0, (1.0, 0.5), (0.0, 0.0), (1.0, 1.0))
    spec = ModelSpec(
        "structured", plant("dc_motor_cart").coordinates, hidden, scales, (0.05, 0.05), depth=depth
    )
    rng = np.random.default_rng(seed)
    size = {name: np.sqrt(shape[-1]) if len(shape) > 1 else 3.0 for name, shape in spec.shapes().items()}
    return spec, {name: rng.normal(size=shape) / size[name] for name, shape in spec.shapes().items()}


def paper_network() -> tuple[ModelSpec, Weights]:
    """The paper's: two networks of 4 ReLU units on monomials."""
    spec = ModelSpec("features", plant("dc_motor_cart").coordinates, 4, None, (), *PAPER)
    rng = np.random.default_rng(0)
    return spec, {name: rng.uniform(0.1, 0.4, shape) for name, shape in spec.shapes().items()}


@cache
def exports(quick: bool) -> tuple[Path, ...]:
    """One of each kind."""
    pages = list(PLANTS.values())[: 2 if quick else None]
    made = [
        export_plant(page, folder("fmus") / f"{page.model_name}{fmi}.fmu", Options(fmi=fmi))
        for page in pages
        for fmi in (2, 3)
    ]
    made += [learned(), learned(3), learned(3, arrays=True)]
    for name, (spec, weights) in {"Paper": paper_network(), "Deep": network(16, 3)}.items():
        ranges = {"i": (-2.0, 2.0), "v": (-9.0, 9.0)} if name == "Deep" else None
        for fmi in (2, 3):
            path = folder("fmus") / f"{name}{fmi}.fmu"
            made.append(
                export_learned(
                    spec, weights, path, name=name, ranges=ranges, options=Options(3 if fmi == 3 else 2)
                )
            )
    return tuple(made)


def validity(quick: bool) -> Figures:
    """FMPy's validation, XML schemas and our own check, and the reference trajectories."""
    paths = (*exports(quick), *motor_controller()[1:])
    found = [check_fmu(path) for path in paths]
    for path, finding in zip(paths, found, strict=True):
        for problem in finding.problems:
            print(f"{path.name}: {problem}")
    return {
        "validate.fmus": len(found),
        "validate.errors": sum(len(f.problems) for f in found),
        "validate.reference_max_rel": max(max(f.runs.values(), default=0.0) for f in found),
    }


# ── importers ────────────────────────────────────────────────────────────────────────────────────────────

STEPS, H = 200, 1e-3


def _expected(path: Path) -> np.ndarray:
    """State after so many steps from the start values at rest, through FMPy's raw classes."""
    run = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=STEPS * H, step_size=H, output_interval=H,
        output=["alpha", "alpha_dot", "i"], start_values={"v": 5.0}, input=None,
    )  # fmt: skip
    return np.array([run[n][-1] for n in ("alpha", "alpha_dot", "i")])


def _by_ecos(path: Path) -> np.ndarray:
    ctypes.CDLL(str(Path(sys.prefix) / "lib" / "libtbb.so.12"), ctypes.RTLD_GLOBAL)
    from ecospy import EcosLib, EcosSimulation, EcosSimulationStructure
    from ecospy.EcosParameterSet import EcosParameterSet

    with EcosSimulationStructure() as structure:
        EcosLib.set_log_level("off")
        structure.add_model("m", path)
        values = EcosParameterSet()
        values.add_real("m::v", 5.0)
        structure.add_parameter_set("start", values)
        with EcosSimulation(structure=structure, step_size=H) as simulation:
            simulation.init(parameter_set="start")
            simulation.step(STEPS)
            return np.array([simulation.get_real(f"m::{n}") for n in ("alpha", "alpha_dot", "i")])


def _by_libcosim(path: Path) -> np.ndarray:
    from libcosimpy.CosimEnums import CosimVariableType
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    log_output_level(CosimLogLevel.WARNING)
    references = {v.name: v.valueReference for v in fmpy.read_model_description(str(path)).modelVariables}
    execution = CosimExecution.from_step_size(1e9 * H)
    slave = execution.add_local_slave(CosimLocalSlave(str(path), "m"))
    execution.real_initial_value(slave, references["v"], 5.0)
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    assert execution.step(STEPS)
    asked = [references[n] for n in ("alpha", "alpha_dot", "i")]
    assert CosimVariableType.REAL is not None
    return np.array(observer.last_real_values(slave, asked))


def importers(quick: bool) -> Figures:
    """Other tools run the learned model and end where FMPy does; CasADi reads derivatives."""
    figures: Figures = {}
    two, three = learned(2), learned(3)
    expected = _expected(two)
    runs: dict[str, Callable[[], np.ndarray]] = {
        "fmpy_fmi3": lambda: _expected(three),
        "ecospy_fmi2": lambda: _by_ecos(two),
        "ecospy_fmi3": lambda: _by_ecos(three),
        "libcosimpy_fmi2": lambda: _by_libcosim(two),
    }
    for name, run in runs.items():
        figures[f"importers.{name}.max_abs"] = float(np.abs(run() - expected).max())
    for path in (two, three):
        figures |= {f"importers.casadi_fmi{path.stem[7]}.{k}": v for k, v in _by_casadi(path).items()}
    return figures


def _by_casadi(path: Path) -> dict[str, float]:
    """Right-hand side against the model's, its Jacobian against central differences."""
    unpacked = folder(f"casadi_{path.stem}")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(unpacked)
    ode = ca.DaeBuilder("model", str(unpacked)).create("ode", ["x", "u"], ["ode"])
    jacobian = ode.factory("jacobian", ["x", "u"], ["jac:ode:x", "jac:ode:u"])
    system = load_model(trained()).system
    off = value = 0.0
    for z in np.random.default_rng(0).uniform(-1, 1, (5, 4)):
        x, u, eps = z[:3], z[3:], 1e-6
        value = max(value, float(ca.norm_inf(ode(x, u) - system.derivative(x, u, []))))
        exact = np.hstack([np.array(j) for j in jacobian(x, u)])
        shift = [eps * np.eye(4)[k] for k in range(4)]
        columns = [(ode((z + s)[:3], (z + s)[3:]) - ode((z - s)[:3], (z - s)[3:])) / (2 * eps) for s in shift]
        numeric = np.hstack([np.array(c) for c in columns])
        off = max(off, float(np.abs(exact - numeric).max() / np.abs(numeric).max()))
    return {"value_max_abs": value, "jacobian_vs_differences": off}


# ── accuracy and speed ───────────────────────────────────────────────────────────────────────────────────


def parity(quick: bool) -> Figures:
    """Learned FMUs against the models in process, 10 s under a random voltage, steps of 1 ms.

    The motor's own model hardly needs its hidden units: a network of random weights stands beside it.
    """
    steps, model, random = 2_000 if quick else 10_000, load_model(trained()), network(16, 3)
    path = export_learned(*random, folder("fmus") / "Random.fmu", name="Random")
    return {
        "parity.max_abs": _apart(learned(), model.system, steps),
        "parity.random_network_max_abs": _apart(path, learned_system(*random), steps),
        "parity.seconds": steps * H,
    }


def _apart(path: Path, system: LagrangianSystem, steps: int) -> float:
    """Largest difference of a state."""
    from fmpy.fmi2 import FMU2Slave

    description = fmpy.read_model_description(str(path))
    references = {v.name: v.valueReference for v in description.modelVariables}
    fmu = FMU2Slave(
        guid=description.guid,
        unzipDirectory=fmpy.extract(str(path)),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="m",
    )
    fmu.instantiate()
    fmu.setupExperiment()
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    names, voltage = system.state_names, 2.9 + 2.9 * np.random.default_rng(0).normal(size=steps // 50 + 1)
    component = LagrangianComponent("m", system)
    values = fmu.getReal([references[n] for n in names])
    component.enter_initialization(0.0, steps * H, dict(zip(names, values, strict=True)))
    component.exit_initialization()
    own, theirs = np.zeros((steps, 3)), np.zeros((steps, 3))
    at, driven = np.array([component.index(n) for n in names]), np.array([component.index("v")])
    for k in range(steps):
        u = voltage[k // 50]
        component.set(driven, np.array([u]))
        component.step(k * H, H)
        component.get(at, own[k])
        fmu.setReal([references["v"]], [u])
        fmu.doStep(k * H, H)
        theirs[k] = fmu.getReal([references[n] for n in names])
    fmu.freeInstance()
    assert np.isfinite(own).all()
    assert np.ptp(own, axis=0).min() > 0.1
    return float(np.abs(own - theirs).max())


def _sources(path: Path) -> Path:
    unpacked = folder(f"sources_{path.stem}")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(unpacked)
    return unpacked / "sources"


def _build(driver: str, sources: Path, *flags: str) -> Path:
    program = sources / driver.removesuffix(".c")
    command = [
        *find_compiler(),
        *flags,
        "-w",
        "-I",
        str(sources),
        str(HERE / driver),
        "-o",
        str(program),
        "-lm",
    ]
    subprocess.run(command, check=True)
    return program


def speed(quick: bool) -> Figures:
    """One step of the Runge–Kutta method through fmi2DoStep, the FMU compiled into the program."""
    cases = {
        "paper_net": (paper_network(), 100_000),
        "1x8": (network(8, 1), 50_000),
        "2x64": (network(64, 2), 2_000),
        "4x256": (network(256, 4), 40),
    }
    figures: Figures = {}
    for name, ((spec, weights), steps) in cases.items():
        path = export_learned(spec, weights, folder("fmus") / f"Net{name}.fmu", name="Net")
        program = _build("export_step.c", _sources(path), *FLAGS)
        took = subprocess.run(
            [program, str(steps // (10 if quick else 1))], capture_output=True, text=True, check=True
        )
        figures[f"step_us.{name}"] = float(took.stdout)
    return figures


@cache
def motor_controller() -> tuple[NmpcController, Path, Path]:
    """The tracking scenario's controller in process, as an FMU, and the loop in one FMU."""
    run = trained()
    (run / "scenario.yaml").write_text((ROOT / "scenarios" / "dcwc_tracking.yaml").read_text("utf-8"))
    origin = Origin.find(run)
    path = ship_controller(origin, folder("fmus") / "Controller.fmu", Options())
    return origin.controller(), path, ship_loop(origin, folder("fmus") / "Loop.fmu", Options())


def controller(quick: bool) -> Figures:
    """The controller FMU beside the controller in process, each in a loop of its own with its model, 10 s."""
    ours, path, _ = motor_controller()
    system, step, ticks = ours.parts.ocp.system, ours.parts.step, 200 if quick else 1000
    rows, took = [], []
    for made in (ours, FmuComponent("fmu", path)):
        motor = LagrangianComponent("motor", system)
        for component in (made, motor):
            component.enter_initialization(0.0, ticks * step, {"alpha": 1.2} if component is motor else {})
            component.exit_initialization()
        measured = np.array([motor.index(n) for n in system.state_names])
        given = np.array([made.index(n) for n in system.state_names])
        out, v = np.array([made.index("v")]), np.array([motor.index("v")])
        states, u, seconds = np.zeros(3), np.zeros((ticks, 1)), 0.0
        for k in range(ticks):
            motor.get(measured, states)
            began = time.process_time()
            made.set(given, states)
            made.get(out, u[k])
            made.step(k * step, step)
            seconds += time.process_time() - began
            motor.set(v, u[k])
            motor.step(k * step, step)
        rows.append(u)
        took.append(1e6 * seconds / ticks)
    return {
        "controller.max_abs_v": float(np.abs(rows[0] - rows[1]).max()),
        "controller.largest_v": float(np.abs(rows[0]).max()),
        "controller.in_process_step_us": took[0],
        "controller.step_us": took[1],
        "controller.over_in_process": took[1] / took[0],
    }


def platforms(quick: bool) -> Figures:
    """An export for five platforms in one file, the compiler's cache warm but the model new."""
    if not has_zig():
        return {"platforms": "no ziglang"}
    path, took = folder("fmus") / "Five.fmu", []
    for seed in range(3):
        spec, weights = network(8, 1, seed)
        began = time.perf_counter()
        export_learned(spec, weights, path, name="Five", options=Options(platforms=tuple(PLATFORMS)))
        took.append(time.perf_counter() - began)
    first = path.read_bytes()
    export_learned(spec, weights, path, name="Five", options=Options(platforms=tuple(PLATFORMS)))
    return {
        "platforms.cold_s": took[0],
        "platforms.warm_s": min(took[1:]),
        "platforms.kB": len(first) / 1000,
        "platforms.same_bytes": float(first == path.read_bytes()),
    }


def emulated(quick: bool) -> Figures:
    """Binaries of other platforms under emulators: largest relative difference from this machine's."""
    tools = {"x86_64-windows": shutil.which("wine"), "aarch64-linux": shutil.which("qemu-aarch64")}
    if not has_zig() or not all(tools.values()):
        return {"emulated": "needs ziglang, wine64, qemu-user and libc6-arm64-cross"}
    here = _sources(learned(platforms=tuple(PLATFORMS))).parent
    token = fmpy.read_model_description(str(here)).guid
    zig = [sys.executable, "-m", "ziglang"]
    kernel = "LoadLibraryA GetProcAddress GetStdHandle WriteFile ExitProcess GetCommandLineA"
    (here / "k.def").write_text("\n".join(["LIBRARY kernel32.dll", "EXPORTS", *kernel.split(), ""]))
    make_library = [*zig, "dlltool", "-m", "i386:x86-64", "-d", "k.def", "-l", "k.lib"]
    subprocess.run(make_library, cwd=here, check=True, capture_output=True)
    arm = PLATFORMS["aarch64-linux"].target
    builds: dict[str, tuple[list[str], list[str], str]] = {
        "host": ([*find_compiler(), "-ldl"], [], "binaries/linux64/Learned.so"),
        "aarch64-linux": (
            [*zig, "cc", "-target", arm, "-ldl"],
            [tools["aarch64-linux"] or "", "-L", "/usr/aarch64-linux-gnu"],
            "binaries/aarch64-linux/Learned.so",
        ),
        "x86_64-windows": (
            [*zig, "cc", "-target", "x86_64-windows-gnu", "-nostdlib", "k.lib"],
            [tools["x86_64-windows"] or ""],
            "binaries\\win64\\Learned.dll",
        ),
    }
    values = {}
    for name, (compiler, emulator, library) in builds.items():
        program = f"./run_{name}.exe"
        command = [*compiler[:-1], "-w", "-O1", str(HERE / "export_run.c"), compiler[-1], "-o", program]
        subprocess.run(command, cwd=here, check=True, capture_output=True)
        told = subprocess.run(
            [*emulator, program, library, token], cwd=here, check=True, capture_output=True, text=True
        ).stdout
        values[name] = np.array([int(line, 16) for line in told.split()], dtype=np.uint64).view(np.float64)
    host = values.pop("host")
    return {f"emulated.{n}.max_rel": float(np.abs(v / host - 1).max()) for n, v in values.items()}


def fuzz(quick: bool) -> Figures:
    """Random calls, legal and not, under the address and undefined-behaviour sanitisers."""
    calls, findings = 10_000 if quick else 100_000, 0
    sanitise = ("-g", "-O1", "-std=c99", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    for path in (*exports(quick), *motor_controller()[1:]):
        program = _build("export_fuzz.c", _sources(path), *sanitise)
        for seed in range(1 if quick else 2):
            run = subprocess.run(
                [program, str(calls), str(seed)], capture_output=True, text=True, check=False
            )
            if run.returncode:
                findings += 1
                print(f"{path.name}, seed {seed}: {run.stderr[:2000]}")
    return {"fuzz.models": len(exports(quick)) + 2, "fuzz.calls": calls, "fuzz.findings": findings}


FIGURES: dict[str, Callable[[bool], Figures]] = {
    "validity": validity,
    "importers": importers,
    "parity": parity,
    "speed": speed,
    "controller": controller,
    "platforms": platforms,
    "emulated": emulated,
    "fuzz": fuzz,
}
"""What is measured: each makes figures, given whether to be quick."""


def measured(names: list[str], quick: bool) -> Iterator[tuple[str, float | str]]:
    """Figures as they are made."""
    for name in names:
        yield from FIGURES[name](quick).items()


def main() -> None:
    """Measure, print, and write JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer models, steps and calls")
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES), help="what to measure")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    figures: Figures = {}
    for name, value in measured(options.only, options.quick):
        print(
            f"{name:<46} {value:.4g}" if isinstance(value, float | int) else f"{name:<46} {value}", flush=True
        )
        figures[name] = value
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()

"""The commands `exlinn export …`: arguments and what is printed, nothing else."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from exlinn_fmi.errors import InputError, RunError

if TYPE_CHECKING:
    from exlinn_fmi.export.build import Options

app = typer.Typer(
    help="Write an FMU without Python inside or a package of SSP, or check an FMU.\n\n"
    "Example: exlinn export plant dc_motor_cart",
    no_args_is_help=True,
    rich_markup_mode=None,
)


class Fmi(StrEnum):
    """Major versions of FMI."""

    two = "2"
    three = "3"


FmiVersion = Annotated[Fmi, typer.Option("--fmi", help="Version of FMI.")]
Platforms = Annotated[
    list[str] | None,
    typer.Option(
        "--platform",
        help="Platform to compile for, e.g. x86_64-linux; 'host' for this machine's alone; may be given "
        "often. All five if not given and ziglang is installed, else this machine's.",
    ),
]
Arrays = Annotated[bool, typer.Option("--arrays", help="Make the state an array variable (FMI 3).")]
Folder = Annotated[Path, typer.Argument(help="Run folder, or any folder with model.json.", metavar="FOLDER")]


def options(fmi: Fmi, platforms: list[str] | None, arrays: bool = False) -> Options:
    """How to write the FMU; what cannot be built for is told."""
    from exlinn_fmi.export.build import Options
    from exlinn_fmi.export.platforms import PLATFORMS, buildable, host

    names = tuple(host() if name == "host" else name for name in platforms or buildable())
    missing = [name for name in PLATFORMS if name not in names]
    if missing and not platforms:
        typer.echo(
            f"built for {host()} alone, without {', '.join(missing)}; for all platforms: pip install ziglang",
            err=True,
        )
    return Options(3 if fmi is Fmi.three else 2, arrays, names)


@app.command("plant")
def plant_command(
    name: Annotated[str, typer.Argument(help="Name of the plant, e.g. dc_motor_cart.")],
    out: Annotated[Path | None, typer.Option(help="FMU to write; <ModelName>.fmu if not given.")] = None,
    fmi: FmiVersion = Fmi.two,
    platform: Platforms = None,
    arrays: Arrays = False,
) -> None:
    """Build a plant page as an FMU (Co-Simulation and Model Exchange). Needs a C compiler.

    Example: exlinn export plant dc_motor_cart --fmi 3 --out DCMotorCart.fmu
    """
    from exlinn_fmi.export.build import export_plant
    from exlinn_fmi.plants import plant

    page = plant(name)
    typer.echo(str(export_plant(page, out or Path(f"{page.model_name}.fmu"), options(fmi, platform, arrays))))


@app.command("model")
def model_command(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(help="FMU to write; <folder name>.fmu if not given.")] = None,
    fmi: FmiVersion = Fmi.two,
    platform: Platforms = None,
    arrays: Arrays = False,
) -> None:
    """Build a learned model as an FMU (Co-Simulation and Model Exchange). Needs a C compiler.

    It says where it leaves the range that it was trained in, and carries a model card.

    Example: exlinn export model runs/dcwc_tracking --fmi 3 --out Learned.fmu
    """
    from exlinn_fmi.export.build import export_learned
    from exlinn_fmi.export.card import read_card
    from exlinn_fmi.learn.weights import load_model

    model, file = load_model(folder), out or Path(f"{folder.resolve().name}.fmu")
    written = export_learned(
        model.spec,
        model.weights,
        file,
        name=file.stem,
        ranges=model.provenance.get("ranges"),
        card=read_card(folder),
        options=options(fmi, platform, arrays),
    )
    typer.echo(str(written))


OwnScenario = Annotated[
    Path | None,
    typer.Option(help="Scenario of the run, if it names files; that in the run folder if not given."),
]
ControllerName = Annotated[
    str | None, typer.Option("--name", help="Controller in the scenario; the only one if not given.")
]


@app.command("controller")
def controller_command(
    folder: Annotated[Path, typer.Argument(help="Run folder.", metavar="FOLDER")],
    out: Annotated[Path | None, typer.Option(help="FMU to write; Controller.fmu if not given.")] = None,
    fmi: FmiVersion = Fmi.two,
    platform: Platforms = None,
    scenario: OwnScenario = None,
    name: ControllerName = None,
) -> None:
    """Build the NMPC controller of a run, its estimator inside, as a sampled FMU (Co-Simulation).

    Example: exlinn export controller runs/dcwc_tracking --out Controller.fmu
    """
    from exlinn_fmi.shipping import Origin, ship_controller

    origin = Origin.find(folder, scenario, name)
    typer.echo(str(ship_controller(origin, out or Path("Controller.fmu"), options(fmi, platform))))


@app.command("loop")
def loop_command(
    folder: Annotated[Path, typer.Argument(help="Run folder.", metavar="FOLDER")],
    out: Annotated[Path | None, typer.Option(help="FMU or SSP to write; Loop.fmu if not given.")] = None,
    fmi: FmiVersion = Fmi.two,
    platform: Platforms = None,
    scenario: OwnScenario = None,
    name: ControllerName = None,
) -> None:
    """Write the controller of a run and its prediction model as a closed loop: one FMU, or two in an .ssp.

    Example: exlinn export loop runs/dcwc_tracking --out Loop.ssp
    """
    from exlinn_fmi.shipping import Origin, ship_loop

    origin = Origin.find(folder, scenario, name)
    typer.echo(str(ship_loop(origin, out or Path("Loop.fmu"), options(fmi, platform))))


@app.command("ssp")
def ssp_command(
    scenario: Annotated[Path, typer.Argument(help="Scenario file (YAML).", metavar="SCENARIO")],
    out: Annotated[Path | None, typer.Option(help="Package to write; <name>.ssp if not given.")] = None,
    ssp: Annotated[str, typer.Option("--ssp", help="Version of SSP: 1.0 or 2.0.")] = "1.0",
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="Set a value of the scenario before."),
    ] = None,
) -> None:
    """Write a scenario's components, connections and start values as a package of SSP, FMUs included.

    Example: exlinn export ssp scenarios/two_fmus.yaml --out TwoMotors.ssp
    """
    from exlinn_fmi.export.ssp import VERSIONS, write_ssp
    from exlinn_fmi.factory import outline
    from exlinn_fmi.workspace import Run

    if ssp not in VERSIONS:
        raise InputError(f"--ssp: expected {' or '.join(VERSIONS)}, found {ssp!r}")
    loaded = Run.open(scenario, None, overrides or ()).loaded
    whole = loaded.scenario
    variables = {name: outline(name, whole, loaded.folder).variables for name in whole.components}
    typer.echo(str(write_ssp(loaded, variables, out or Path(f"{whole.name}.ssp"), ssp)))


@app.command("check")
def check_command(
    fmus: Annotated[list[Path], typer.Argument(help="FMUs to check.", metavar="FMU...")],
) -> None:
    """Validate FMUs and run them against the reference trajectories inside.

    Example: exlinn export check fmus/DCMotorCart.fmu
    """
    from exlinn_fmi.export.check import check_fmu

    bad = []
    for path in fmus:
        if not path.is_file():
            raise InputError(f"{path}: no such file; give an FMU")
        found = check_fmu(path)
        runs = ", ".join(f"{kind} within {error:.1e} of the reference" for kind, error in found.runs.items())
        typer.echo(f"{path}: {'valid' if not found.problems else 'NOT valid'}{f', {runs}' if runs else ''}")
        for problem in found.problems:
            typer.echo(f"  {problem}")
        bad += [path] if found.problems else []
    if bad:
        raise RunError(f"{len(bad)} of {len(fmus)} FMUs failed the check: {', '.join(map(str, bad))}")

"""The command `exlinn`: arguments, progress and exit codes, nothing else."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from exlinn_fmi import cli_export
from exlinn_fmi.errors import ExlinnError, InputError, Interrupted, StorageError

if TYPE_CHECKING:
    from exlinn_fmi.workspace import Run

# Typer brings its own copy of click from 0.26 on: the base of its usage errors is found either way.
UsageError: Any = next(base for base in typer.BadParameter.__mro__ if base.__name__ == "ClickException")

app = typer.Typer(
    name="exlinn",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ScenarioFile = Annotated[
    Path,
    typer.Argument(
        help="Scenario file (YAML), an FMU to run by itself, or a system of SSP.", metavar="SCENARIO"
    ),
]
Out = Annotated[Path | None, typer.Option("--out", help="Run folder; runs/<scenario name> if not given.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY.PATH=VALUE",
        help="Set a value of the scenario, or with component.variable a start value; may be given often.",
    ),
]
Stop = Annotated[float | None, typer.Option("--stop", help="Stop time of the co-simulation [s].")]
Step = Annotated[float | None, typer.Option("--step", help="Communication step [s].")]

Resume = Annotated[
    bool, typer.Option("--resume", help="Go on from the last checkpoint of a co-simulation that was stopped.")
]
Record = Annotated[
    list[str] | None,
    typer.Option("--record", metavar="PATTERN", help="Record what fits, e.g. 'plant.*'; may be given often."),
]


class Terminal:
    """Shows progress on stderr: a bar on a terminal, plain lines of stages elsewhere."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.console = Console(stderr=True, highlight=False, soft_wrap=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self.progress = Progress(
            *columns, TextColumn("{task.fields[text]}"), console=self.console, transient=True
        )
        self.task: Any = None

    def stage(self, name: str, detail: str) -> None:
        """A stage begins."""
        self.close()
        self.console.print(f"[bold]{name:<9}[/] {detail}", markup=True)
        if self.console.is_terminal:
            self.progress.start()
            self.task = self.progress.add_task(name, total=1.0, text="")

    def update(self, fraction: float, text: str = "") -> None:
        """The present stage is that far."""
        if self.task is not None:
            self.progress.update(self.task, completed=fraction, text=text)

    def note(self, text: str) -> None:
        """Something that the user should know."""
        self.console.print(text, markup=False)

    def close(self) -> None:
        """Take the bar away."""
        if self.task is not None:
            self.progress.remove_task(self.task)
            self.progress.stop()
            self.task = None


def tell_inputs(scenario: Path, overrides: list[str]) -> None:
    """Say that the inputs of an FMU that is run by itself are held, unless one was set."""
    if scenario.suffix.lower() == ".fmu" and not any(text.startswith("plant.") for text in overrides):
        from exlinn_fmi.drafting import held_inputs

        if said := held_inputs(scenario):
            typer.echo(said, err=True)


def perform(work: Callable[[Run], object], file: Path, out: Path | None, overrides: list[str] | None) -> Run:
    """Do some work on a scenario, with progress shown and Ctrl-C minded."""
    from exlinn_fmi.workspace import Run

    terminal = Terminal()
    try:
        run = Run.open(file, out, overrides or (), terminal)
        with run.stop:
            work(run)
    except KeyboardInterrupt:
        # Caught here since Typer has an answer of its own to it.
        raise Interrupted("stopped at once by a second Ctrl-C; files that were complete are kept") from None
    finally:
        terminal.close()
    return run


def show_version(wanted: bool) -> None:
    """Print the version and end, where that is asked for."""
    if wanted:
        from importlib.metadata import version

        typer.echo(f"exlinn {version('exlinn-fmi')}")
        raise typer.Exit


@app.callback()
def exlinn(
    version: Annotated[
        bool, typer.Option("--version", callback=show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Learn a physics-faithful model of a plant, control it with NMPC, run both in co-simulation.

    Example: exlinn run scenarios/dcwc_tracking.yaml
    """


@app.command()
def run(
    scenario: ScenarioFile,
    out: Out = None,
    overrides: Overrides = None,
    stop: Stop = None,
    step: Step = None,
    record: Record = None,
    resume: Resume = False,
) -> None:
    """Do all that a scenario asks for: collect, train, simulate, report.

    Example: exlinn run scenarios/dcwc_tracking.yaml --stop 5

    An FMU is simulated by itself: exlinn run fmus/DCMotorCart.fmu --set plant.v=12 --stop 3
    """
    from exlinn_fmi import pipeline

    began = time.perf_counter()
    overrides = [*(overrides or ()), *shorthand(stop, step, record)]
    work = perform(lambda work: pipeline.run(work, resume), scenario, out, overrides)
    tell_inputs(scenario, overrides)
    show_metrics(work.folder)
    typer.echo(f"\n{work.folder / 'report.html'}  ({time.perf_counter() - began:.1f} s)")


@app.command()
def init(
    files: Annotated[
        list[Path], typer.Argument(help="An FMU, or recordings (CSV, Parquet).", metavar="FILE")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Scenario to write; <name of the file>.yaml here if not given."),
    ] = None,
) -> None:
    """Write a scenario to go on with, for an FMU or for measured data.

    Inputs, parameters and units are filled in, and what names and units tell of generalised coordinates. TODO
    marks what is yours to look at; the file can be run as it is, unless nothing could be told.

    Example: exlinn init fmus/DCMotorCart.fmu --out motor.yaml
    """
    from exlinn_fmi.drafting import draft

    typer.echo(draft(files, out))


@app.command()
def validate(scenario: ScenarioFile, overrides: Overrides = None) -> None:
    """Check a scenario and everything that it names, without running anything.

    Example: exlinn validate scenarios/dcwc_paper.yaml
    """
    from exlinn_fmi.describe import describe_purpose
    from exlinn_fmi.workspace import Run

    work = Run.open(scenario, None, overrides or ())
    parts = f"{len(work.scenario.components)} components, {len(work.scenario.connection_list())} connections"
    typer.echo(f"{scenario}: valid ({parts})")
    for line in describe_purpose(work.scenario):
        typer.echo(f"  {line}")


@app.command()
def info(
    target: Annotated[Path, typer.Argument(help="A scenario, an FMU or a run folder.", metavar="PATH")],
    overrides: Overrides = None,
) -> None:
    """Tell what is in a scenario (order, delays), an FMU (variables) or a run folder (stages, metrics).

    Example: exlinn info fmus/DCMotorCart.fmu
    """
    from exlinn_fmi.describe import describe

    typer.echo(describe(target, overrides or ()))


@app.command()
def collect(scenario: ScenarioFile, out: Out = None, overrides: Overrides = None) -> None:
    """Excite the plant and save the data set.

    Example: exlinn collect scenarios/dcwc_tracking.yaml --out runs/data
    """
    from exlinn_fmi import pipeline

    work = perform(pipeline.collect, scenario, out, overrides)
    typer.echo(str(work.folder / "dataset.csv"))


@app.command()
def train(scenario: ScenarioFile, out: Out = None, overrides: Overrides = None) -> None:
    """Train the model (on data collected as needed) and print its report card. Ctrl-C keeps the best so far.

    Example: exlinn train scenarios/dcwc_tracking.yaml --set learn.method.hidden=6
    """
    from exlinn_fmi import pipeline

    work = perform(pipeline.train, scenario, out, overrides)
    show_metrics(work.folder, "learn.", "identify.")
    typer.echo(f"\n{work.folder / 'model.safetensors'}")


@app.command()
def design(scenario: ScenarioFile, out: Out = None, overrides: Overrides = None) -> None:
    """Propose an excitation that tells most of the parameter known worst. Ctrl-C keeps the best so far.

    Counts on the plant's formulas, or on the model that `exlinn train` learned, and on the sensors' noise
    and the limits in `learn.design`.

    Example: exlinn design scenarios/dcwc_tracking.yaml --set learn.design.limits.states.i='{min: -4, max: 4}'
    """
    from exlinn_fmi import pipeline
    from exlinn_fmi.designing import summary

    work = perform(pipeline.design, scenario, out, overrides)
    typer.echo(summary(work.folder))


@app.command()
def simulate(
    scenario: ScenarioFile,
    out: Out = None,
    overrides: Overrides = None,
    stop: Stop = None,
    step: Step = None,
    record: Record = None,
    resume: Resume = False,
) -> None:
    """Run the scenario's components in co-simulation (learning first what they need).

    Example: exlinn simulate scenarios/two_fmus.yaml --stop 2 --record 'first.*'

    An FMU by itself: exlinn simulate fmus/DCMotorCart.fmu --set plant.v=12 --stop 3 --step 1e-3

    A long run that may be interrupted: --set simulate.checkpoint=60 makes a checkpoint each minute, and the
    same command with --resume goes on from the last one.
    """
    from exlinn_fmi import pipeline

    overrides = [*(overrides or ()), *shorthand(stop, step, record)]
    work = perform(lambda work: pipeline.simulate(work, resume), scenario, out, overrides)
    tell_inputs(scenario, overrides)
    show_metrics(work.folder, "control.", "simulate.")
    typer.echo(f"\n{work.folder / 'trajectories.csv'}")


@app.command()
def sweep(scenario: ScenarioFile, out: Out = None, overrides: Overrides = None) -> None:
    """Run the closed loop many times with values drawn at random. Ctrl-C keeps the runs so far.

    Called again it goes on where it was stopped; more repetitions add to those that there are.

    Example: exlinn sweep scenarios/dcwc_robustness.yaml --set study.repetitions=200
    """
    from exlinn_fmi import pipeline

    def work_on(work: Run) -> None:
        pipeline.sweep(work)
        pipeline.report(work.folder)

    work = perform(work_on, scenario, out, overrides)
    show_metrics(work.folder, "study.")
    typer.echo(f"\n{work.folder / 'study.csv'}")


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Run folder, e.g. runs/dcwc_tracking.", metavar="FOLDER")],
) -> None:
    """Make figures and report.html again from what is in a run folder.

    Example: exlinn report runs/dcwc_tracking
    """
    from exlinn_fmi import pipeline

    if not (folder / "scenario.yaml").exists():
        raise InputError(
            f"{folder}: not a run folder (it has no scenario.yaml); give one that `exlinn run` wrote"
        )
    typer.echo(str(pipeline.report(folder)))


app.add_typer(cli_export.app, name="export")


@app.command()
def schema(
    out: Annotated[
        Path | None, typer.Option("--out", help="File to write; standard output if not given.")
    ] = None,
) -> None:
    """Print the JSON Schema of scenario files, for editors.

    Example: exlinn schema --out scenario.schema.json
    """
    import json

    from exlinn_fmi.data.files import write_text
    from exlinn_fmi.scenario.load import json_schema

    text = json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_text(out, text)
        typer.echo(str(out))


def shorthand(stop: float | None, step: float | None, record: list[str] | None) -> list[str]:
    """The settings of the scenario that `--stop`, `--step` and `--record` stand for."""
    import json

    given = {"stop": stop, "step": step, "record": record or None}
    return [f"simulate.{key}={json.dumps(value)}" for key, value in given.items() if value is not None]


def show_metrics(folder: Path, *prefixes: str) -> None:
    """Print the metrics of a run folder that have a value, one a line."""
    from exlinn_fmi.workspace import metrics

    known = metrics(folder)
    if known.get("learn.rollout_diverged"):
        known = {k: "diverged" if v is None and "rollout" in k else v for k, v in known.items()}
    values = {k: v for k, v in known.items() if v is not None and k.startswith(prefixes or ("",))}
    width = max(map(len, values), default=0)
    for name, value in values.items():
        typer.echo(
            f"{name:<{width}}  {value:.6g}" if isinstance(value, float) else f"{name:<{width}}  {value}"
        )


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the console script: run a command and end with its exit code."""
    sys.exit(exit_code(arguments))


def exit_code(arguments: list[str] | None = None) -> int:
    """Run a command; 0 done, 1 the user's input is at fault, 2 the run failed, 3 a bug."""
    try:
        app(arguments, standalone_mode=False)
    except UsageError as error:
        error.show()
        return 1
    except ExlinnError as error:
        return fail(error)
    except OSError as error:
        return fail(StorageError(f"{error.filename or 'a file'}: {error.strerror or error}"))
    except Exception:
        traceback.print_exc()
        typer.echo("This is a bug in exlinn; please report it with the text above.", err=True)
        return 3
    return 0


def fail(error: ExlinnError) -> int:
    """Print an error and give its exit code."""
    typer.echo(f"error: {error}", err=True)
    return error.exit_code

"""One scenario being worked on in its run folder: what was done, what was found, who is told."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from exlinn_fmi.components.base import Component
from exlinn_fmi.data.files import read_record, write_json, write_text
from exlinn_fmi.errors import ExlinnError, InputError
from exlinn_fmi.factory import build, inspect
from exlinn_fmi.interrupts import StopRequest
from exlinn_fmi.scenario.load import LoadedScenario, load_scenario, named_files
from exlinn_fmi.stages import Stages

if TYPE_CHECKING:
    from exlinn_fmi.scenario.learning import AnyLearn
    from exlinn_fmi.scenario.schema import Scenario


class Reporter(Protocol):
    """Who is told how the work goes; the command line shows it, a library user may ignore it."""

    def stage(self, name: str, detail: str) -> None:
        """A stage begins."""

    def update(self, fraction: float, text: str = "") -> None:
        """The present stage is that far (0…1)."""

    def note(self, text: str) -> None:
        """Something that the user should know, e.g. a warning."""


class Silent:
    """A reporter that says nothing."""

    def stage(self, name: str, detail: str) -> None:
        """Nothing."""

    def update(self, fraction: float, text: str = "") -> None:
        """Nothing."""

    def note(self, text: str) -> None:
        """Nothing."""


@dataclass
class Run:
    """One scenario being worked on in its folder.

    Args:
        loaded: the scenario, checked.
        folder: where results go.
        reporter: who is told of progress.
        stop: whether the user asked to stop.
    """

    loaded: LoadedScenario
    folder: Path
    reporter: Reporter = field(default_factory=Silent)
    stop: StopRequest = field(default_factory=StopRequest)
    history: dict[str, dict[str, Any]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    @classmethod
    def open(
        cls,
        file: Path,
        out: Path | None = None,
        overrides: Sequence[str] = (),
        reporter: Reporter | None = None,
    ) -> Run:
        """Read and check a scenario; nothing is run or written.

        Args:
            file: the scenario file.
            out: run folder; ``runs/<scenario name>`` if not given.
            overrides: ``key.path=value`` texts.
            reporter: who is told of progress.

        Raises:
            ScenarioError: everything that is wrong with the scenario.
        """
        loaded = load_scenario(file, overrides, inspect)
        return cls(loaded, out or Path("runs") / loaded.scenario.name, reporter or Silent())

    @property
    def scenario(self) -> Scenario:
        """The scenario."""
        return self.loaded.scenario

    @property
    def stages(self) -> Stages:
        """What was done in the run folder before."""
        return Stages(self.folder)

    @property
    def learn(self) -> AnyLearn:
        """The scenario's `learn` section.

        Raises:
            InputError: it has none.
        """
        if self.scenario.learn is None:
            file = self.loaded.file
            hint = (
                f"; `exlinn init {file}` writes a scenario with one" if file.suffix.lower() == ".fmu" else ""
            )
            raise InputError(f"{file}: this needs a `learn` section, and the scenario has none{hint}")
        return self.scenario.learn

    @property
    def seed(self) -> int:
        """The seed of learning."""
        return self.learn.seed if self.learn.seed is not None else self.scenario.seed

    def component(self, name: str) -> Component:
        """Make a component of the scenario."""
        return build(name, self.scenario, self.loaded.folder, self.folder)

    def files(self, *sections: object) -> list[Path]:
        """Files that sections of the scenario name: what results depend on beside the settings."""
        folder = self.loaded.folder
        return [folder / name for name in named_files(*sections, folder=folder)]

    def warn(self, text: str) -> None:
        """Tell the user, and the report, of something; once, however often it comes up."""
        if text not in self.warnings:
            self.warnings.append(text)
            self.reporter.note(f"warning: {text}")

    # ── the run folder ───────────────────────────────────────────────────────────────────────────────────

    def unchanged(self, stage: str, key: str, detail: str) -> bool:
        """Whether a stage need not run again; if it must, say so and lay the run folder."""
        if stage in self.history:
            return True  # done or found unchanged a moment ago
        if self.stages.holds(stage, key):
            self.reporter.stage(stage, "unchanged since the last run")
            self.noted(stage, "cached", None)
            return True
        self.reporter.stage(stage, detail)
        self.stages.forget(stage)
        write_text(self.folder / "scenario.yaml", self.loaded.text)
        return False

    def done(self, stage: str, key: str, written: Iterable[Path], began: float) -> None:
        """Record that a stage is done."""
        seconds = time.perf_counter() - began
        self.stages.record(stage, key, written, seconds)
        self.noted(stage, "ran", seconds)

    def failed(self, stage: str, error: ExlinnError) -> ExlinnError:
        """Record that a stage failed and why; gives the error back, to be raised."""
        self.noted(stage, "failed", None, error=str(error))
        return error

    def noted(self, stage: str, status: str, seconds: float | None, **more: Any) -> None:
        """Keep ``provenance.json`` up to date: where all that is in the folder came from."""
        from exlinn_fmi.results.tables import provenance, write_provenance

        self.history[stage] = {"status": status, "seconds": seconds}
        files = self.files(self.scenario)
        record = provenance(self.loaded.file, files, self.scenario.seed, self.history)
        write_provenance(self.folder, record | {"warnings": self.warnings} | more)

    def replace_metrics(self, prefixes: tuple[str, ...], new: Mapping[str, Any]) -> None:
        """Replace the metrics that begin with one of the prefixes."""
        kept = {name: value for name, value in metrics(self.folder).items() if not name.startswith(prefixes)}
        write_json(self.folder / "metrics.json", kept | dict(new))


def metrics(folder: Path) -> dict[str, Any]:
    """The metrics of a run folder by name, {} where there are none yet."""
    return read_record(folder / "metrics.json")

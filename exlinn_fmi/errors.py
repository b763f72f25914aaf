"""Every error that exlinn raises on purpose, and the exit code each one ends the command line with.

    ExlinnError
    ├─ InputError            exit 1: what the user gave is at fault
    │   ├─ ScenarioError     a scenario file: all its problems at once
    │   ├─ FmuError          an FMU file that cannot be used
    │   ├─ DataError         a data set or signal table that cannot be used
    │   └─ ModelError        a learned-model folder or model structure that cannot be used
    └─ RunError              exit 2: the run failed although the input was well formed
        ├─ ComponentError    a component reported an error or returned a value that is not finite
        ├─ LoopError         an algebraic loop between components could not be solved
        ├─ TrainingError     no usable model came out of training
        ├─ SolverError       an optimal control problem could not be set up or solved at all
        ├─ StorageError      a result could not be written
        └─ Interrupted       the user stopped the run

Anything else that reaches the command line is a bug of ours: exit 3.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


class ExlinnError(Exception):
    """Root of all errors raised on purpose; `exit_code` is what the command line ends with."""

    exit_code = 3


class InputError(ExlinnError):
    """What the user gave is at fault; the message says what, where, found, expected and what to do."""

    exit_code = 1


@dataclass(frozen=True)
class Problem:
    """One mistake in a scenario file.

    Args:
        path: key path, e.g. ``components.plant.fmu``.
        message: what is wrong, found versus expected, and what to do.
        line: line number in the file counted from 1, 0 where unknown.
    """

    path: str
    message: str
    line: int = 0


class ScenarioError(InputError):
    """A scenario file with one or more mistakes, all of them listed."""

    def __init__(self, file: str, problems: Sequence[Problem]) -> None:
        self.file = file
        self.problems = tuple(sorted(problems, key=lambda p: p.line))
        lines = [
            f"{file}{f':{p.line}' if p.line else ''}: {f'{p.path}: ' if p.path else ''}{p.message}"
            for p in self.problems
        ]
        if len(lines) > 1:
            lines.append(f"{len(lines)} problems found in {file}")
        super().__init__("\n".join(lines))


class FmuError(InputError):
    """An FMU file that cannot be used (missing, truncated, no binary for this platform, …)."""


class DataError(InputError):
    """A data set or signal table that cannot be used."""


class ModelError(InputError):
    """A learned-model folder or a model structure that cannot be used."""


class RunError(ExlinnError):
    """The run failed although the input was well formed."""

    exit_code = 2


class ComponentError(RunError):
    """A component reported an error or returned a value that is not finite.

    Args:
        component: name of the component in the scenario.
        message: what happened, in the component's own words where it has any.
        variable: the variable concerned, if one is.
        time: simulation time [s], if the simulation had begun.
    """

    def __init__(
        self, component: str, message: str, variable: str | None = None, time: float | None = None
    ) -> None:
        self.component, self.variable, self.time = component, variable, time
        where = f"{component}.{variable}" if variable else component
        when = f" at t = {time:.9g} s" if time is not None else ""
        super().__init__(f"{where}{when}: {message}")


class LoopError(RunError):
    """An algebraic loop between components could not be solved."""


class TrainingError(RunError):
    """No usable model came out of training."""


class SolverError(RunError):
    """An optimal control problem could not be set up or solved at all."""


class StorageError(RunError):
    """A result could not be written (disk full, no permission, …)."""


class Interrupted(RunError):  # noqa: N818 - the user's wish, not an error
    """The user stopped the run; what was finished until then is on disk."""


def nearest(name: str, known: Iterable[str], kind: str = "names") -> str:
    """A hint for an unknown name: what the user may have meant, or what there is.

    Args:
        name: the unknown name.
        known: all valid names.
        kind: what they are, in the plural.
    """
    names = list(dict.fromkeys(known))
    close = difflib.get_close_matches(name, names, n=3)
    if close:
        return f"did you mean {' or '.join(repr(c) for c in close)}?"
    if not names:
        return f"there are no {kind}"
    shown = ", ".join(names[:8]) + (f", … ({len(names)} in all)" if len(names) > 8 else "")
    return f"the {kind} are: {shown}"

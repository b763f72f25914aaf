"""FMUs driven by FMPy's raw classes, one thin layer above the C functions."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import fmpy
import fmpy.fmi2
import numpy as np
from numpy.typing import NDArray


class Instance:
    """One instance of an FMI 2.0 FMU; `log` holds what it said."""

    def __init__(
        self,
        fmu: Path,
        kind: str = "cs",
        name: str = "plant",
        guid: str | None = None,
        log: list[str] | None = None,
    ) -> None:
        self.description = fmpy.read_model_description(fmu)
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.folder = Path(fmpy.extract(str(fmu)))
        self.log: list[str] = [] if log is None else log
        cls = fmpy.fmi2.FMU2Slave if kind == "cs" else fmpy.fmi2.FMU2Model
        self.fmu = cls(
            guid=guid or self.description.guid,
            unzipDirectory=str(self.folder),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName=name,
        )
        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        # Only the logger is given: the FMU says that it needs no memory functions of the importer.
        self._logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(
            lambda _, name, status, category, message: self.log.append(message.decode())
        )
        callbacks.logger = self._logger
        self.callbacks = callbacks
        self.fmu.instantiate(callbacks=callbacks)

    def start(
        self, starts: Mapping[str, float] | None = None, t0: float = 0.0, stop: float | None = None
    ) -> None:
        """Initialise with start values."""
        self.fmu.setupExperiment(startTime=t0, stopTime=stop)
        for name, value in (starts or {}).items():
            self.set(name, value)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, name: str, value: float) -> None:
        self.fmu.setReal([self.references[name]], [value])

    def get(self, *names: str) -> list[float]:
        return list(self.fmu.getReal([self.references[n] for n in names]))

    def run(
        self, names: Sequence[str], h: float, inputs: Mapping[str, NDArray[np.float64]], first: int = 0
    ) -> NDArray[np.float64]:
        """Steps of h with inputs by step; the values of `names` after each step, shape (steps, names)."""
        driven = [self.references[n] for n in inputs]
        asked = [self.references[n] for n in names]
        columns = np.column_stack(list(inputs.values()))
        rows = []
        for k, row in enumerate(columns):
            self.fmu.setReal(driven, list(row))
            self.fmu.doStep((first + k) * h, h)
            rows.append(self.fmu.getReal(asked))
        return np.array(rows)

    def close(self) -> None:
        self.fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def instance(fmu: Path, kind: str = "cs", name: str = "plant") -> Iterator[Instance]:
    made = Instance(fmu, kind, name)
    try:
        yield made
    finally:
        made.close()

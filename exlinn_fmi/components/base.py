"""The component contract: what the co-simulation master knows of anything that is stepped in time.

An external FMU, a Python plant, a learned model, a signal source and an NMPC controller all look like
this, and like an FMU: variables addressed by index, values in numpy buffers, statuses returned.

Life of a component:

    enter_initialization(t0, t1, starts) → set/get … → exit_initialization() → [set, get, step]* → close()

`get` after `set` gives outputs that are up to date with the inputs at the present communication point
(direct feed-through, as FMI 2.0 §4.2.1); `step` carries the component from t to t + h with inputs held.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from exlinn_fmi.components.native import Native

Causality = Literal["parameter", "input", "output", "local", "independent"]
Variability = Literal["constant", "fixed", "tunable", "discrete", "continuous"]
VariableType = Literal["Real", "Integer", "Boolean", "Enumeration", "String", "Binary"]

TEXT_TYPES: tuple[VariableType, ...] = ("String", "Binary")
"""Types whose values are numbers that stand for texts, see `components.texts`."""

Number = float | int
"""A number; a whole one that float64 may not hold is an int, see `wide.exact`."""

Values = NDArray[np.float64]
Indices = NDArray[np.intp]


class Status(IntEnum):
    """Outcome of a call, numbered as in FMI: everything from DISCARD on stops the run."""

    OK = 0
    WARNING = 1
    DISCARD = 2
    ERROR = 3
    FATAL = 4


@dataclass(frozen=True)
class SiUnit:
    """A unit in terms of SI base units: value in SI = factor · value + offset (FMI 2.0 §2.2.2).

    Args:
        powers: exponents of kg, m, s, A, K, mol, cd, rad.
        factor: see above.
        offset: see above.
    """

    powers: tuple[int, int, int, int, int, int, int, int]
    factor: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Variable:
    """One variable of a component.

    Args:
        name: FMI structured name, unique within the component.
        causality: as in FMI.
        variability: as in FMI.
        unit: SI unit as text, None where the component states none, ``"1"`` for dimensionless.
        type: how the values are meant; all travel as float64 (booleans 0/1, integers rounded beyond 2⁵³,
            texts and binaries as numbers that `components.texts` gives them).
        start: start value, None where there is none.
        description: one line.
        depends_on: for an output, the inputs it depends on directly; None where the component does not say.
        min: least value that makes sense, None where the component states none.
        max: greatest value that makes sense, None where the component states none.
        si: what the unit is in SI base units, None where the component does not define it.
        wide: type of whole numbers of 64 bits, of which float64 does not hold all. What it lacks of the value
            of variable k, the *rest*, is set and got at index k + `len(variables)`, in one call with the
            value.
        clocked: whether it is an input that could be set at the ticks of its clock alone; it keeps its start.
    """

    name: str
    causality: Causality = "local"
    variability: Variability = "continuous"
    unit: str | None = None
    type: VariableType = "Real"
    start: Number | None = None
    description: str = ""
    depends_on: tuple[str, ...] | None = ()
    min: Number | None = None
    max: Number | None = None
    si: SiUnit | None = None
    wide: Literal["int64", "uint64"] | None = None
    clocked: bool = False


class Component(ABC):
    """Anything that the master can step.

    Attributes:
        name: name in the scenario.
        variables: all variables; an index into this tuple addresses one.
        message: what the component last said of a status other than OK.
        facts: what was decided for the user, by name: said in the log, and a metric of control.
        warnings: what the user should know before a run, e.g. of settings that do not fit together.
    """

    name: str
    variables: tuple[Variable, ...]
    message: str = ""
    facts: Mapping[str, str] = MappingProxyType({})
    warnings: Sequence[str] = ()

    @property
    def sampled(self) -> bool:
        """Whether outputs change at communication points only and hold in between (sources, controllers)."""
        return False

    @property
    def can_save_state(self) -> bool:
        """Whether `save_state` and `restore_state` work."""
        return False

    @abstractmethod
    def enter_initialization(
        self, start_time: float, stop_time: float, starts: Mapping[str, Number]
    ) -> Status:
        """Prepare for a run from `start_time` to `stop_time` [s] with start values by variable name.

        May be called again after a run: the component begins afresh.

        Raises:
            InputError: a name in `starts` is unknown or cannot be set.
        """

    @abstractmethod
    def exit_initialization(self) -> Status:
        """End initialisation: start values and initial inputs are in force."""

    @abstractmethod
    def set(self, indices: Indices, values: Values) -> Status:
        """Set the variables at `indices` (k,) to `values` (k,)."""

    @abstractmethod
    def get(self, indices: Indices, values: Values) -> Status:
        """Write the variables at `indices` (k,) into `values` (k,)."""

    @abstractmethod
    def step(self, t: float, h: float) -> Status:
        """Advance from t to t + h [s] with the inputs held."""

    def save_state(self) -> object:
        """A copy of the whole state, to be given to `restore_state`."""
        raise NotImplementedError(f"{self.name} cannot save its state; ask can_save_state first")

    def restore_state(self, state: object) -> None:
        """Go back to a state that `save_state` returned."""
        raise NotImplementedError(f"{self.name} cannot restore its state; ask can_save_state first")

    @property
    def can_serialize_state(self) -> bool:
        """Whether `serialize_state` and `deserialize_state` work."""
        return False

    def serialize_state(self, state: object) -> bytes:
        """A state that `save_state` returned, as bytes that another process can go on from.

        Raises:
            NotImplementedError: it cannot be done for what is in this one; the text says why.
        """
        raise NotImplementedError(f"{self.name} cannot serialize its state; ask can_serialize_state first")

    def deserialize_state(self, data: bytes) -> object:
        """A state for `restore_state`, from bytes that `serialize_state` gave in a run begun alike."""
        raise NotImplementedError(f"{self.name} cannot deserialize a state; ask can_serialize_state first")

    @property
    def gives_directional_derivatives(self) -> bool:
        """Whether `directional_derivative` works."""
        return False

    def directional_derivative(self, unknowns: Indices, knowns: Indices, seed: Values) -> Values:
        """∂(unknowns)/∂(knowns) · seed at the present point: outputs (n,) along a direction (k,)."""
        raise NotImplementedError(f"{self.name} has none; ask gives_directional_derivatives first")

    @property
    def takes_input_derivatives(self) -> bool:
        """Whether `set_input_derivatives` works."""
        return False

    def set_input_derivatives(self, indices: Indices, derivatives: Values) -> Status:
        """Let continuous inputs (k,) change by `derivatives` [unit/s] over the next step."""
        raise NotImplementedError(f"{self.name} takes none; ask takes_input_derivatives first")

    def native(self) -> Native | None:
        """The C functions behind `set`, `get` and `step`, for compiled stepping; None where there are none.

        Asked once initialisation is over; what is returned holds until the component is closed or a state is
        saved. Calling them has the effect of `set`, `get` and `step` to the last bit.
        """
        return None

    def outputs_over(self, indices: Indices, times: Values) -> Values | None:
        """Variables at `indices` (k,) at `times` (n,) [s] as (n, k), where they depend on nothing but time.

        None where they do: the component is set, read and stepped.
        """
        return None

    @abstractmethod
    def close(self) -> None:
        """Free everything the component holds; harmless when called twice."""

    def index(self, name: str) -> int:
        """Index of the variable of that name.

        Raises:
            KeyError: there is none.
        """
        for k, variable in enumerate(self.variables):
            if variable.name == name:
                return k
        raise KeyError(name)

    def indices(self, *causalities: Causality) -> Indices:
        """Indices of all variables of these causalities."""
        return np.array(
            [k for k, v in enumerate(self.variables) if v.causality in causalities], dtype=np.intp
        )

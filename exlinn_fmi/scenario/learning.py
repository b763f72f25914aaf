"""The vocabulary of learning: coordinates, experiments or measured files, learners, parameters, design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from exlinn_fmi.mechanics.coordinates import Coordinate, Kind, Topology
from exlinn_fmi.mechanics.structure import Coupling, Friction, Structure
from exlinn_fmi.scenario.signals import Signal
from exlinn_fmi.scenario.spec import (
    Band,
    Bounds,
    Name,
    NonNegative,
    Positive,
    Spec,
    StartValue,
    VariablePath,
    form,
    telling_key,
)

STRUCTURE = {"friction", "offset"}
"""Keys of a coordinate that tell how it is learned, not what is measured."""


class CoordinateSpec(Spec):
    """A generalised coordinate of the model to learn."""

    name: Name = Field(description="name of q")
    unit: str = Field(description="unit of q, e.g. rad")
    kind: Kind = Field("mechanical", description="mechanical or electrical")
    topology: Topology = Field(
        "line",
        description="line; circle (an angle: the model is periodic in it); cyclic (a charge: no influence)",
    )
    velocity_unit: str = Field("", description="unit of q̇; <unit>/s if not given")
    input_unit: str = Field("", description="unit of the input")
    friction: list[Friction] | None = Field(
        None,
        description="kinds of friction that act on q̇, [] for none; if not given, any that grows with speed",
    )
    offset: bool = Field(
        False, description="whether a constant force of unknown size acts on q beside the input"
    )


class PlantCoordinate(CoordinateSpec):
    """A generalised coordinate of the model to learn, and the plant variables that carry it."""

    position: VariablePath | None = Field(
        None, description="plant variable that is q; not needed where cyclic"
    )
    velocity: VariablePath = Field(description="plant variable that is q̇")
    acceleration: VariablePath | None = Field(
        None, description="plant variable that is q̈; estimated from the velocity if not given"
    )
    input: VariablePath | None = Field(None, description="plant input that acts on q; none if not given")

    def coordinate(self) -> Coordinate:
        """The coordinate with the names of its plant variables, less the component's name."""

        def short(path: str | None) -> str | None:
            return None if path is None else path.split(".", 1)[1]

        return Coordinate(
            name=short(self.position) or self.name,
            unit=self.unit,
            kind=self.kind,
            topology=self.topology,
            velocity=short(self.velocity) or "",
            velocity_unit=self.velocity_unit,
            acceleration=short(self.acceleration) or "",
            input=short(self.input),
            input_unit=self.input_unit,
        )


class DataCoordinate(CoordinateSpec):
    """A generalised coordinate of the model to learn from data; `data.columns` tells its columns."""

    velocity: Name | None = Field(None, description="name of q̇; <name>_dot if not given")
    acceleration: Name | None = Field(None, description="name of q̈; <velocity>_dot if not given")
    input: Name | None = Field(None, description="name of the input that acts on q; none if not given")

    def coordinate(self) -> Coordinate:
        """The coordinate by the names of its quantities."""
        return Coordinate(**self.model_dump(exclude_none=True, exclude=STRUCTURE))


class Experiment(Spec):
    """One run of the plant under given inputs."""

    duration: Positive = Field(description="duration [s]")
    step: Positive = Field(1e-3, description="sampling step [s]")
    inputs: dict[VariablePath, Signal] = Field(description="signal for each driven plant input")
    start: dict[str, StartValue] = Field(default_factory=dict, description="start values of plant variables")


class Column(Spec):
    """A column of the data files: scale · number + offset, in `unit`."""

    column: str = Field(description="name of the column in the files")
    scale: float = Field(1.0, description="factor; -1 where the sensor counts the other way")
    offset: float = Field(0.0, description="added after scaling")
    unit: str | None = Field(
        None, description="unit after that, e.g. deg; converted to the model's, which it is if not given"
    )


ColumnName = Annotated[Annotated[str, Tag("text")] | Annotated[Column, Tag("a mapping")], Discriminator(form)]


class Resample(Spec):
    """How measured data get to a regular grid."""

    step: Positive = Field(description="step of the grid [s]; where coarser than the data they are smoothed")
    interpolation: Literal["cubic", "linear"] = Field(
        "cubic", description="how positions, velocities and accelerations go between rows"
    )
    inputs: Literal["linear", "hold"] = Field(
        "linear", description="how inputs do; `hold` where a digital controller set and logged them"
    )


class LowPass(Spec):
    """Zero-phase Butterworth filter, forwards and backwards over all columns."""

    type: Literal["low-pass"]
    cutoff: Positive = Field(description="frequency where the gain is one half [Hz]")
    order: int = Field(4, ge=1, le=12, description="order, before it is run twice")


class Measured(Spec):
    """Measured data: CSV or Parquet files, each the recording of one run."""

    files: list[str] = Field(min_length=1, description="files, relative to the scenario")
    test: list[str] = Field(default_factory=list, description="files that training never sees")
    hold_out: int = Field(
        0, ge=0, description="instead of `test`: this many of `files`, drawn by seed, are kept for the test"
    )
    time: ColumnName | None = Field(None, description="column of the time [s]; `time` if not given")
    step: Positive | None = Field(None, description="instead of `time`: step from row to row [s]")
    columns: dict[Name, ColumnName] = Field(
        default_factory=dict,
        description="column by name of the quantity in the model; the same name where not given",
    )
    resample: (
        Annotated[
            Annotated[Positive, Tag("a number")] | Annotated[Resample, Tag("a mapping")], Discriminator(form)
        ]
        | None
    ) = Field(None, description="to a regular grid of this step [s]; left as it is if not given")
    filter: LowPass | None = Field(None, description="take out noise above the frequencies that matter")
    delimiter: str | None = Field(
        None, description="between the cells of CSV files, e.g. ';'; found out if not given"
    )
    decimal: Literal[".", ","] | None = Field(
        None, description="decimal mark of CSV files; found out if not given"
    )


Optimiser = Literal["levenberg-marquardt", "l-bfgs"]


class Structured(Spec):
    """The default learner: M(q) ≻ 0, A(q), V(q), convex D by construction."""

    preset: Literal["structured"]
    hidden: int = Field(8, ge=1, le=512, description="units of the hidden layer of each network")
    optimiser: Optimiser | Literal["auto"] = Field(
        "auto",
        description="`levenberg-marquardt`, which gets furthest; `l-bfgs` for thousands of weights, where "
        "that takes too much time and memory; `auto`: by the number of weights",
    )
    iterations: int = Field(
        300, ge=1, description="most iterations of Levenberg–Marquardt; rounds of 20 iterations of L-BFGS"
    )
    target: NonNegative = Field(1e-20, description="stop when the scaled training loss is below this")
    regularisation: NonNegative = Field(1e-24, description="λ of the L2 term")


class Terms(Spec):
    """A sum of terms, found among generic ones: least squares, or maximum likelihood where data are noisy."""

    preset: Literal["terms"]
    lagrangian: list[str] = Field(
        default_factory=list,
        description="candidates for 𝓛, monomials; from the coordinates' topology if none are given",
    )
    dissipation: list[str] = Field(
        default_factory=list, description="candidates for D; none are used where only those for 𝓛 are given"
    )
    shapes: dict[str, float] = Field(
        default_factory=dict,
        description="parameters inside functions of the candidates and where they are looked for",
    )
    known: dict[str, float] = Field(
        default_factory=dict, description="candidates whose coefficients are known and held"
    )


class Paper(Spec):
    """The paper's learner: feature functions into one hidden layer of ReLU units each, Adam."""

    preset: Literal["paper"]
    lagrangian_features: list[str] = Field(
        min_length=1,
        description="monomials for 𝓛 in names of positions and velocities, e.g. 'sin(alpha)^2*alpha_dot^2'",
    )
    dissipation_features: list[str] = Field(
        min_length=1, description="monomials for D in names of velocities"
    )
    hidden: int = Field(4, ge=1, description="ReLU units of each network")
    learning_rate: Positive = Field(1e-3, description="Adam's step size")
    weight_decay: NonNegative = Field(1e-5, description="λ of the L2 term")
    epochs: int = Field(20, ge=1, description="passes over the training data")
    batch: int = Field(8, ge=1, description="samples in a batch (the paper does not say)")


Objective = Literal["auto", "inverse", "weak", "trajectory"]


class Identify(Spec):
    """Read physical parameters off the learned model: 𝓛 = Σ p·φ(q, q̇), D = Σ p·ψ(q̇) with these monomials.

    A name is a parameter of the plant or a product of some, e.g. `m_c*d^2`; where the plant states their
    values the report gives the relative error.
    """

    lagrangian: dict[str, str] = Field(
        default_factory=dict, description="parameter: monomial of 𝓛, e.g. j_m: 0.5*alpha_dot^2"
    )
    dissipation: dict[str, str] = Field(
        default_factory=dict, description="parameter: monomial of D, e.g. r: 0.5*i^2"
    )
    shapes: dict[str, float] = Field(
        default_factory=dict,
        description="parameters inside functions and where they are looked for, e.g. s: 0.1 for "
        "tau_c: s*logcosh(phi_dot/s)",
    )
    known: dict[str, float] = Field(
        default_factory=dict, description="values of parameters that are known and held, e.g. l: 0.02"
    )

    @property
    def names(self) -> list[str]:
        """All parameters, those of 𝓛 first, shapes last."""
        return [*self.lagrangian, *self.dissipation, *self.shapes]


class EnergiesSpec(Spec):
    """Energies that the plant has; what is left out here, the model has not either."""

    potential: bool = Field(True, description="whether mechanical positions store energy: gravity, springs")
    coupling: Coupling = Field(
        "any",
        description="between mechanical and electrical coordinates: `magnetic` (inductance L(x), flux), "
        "`electric` (capacitance C(x)), `none`; `any` where that is not known",
    )


class Learn(Spec):
    """What the learning of a model takes, wherever the data come from."""

    coordinates: Sequence[CoordinateSpec]

    train_fraction: float = Field(
        0.8, gt=0, lt=1, description="share of the training data to fit; the rest validates"
    )
    split_blocks: int = Field(10, ge=1, description="time blocks that the split draws from")
    method: Annotated[Structured | Terms | Paper, Field(discriminator="preset")] = Field(
        default_factory=lambda: Structured(preset="structured"), description="the learner"
    )
    objective: Objective = Field(
        "auto",
        description="what `structured`, `terms` and `identify` make small: `inverse`: errors of forces, "
        "which takes accelerations; `weak`: those against test functions, without accelerations; "
        "`trajectory`: errors of predicted states, best under noise; `auto`: as the noise calls for",
    )
    energies: EnergiesSpec = Field(
        default_factory=lambda: EnergiesSpec(), description="energies that the plant has, as far as known"
    )
    identify: Identify = Field(
        default_factory=lambda: Identify(), description="physical parameters to read off"
    )
    seed: int | None = Field(None, ge=0, description="seed of split and weights; the scenario's if not given")

    @property
    def structure(self) -> Structure:
        """What is known of the plant before it is learned."""
        return Structure(
            self.energies.potential,
            self.energies.coupling,
            tuple(None if c.friction is None else tuple(c.friction) for c in self.coordinates),
            tuple(c.offset for c in self.coordinates),
        )


class Noise(Spec):
    """Noise of a sensor in the unit of what it measures."""

    std: Positive = Field(description="standard deviation")


NoiseLevel = Annotated[
    Annotated[Positive, Tag("a number")] | Annotated[Noise, Tag("a mapping")], Discriminator(form)
]


Sensors = Annotated[
    Annotated[Positive, Tag("a number")] | Annotated[dict[str, NoiseLevel], Tag("a mapping")],
    Discriminator(form),
]


class Limits(Spec):
    """What an experiment must not exceed."""

    inputs: dict[str, Bounds] = Field(
        default_factory=dict,
        description="bounds on inputs, by name; the range of the present training where not given",
    )
    states: dict[str, Bounds] = Field(default_factory=dict, description="bounds on states, by name")


class Design(Spec):
    """What `exlinn design` counts on when it looks for a better excitation."""

    noise: Sensors = Field(
        0.01,
        description="noise of the measured states: a share of each signal's standard deviation in the "
        "present training, or by name a share or {std: …}; those not named are not measured",
    )
    limits: Limits = Field(
        default_factory=lambda: Limits(), description="what the experiment must not exceed"
    )
    duration: Positive | None = Field(
        None, description="duration of the experiment [s]; that of the present training if not given"
    )
    band: Band | None = Field(
        None, description="frequencies that may be used [Hz]; from the model if not given"
    )
    candidates: int = Field(200, ge=10, le=100_000, description="multisines that are tried before refining")
    model: str | None = Field(
        None,
        description="`learned`, `plant:NAME` or a folder with model.json; if not given the plant itself "
        "where it is one of ours, else what `exlinn train` learned",
    )


class LearnFromPlant(Learn):
    """Collect data from a plant and train an extended Lagrangian model on it."""

    plant: Name = Field(description="component to learn")
    coordinates: list[PlantCoordinate] = Field(min_length=1, description="the generalised coordinates")
    training: list[Experiment] = Field(min_length=1, description="experiments to train on")
    test: list[Experiment] = Field(default_factory=list, description="experiments that training never sees")
    design: Design = Field(
        default_factory=lambda: Design(), description="for `exlinn design`: sensors and limits"
    )


class LearnFromData(Learn):
    """Train an extended Lagrangian model on measured data."""

    data: Measured = Field(description="files, and which of their columns is what")
    coordinates: list[DataCoordinate] = Field(min_length=1, description="the generalised coordinates")


LEARN_KEYS: Mapping[str, type[Spec]] = {"plant": LearnFromPlant, "data": LearnFromData}
"""The key that tells what is learned from, and the section it makes."""


def learn_kind(value: Any) -> str | None:
    """Which key of `LEARN_KEYS` a `learn` section has."""
    return telling_key(value, LEARN_KEYS)


AnyLearn = Annotated[
    Annotated[LearnFromPlant, Tag("plant")] | Annotated[LearnFromData, Tag("data")],
    Discriminator(learn_kind),
]

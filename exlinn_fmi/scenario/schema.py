"""The vocabulary of scenario files: every key, its meaning, its default and its bounds.

The other parts take these models as their options (`learn` a `Learn`, `control` an `Nmpc`, …), so that each
setting is written down once. The JSON Schema that editors use is generated from here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag

from exlinn_fmi.mechanics.coordinates import Coordinate, Kind, Topology


class Spec(BaseModel):
    """Base of all scenario sections: unknown keys are mistakes, values are never converted silently."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def form(value: Any) -> str:
    """What a value is, in the words of error texts; tells the forms apart that a setting may have."""
    if isinstance(value, bool):
        return "true or false"
    names = {
        int: "a number",
        float: "a number",
        str: "text",
        list: "a list",
        tuple: "a list",
        dict: "a mapping",
        Spec: "a mapping",
    }
    return next((name for kind, name in names.items() if isinstance(value, kind)), "nothing")


Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Band = Annotated[tuple[Positive, Positive], Field(strict=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
VariablePath = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*\..+$", examples=["plant.alpha"])]
StartValue = Annotated[
    Annotated[float, Tag("a number")] | Annotated[bool, Tag("true or false")], Discriminator(form)
]

# ── signals ──────────────────────────────────────────────────────────────────────────────────────────────


class Constant(Spec):
    """A constant value."""

    signal: Literal["constant"]
    value: float = Field(description="the value, at all times")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Step(Spec):
    """`before` until t = `time`, `after` from then on."""

    signal: Literal["step"]
    time: float = Field(description="time of the step [s]")
    before: float = Field(0.0, description="value before")
    after: float = Field(1.0, description="value from `time` on")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Ramp(Spec):
    """`offset`, then a straight line of `slope` from `start` until `stop`, then held."""

    signal: Literal["ramp"]
    slope: float = Field(description="slope [unit/s]")
    start: float = Field(0.0, description="where the ramp begins [s]")
    stop: float | None = Field(
        None, description="where it ends and the value is held [s]; never if not given"
    )
    offset: float = Field(0.0, description="value before the ramp")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Sine(Spec):
    """offset + amplitude · sin(2π · frequency · t + phase)."""

    signal: Literal["sine"]
    amplitude: float = Field(description="amplitude")
    frequency: Positive = Field(description="frequency [Hz]")
    phase: float = Field(0.0, description="phase [rad]")
    offset: float = Field(0.0, description="mean")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Multisine(Spec):
    """A sum of sines, equally spaced in a band, with random phases (Schroeder's problem, by seed)."""

    signal: Literal["multisine"]
    rms: Positive = Field(description="root mean square of the oscillating part")
    band: Band = Field(description="lowest and highest frequency [Hz]")
    lines: int = Field(20, ge=1, le=10_000, description="number of sines")
    offset: float = Field(0.0, description="mean")
    seed: int = Field(0, ge=0, description="seed of the phases")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Chirp(Spec):
    """A sine whose frequency sweeps a band over a duration, then starts again."""

    signal: Literal["chirp"]
    amplitude: float = Field(description="amplitude")
    band: Band = Field(description="first and last frequency [Hz]")
    duration: Positive = Field(description="duration of a sweep [s]")
    method: Literal["linear", "logarithmic"] = Field("linear", description="how the frequency moves")
    offset: float = Field(0.0, description="mean")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Prbs(Spec):
    """Pseudo-random binary sequence: offset ± amplitude, maximum-length, by seed."""

    signal: Literal["prbs"]
    amplitude: float = Field(description="half the distance of the two levels")
    hold: Positive = Field(description="shortest time between two changes [s]")
    order: int = Field(10, ge=3, le=20, description="register length; period (2^order − 1) · hold")
    offset: float = Field(0.0, description="mean of the two levels")
    seed: int = Field(0, ge=0, description="seed of the first register content")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


class Table(Spec):
    """Values from a column of a CSV file that has a column `time` [s]."""

    signal: Literal["table"]
    file: str = Field(description="CSV file, relative to the scenario")
    column: str = Field(description="name of the column")
    interpolation: Literal["linear", "hold"] = Field("linear", description="between rows")
    outside: Literal["hold", "error"] = Field("hold", description="before the first and after the last row")
    unit: str | None = Field(None, description="unit of the signal, e.g. V")


Signal = Annotated[
    Constant | Step | Ramp | Sine | Multisine | Chirp | Prbs | Table, Field(discriminator="signal")
]

# ── controller ───────────────────────────────────────────────────────────────────────────────────────────


class Bounds(Spec):
    """Lower and upper bound of a variable; leave one out where there is none."""

    min: float | None = Field(None, description="lower bound")
    max: float | None = Field(None, description="upper bound")


class ScotchYoke(Spec):
    """Position of a cart driven through a scotch yoke, x = crank · cos(coordinate)."""

    map: Literal["scotch_yoke"]
    crank: Positive = Field(description="crank radius d [m]; the stroke is ± d")
    margin: NonNegative = Field(
        1e-3,
        lt=1,
        description="share of the stroke kept free at both ends, where x = d cos α cannot be inverted",
    )


class Linear(Spec):
    """A quantity proportional to the coordinate, y = gain · coordinate + offset (a gear, a spindle)."""

    map: Literal["linear"]
    gain: float = Field(1.0, description="gain")
    offset: float = Field(0.0, description="offset")


class Reference(Spec):
    """What the controller follows: a signal for one quantity, and how that hangs on a coordinate."""

    coordinate: str = Field(description="position or velocity of the model that follows the reference")
    trajectory: Signal = Field(description="the reference over time")
    through: Annotated[ScotchYoke | Linear, Field(discriminator="map")] | None = Field(
        None,
        description="kinematics between the trajectory's quantity and the coordinate; the same if not given",
    )


Weight = Annotated[
    Annotated[NonNegative, Tag("a number")] | Annotated[dict[str, NonNegative], Tag("a mapping")],
    Discriminator(form),
]


class Weights(Spec):
    """Weights of the cost: a number, or one by name (those not named weigh 0)."""

    states: Weight = Field(10.0, description="Q, on x_ref − x; a number weighs the referenced state alone")
    inputs: Weight = Field(
        1e-3, description="R, on u, or on u − u_ref for tracking; a number weighs all inputs"
    )
    terminal: Annotated[
        Annotated[Literal["dare"], Tag("text")] | Annotated[NonNegative, Tag("a number")], Discriminator(form)
    ] = Field("dare", description="terminal cost: the Riccati solution at the reference, or a multiple of Q")


class Nmpc(Spec):
    """Nonlinear model predictive control around a learned model: eqs. (13), (14), Algorithm 1."""

    model: str = Field(
        "learned",
        description="`learned`: what this scenario's `learn` trains; `plant:NAME`: a plant of ours; "
        "else a folder with model.json",
    )
    reference: Reference = Field(description="what to follow")
    horizon: int = Field(30, ge=1, le=10_000, description="N_p, number of intervals")
    cost: Literal["tracking", "paper"] = Field(
        "tracking",
        description="`tracking`: states and inputs against a reference trajectory that the model can follow; "
        "`paper`: Σ‖x_ref−x‖²_Q + ‖u‖²_R, eq. (13)",
    )
    weights: Weights = Field(default_factory=lambda: Weights(), description="Q, R and the terminal cost")
    inputs: dict[str, Bounds] = Field(default_factory=dict, description="bounds on inputs, by name")
    states: dict[str, Bounds] = Field(
        default_factory=dict, description="bounds on states, by name (softened)"
    )
    solver: Literal["rti", "sqp", "ipopt"] = Field(
        "rti", description="`rti`: one QP a step; `sqp`: until converged; `ipopt`: interior point"
    )
    iterations: int = Field(50, ge=1, description="most iterations of `sqp` and `ipopt`")
    tolerance: Positive = Field(1e-8, description="KKT tolerance of `sqp` and `ipopt`")
    substeps: int = Field(1, ge=1, le=100, description="RK4 steps in one interval")
    safe_input: dict[str, float] = Field(
        default_factory=dict,
        description="input to fall back to when there is no plan left, by name; 0 if not given",
    )


# ── components ───────────────────────────────────────────────────────────────────────────────────────────


class ComponentBase(Spec):
    """What every component may say."""

    step: Positive | None = Field(
        None, description="own communication step [s]: a multiple of the scenario's; that one if not given"
    )
    start: dict[str, StartValue] = Field(
        default_factory=dict, description="start values of parameters, inputs and states, by variable name"
    )


class FmuComponent(ComponentBase):
    """A Functional Mock-up Unit, FMI 2.0 or 3.0 Co-Simulation."""

    fmu: str = Field(description="the .fmu file, relative to the scenario")


class PlantComponent(ComponentBase):
    """One of the plants that come with exlinn, run in this process."""

    plant: str = Field(description="name of the plant, e.g. dc_motor_cart")


class PythonComponentSpec(ComponentBase):
    """Your own class: a `PythonComponent`, found as `module:Class` beside the scenario or installed."""

    python: str = Field(pattern=r"^[\w.]+:\w+$", description="module:Class")
    options: dict[str, Any] = Field(default_factory=dict, description="keyword arguments of the class")


class SignalComponent(ComponentBase):
    """A signal source with one output, `y`."""

    source: Signal = Field(description="the signal")


class ModelComponent(ComponentBase):
    """A learned model, run as if it were the plant."""

    model: str = Field(
        description="`learned`: what this scenario's `learn` trains; else a folder with model.json"
    )


class NmpcComponent(ComponentBase):
    """The controller: inputs are the model's states, outputs its inputs."""

    nmpc: Nmpc = Field(description="the controller's settings")


COMPONENT_KEYS: Mapping[str, type[Spec]] = {
    "fmu": FmuComponent,
    "plant": PlantComponent,
    "python": PythonComponentSpec,
    "source": SignalComponent,
    "model": ModelComponent,
    "nmpc": NmpcComponent,
}
"""The key that tells what a component is, and the section it makes."""


def telling_key(value: Any, keys: Iterable[str]) -> str | None:
    """Which of several keys, one of which tells what a section is, a section has."""
    found = value if isinstance(value, dict) else getattr(value, "model_fields_set", ())
    return next((key for key in keys if key in found), None)


def component_kind(value: Any) -> str | None:
    """Which key of `COMPONENT_KEYS` a component has."""
    return telling_key(value, COMPONENT_KEYS)


ComponentSpec = Annotated[
    Annotated[FmuComponent, Tag("fmu")]
    | Annotated[PlantComponent, Tag("plant")]
    | Annotated[PythonComponentSpec, Tag("python")]
    | Annotated[SignalComponent, Tag("source")]
    | Annotated[ModelComponent, Tag("model")]
    | Annotated[NmpcComponent, Tag("nmpc")],
    Discriminator(component_kind),
]

# ── learning ─────────────────────────────────────────────────────────────────────────────────────────────


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
        return Coordinate(**self.model_dump(exclude_none=True))


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


class Structured(Spec):
    """The default learner: M(q) ≻ 0, A(q), V(q), convex D by construction; Levenberg–Marquardt."""

    preset: Literal["structured"]
    hidden: int = Field(8, ge=1, le=512, description="units of the hidden layer of each network")
    iterations: int = Field(300, ge=1, description="most Levenberg–Marquardt iterations")
    target: NonNegative = Field(1e-20, description="stop when the scaled training loss is below this")
    regularisation: NonNegative = Field(1e-16, description="λ of the L2 term")


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

    @property
    def names(self) -> list[str]:
        """All parameters, those of 𝓛 first."""
        return [*self.lagrangian, *self.dissipation]


class Learn(Spec):
    """What the learning of a model takes, wherever the data come from."""

    train_fraction: float = Field(
        0.8, gt=0, lt=1, description="share of the training data to fit; the rest validates"
    )
    split_blocks: int = Field(10, ge=1, description="time blocks that the split draws from")
    method: Annotated[Structured | Terms | Paper, Field(discriminator="preset")] = Field(
        default_factory=lambda: Structured(preset="structured"), description="the learner"
    )
    objective: Objective = Field(
        "auto",
        description="what `terms` and `identify` make small: `inverse`: errors of forces, which takes "
        "accelerations; `weak`: those against test functions, without accelerations; `trajectory`: errors of "
        "predicted states, best under noise; `auto`: as the noise calls for",
    )
    identify: Identify = Field(
        default_factory=lambda: Identify(), description="physical parameters to read off"
    )
    seed: int | None = Field(None, ge=0, description="seed of split and weights; the scenario's if not given")


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


# ── the scenario ─────────────────────────────────────────────────────────────────────────────────────────


class Simulate(Spec):
    """Run the connected components in co-simulation."""

    start: float = Field(0.0, description="start time [s]")
    stop: float = Field(description="stop time [s]")
    step: Positive = Field(1e-3, description="communication step [s]")
    algorithm: Literal["jacobi", "gauss-seidel"] = Field("jacobi", description="master algorithm")
    record: list[str] = Field(
        default_factory=lambda: ["*"],
        description="variables to record, with wildcards; inputs and outputs of all by default",
    )


class Metrics(Spec):
    """How the closed loop is judged."""

    settle: NonNegative = Field(0.0, description="time at the start that the errors leave out [s]")
    output: VariablePath | None = Field(
        None, description="recorded variable that is compared with the reference's quantity"
    )


Targets = Annotated[
    Annotated[VariablePath, Tag("text")] | Annotated[list[VariablePath], Tag("a list")], Discriminator(form)
]


class Scenario(Spec):
    """One experiment: components, how they are connected, and what is done with them."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9_.-]+$", description="name of the scenario and of its result folder"
    )
    description: str = Field("", description="what it shows")
    seed: int = Field(0, ge=0, description="seed of everything random")
    components: dict[Name, ComponentSpec] = Field(
        default_factory=dict, description="what takes part, by name"
    )
    connections: dict[VariablePath, Targets] = Field(
        default_factory=dict, description="from: to, or from: [to, to], each component.variable"
    )
    learn: AnyLearn | None = Field(None, description="learn a model of one component, or of measured data")
    simulate: Simulate | None = Field(None, description="run the components together")
    metrics: Metrics = Field(default_factory=lambda: Metrics(), description="how the closed loop is judged")

    def connection_list(self) -> list[tuple[str, str]]:
        """All connections as (from, to)."""
        return [
            (source, target)
            for source, targets in self.connections.items()
            for target in (targets if isinstance(targets, list) else [targets])
        ]

"""The vocabulary of the controller: reference, cost, bounds and solver of an NMPC."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from pydantic import Discriminator, Field, Tag

from exlinn_fmi.scenario.signals import Signal
from exlinn_fmi.scenario.spec import Bounds, NonNegative, Positive, Spec, form


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

    states: Weight | None = Field(
        None,
        description="Q, on x_ref − x; a number weighs the referenced states alone; if not given, from how "
        "far the inputs move them within the model's slowest response; 10 with `cost: paper`",
    )
    inputs: Weight | None = Field(
        None,
        description="R, on u, or on u − u_ref for tracking; a number weighs all inputs; if not given, each "
        "weighs one at half of its range; 1e-3 with `cost: paper`",
    )
    terminal: Annotated[
        Annotated[Literal["dare"], Tag("text")] | Annotated[NonNegative, Tag("a number")], Discriminator(form)
    ] = Field("dare", description="terminal cost: the Riccati solution at the reference, or a multiple of Q")


class TerminalSet(Spec):
    """Set about the reference in which plans should end, by a heavier terminal cost (Limon et al. 2006)."""

    weight: float = Field(10.0, ge=1, description="λ, what the terminal cost is multiplied by")


Disturbances = Annotated[
    Annotated[list[str], Tag("a list")] | Annotated[dict[str, Positive], Tag("a mapping")],
    Discriminator(form),
]
EstimatorKind = Literal["auto", "none", "ekf", "mhe"]


class Estimator(Spec):
    """How states that are not measured, and disturbances, are found from those that are."""

    type: EstimatorKind = Field(
        "auto",
        description="`ekf`: extended Kalman filter; `mhe`: moving horizon; `none`: states are as measured; "
        "`auto`: `ekf` where a state of the model is not connected, else `none`",
    )
    measured: list[str] | None = Field(
        None, min_length=1, description="states that are measured; those that are connected if not given"
    )
    noise: Weight | None = Field(
        None,
        description="standard deviation of the measurements by state, or as a share of each state's size; "
        "a ten-thousandth of its size where not given",
    )
    process: dict[str, NonNegative] = Field(
        default_factory=dict,
        description="by state, what changes it beside the model: standard deviation over √s",
    )
    disturbances: Disturbances | None = Field(
        None,
        description="coordinates on which an unknown constant force is estimated, so that it leaves no "
        "offset; by name with its change: standard deviation over √s. As many as the measurements tell "
        "apart if not given; [] for none",
    )
    gain: Literal["updated", "steady"] = Field(
        "updated", description="gain of `ekf`: of each sample, or that of the steady state at the reference"
    )
    window: int = Field(10, ge=1, le=1000, description="samples that `mhe` looks back")
    iterations: int = Field(2, ge=1, le=100, description="Gauss–Newton steps of `mhe` at each sample")


class Dropout(Spec):
    """What counts as a lost measurement, and for how long the model's prediction stands in for it."""

    stale: int | None = Field(
        None,
        ge=1,
        description="a measurement that has come again to the last bit so many times counts as missing while "
        "the model expects a change beyond its noise: for sensors that hold their last value; else never",
    )
    timeout: Positive | None = Field(
        None,
        description="`safe_input` is applied while a measurement has been missing for longer than this [s]; "
        "predicted for as long as it takes if not given",
    )


class Nmpc(Spec):
    """Nonlinear model predictive control around a learned model: eqs. (13), (14), Algorithm 1."""

    model: str = Field(
        "learned",
        description="`learned`: what this scenario's `learn` trains; `plant:NAME`: a plant of ours; "
        "else a folder with model.json",
    )
    reference: Annotated[
        Annotated[Reference, Tag("a mapping")] | Annotated[list[Reference], Tag("a list"), Len(1)],
        Discriminator(form),
    ] = Field(description="what to follow; a list for several coordinates")
    horizon: int | None = Field(
        None,
        ge=1,
        le=10_000,
        description="N_p, number of intervals; if not given, one and a half of the model's slowest response",
    )
    cost: Literal["tracking", "paper"] = Field(
        "tracking",
        description="`tracking`: states and inputs against a reference trajectory that the model can follow; "
        "`paper`: Σ‖x_ref−x‖²_Q + ‖u‖²_R, eq. (13)",
    )
    weights: Weights = Field(default_factory=lambda: Weights(), description="Q, R and the terminal cost")
    terminal_set: TerminalSet | None = Field(
        None,
        description="plans should end where the linear feedback of the Riccati equation keeps all bounds: "
        "`{}` or `{weight: 10}`; for short horizons. Needs `cost: tracking` and `weights.terminal: dare`",
    )
    inputs: dict[str, Bounds] = Field(default_factory=dict, description="bounds on inputs, by name")
    states: dict[str, Bounds] = Field(
        default_factory=dict, description="bounds on states, by name (softened)"
    )
    back_off: NonNegative = Field(
        0.005,
        lt=1,
        description="how far bounds on states are moved inwards, as a share of half their range: room for "
        "what the model does not know, and for what states do between two samples",
    )
    rates: dict[str, Positive] = Field(
        default_factory=dict, description="largest rate of change of inputs, per second, by name"
    )
    solver: Literal["rti", "sqp", "ipopt"] = Field(
        "rti", description="`rti`: one QP a step; `sqp`: until converged; `ipopt`: interior point"
    )
    iterations: int = Field(50, ge=1, description="most iterations of `sqp` and `ipopt`")
    tolerance: Positive = Field(1e-8, description="KKT tolerance of `sqp` and `ipopt`")
    substeps: int | None = Field(
        None,
        ge=1,
        le=100,
        description="RK4 steps in one interval; from the model's fastest pole if not given",
    )
    backend: Literal["auto", "compiled", "casadi"] = Field(
        "auto",
        description="what computes `rti` and `sqp`: C compiled on this machine, or CasADi; `auto`: compiled "
        "where there is a C compiler",
    )
    estimator: Annotated[
        Annotated[EstimatorKind, Tag("text")] | Annotated[Estimator, Tag("a mapping")], Discriminator(form)
    ] = Field("auto", description="how states that are not measured, and disturbances, are found")
    delay: Literal["none", "measurement", "computation"] = Field(
        "none",
        description="`measurement`: what is measured arrives a sample late; `computation`: the solve may "
        "take a sample, its input is applied at the next one. Either is compensated by prediction",
    )
    safe_input: dict[str, float] = Field(
        default_factory=dict,
        description="input to fall back to when there is no plan left, by name; 0 if not given",
    )
    dropout: Dropout = Field(default_factory=lambda: Dropout(), description="measurements that are lost")

    @property
    def estimation(self) -> Estimator:
        """The settings of the estimator."""
        return Estimator(type=self.estimator) if isinstance(self.estimator, str) else self.estimator

    @property
    def references(self) -> dict[str, Reference]:
        """What to follow by the name of the output that tells it: `reference`, or `reference_1` and so on."""
        if isinstance(self.reference, Reference):
            return {"reference": self.reference}
        return {f"reference_{k}": spec for k, spec in enumerate(self.reference, 1)}

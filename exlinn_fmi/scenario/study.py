"""The vocabulary of robustness studies: what varies from run to run, and what a success is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag

from exlinn_fmi.scenario.spec import NonNegative, Positive, Spec, telling_key


class Relative(Spec):
    """Around the value that the scenario, or else the component, gives."""

    relative: Positive = Field(description="half width, or standard deviation, over the value: 0.1 is ± 10 %")
    shape: Literal["uniform", "normal"] = Field("uniform", description="uniform within, or normal")


class Range(Spec):
    """Uniform between two values."""

    min: float = Field(description="least value")
    max: float = Field(description="greatest value")


class Normal(Spec):
    """Normally distributed."""

    mean: float = Field(description="mean")
    std: NonNegative = Field(description="standard deviation")


class Choice(Spec):
    """One of some values, each as likely."""

    values: list[Any] = Field(min_length=1, description="the values")


DISTRIBUTION_KEYS: Mapping[str, type[Spec]] = {
    "relative": Relative,
    "min": Range,
    "mean": Normal,
    "values": Choice,
}
"""The key that tells how a value is distributed."""

Distribution = Annotated[
    Annotated[Relative, Tag("relative")]
    | Annotated[Range, Tag("min")]
    | Annotated[Normal, Tag("mean")]
    | Annotated[Choice, Tag("values")],
    Discriminator(lambda value: telling_key(value, DISTRIBUTION_KEYS)),
]


class Study(Spec):
    """Many runs of the closed loop, in each of which some values of the scenario are drawn at random."""

    repetitions: int = Field(100, ge=1, le=1_000_000, description="number of runs")
    seed: int = Field(
        0, ge=0, description="seed of what is drawn; a run's draw does not depend on the others"
    )
    vary: dict[str, Distribution] = Field(
        min_length=1,
        description="what varies, by key path, e.g. `components.plant.start.j_m: {relative: 0.1}`",
    )
    success: dict[str, float] = Field(
        default_factory=lambda: {"violations": 0.0, "fallbacks": 0.0},
        description="a run is a success if it ends and these metrics of the closed loop are at most so large",
    )
    workers: int | None = Field(
        None, ge=1, le=1024, description="processes at a time; one for each processor if not given"
    )

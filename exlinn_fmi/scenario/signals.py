"""The vocabulary of signals: what a source, an experiment or a reference may be over time."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from exlinn_fmi.scenario.spec import Band, NonNegative, Positive, Spec


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


MEASURED = "_measured"
"""What a sensor appends to the name of a signal."""


class Channel(Spec):
    """What a sensor makes of one signal: (late signal + offset + noise), rounded to its resolution."""

    unit: str | None = Field(None, description="unit of the signal, e.g. rad")
    noise: NonNegative = Field(0.0, description="standard deviation of white noise")
    offset: float = Field(0.0, description="constant error")
    resolution: NonNegative = Field(0.0, description="distance of the values that it can give; 0: all")
    delay: int = Field(0, ge=0, le=1000, description="samples by which it is late")


Signal = Annotated[
    Constant | Step | Ramp | Sine | Multisine | Chirp | Prbs | Table, Field(discriminator="signal")
]

"""The vocabulary of `simulate`: how components are stepped together, and what is kept of it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from exlinn_fmi.scenario.spec import Positive, Spec, form


class Loops(Spec):
    """Algebraic loops are solved at each communication point."""

    solver: Literal["newton", "anderson", "aitken", "fixed-point"] = Field(
        "newton",
        description="newton takes directional derivatives of FMUs where all have them, or differences",
    )
    tolerance: Positive = Field(1e-9, description="greatest residual, relative to 1 + |value|")
    iterations: int = Field(50, ge=1, description="passes around the loops at most; an error beyond")


class Adaptive(Spec):
    """Communication steps as short as the error of the coupling asks for, found by step doubling."""

    tolerance: Positive = Field(
        1e-4, description="error per step, relative to the largest value that a variable had so far"
    )
    tolerances: dict[str, Positive] = Field(
        default_factory=dict,
        description="absolute error per step by variable or pattern, in its unit; the last that fits counts",
    )
    min_step: Positive | None = Field(
        None, description="shortest communication step [s]; a thousandth of `step` if not given"
    )


class Extrapolation(Spec):
    """Inputs from other components go on as a polynomial over a step, instead of being held."""

    order: Literal[0, 1, 2] = Field(1, description="of the polynomial: 0 holds")
    smooth: bool = Field(
        False, description="no jumps at communication points: from where the last polynomial ended"
    )


class Simulate(Spec):
    """Run the connected components in co-simulation."""

    start: float = Field(0.0, description="start time [s]")
    stop: float = Field(description="stop time [s]")
    step: Positive = Field(1e-3, description="communication step [s]")
    algorithm: Literal["jacobi", "gauss-seidel"] = Field("jacobi", description="master algorithm")
    loops: Annotated[
        Annotated[Literal["delay", "solve"], Tag("text")] | Annotated[Loops, Tag("a mapping")],
        Discriminator(form),
    ] = Field(
        "delay",
        description="algebraic loops: `delay` breaks each by one step, `solve` or settings solve them",
    )
    extrapolation: Extrapolation | None = Field(
        None, description="how inputs from other components go on over a step; held if not given"
    )
    adaptive: Adaptive | None = Field(
        None, description="shorter communication steps where they are needed; `step` is the longest then"
    )
    record: list[str] = Field(
        default_factory=lambda: ["*"],
        description="variables to record, with wildcards; inputs and outputs of all by default",
    )
    record_every: int = Field(1, ge=1, description="record a row at every so many communication points")
    stream: bool | None = Field(
        None,
        description="keep rows on disk while the run goes on; where they take more than 512 MB, if not given",
    )
    checkpoint: Positive | None = Field(
        None,
        description="wall time between two checkpoints [s], which `exlinn simulate --resume` goes on from",
    )
    pace: Positive | None = Field(
        None, description="hold the run to so many simulated seconds per second: 1 is real time"
    )

    profile: bool = Field(
        False, description="tell in the metrics how much time each component took [s] (costs some itself)"
    )

    @property
    def loop_settings(self) -> Loops | None:
        """How loops are solved, None where they are broken."""
        return self.loops if isinstance(self.loops, Loops) else Loops() if self.loops == "solve" else None

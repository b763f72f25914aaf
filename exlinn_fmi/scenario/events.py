"""The vocabulary of events: what happens to signals, parameters and components in the course of a run."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from exlinn_fmi.scenario.spec import Name, NonNegative, Positive, Spec, StartValue, VariablePath

Probability = Annotated[float, Field(gt=0, le=1)]

EFFECTS = ("set", "add", "scale", "hold", "disconnect", "drop", "delay", "noise", "freeze")
"""Keys that say what an event does; each has one."""


class Crossing(Spec):
    """When a variable goes beyond a value, for the first time in the run."""

    variable: VariablePath = Field(description="what is watched, component.variable")
    above: float | None = Field(None, description="begins when the variable is above this")
    below: float | None = Field(None, description="begins when the variable is below this")


class Event(Spec):
    """One thing that happens, from a time or a crossing on, for a while or to the end."""

    name: Name | None = Field(
        None,
        description="name of its column in the trajectories, events.NAME; made of what it does if not given",
    )
    on: str = Field(
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\..+)?$",
        description="what it happens to, component.variable: an output as all others see it, an input as its "
        "component sees it, or a tunable parameter; for `freeze` a component",
        examples=["plant.alpha", "controller"],
    )
    at: float | None = Field(None, description="when it begins [s]")
    when: Crossing | None = Field(None, description="what it begins with, instead of a time")
    until: float | None = Field(None, description="when it ends [s]; with the run if not given")
    duration: Positive | None = Field(None, description="how long it lasts [s], instead of `until`")
    set: StartValue | None = Field(None, description="the value is this")
    add: float | None = Field(None, description="this is added to the value")
    scale: float | None = Field(None, description="the value is multiplied by this")
    hold: Literal[True] | None = Field(None, description="the value stays what it was before")
    disconnect: Literal[True] | None = Field(
        None, description="the input has its start value, as if nothing were connected to it"
    )
    drop: Probability | None = Field(
        None, description="each sample is lost with this probability; the last that came through is held"
    )
    delay: Positive | None = Field(None, description="the value is what it was so long ago [s]")
    noise: NonNegative | None = Field(
        None,
        description="Gaussian noise of this standard deviation is added, anew at each communication point",
    )
    freeze: Literal[True] | None = Field(
        None, description="the component stands still: it is not stepped, its outputs stay as they are"
    )

    @property
    def effect(self) -> str:
        """Which of `EFFECTS` it has; the last, should it wrongly have several or none."""
        return next((key for key in EFFECTS if getattr(self, key) is not None), EFFECTS[-1])

    def words(self) -> str:
        """What happens, in a line."""
        value = getattr(self, self.effect)
        what = f"{self.effect} {self.on}" if value is True else f"{self.effect} {value:g} on {self.on}"
        if self.when is not None:
            sign = f"> {self.when.above:g}" if self.when.above is not None else f"< {self.when.below:g}"
            begin = f"when {self.when.variable} {sign}"
        else:
            begin = f"from t = {self.at:g} s"
        end = f" until t = {self.until:g} s" if self.until is not None else ""
        return f"{what} {begin}{end}" + (f" for {self.duration:g} s" if self.duration is not None else "")

    @property
    def component(self) -> str:
        """Name of the component that it happens to."""
        return self.on.partition(".")[0]

    @property
    def variable(self) -> str:
        """Name of the variable that it happens to, empty for a whole component."""
        return self.on.partition(".")[2]


def event_names(events: list[Event]) -> list[str]:
    """Names of the events' columns: as given, else what each does to what, with a number if that is taken."""
    given = [event.name for event in events]
    names = list[str]()
    for event in events:
        text = event.name or "".join(c if c.isalnum() else "_" for c in f"{event.effect}_{event.on}")
        taken, number = [*names, *(() if event.name else given)], 1
        name = text
        while name in taken:
            number += 1
            name = f"{text}_{number}"
        names.append(name)
    return names

"""Times of a run in whole steps: how many there are, and how many of them a component's own step takes."""

from __future__ import annotations

import math
import sys

from exlinn_fmi.errors import InputError


def count_ticks(start: float, stop: float, step: float) -> int:
    """Number of steps from start to stop.

    Args:
        start: [s].
        stop: [s].
        step: [s].

    Raises:
        InputError: it is no whole number of at least 1; the nearest stop times are offered.
    """
    if not (math.isfinite(start) and math.isfinite(stop) and math.isfinite(step) and step > 0):
        raise InputError(
            f"start {start} s, stop {stop} s, step {step} s: expected finite times and a step above 0"
        )
    if stop <= start:
        raise InputError(f"stop {stop:.12g} s does not lie after start {start:.12g} s; give a later stop")
    ratio = (stop - start) / step
    ticks = round(ratio)
    if ticks >= 1 and _whole(ratio, max(abs(start), abs(stop)) / step):
        return ticks
    below, above = (f"{start + n * step:.12g} s" for n in (math.floor(ratio), math.floor(ratio) + 1))
    offer = f"{below} or {above}" if ratio > 1 else above
    raise InputError(
        f"stop {stop:.12g} s is no whole number of steps of {step:.12g} s after start {start:.12g} s; "
        f"nearest: {offer}"
    )


def count_every(name: str, own_step: float, step: float) -> int:
    """A component's own step in steps of the master.

    Args:
        name: of the component, for the message.
        own_step: [s].
        step: [s].

    Raises:
        InputError: it is no whole number of at least 1; the nearest own steps are offered.
    """
    if not (math.isfinite(own_step) and own_step > 0):
        raise InputError(f"component {name!r}: its step is {own_step} s, expected a finite time above 0")
    ratio = own_step / step
    if ratio > 0.5 and _whole(ratio, ratio):
        return round(ratio)
    below, above = (f"{n * step:.12g} s" for n in (math.floor(ratio), math.floor(ratio) + 1))
    offer = f"{below} or {above}" if ratio > 1 else f"{step:.12g} s"
    raise InputError(
        f"component {name!r}: its step {own_step:.12g} s is no multiple of the communication step "
        f"{step:.12g} s; nearest: {offer}"
    )


def _whole(ratio: float, largest: float) -> bool:
    """Whether a ratio of times is whole, but for the rounding of times as large as `largest` steps."""
    return abs(ratio - round(ratio)) <= max(1e-9, 4 * sys.float_info.epsilon * largest)

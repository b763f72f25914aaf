"""Start values: who takes one, and which."""

from __future__ import annotations

import math

import pytest

from exlinn_fmi.components.base import Variable
from exlinn_fmi.components.starts import check_starts, takes_start, value_problem
from exlinn_fmi.errors import InputError


@pytest.mark.parametrize(
    ("variable", "takes"),
    [
        (Variable("u", "input"), True),
        (Variable("p", "parameter", "fixed"), True),
        (Variable("x", "output", start=0.0), True),
        (Variable("s", "local", start=0.0), True),
        (Variable("y", "output"), False),
        (Variable("c", "local", "constant", start=3.0), False),
        (Variable("t", "independent"), False),
    ],
)
def test_inputs_parameters_and_states_take_a_start_value(variable: Variable, takes: bool) -> None:
    assert takes_start(variable) == takes


@pytest.mark.parametrize(
    ("variable", "value", "problem"),
    [
        (Variable("x"), math.nan, "expected a finite number, found nan"),
        (Variable("x"), math.inf, "expected a finite number, found inf"),
        (Variable("x", unit="V", min=-1.0, max=1.0), 2.0, "expected -1 … 1 V, found 2"),
        (Variable("x", min=0.0), -1.0, "expected at least 0, found -1"),
        (Variable("x", unit="K", max=300.0), 301.0, "expected at most 300 K, found 301"),
        (Variable("x", min=0.0, max=1.0), 1.0, None),
        (Variable("b", type="Boolean"), True, None),
        (Variable("b", type="Boolean"), 2.0, "is a Boolean: expected true or false, found 2"),
        (Variable("n", type="Integer"), -3.0, None),
    ],
)
def test_a_value_is_taken_or_refused_with_the_reason(
    variable: Variable, value: float, problem: str | None
) -> None:
    assert value_problem(variable, value) == problem


def test_values_come_back_by_index() -> None:
    variables = (Variable("y", "output"), Variable("on", "input", type="Boolean"), Variable("k", "parameter"))
    assert check_starts("c", variables, {"k": 2, "on": True}) == {2: 2.0, 1: 1.0}


def test_every_problem_is_told_with_the_component() -> None:
    with pytest.raises(InputError) as error:
        check_starts("c", (Variable("y", "output"),), {"y": 1.0, "z": 1.0})
    assert str(error.value).splitlines() == [
        "c.y: is calculated by the component and takes no start value",
        "c.z: no such variable; there are no variables that take a start value",
    ]

"""Curves with bands: what a learned model says of M(q), V(q), 1/C(x) and friction."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from learn_helpers import MOTOR_CART, motor_cart_dataset, multisine, simulate
from test_learn_noise_trajectory import clean, noisy

from exlinn_fmi.data.dataset import Dataset, split
from exlinn_fmi.learn.curves import COLUMNS, curves
from exlinn_fmi.learn.train import train
from exlinn_fmi.plants.mems_actuator import PLANT as MEMS
from exlinn_fmi.results.charts import curve_charts
from exlinn_fmi.scenario.learning import Paper, Structured, Terms

CANDIDATES = Terms(
    preset="terms",
    lagrangian=["0.5*alpha_dot^2", "0.5*sin(alpha)^2*alpha_dot^2", "0.5*i^2", "alpha*i", "cos(alpha)"],
    dissipation=["0.5*alpha_dot^2", "0.5*i^2"],
)


def one(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """The rows of one curve."""
    return table[table["curve"] == name]


def inertia(table: pd.DataFrame) -> np.ndarray:
    """The true M_11 of the motor with cart where the curve is."""
    return 0.1 + 0.04 * np.sin(table["at"].to_numpy()) ** 2


def test_bands_of_terms_from_noisy_data_hold_the_truth_and_are_narrow() -> None:
    data = noisy(0.01, seed=3)
    table = curves(train(data, data, CANDIDATES, 0), data)
    mass, rubs = one(table, "M_11"), one(table, "friction_alpha_dot")
    assert list(table.columns) == COLUMNS
    assert (np.abs(mass["value"] - inertia(mass)) < 2 * (mass["high"] - mass["value"])).all()
    assert 1e-5 < (mass["high"] - mass["low"]).max() < 2e-3
    assert (rubs["low"] <= 0.5 * rubs["at"] + 1e-3 * np.abs(rubs["at"])).all()
    assert mass["unit"].unique().tolist() == ["kg.m2"]


def test_networks_have_bands_too_that_widen_with_noise() -> None:
    exact = motor_cart_dataset()
    frame, random = exact.frame.copy(), np.random.default_rng(0)
    for name in ("alpha_dot", "i", "alpha_ddot", "i_dot"):
        frame[name] += 0.01 * frame[name].std() * random.standard_normal(len(frame))
    method = Structured(preset="structured", hidden=4, iterations=30)
    width = {}
    for name, data in {"clean": exact, "noisy": Dataset(frame, MOTOR_CART)}.items():
        mass = one(curves(train(*split(data, 0.8, 4, 0), method, 0), data), "M_11")
        width[name] = (mass["high"] - mass["low"]).max()
        assert mass["value"].to_numpy() == pytest.approx(inertia(mass), rel=1e-6 if name == "clean" else 0.1)
    assert width["clean"] < 1e-4 * width["noisy"]
    assert 1e-4 < width["noisy"] < 0.1


def test_a_capacitance_is_a_curve_of_the_distance() -> None:
    system, time = MEMS.system, np.arange(1001) * 2e-3
    inputs = np.column_stack(
        [multisine(5e-3, (0.3, 8), 20, 0, 1, time), multisine(250, (0.1, 6), 20, 700, 2, time)]
    )
    data = Dataset(simulate(system, inputs, 2e-3, np.array([0, 5e-8, 0, 0])), system.coordinates)
    method = Terms(
        preset="terms",
        lagrangian=["0.5*x_dot^2", "0.5*i^2", "-0.5*x^2", "-0.5*Q^2", "0.5*x*Q^2"],
        dissipation=["0.5*x_dot^2", "0.5*i^2"],
    )
    found = one(curves(train(data, data, method, 0), data), "1/C_Q")
    p = {parameter.name: parameter.value for parameter in MEMS.parameters}
    expected = (p["gap"] - found["at"].to_numpy()) / (p["epsilon"] * p["area"])
    assert found["value"].to_numpy() == pytest.approx(expected, rel=1e-9)
    assert found["variable"].unique().tolist() == ["x"]


def test_a_model_without_covariance_has_curves_without_bands() -> None:
    features = ["alpha_dot^2", "i^2", "i*alpha"]
    method = Paper(preset="paper", lagrangian_features=features, dissipation_features=["i^2", "alpha_dot^2"])
    data = clean()
    table = curves(train(data, data, method, 0), data)
    assert len(table)
    assert table["low"].isna().all()


def test_curves_are_drawn_by_the_variable_they_are_over() -> None:
    data = clean()
    charts = curve_charts(curves(train(data, data, CANDIDATES, 0, objective="inverse"), data))
    assert [chart.name for chart in charts] == ["curves_alpha", "curves_alpha_dot", "curves_i"]
    panel = charts[0].panels[0]
    assert panel.name == "M_11"
    assert [line.role for line in panel.lines] == ["model", "bound", "bound"]

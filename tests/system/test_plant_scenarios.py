"""The scenarios of the other plants excite them richly and within what the plant pages hold for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pandas import DataFrame

from exlinn_fmi.data.tables import read_table
from exlinn_fmi.pipeline import Run, collect, simulate
from exlinn_fmi.plants import plant
from exlinn_fmi.workspace import metrics

SCENARIOS = ("maglev", "mems", "motor_pendulum", "two_link_arm")


@pytest.fixture(scope="module")
def frames(root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, DataFrame]:
    """Each scenario's training data."""
    found = {}
    for name in SCENARIOS:
        file, folder = root / "scenarios" / f"{name}.yaml", tmp_path_factory.mktemp(name)
        found[name] = collect(Run.open(file, folder, ["learn.test=[]"])).frame
    return found


def share_of_circle(angle: DataFrame) -> float:
    """Share of 72 sectors of the circle that an angle visits."""
    return len(set((np.floor(angle / (2 * np.pi) * 72) % 72).astype(int))) / 72


def test_the_ball_stays_near_the_coil_and_passes_both_equilibria(frames: dict[str, DataFrame]) -> None:
    x = frames["maglev"]["x"]
    assert -0.01 < x.min() < 0 < 0.025 < x.max() < 0.04


def test_the_plate_is_not_pulled_in(frames: dict[str, DataFrame]) -> None:
    gap = next(p.value for p in plant("mems_actuator").parameters if p.name == "gap")
    x, charge = frames["mems"]["x"], frames["mems"]["Q"]
    assert gap / 4 < x.abs().max() < gap / 2
    assert charge.min() < -1e-7 < 1e-7 < charge.max()


def test_the_pendulum_goes_all_the_way_round_and_through_rest(frames: dict[str, DataFrame]) -> None:
    frame = frames["motor_pendulum"]
    assert share_of_circle(frame["phi"]) == 1
    slow = 0.2  # the speed over which Coulomb friction is smoothed
    assert (frame["phi_dot"].abs() < slow).mean() > 0.03


def test_both_joints_of_the_arm_go_all_the_way_round(frames: dict[str, DataFrame]) -> None:
    assert share_of_circle(frames["two_link_arm"]["phi_1"]) == 1
    assert share_of_circle(frames["two_link_arm"]["phi_2"]) == 1
    assert (share_of_circle(frames["two_link_arm"]["phi_1"] + frames["two_link_arm"]["phi_2"])) == 1


TRACKED = {
    # name: (error after settling at most, time simulated, bounded variable, bound that is reached)
    "maglev": ({"rmse_x_m": 1e-7}, 1.4, "plant.i", 0.75),
    "mems": ({"rmse_x_m": 1e-8}, 1.4, "plant.v", 2000.0),
    "motor_pendulum": ({"rmse_phi_rad": 1e-3}, 2.6, "plant.i", 1.0),
    "two_link_arm": ({"rmse_phi_1_rad": 1e-3, "rmse_phi_2_rad": 1e-3}, 2.6, "plant.i_1", 8.0),
}


@pytest.mark.parametrize("name", TRACKED)
def test_a_model_learned_of_the_plant_tracks_within_bounds(name: str, root: Path, tmp_path: Path) -> None:
    errors, stop, bounded, bound = TRACKED[name]
    settings = [f"simulate.stop={stop}", "learn.identify={}", "learn.method.iterations=100"]
    simulate(Run.open(root / "scenarios" / f"{name}.yaml", tmp_path, settings))
    found = metrics(tmp_path)
    for metric, most in errors.items():
        assert found[f"control.{metric}"] <= most
    assert found["control.fallbacks"] == 0
    reached = read_table(tmp_path / "trajectories")[0][bounded].abs().max()
    assert 0.97 * bound <= reached <= 1.05 * bound

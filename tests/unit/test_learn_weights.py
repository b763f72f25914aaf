"""Learned models on disk: exact round trip, and an error of its own for everything that can be wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from learn_helpers import MOTOR_CART, random_model
from safetensors.numpy import save

from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.train import HISTORY, TrainedModel
from exlinn_fmi.learn.weights import load_model, save_model
from exlinn_fmi.mechanics.learned import ModelSpec


def model(seed: int = 0) -> TrainedModel:
    spec, weights = random_model(seed, MOTOR_CART)
    history = pd.DataFrame([(0, "direct", 1.0, 2.0, 0.1)], columns=HISTORY)
    return TrainedModel(spec, dict(weights), history, "converged", 0.1, {"seed": seed})


def edit(folder: Path, **changes: object) -> None:
    file = folder / "model.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_a_saved_model_reads_back_to_the_last_bit(tmp_path: Path) -> None:
    written = save_model(tmp_path, model())
    loaded = load_model(tmp_path)
    assert {p.name for p in written} == {"model.safetensors", "model.json", "training.csv"}
    assert loaded.spec == model().spec
    assert loaded.weights.keys() == model().weights.keys()
    assert all((loaded.weights[name] == array).all() for name, array in model().weights.items())
    assert loaded.history.equals(model().history)
    assert (loaded.status, loaded.seconds, loaded.provenance) == ("converged", 0.1, {"seed": 0})


def test_features_models_are_saved_too(tmp_path: Path) -> None:
    spec = ModelSpec("features", MOTOR_CART, 2, lagrangian_features=("i^2",), dissipation_features=("i^2",))
    weights = {name: np.ones(shape) for name, shape in spec.shapes().items()}
    save_model(tmp_path, TrainedModel(spec, weights, pd.DataFrame(columns=HISTORY), "iterations", 1.0, {}))
    assert load_model(tmp_path).spec == spec


def test_history_is_not_needed_to_load(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    (tmp_path / "training.csv").unlink()
    assert load_model(tmp_path).history.empty


@pytest.mark.parametrize("name", ["model.json", "model.safetensors"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    save_model(tmp_path, model())
    (tmp_path / name).unlink()
    with pytest.raises(ModelError, match=rf"{name}: cannot be read \(No such file"):
        load_model(tmp_path)


def test_a_truncated_description_is_refused(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    (tmp_path / "model.json").write_text("{")
    with pytest.raises(ModelError, match=r"model\.json: not a JSON file"):
        load_model(tmp_path)


@pytest.mark.parametrize("found", [2, None, "1"])
def test_another_format_is_refused(tmp_path: Path, found: object) -> None:
    save_model(tmp_path, model())
    edit(tmp_path, format=found)
    with pytest.raises(ModelError, match=rf"found format {found}, expected 1"):
        load_model(tmp_path)


def test_a_description_that_is_no_mapping_is_refused(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    (tmp_path / "model.json").write_text("[]")
    with pytest.raises(ModelError, match="found format None"):
        load_model(tmp_path)


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    (tmp_path / "model.json").write_text('{"format": 1}')
    with pytest.raises(ModelError, match="'spec' is missing"):
        load_model(tmp_path)


def test_weights_of_another_model_are_refused(tmp_path: Path) -> None:
    save_model(tmp_path, model(0))
    save_model(tmp_path / "other", model(1))
    (tmp_path / "other" / "model.safetensors").replace(tmp_path / "model.safetensors")
    with pytest.raises(ModelError, match="not the weights that"):
        load_model(tmp_path)


def replace_weights(folder: Path, content: bytes) -> None:
    import hashlib

    (folder / "model.safetensors").write_bytes(content)
    edit(folder, weights_sha256=hashlib.sha256(content).hexdigest())


def test_what_is_no_safetensors_file_is_refused(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    replace_weights(tmp_path, b"nothing of the kind")
    with pytest.raises(ModelError, match="not a safetensors file"):
        load_model(tmp_path)


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    replace_weights(tmp_path, save({**model().weights, "dissipation.viscous": np.zeros(5)}))
    with pytest.raises(ModelError, match=r"model\.json: weights: .* has shape \(5,\), expected \(2,\)"):
        load_model(tmp_path)


def test_a_spec_of_another_kind_is_refused(tmp_path: Path) -> None:
    save_model(tmp_path, model())
    edit(tmp_path, spec={"form": "structured"})
    with pytest.raises(ModelError, match=r"model\.json: not the description of a model"):
        load_model(tmp_path)

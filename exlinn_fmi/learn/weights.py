"""Learned models on disk: model.safetensors (weights), model.json (all else), training.csv (history).

Nothing that is loaded can run code: no pickle.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from exlinn_fmi.data.files import write_bytes, write_json, write_text
from exlinn_fmi.errors import ModelError
from exlinn_fmi.learn.train import HISTORY, TrainedModel
from exlinn_fmi.mechanics.learned import ModelSpec, check_weights

FORMAT = 1
"""Version of model.json; a newer one is refused."""


def save_model(folder: Path, model: TrainedModel) -> list[Path]:
    """Write model.safetensors, model.json and training.csv; return their paths.

    Raises:
        StorageError: one of them could not be written.
    """
    from safetensors.numpy import save

    arrays = {name: np.ascontiguousarray(array) for name, array in model.weights.items()}
    content = save(arrays)
    description = {
        "format": FORMAT,
        "spec": model.spec.to_dict(),
        "status": model.status,
        "seconds": model.seconds,
        "provenance": model.provenance,
        "weights_sha256": hashlib.sha256(content).hexdigest(),
    }
    paths = [folder / name for name in ("model.safetensors", "model.json", "training.csv")]
    write_bytes(paths[0], content)
    write_json(paths[1], description)
    write_text(paths[2], model.history.to_csv(index=False))
    return paths


def load_model(folder: Path) -> TrainedModel:
    """Read what `save_model` wrote.

    Raises:
        ModelError: a file is missing or damaged, or the weights do not belong to the description.
    """
    description = _description(folder / "model.json")
    file = folder / "model.safetensors"
    content = _read(file)
    if hashlib.sha256(content).hexdigest() != description["weights_sha256"]:
        raise ModelError(
            f"{file}: these are not the weights that model.json describes (its hash differs); copy both "
            "files from one run, or train again"
        )
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        arrays = load(content)
    except SafetensorError as error:
        raise ModelError(f"{file}: not a safetensors file ({error}); train again") from error
    try:
        spec = ModelSpec.from_dict(description["spec"])
        check_weights(spec, arrays)
    except ModelError as error:
        raise ModelError(f"{folder / 'model.json'}: {error}") from error
    history = folder / "training.csv"
    return TrainedModel(
        spec,
        arrays,
        pd.read_csv(history) if history.is_file() else pd.DataFrame(columns=HISTORY),
        description["status"],
        description["seconds"],
        description["provenance"],
    )


def _description(file: Path) -> dict[str, Any]:
    """The content of model.json, with all its keys."""
    try:
        description = json.loads(_read(file))
    except ValueError as error:
        raise ModelError(f"{file}: not a JSON file ({error}); train again") from error
    found = description.get("format") if isinstance(description, dict) else None
    if found != FORMAT:
        raise ModelError(
            f"{file}: found format {found}, expected {FORMAT}; train again, or update exlinn-fmi"
        )
    for key in ("spec", "status", "seconds", "provenance", "weights_sha256"):
        if key not in description:
            raise ModelError(f"{file}: {key!r} is missing; train again")
    return dict(description)


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ModelError(
            f"{file}: cannot be read ({error.strerror}); give the folder of a run that has trained a model"
        ) from error

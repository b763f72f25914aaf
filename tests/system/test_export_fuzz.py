"""FMUs called in random order, legal and not, under the address and undefined-behaviour sanitisers."""

from __future__ import annotations

import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from exlinn_fmi.export.build import Options, export_learned
from exlinn_fmi.export.model_description import Version
from exlinn_fmi.mechanics.learned import ModelSpec, Scales
from exlinn_fmi.plants import plant

SANITISERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.mark.parametrize("fmi", [2, 3])
def test_random_calls_do_no_harm(fmi: Version, tmp_path: Path, root: Path) -> None:
    spec = ModelSpec(
        "structured",
        plant("dc_motor_cart").coordinates,
        3,
        Scales(0.2, 1.0, (1.0, 0.5), (0.0, 0.0), (1.0, 1.0)),
        (0.05, 0.05),
        depth=2,
    )
    rng = np.random.default_rng(0)
    weights = {name: 0.3 * rng.normal(size=shape) for name, shape in spec.shapes().items()}
    ranges = {"i": (-1.0, 1.0), "v": (-5.0, 5.0)}
    path = export_learned(spec, weights, tmp_path, name="Fuzzed", ranges=ranges, options=Options(fmi))
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path)
    command = ["cc", "-g", "-O1", "-std=c99", "-w", *SANITISERS, "-I", str(tmp_path / "sources")]
    command += [str(root / "benchmarks" / "export_fuzz.c"), "-o", str(tmp_path / "fuzz"), "-lm"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode:
        pytest.skip(f"no sanitisers here: {built.stderr[:200]}")
    run = subprocess.run([tmp_path / "fuzz", "10000"], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout) == (0, "10000\n"), run.stderr[:4000]

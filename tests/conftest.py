"""Fixtures for all tests, and run-time checking of the shapes in the package's annotations."""

from __future__ import annotations

from pathlib import Path

import pytest
from jaxtyping import install_import_hook

CHECKED = ("mechanics", "learn", "data", "cosim", "control")
install_import_hook([f"exlinn_fmi.{part}" for part in CHECKED], "beartype.beartype")

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT

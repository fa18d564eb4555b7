"""Settings and fixtures that every test may rely on."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# The same examples on every run and machine; a slow machine is no failure (pytest-timeout watches for hangs).
settings.register_profile("surefoot", deadline=None, derandomize=True)
settings.load_profile("surefoot")


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator that starts at the same state in every test."""
    return np.random.default_rng(20180426)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Return the root of the repository."""
    return Path(__file__).resolve().parents[1]

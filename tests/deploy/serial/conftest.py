"""The benchmark of the link, whose bad line several tests use."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="package")
def link_soak(repository: Path) -> ModuleType:
    """Return benchmarks/link_soak.py as a module."""
    spec = importlib.util.spec_from_file_location("link_soak", repository / "benchmarks" / "link_soak.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["link_soak"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module

"""Settings of the tests that draw."""

from __future__ import annotations

import pytest

from surefoot.report import style


@pytest.fixture(autouse=True)
def _coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw figures with few pixels, which takes less time."""
    monkeypatch.setattr(style, "DPI", 40)

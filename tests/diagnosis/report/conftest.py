"""Reports without their pictures."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of a page have their captions and are left blank: to draw them takes seconds."""
    monkeypatch.setattr(Figure, "savefig", lambda *file, **options: None)

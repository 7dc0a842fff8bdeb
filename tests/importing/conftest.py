"""Pages of imports show a blank picture: to draw it is nearly half of an import's time. `test_columns.py` draws."""

import pytest

from ballfg.importing import importer
from ballfg.pages.html import Html


@pytest.fixture(autouse=True)
def blank_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the page has a drawing of the shots stands an empty one."""
    monkeypatch.setattr(importer, "_drawing", lambda tracks, height: Html("<svg></svg>"))

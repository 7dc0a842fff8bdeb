"""The sub-rooms of learning import one way."""

from __future__ import annotations

import pytest

from tests.test_layout import MODULES, imported

ORDER = {"config": 0, "gradient": 0, "run": 1, "end_to_end": 2, "sequence": 2, "calibration": 3}
"""A module imports from its own sub-room and from those of a lower number."""


def sub_room(module: str) -> str | None:
    parts = module.split(".")
    return parts[2] if parts[:2] == ["ballfg", "learning"] and len(parts) > 3 else None


@pytest.mark.parametrize("module", [name for name in MODULES if sub_room(name)])
def test_sub_rooms_import_one_way(module: str) -> None:
    mine = sub_room(module)
    for line, name in imported(module, MODULES[module]):
        other = sub_room(name)
        assert other in (None, mine) or ORDER[other] < ORDER[mine], f"{MODULES[module]}:{line}: {mine} imports {other}"

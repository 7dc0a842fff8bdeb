"""Rooms hand out their names when they are asked for; until then they cost nothing."""

from __future__ import annotations

import ast
import importlib
import inspect
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import ballfg
from tests.test_layout import MODULES, ROOT

STUBS = {name: stub for name, path in MODULES.items() if (stub := path.with_suffix(".pyi")).is_file()}
HEAVY = {"torch", "gtsam", "numpy", "scipy", "cv2", "matplotlib", "pydantic", "pyarrow"}


def listed(stub: Path) -> list[str]:
    """The names in a stub, in order."""
    return [
        alias.name
        for node in ast.parse(stub.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]


def test_no_room_keeps_a_list_of_its_own() -> None:
    for name, path in MODULES.items():
        if path.name == "__init__.py":
            tree = ast.parse(path.read_text(encoding="utf-8"))
            assert not any(isinstance(node, ast.ImportFrom) for node in tree.body), f"{name}: put names in __init__.pyi"
            assert ("lazy_loader" in path.read_text(encoding="utf-8")) == (name in STUBS), f"{name}: stub and loader"


@pytest.mark.parametrize("room", STUBS)
def test_every_name_is_there_and_listed_once(room: str) -> None:
    names = listed(STUBS[room])
    module = importlib.import_module(room)
    assert sorted(names) == sorted(module.__all__)
    assert len(set(names)) == len(names)
    for name in names:
        value = getattr(module, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert value.__name__ == name
            assert pickle.loads(pickle.dumps(value)) is value
    with pytest.raises(AttributeError, match="nonsense"):
        _ = module.nonsense


def test_front_door_is_that_of_the_rooms() -> None:
    assert ballfg.Smoother is ballfg.estimation.Smoother
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert ballfg.__version__ == project["version"]
    assert "bf.estimate(" in (ballfg.__doc__ or "")


def test_rooms_cost_nothing_until_a_name_is_used() -> None:
    code = f"import sys, {', '.join(STUBS)}; print(*sorted({HEAVY!r} & sys.modules.keys()))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert loaded.stdout.split() == []


def test_public_names_are_few_and_each_is_told_in_a_guide() -> None:
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    told = " ".join(page.read_text(encoding="utf-8") for page in pages if "reference" not in page.parts)
    names = {room: listed(stub) for room, stub in STUBS.items() if room != "ballfg"}
    assert sum(map(len, names.values())) <= 150
    words = set(re.findall(r"\w+", told))
    assert [f"{room}.{name}" for room, own in names.items() for name in own if name not in words] == []

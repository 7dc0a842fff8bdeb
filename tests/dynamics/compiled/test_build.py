"""Where compiled functions are kept."""

import os
import subprocess
import sys

import pytest

from ballfg.dynamics.compiled.build import cache_folder

SCRIPT = """
from ballfg.dynamics import nominal_model
from ballfg.dynamics.compiled.build import cache_folder
from ballfg.dynamics.compiled.functions import compiled
assert compiled(nominal_model()) is not None
print(cache_folder(), *sorted(p.name for p in cache_folder().glob("*.py")))
"""


def in_process(folder) -> list[str]:
    environment = os.environ | {"BALLFG_CACHE": str(folder)}
    return subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
    ).stdout.split()


def test_a_second_process_finds_what_the_first_has_made(tmp_path) -> None:
    first = in_process(tmp_path)
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "ballfg").rglob("*") if path.is_file()}
    assert len(first) == 4  # the folder; rates, impact and surface
    assert in_process(tmp_path) == first
    assert {path: path.stat().st_mtime_ns for path in made} == made


def test_without_a_folder_to_write_to_a_temporary_one_serves(tmp_path, monkeypatch) -> None:
    file = tmp_path / "file"
    file.write_text("no folder")
    monkeypatch.setenv("BALLFG_CACHE", str(file))
    cache_folder.cache_clear()
    try:
        folder = cache_folder()
        assert folder.is_dir()
        assert file not in folder.parents
    finally:
        cache_folder.cache_clear()


@pytest.fixture(autouse=True)
def _restored():
    yield
    cache_folder.cache_clear()

"""Where compiled functions are kept."""

import errno
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ballfg.dynamics.compiled.build import cache_folder, read_note, write_note

SCRIPT = """
from ballfg.dynamics import nominal_model
from ballfg.dynamics.compiled.build import cache_folder
from ballfg.dynamics.compiled.functions import compiled
assert compiled(nominal_model()) is not None
print(*sorted(p.name for p in cache_folder().glob("*.py")))
"""

FUNCTION_FILE = """
from numba import types
from ballfg.dynamics.compiled.build import machine_code

@machine_code(types.float64(types.float64))
def twice(x):
    return 2.0 * x
"""


def in_process(folder) -> list[str]:
    environment = os.environ | {"BALLFG_CACHE": str(folder)}
    return subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
    ).stdout.split()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, list[str]]:
    """What a first process leaves: the folder, and names of its functions."""
    folder = tmp_path_factory.mktemp("cache")
    return folder, in_process(folder)


def test_a_second_process_finds_what_the_first_has_made(made) -> None:
    folder, names = made
    stamps = {path: path.stat().st_mtime_ns for path in (folder / "ballfg").rglob("*") if path.is_file()}
    assert len(names) == 3  # rates, impact and surface
    assert in_process(folder) == names
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps


def test_what_a_power_failure_has_damaged_is_made_again(made, tmp_path) -> None:
    folder = Path(shutil.copytree(made[0], tmp_path / "cache"))
    whole = {path: path.read_bytes() for path in (folder / "ballfg").rglob("*") if path.is_file()}
    for number, (path, content) in enumerate(whole.items()):
        path.write_bytes(content[: len(content) // 2] if number % 2 else b"")
    assert in_process(folder) == made[1]
    for path, content in whole.items():
        assert path.read_bytes() == content if path.suffix in (".py", ".json") else path.stat().st_size


@pytest.fixture
def function(tmp_path) -> Callable[[], Any]:
    """Machine code of a file, as each process declares it anew."""
    file = tmp_path / "some_function.py"
    file.write_text(FUNCTION_FILE)

    def declared() -> Any:
        spec = importlib.util.spec_from_file_location("some_function", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.twice

    return declared


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_file_of_machine_code_is_replaced(tmp_path, function, ending) -> None:
    assert function()(2.0) == 4.0
    (file,) = tmp_path.rglob(f"*.{ending}")
    size = file.stat().st_size
    for content in (b"", file.read_bytes()[:-5]):
        file.write_bytes(content)
        assert function()(2.0) == 4.0
        assert file.stat().st_size == size


def test_a_full_disk_only_costs_the_machine_code_of_the_next_process(tmp_path, function, monkeypatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    assert function()(2.0) == 4.0
    assert not list(tmp_path.rglob("*.nbc"))


def test_a_note_that_somebody_changed_is_none(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BALLFG_CACHE", str(tmp_path))
    cache_folder.cache_clear()
    assert read_note("a") is None
    write_note("a", {"size": 3})
    assert read_note("a") == {"size": 3}
    (file,) = tmp_path.rglob("*.json")
    for text in (file.read_text().replace("3", "4"), '{"size": 3}', "[", "[" * 100_000, "", "3"):
        file.write_text(text)
        assert read_note("a") is None


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

"""Folders of machine code: which are written to, which are read, and what is made again."""

from __future__ import annotations

import errno
import importlib.util
import os
import pickle
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import ballfg
from ballfg.dynamics.compiled.build import read_note, write_note
from ballfg.dynamics.compiled.kept import (
    NOTED,
    _digest,
    _is_trusted,
    _is_usable,
    _read,
    cache_folder,
    keep,
    readable,
    source_stamp,
)
from tests.places import ROOT

FUNCTION_FILE = """
from numba import types
from ballfg.dynamics.compiled.build import machine_code

@machine_code(types.float64(types.float64))
def twice(x):
    return 2.0 * x
"""


def ask_anew() -> None:
    """Folders are looked at once in a process."""
    for asked in (cache_folder, _is_trusted, _is_usable):
        asked.cache_clear()


@pytest.fixture(autouse=True)
def _asked_anew() -> Iterator[None]:
    before = os.environ.pop(NOTED, None)
    ask_anew()
    yield
    ask_anew()
    os.environ.pop(NOTED, None)
    os.environ |= {} if before is None else {NOTED: before}


@pytest.fixture
def function(tmp_path: Path) -> Callable[[], Any]:
    """Machine code of a file, as each process declares it anew."""
    file = tmp_path / "source" / "some_function.py"
    file.parent.mkdir()
    file.write_text(FUNCTION_FILE)

    return lambda: declared_in(file).twice


def declared_in(file: Path) -> Any:
    """The module of a file, as a new process declares it."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def nowhere_to_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Neither in the package nor in the cache; the folder for temporary files."""
    monkeypatch.setenv("BALLFG_CACHE", "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("tempfile.TemporaryFile", full)
    ask_anew()
    return tmp_path / f"ballfg-{os.getuid()}" / "cache"


def cut(content: bytes) -> bytes:
    """A file whose end has not reached the disk."""
    return content[:-5]


def holed(content: bytes) -> bytes:
    """A file with a block that has not reached the disk."""
    middle = len(content) // 2
    return content[:middle] + bytes(64) + content[middle + 64 :]


def flipped(content: bytes) -> bytes:
    """A file with one wrong bit in its machine code."""
    place = 2 * len(content) // 3
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


def empty(_: bytes) -> bytes:
    return b""


@pytest.mark.parametrize("damage", [empty, cut, holed, flipped])
def test_a_damaged_file_is_replaced(
    tmp_path: Path, function: Callable[[], Any], damage: Callable[[bytes], bytes]
) -> None:
    """Machine code with a wrong bit ended one process in ten; one in three with a block of zeros."""
    assert function()(2.0) == 4.0
    (file,) = tmp_path.rglob("*.nbc")
    file.write_bytes(damage(file.read_bytes()))
    twice = function()
    assert twice(2.0) == 4.0
    assert not twice.stats.cache_hits
    again = function()
    assert again(2.0) == 4.0
    assert again.stats.cache_hits


def full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_only_costs_the_machine_code_of_the_next_process(
    tmp_path: Path, function: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.replace", full)
    assert function()(2.0) == 4.0
    assert not list(tmp_path.rglob("*.nbc"))


def test_without_a_folder_to_write_to_the_next_process_finds_it_among_temporary_files(
    nowhere_to_write: Path, function: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert function()(2.0) == 4.0
    assert cache_folder() == nowhere_to_write
    assert stat.S_IMODE(nowhere_to_write.stat().st_mode) == 0o700
    (code,) = nowhere_to_write.rglob("*.nbc")
    stamp = code.stat().st_mtime_ns
    monkeypatch.setattr("os.replace", full)  # what is compiled anew is not kept
    twice = function()
    assert twice(2.0) == 4.0
    assert twice.stats.cache_hits
    assert code.stat().st_mtime_ns == stamp


def test_what_was_compiled_beside_the_source_is_found_where_nothing_can_be_written(
    tmp_path: Path, function: Callable[[], Any], request: pytest.FixtureRequest
) -> None:
    """As by an administrator, for users without rights."""
    assert function()(2.0) == 4.0
    made = set(tmp_path.rglob("*.nbc"))
    assert made
    request.getfixturevalue("nowhere_to_write")
    twice = function()
    assert twice(2.0) == 4.0
    assert twice.stats.cache_hits
    assert set(tmp_path.rglob("*.nbc")) == made


def test_the_folder_that_numba_is_told_is_the_only_one(
    tmp_path: Path, function: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert function()(2.0) == 4.0
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "told"))
    twice = function()
    assert twice(2.0) == 4.0
    assert not twice.stats.cache_hits
    assert list((tmp_path / "told").rglob("*.nbc"))


def test_notes_in_a_folder_that_is_only_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BALLFG_CACHE", str(tmp_path / "filled"))
    write_note("a", {"size": 3})
    assert stat.S_IMODE(next((tmp_path / "filled").rglob("*.json")).stat().st_mode) & 0o444 == 0o444
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr("tempfile.TemporaryFile", full)
    ask_anew()
    assert cache_folder() == tmp_path / "temporary" / f"ballfg-{os.getuid()}" / "cache"
    assert read_note("a") == {"size": 3}
    write_note("b", {"size": 4})
    assert read_note("b") == {"size": 4}
    assert len(list((tmp_path / "filled").rglob("*.json"))) == 1


def test_a_note_that_finds_a_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BALLFG_CACHE", str(tmp_path))
    monkeypatch.setattr("os.replace", full)
    write_note("a", {"size": 3})
    assert read_note("a") is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


class Planted:
    """What runs when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def plant(file: Path, mark: Path) -> None:
    """Puts a whole file in the place of machine code, whose pickle leaves a mark."""
    content = pickle.dumps(Planted(mark))
    file.write_bytes(_digest(content) + content)


@pytest.mark.parametrize("told", [False, True])
def test_machine_code_in_a_folder_that_others_may_change_is_not_run(
    tmp_path: Path,
    function: Callable[[], Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    told: bool,
) -> None:
    """Beside the source, and where numba is told to keep it; one line says so."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "told") if told else "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "mine"))
    assert function()(2.0) == 4.0
    (code,) = tmp_path.rglob("*.nbc")
    plant(code, tmp_path / "mark")
    code.parent.chmod(0o777)
    capsys.readouterr()
    for hits in (False, True):
        ask_anew()
        twice = function()
        assert twice(2.0) == 4.0
        assert bool(twice.stats.cache_hits) == hits
    assert not (tmp_path / "mark").exists()
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"note: {code.parent} is not used for machine code")


@pytest.mark.parametrize(
    ("variable", "place"), [("BALLFG_CACHE", "ballfg"), ("XDG_CACHE_HOME", "ballfg"), ("HOME", ".cache/ballfg")]
)
def test_a_cache_that_others_may_change_is_neither_read_nor_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], variable: str, place: str
) -> None:
    for name in ("BALLFG_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(variable, str(tmp_path))
    assert readable("a.py") == [tmp_path / place / "a.py"]
    (tmp_path / place).chmod(0o777)
    ask_anew()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    mine = tmp_path / f"ballfg-{os.getuid()}" / "cache"
    assert readable("a.py") == [mine / "a.py"]
    assert keep("a.py", "") == mine / "a.py"
    assert not list((tmp_path / place).iterdir())
    assert capsys.readouterr().err.count("\n") == 1


def of_somebody_else(file: Path) -> None:
    os.chown(file, 12345, 12345)


def open_to_all(file: Path) -> None:
    file.chmod(0o666)


@pytest.mark.parametrize(
    "given",
    [open_to_all, pytest.param(of_somebody_else, marks=pytest.mark.skipif(os.geteuid() != 0, reason="only root may"))],
)
def test_a_file_that_others_may_change_is_replaced(
    tmp_path: Path, function: Callable[[], Any], given: Callable[[Path], None]
) -> None:
    assert function()(2.0) == 4.0
    (file,) = tmp_path.rglob("*.nbc")
    plant(file, tmp_path / "mark")
    given(file)
    for hits in (False, True):
        twice = function()
        assert twice(2.0) == 4.0
        assert bool(twice.stats.cache_hits) == hits
    assert not (tmp_path / "mark").exists()
    assert (file.stat().st_uid, stat.S_IMODE(file.stat().st_mode) & 0o022) == (os.geteuid(), 0)


def test_files_of_two_functions_exchanged_are_noticed(tmp_path: Path) -> None:
    """They ended the process, or computed the other function."""
    file = tmp_path / "some_function.py"
    file.write_text(FUNCTION_FILE + FUNCTION_FILE.replace("2.0", "3.0").replace("twice", "thrice"))
    both = declared_in(file)
    assert (both.twice(2.0), both.thrice(2.0)) == (4.0, 6.0)
    (one,), (other,) = tmp_path.rglob("*twice*.nbc"), tmp_path.rglob("*thrice*.nbc")
    contents = one.read_bytes(), other.read_bytes()
    other.write_bytes(contents[0])
    one.write_bytes(contents[1])
    again = declared_in(file)
    assert (again.twice(2.0), again.thrice(2.0)) == (4.0, 6.0)
    assert not again.twice.stats.cache_hits
    assert not again.thrice.stats.cache_hits


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("from ballfg.made_up import FACTOR", "FACTOR"),
        ("from ballfg import made_up", "made_up.FACTOR"),
        ("from ballfg import (\n    arrays,\n    made_up as other,\n)", "other.FACTOR"),
    ],
)
def test_a_change_of_another_file_that_is_built_in_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, name: str
) -> None:
    """What a function calls, and the constants that it reads; numba looks at the function's own file alone."""
    text = FUNCTION_FILE.replace("\n@machine", f"{line}\n\n@machine").replace("2.0", name)
    (tmp_path / "some_function.py").write_text(text)
    for factor in (2.0, 3.25):
        other = tmp_path / "made_up.py"
        other.write_text(f"FACTOR = {factor}\n")
        module = ModuleType("ballfg.made_up")
        module.__dict__.update(FACTOR=factor, __file__=str(other))
        monkeypatch.setitem(sys.modules, "ballfg.made_up", module)
        monkeypatch.setattr(ballfg, "made_up", module, raising=False)
        for hits in (False, True):
            for asked in (source_stamp, _read):
                asked.cache_clear()
            found = declared_in(tmp_path / "some_function.py").twice
            assert found(2.0) == 2.0 * factor
            assert bool(found.stats.cache_hits) == hits


@pytest.mark.parametrize("kind", ["open to others", "a link", "a file"])
def test_a_temporary_folder_that_others_may_have_filled_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Its name is known beforehand, and what machine code lies in it would be run."""
    taken, mine = tmp_path / f"ballfg-{os.getuid()}", tmp_path / "mine"
    if kind == "open to others":
        taken.mkdir()
        taken.chmod(0o777)
    elif kind == "a link":
        mine.mkdir(mode=0o700)
        taken.symlink_to(mine)
    else:
        taken.touch()
    monkeypatch.setenv("BALLFG_CACHE", "/proc/nowhere")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    used = cache_folder()
    assert used.parent == tmp_path
    assert used not in (taken, mine)
    assert stat.S_IMODE(used.stat().st_mode) == 0o700


def test_the_folder_of_one_process_goes_with_it(tmp_path: Path) -> None:
    taken = tmp_path / f"ballfg-{os.getuid()}"
    taken.touch()
    code = "from ballfg.dynamics.compiled.kept import keep; path = keep('a.py', ''); print(path, path.is_file())"
    environment = os.environ | {"BALLFG_CACHE": "/proc/nowhere", "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    path, was_there = said.stdout.split()
    assert Path(path).parents[1] == tmp_path
    assert was_there == "True"
    assert list(tmp_path.iterdir()) == [taken]


ALLOCATES = """
import sys
import numpy as np
from numba import types
from ballfg.dynamics.compiled.build import machine_code
TWO = types.Array(types.float64, 2, "C")

@machine_code(types.void(TWO, TWO))
def square(x, y):
    y[:] = np.dot(x, x.T) + np.ones((2, 2))

@machine_code(types.void(TWO, TWO))
def cube(x, y):
    y[:] = np.dot(np.dot(x, x.T), x)

x, y, z = np.array([[1.0, 2.0], [3.0, 5.0]]), np.empty((2, 2)), np.empty((2, 2))
square(x, y)
loaded = "numba.misc.cffiimpl" in sys.modules  # a part that numba imports for compilations alone
if len(sys.argv) > 1:
    cube(x, z)
print(loaded, np.array_equal(y, x @ x.T + 1.0), np.array_equal(z, x @ x.T @ x))
"""


@pytest.mark.thorough
def test_kept_code_runs_without_what_a_compilation_loads_and_a_compilation_after_it_works(tmp_path: Path) -> None:
    (tmp_path / "allocates.py").write_text(ALLOCATES)

    def answer(*words: str) -> list[str]:
        command = [sys.executable, str(tmp_path / "allocates.py"), *words]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()

    assert answer() == ["True", "True", "False"]  # compiled
    assert answer() == ["False", "True", "False"]  # kept
    assert answer("cube") == ["False", "True", "True"]  # kept, and then another one is compiled

"""A folder's files are there all together or not at all."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from ballfg.files.whole_folder import check_replaceable, reserved, whole_folder


def contents(folder: Path) -> dict[str, str]:
    """Every file below a folder, hidden ones too."""
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def fill(folder: Path, **files: str) -> None:
    """Writes files; in a name `__` stands for a folder's slash."""
    for name, text in files.items():
        path = folder / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


# --- files that join a folder ------------------------------------------------------------------------------------


def test_a_new_folder_appears_at_once(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "new") as stage:
        fill(stage, a="1", below__b="2")
        assert not (tmp_path / "new").exists()
    assert contents(tmp_path) == {"new/a": "1", "new/below/b": "2"}
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_an_earlier_result_is_replaced_and_other_files_stay(tmp_path: Path) -> None:
    fill(tmp_path / "d", a="old", gone="old", mine="mine", place="old")
    fill(tmp_path / "d", images__x="old", images__y="old", data_1__w="old")
    with whole_folder(tmp_path / "d", earlier=("a", "gone", "images", "data_*", "..")) as stage:
        fill(stage, a="new", images__x="new", data_2__w="new", place__z="new")
    new = {"a": "new", "images/x": "new", "data_2/w": "new", "place/z": "new"}
    assert contents(tmp_path / "d") == new | {"mine": "mine"}
    assert {path.name for path in (tmp_path / "d").iterdir()} == {"a", "images", "data_2", "mine", "place"}


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_what_was_there(tmp_path: Path, exists: bool, error: type[BaseException]) -> None:
    folder = tmp_path / "d"
    if exists:
        fill(folder, a="old")

    def broken() -> None:
        with whole_folder(folder, earlier=("a",)) as stage:
            fill(stage, b="new")
            raise error

    with pytest.raises(error):
        broken()
    assert contents(tmp_path) == ({"d/a": "old"} if exists else {})
    assert folder.exists() == exists


# --- two at a time, and other programs -----------------------------------------------------------------------------


def test_folders_in_it_keep_other_files(tmp_path: Path) -> None:
    fill(tmp_path, d__one__a="old", d__one__b="old", d__one__mine="mine")
    with whole_folder(tmp_path / "d", earlier=("one/a", "one/b", "two/b")) as stage:
        fill(stage, one__a="new", two__a="new")
    assert contents(tmp_path / "d") == {"one/a": "new", "one/mine": "mine", "two/a": "new"}


def test_a_folder_that_somebody_makes_meanwhile_keeps_its_files(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "d") as stage:
        fill(stage, a="new")
        fill(tmp_path, d__mine="mine")
    assert contents(tmp_path) == {"d/a": "new", "d/mine": "mine"}


@pytest.mark.parametrize("exists", [False, True])
def test_a_second_process_is_refused_and_a_killed_one_is_not_waited_for(tmp_path: Path, exists: bool) -> None:
    folder = tmp_path / "d"
    if exists:
        fill(folder, a="old")
    code = (
        "import sys, time; from pathlib import Path; from ballfg.files.whole_folder import reserved\n"
        f"with reserved(Path({str(folder)!r})): print('held', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        try:
            message = f"out must not be written twice .* is being written by process {other.pid}. Wait for it"
            with pytest.raises(ValueError, match=message), whole_folder(folder):
                pass
        finally:
            other.kill()
    with reserved(folder), whole_folder(folder, earlier=("a",)) as stage:
        fill(stage, b="new")
    assert contents(tmp_path) == {"d/b": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_another_thread_is_refused(tmp_path: Path) -> None:
    def write() -> None:
        with whole_folder(tmp_path / "d") as stage:
            fill(stage, a="thread")

    with whole_folder(tmp_path / "d") as stage, ThreadPoolExecutor(1) as threads:
        fill(stage, a="new")
        with pytest.raises(ValueError, match=f"is being written by process {os.getpid()}"):
            threads.submit(write).result()
    assert contents(tmp_path) == {"d/a": "new"}


def test_a_disk_without_locks_is_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with whole_folder(tmp_path / "d") as stage:
        fill(stage, a="new")
    assert contents(tmp_path) == {"d/a": "new"}


# --- folders in which something would be lost --------------------------------------------------------------------


def test_what_may_be_replaced(tmp_path: Path) -> None:
    what = {"mark": "report", "what": "an earlier report"}
    check_replaceable(tmp_path, **what)
    check_replaceable(tmp_path / "new", **what)
    fill(tmp_path, report="")
    check_replaceable(tmp_path, **what, only=("report",))
    with pytest.raises(ValueError, match=r"out must be new or empty; .* holds an earlier report"):
        check_replaceable(tmp_path, **what, force=False)
    fill(tmp_path, other="")
    check_replaceable(tmp_path, **what)
    message = r"out must be new, empty or hold an earlier report; .* holds other files\. Choose another name\."
    with pytest.raises(ValueError, match=message):
        check_replaceable(tmp_path, **what, only=("report",))
    with pytest.raises(ValueError, match=message):
        check_replaceable(tmp_path, mark="none", what="an earlier report")
    with pytest.raises(ValueError, match=r"out must be a folder; .*report is a file"):
        check_replaceable(tmp_path / "report", **what)
    with pytest.raises(FileNotFoundError, match=r"out must be in an existing folder; .*no is none"):
        check_replaceable(tmp_path / "no" / "d", **what)

"""A folder's files are there all together or not at all."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from ballfg.files.held import MARK, NEW, PLAN
from ballfg.files.moving import settle
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
    fill(tmp_path, a="old", gone="old", mine="mine", images__x="old", images__y="old", data_1__w="old", place="old")
    with whole_folder(tmp_path, earlier=("a", "gone", "data_*", "..")) as stage:
        fill(stage, a="new", images__x="new", data_2__w="new", place__z="new")
    new = {"a": "new", "images/x": "new", "data_2/w": "new", "place/z": "new"}
    assert contents(tmp_path) == new | {"mine": "mine"}
    assert {path.name for path in tmp_path.iterdir()} == {"a", "images", "data_2", "mine", "place"}


def test_the_last_name_moves_last_and_folders_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moved: list[str] = []
    real = os.replace

    def replace(source: Any, target: Any) -> None:
        moved.append(Path(target).name)
        real(source, target)

    monkeypatch.setattr("os.replace", replace)
    with whole_folder(tmp_path, last="a") as stage:
        fill(stage, a="", b="", z__x="")
    assert moved[-3:] == ["z", "b", "a"]


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


# --- a writing that was killed, and two at a time ------------------------------------------------------------------


def killed_between(folder: Path, monkeypatch: pytest.MonkeyPatch, moves: int) -> None:
    """Leaves a folder as a kill does after some moves: no call works any more, those that clear up neither."""
    real, count = os.replace, [0]

    def replace(source: Any, target: Any) -> None:
        count[0] += 1
        if count[0] > moves:
            raise OSError("killed")
        real(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("os.replace", replace)
        with pytest.raises(OSError, match="killed"), whole_folder(folder, earlier=("gone",)) as stage:
            fill(stage, a="new", b="new", place__x="new")


@pytest.mark.parametrize("moves", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("way", ["read", "write"])
def test_a_killed_move_is_finished_by_the_next_reader_or_writer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int, way: str
) -> None:
    old = {"a": "old", "gone": "old", "place/y": "old", "mine": "mine"}
    fill(tmp_path, a="old", gone="old", place__y="old", mine="mine")
    killed_between(tmp_path, monkeypatch, moves)
    assert (tmp_path / MARK / PLAN).exists() == (moves > 0)
    if way == "read":
        settle(tmp_path)
        new = {"a": "new", "b": "new", "place/x": "new", "mine": "mine"}
        assert contents(tmp_path) == (new if moves else old)
    else:
        with whole_folder(tmp_path, earlier=("a", "b", "place", "gone")) as stage:
            fill(stage, c="newer")
        assert contents(tmp_path) == {"c": "newer", "mine": "mine"}
    assert not (tmp_path / MARK).exists()


PLANS = {
    "empty": "",
    "of another kind": "[1, 2]",
    "without lists": '{"stale": 3, "new": null}',
    "cut off": '{"stale": ["a"], "ne',
    "beside the folder": '{"stale": ["../precious"], "new": []}',
    "anywhere": '{"stale": [], "new": ["/precious"]}',
    "deeper": '{"stale": ["place/../../precious"], "new": []}',
    "through a link": '{"stale": ["away/precious"], "new": []}',
    "its own": f'{{"stale": ["{MARK}"], "new": []}}',
}


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_a_plan_from_elsewhere_moves_nothing(tmp_path: Path, plan: str) -> None:
    """A folder that somebody sends may hold anything; reading it must not touch what lies around it."""
    folder, precious = tmp_path / "sent", tmp_path / "precious"
    fill(folder, a="mine", place__y="mine")
    precious.write_text("mine")
    (folder / "away").symlink_to(tmp_path)
    (folder / MARK / NEW).mkdir(parents=True)
    (folder / MARK / PLAN).write_text(plan)
    with pytest.raises(ValueError, match="must be the plan of a writing that was ended") as refused:
        settle(folder)
    assert len(str(refused.value).splitlines()) == 1
    assert {name for name in contents(folder) if not name.startswith(MARK)} == {"a", "place/y"}
    assert precious.read_text() == "mine"


def test_a_plan_does_not_fetch_files_through_a_link(tmp_path: Path) -> None:
    folder, home = tmp_path / "sent", tmp_path / "home"
    fill(home, secret="mine")
    fill(folder, a="mine")
    (folder / MARK).mkdir()
    (folder / MARK / NEW).symlink_to(home)
    (folder / MARK / PLAN).write_text('{"stale": [], "new": ["secret"]}')
    with pytest.raises(ValueError, match="must be the plan"):
        settle(folder)
    assert (home / "secret").read_text() == "mine"


def test_a_folder_in_one_that_was_killed_is_finished_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, place__y="old")
    killed_between(tmp_path, monkeypatch, 1)
    settle(tmp_path / "place")
    assert contents(tmp_path) == {"a": "new", "b": "new", "place/x": "new"}


def test_a_reader_that_may_not_write_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, a="old")
    killed_between(tmp_path, monkeypatch, 1)

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as patch:
        patch.setattr("os.open", refuse)
        with pytest.raises(ValueError, match=r"between two results: .* \(Read-only file system\)\. Give permission"):
            settle(tmp_path)
    settle(tmp_path)
    assert contents(tmp_path) == {"a": "new", "b": "new", "place/x": "new"}


def test_what_a_killed_writing_made_is_cleared_by_the_next(tmp_path: Path) -> None:
    fill(tmp_path, d__a="old", **{f"d__{MARK}__{NEW}__half": "half", f".d{MARK}__{NEW}__half": "half"})
    with whole_folder(tmp_path / "d") as stage:
        fill(stage, b="new")
    assert contents(tmp_path) == {"d/a": "old", "d/b": "new"}


def test_folders_that_are_merged_keep_other_files(tmp_path: Path) -> None:
    fill(tmp_path, one__a="old", one__b="old", one__mine="mine")
    with whole_folder(tmp_path, earlier=("one/a", "one/b", "two/b"), merged=("one", "two")) as stage:
        fill(stage, one__a="new", two__a="new")
    assert contents(tmp_path) == {"one/a": "new", "one/mine": "mine", "two/a": "new"}


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
        message = f"out must not be written twice .* is being written by process {other.pid}. Wait for it"
        with pytest.raises(ValueError, match=message), whole_folder(folder):
            pass
        other.kill()
        other.wait()
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

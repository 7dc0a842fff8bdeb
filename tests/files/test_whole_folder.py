"""A folder's files are there all together or not at all."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from signal import SIGKILL
from stat import S_ISDIR
from typing import Any

import pytest

from ballfg.files import whole_folder as module
from ballfg.files.held import MARK
from ballfg.files.whole_file import whole_file, write_text
from ballfg.files.whole_folder import check_replaceable, reserved, whole_folder
from tests.faults.kills import in_fork


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


# --- what stays, and disks that can do less ------------------------------------------------------------------------


def cannot(*_: object, **__: object) -> None:
    raise OSError(errno.EINVAL, "not supported")


def test_the_exchange_is_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, d__a="old", d__b="old", d__mine="mine")
    real, seen = module.exchange, []

    def exchange(one: Path, other: Path) -> None:
        seen.append(contents(tmp_path / "d"))
        real(one, other)
        seen.append(contents(tmp_path / "d"))

    monkeypatch.setattr(module, "exchange", exchange)
    with whole_folder(tmp_path / "d", earlier=("a", "b")) as stage:
        fill(stage, a="new")
    assert seen == [{"a": "old", "b": "old", "mine": "mine"}, {"a": "new", "mine": "mine"}]
    assert os.listdir(tmp_path) == ["d"]


@pytest.mark.parametrize("lacks", ["", "exchange", "link"])
def test_what_stays_is_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacks: str) -> None:
    folder = tmp_path / "d"
    fill(folder, mine="mine", below__deep__x="x", a="old")
    (folder / "mine").chmod(0o600)
    (folder / "dangling").symlink_to("nowhere")
    (folder / "away").symlink_to(tmp_path)
    if lacks != "link":
        os.mkfifo(folder / "pipe")
    (folder / "below" / "deep").chmod(0o555)
    os.utime(folder / "below" / "deep", (1e9, 1e9))
    folder.chmod(0o750)

    def seen() -> dict[str, tuple[int, ...]]:
        found = {str(path.relative_to(folder)): path.lstat() for path in [folder, *folder.rglob("*")]}
        keeps = {name: (one.st_mode, one.st_uid, one.st_gid) for name, one in found.items() if name != "a"}
        files = {
            name: (one.st_mtime_ns, 0 if lacks == "link" else one.st_ino)
            for name, one in found.items()
            if not S_ISDIR(one.st_mode)
        }
        return {name: (*modes, *files.get(name, ())) for name, modes in keeps.items()}

    if lacks:
        monkeypatch.setattr(*{"exchange": (module, "exchange"), "link": (os, "link")}[lacks], cannot)
    before = seen()
    with whole_folder(folder) as stage:
        fill(stage, a="new", below__b="new")
    after = seen()
    del after["below/b"]
    assert after == before
    assert (folder / "below" / "deep").stat().st_mtime == 1e9
    assert (folder / "a").read_text() == "new"
    assert os.listdir(tmp_path) == ["d"]


def test_what_somebody_writes_at_the_last_moment_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "d"
    fill(folder, a="old", mine="mine", below__x="x")
    real = module.exchange

    def exchange(one: Path, other: Path) -> None:
        fill(folder, late="late", below__y="late", a="theirs", gone="late")
        (folder / "part").write_text("changed")
        os.replace(folder / "part", folder / "mine")
        real(one, other)

    monkeypatch.setattr(module, "exchange", exchange)
    with whole_folder(folder, earlier=("gone",)) as stage:
        fill(stage, a="new")
    assert contents(tmp_path) == {
        "d/a": "new", "d/mine": "changed", "d/below/x": "x", "d/below/y": "late", "d/late": "late",
    }  # fmt: skip


def test_folders_that_must_keep_their_place_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path, d__below__a="old", d__deep__a="old")
    message = "out must be a folder that can be exchanged for a new one; .* is mounted, or the current folder is in it"
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path / "d" / "below")
        for folder in (Path(), Path(), tmp_path / "d"):
            with pytest.raises(ValueError, match=message), whole_folder(folder):
                pass
        with pytest.raises(ValueError, match=message):
            check_replaceable(tmp_path / "d", mark="below", what="anything", is_mark=Path.is_dir)
        with whole_folder(Path("../new")) as stage:
            fill(stage, a="new")
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path).name == "below")
    with pytest.raises(ValueError, match=message), whole_folder(tmp_path / "d" / "below"):
        pass
    with pytest.raises(OSError, match="mounted or nested too deep"), whole_folder(tmp_path / "d"):
        pass
    assert contents(tmp_path) == {"d/below/a": "old", "d/deep/a": "old", "d/new/a": "new"}
    with whole_folder(tmp_path / "d", earlier=("below",)) as stage:  # which goes with its folder
        fill(stage, a="new")


def test_a_tree_without_end_is_refused(tmp_path: Path) -> None:
    deep = tmp_path.joinpath("d", *["x"] * (module.DEEPEST + 5))
    deep.mkdir(parents=True)
    with pytest.raises(OSError, match="mounted or nested too deep"), whole_folder(tmp_path / "d") as stage:
        fill(stage, a="new")
    assert deep.is_dir()
    assert not contents(tmp_path)
    assert os.listdir(tmp_path) == ["d"]


# --- writers that were killed, and what lies around ----------------------------------------------------------------


def killed(tmp_path: Path, work: Callable[[], object]) -> None:
    """Does some work in a process that kills itself."""
    assert in_fork(work, tmp_path / "said") == -SIGKILL
    (tmp_path / "said").unlink()


def end() -> None:
    os.kill(os.getpid(), SIGKILL)


def kill_in(write: Callable[[], AbstractContextManager[Path]]) -> None:
    with write() as stage:
        (stage / "half" if stage.is_dir() else stage).write_text("half")
        end()


WRITERS = {
    "file": lambda folder: whole_file(folder / "a"),
    "new folder": lambda folder: whole_folder(folder / "new"),
    "folder": lambda folder: whole_folder(folder / "place"),
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_next_writer_removes_what_a_killed_one_left_and_nothing_else(tmp_path: Path, name: str) -> None:
    fill(tmp_path, place__x="x")
    fill(tmp_path, **{f"{MARK}{'0' * 16}__new__x": "planted", f"place__{MARK}{'1' * 16}__new__x": "planted"})
    before = contents(tmp_path)
    killed(tmp_path, lambda: kill_in(lambda: WRITERS[name](tmp_path)))
    assert set(contents(tmp_path)) > set(before)  # the hidden folder
    with WRITERS[name](tmp_path) as stage:
        (stage / "b" if stage.is_dir() else stage).write_text("b")
    after = contents(tmp_path)
    assert len(after) == len(before) + 1
    assert before.items() <= after.items()


def test_a_leftover_that_became_a_link_is_not_followed(tmp_path: Path) -> None:
    fill(tmp_path, precious__x="mine", out__y="y")
    killed(tmp_path, lambda: kill_in(lambda: whole_file(tmp_path / "out" / "a")))
    (left,) = (tmp_path / "out").glob(f"{MARK}*")
    shutil.rmtree(left)
    left.symlink_to(tmp_path / "precious")
    write_text(tmp_path / "out" / "a", "a")
    assert contents(tmp_path) == {"precious/x": "mine", "out/y": "y", "out/a": "a"}
    assert left.is_symlink()


@pytest.mark.parametrize("renames", [1, 2])
def test_a_kill_between_two_steps_leaves_the_old_folder_to_the_next_writer(tmp_path: Path, renames: int) -> None:
    """On a disk that cannot exchange folders."""
    fill(tmp_path, d__mark="old", d__mine="mine")
    real, count = os.rename, [0]

    def rename(*paths: Any) -> None:
        real(*paths)
        count[0] += 1
        if count[0] == renames:
            end()

    def work() -> None:
        module.exchange, os.rename = cannot, rename
        with whole_folder(tmp_path / "d") as stage:
            fill(stage, mark="new")

    killed(tmp_path, work)
    assert (tmp_path / "d").exists() == (renames == 2)
    check_replaceable(tmp_path / "d", mark="mark", what="a result")
    assert contents(tmp_path) == {"d/mark": "old" if renames == 1 else "new", "d/mine": "mine"}


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), KeyboardInterrupt()])
@pytest.mark.parametrize("at", [1, 2])
def test_a_failure_between_two_steps_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, at: int
) -> None:
    fill(tmp_path, d__a="old")
    real, count = os.rename, [0]

    def rename(*paths: Any) -> None:
        count[0] += 1
        if not at == count[0] == 2:
            real(*paths)
        if count[0] == at:  # after the first of them, and in place of the second
            raise error

    def broken() -> None:
        with whole_folder(tmp_path / "d") as stage:
            fill(stage, a="new")

    monkeypatch.setattr(module, "exchange", cannot)
    monkeypatch.setattr("os.rename", rename)
    with pytest.raises(type(error)):
        broken()
    assert contents(tmp_path) == {"d/a": "old"}


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

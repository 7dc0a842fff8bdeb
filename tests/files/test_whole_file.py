"""A file is there whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from ballfg.files.whole_file import whole_file, write_text


def test_the_name_appears_at_the_end_with_the_usual_permissions(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with whole_file(path) as temporary:
        temporary.write_text("content")
        assert temporary.name == path.name
        assert not path.exists()
    (tmp_path / "plain").touch()
    assert path.read_text() == "content"
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.txt", "plain"}


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_exception_leaves_the_earlier_file_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "earlier")

    def broken() -> None:
        with whole_file(path) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(error):
        broken()
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("call", ["os.fsync", "os.replace"])
def test_a_disk_that_fails_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "earlier")

    def fail(*_: object) -> None:
        raise OSError("no space")

    with monkeypatch.context() as patch:
        patch.setattr(call, fail)
        with pytest.raises(OSError, match="no space"):
            write_text(path, "later")
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_places_that_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"out must be in an existing folder; .*no is none\. Create it first\."):
        write_text(tmp_path / "no" / "a.txt", "")
    with pytest.raises(ValueError, match=r"table must be a file; .* is a folder"), whole_file(tmp_path, "table"):
        pass
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match=r"out must be a file; .*pipe is a device or a pipe\. Give the name of a file"):
        write_text(tmp_path / "pipe", "")
    assert (tmp_path / "pipe").is_fifo()  # root would have put a file in the place of /dev/null


def test_content_is_on_the_disk_before_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr("os.fsync", lambda handle: (calls.append("fsync"), fsync(handle)))
    monkeypatch.setattr("os.replace", lambda *paths: (calls.append("replace"), replace(*paths)))
    write_text(tmp_path / "a.txt", "content")
    assert calls == ["fsync", "replace", "fsync"]


def test_a_file_that_is_replaced_leaves_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "secret.csv"
    path.write_text("old")
    for mode in (0o600, 0o664):
        path.chmod(mode)
        write_text(path, "new")
        assert stat.S_IMODE(path.stat().st_mode) == mode


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to somebody else")
def test_a_file_that_is_replaced_stays_with_its_owner(tmp_path: Path) -> None:
    path = tmp_path / "theirs.csv"
    path.write_text("old")
    os.chown(path, 12345, 12346)
    write_text(path, "new")
    assert (path.stat().st_uid, path.stat().st_gid) == (12345, 12346)


def test_a_link_stays_and_the_file_that_it_leads_to_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "states.csv").write_text("old")
    (tmp_path / "latest.csv").symlink_to("disk/states.csv")
    write_text(tmp_path / "latest.csv", "new")
    assert os.readlink(tmp_path / "latest.csv") == "disk/states.csv"
    assert (tmp_path / "disk" / "states.csv").read_text() == "new"
    assert sorted(os.listdir(tmp_path)) == ["disk", "latest.csv"]
    (tmp_path / "disk" / "states.csv").unlink()
    with pytest.raises(ValueError, match=r"out must be a file; .*latest\.csv is a link that leads nowhere\. Give the"):
        write_text(tmp_path / "latest.csv", "new")
    assert not (tmp_path / "disk" / "states.csv").exists()


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_full_disk_is_said_with_the_name_of_the_file(tmp_path: Path, number: int) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(OSError, match=os.strerror(number)) as said, whole_file(path):
        raise OSError(number, os.strerror(number))  # as `write` and `fsync` raise it: without a name
    assert said.value.filename == str(path)
    with pytest.raises(OSError, match="No such file") as said, whole_file(path) as temporary:
        temporary.open()
    assert said.value.filename == str(path)


def test_other_errors_keep_their_names(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as said, whole_file(tmp_path / "a.txt"):
        (tmp_path / "input.csv").open()
    assert said.value.filename == str(tmp_path / "input.csv")
    with pytest.raises(BrokenPipeError) as pipe, whole_file(tmp_path / "a.txt"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")  # of stdout
    assert pipe.value.filename is None


def test_a_place_where_nothing_can_be_made_is_refused_at_once() -> None:
    with pytest.raises(OSError, match=r"'/proc/x\.csv'$"):
        write_text(Path("/proc/x.csv"), "")


def test_a_state_folder_on_a_full_disk_keeps_nobody_from_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Path.open

    def full(path: Path, *more: Any, **named: Any) -> Any:
        if path.parent.name == "locks":
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, *more, **named)

    monkeypatch.setattr(Path, "open", full)
    write_text(tmp_path / "a.txt", "content")
    monkeypatch.undo()
    assert (tmp_path / "a.txt").read_text() == "content"


def test_no_lock_stays_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in ("a", "b"):
        write_text(tmp_path / name, name)
    assert not list((tmp_path / "state" / "ballfg" / "locks").iterdir())

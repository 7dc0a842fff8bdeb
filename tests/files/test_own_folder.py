"""Folders that somebody else could change are told from those that only this user can."""

import os
from pathlib import Path

import pytest

from ballfg.files.own_folder import is_own, own_bytes, own_folder, state_folder, temporary_folder


def test_a_folder_for_this_user_alone_is_its_own(tmp_path: Path) -> None:
    made = own_folder(tmp_path / "a" / "b")
    assert made.stat().st_mode & 0o777 == 0o700
    assert is_own(made)
    assert not is_own(tmp_path / "missing")


@pytest.mark.parametrize("opened", ["", "a", "a/b"])
def test_a_folder_that_everybody_may_write_to_is_not(tmp_path: Path, opened: str) -> None:
    made = own_folder(tmp_path / "a" / "b")
    (tmp_path / opened).chmod(0o777)
    assert not is_own(made)
    with pytest.raises(ValueError, match="only this user may write to"):
        own_folder(made)


def test_a_sticky_folder_around_it_keeps_it(tmp_path: Path) -> None:
    made = own_folder(tmp_path / "a" / "b")
    (tmp_path / "a").chmod(0o1777)
    assert is_own(made)
    made.chmod(0o1777)
    assert not is_own(made)  # others may put new files into it


def test_a_link_is_judged_where_it_leads(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "link").symlink_to(tmp_path / "open")
    assert not is_own(tmp_path / "link")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to somebody else")
def test_a_folder_of_somebody_else_is_not(tmp_path: Path) -> None:
    made = own_folder(tmp_path / "a")
    (tmp_path / "link").symlink_to(made)
    assert is_own(tmp_path / "link")
    os.chown(tmp_path / "link", 12345, 12345, follow_symlinks=False)
    assert not is_own(tmp_path / "link")  # its owner could let it lead elsewhere
    os.chown(made, 12345, 12345)
    assert not is_own(made)


def test_a_file_that_others_may_write_to_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"content")
    file.chmod(0o644)
    assert own_bytes(file) == b"content"
    for mode in (0o664, 0o646):
        file.chmod(mode)
        with pytest.raises(ValueError, match="only this user may write to"):
            own_bytes(file)


def test_state_goes_to_a_private_folder_where_the_users_own_is_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert state_folder("locks") == tmp_path / "state" / "ballfg" / "locks"
    (tmp_path / "state" / "ballfg").chmod(0o777)
    assert state_folder("locks") == temporary_folder("locks")
    assert is_own(temporary_folder("locks"))

"""A file is there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

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

"""Recordings: continued, never replaced, whole lines after kills and full disks, one command at a time."""

from __future__ import annotations

import errno
import json
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ballfg.live import recording as module
from ballfg.live.recording import Recording, lines_recording

LINES = b'{"kind":"newcomer","t_input":0.1}\n{"kind":"state","t":0.2}\n'
CONTINUED = b'{"kind":"continued","latency_ms":0.000}\n'


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Files of this process cannot grow beyond a number of bytes, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_line_is_in_the_file_at_once(tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    with lines_recording(out, repeats=True) as recording:
        recording.append(LINES)
        assert out.read_bytes() == LINES
    assert out.read_bytes() == LINES
    assert [path.name for path in tmp_path.iterdir()] == ["states.jsonl"]


@pytest.mark.parametrize(
    "half", [b"", b"{", b'{"kind":"state","t":0.3', b'"', b"\0" * 70000, b'{"x":"' + b"9" * 200000]
)
def test_a_recording_is_continued_after_its_last_whole_line(
    half: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "states.jsonl"
    out.write_bytes(LINES + half)
    out.chmod(0o600)
    with lines_recording(out, repeats=False) as recording:
        recording.append(LINES)
    assert out.read_bytes() == LINES + CONTINUED + LINES
    assert out.stat().st_mode & 0o777 == 0o600
    said = capsys.readouterr().err
    assert f"continuing {out}, which holds {len(LINES)} bytes" in said
    assert (f"{len(half)} bytes at its end" in said) == bool(half)


@pytest.mark.parametrize("half", [b"", b"{", b'{"kind":"sta'])
def test_a_file_without_a_whole_line_is_begun(half: bytes, tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    out.write_bytes(half)
    with lines_recording(out, repeats=False) as recording:
        recording.append(LINES)
    assert out.read_bytes() == LINES


@pytest.mark.parametrize(
    "content",
    [
        b"a letter\n",
        b"half a letter",
        b"t,x,y,z\n0,1,2,3\n",
        b'{"kind":"invoice"}\n',
        b'["kind"]\n',
        b"\xff\xfe\n",
        b"9" * 70000,
    ],
)
def test_what_is_no_recording_is_left_alone(content: bytes, tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    out.write_bytes(content)
    with pytest.raises(ValueError, match="out must be a new file or a recording of ballfg live"):
        lines_recording(out, repeats=False)
    assert out.read_bytes() == content


def test_a_replay_asks_for_another_name(tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    out.write_bytes(LINES)
    with pytest.raises(ValueError, match=r"out must be a new file for a replay .* Choose another name"):
        lines_recording(out, repeats=True)
    assert out.read_bytes() == LINES


def test_a_second_command_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    with lines_recording(out, repeats=False) as recording:
        with pytest.raises(ValueError, match="out must not be written twice at the same time; another process records"):
            lines_recording(out, repeats=False)
        recording.append(LINES)
    with lines_recording(out, repeats=False):
        pass
    assert out.read_bytes() == LINES + CONTINUED


def test_a_link_is_written_to_where_it_leads(tmp_path: Path) -> None:
    target, out = tmp_path / "elsewhere.jsonl", tmp_path / "states.jsonl"
    target.touch()
    out.symlink_to(target.name)
    for _ in range(2):
        with lines_recording(out, repeats=False) as recording:
            recording.append(LINES)
    assert out.is_symlink()
    assert target.read_bytes() == LINES + CONTINUED + LINES


def test_folders_pipes_and_links_in_a_circle_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    for path, message in (
        (tmp_path, "is a folder"),
        (tmp_path / "pipe", "is a device or a pipe"),
        (tmp_path / "circle", "is a link that leads nowhere"),
    ):
        with pytest.raises(ValueError, match=message):
            Recording(path)
    with pytest.raises(FileNotFoundError, match="out must be in an existing folder"):
        Recording(tmp_path / "none" / "states.jsonl")


def test_a_full_disk_is_one_error_that_names_the_file_and_whole_lines_stay(tmp_path: Path) -> None:
    out = tmp_path / "states.jsonl"
    line = json.dumps({"kind": "state", "t": 0.25}, separators=(",", ":")).encode() + b"\n"
    with lines_recording(out, repeats=False) as recording, disk_of(10 * len(line) + 7):
        for _ in range(10):
            recording.append(line)
        with pytest.raises(OSError, match="File too large") as error:
            recording.append(line)
    assert error.value.filename == str(out)
    assert out.read_bytes() == 10 * line
    with lines_recording(out, repeats=False) as recording:
        recording.append(line)
    assert out.read_bytes() == 10 * line + CONTINUED + line


def test_a_disk_that_fails_later_ends_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`fsync` tells of errors that `write` could not know."""
    failed = module.threading.Event()

    def broken(handle: int) -> None:
        failed.set()
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(module, "EVERY", 0.01)
    monkeypatch.setattr(module.os, "fsync", broken)
    with Recording(tmp_path / "states.jsonl") as recording:
        recording.append(LINES)
        assert failed.wait(20.0)
        recording._thread.join()
        with pytest.raises(OSError, match="Input/output error") as error:
            recording.append(LINES)
    assert error.value.filename == str(tmp_path / "states.jsonl")

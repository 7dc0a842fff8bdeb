"""What a user sees when something is wrong."""

import errno
import os
import subprocess
import sys

import pytest
import torch

from ballfg.cli.start import BAD_INPUT, NO_MEMORY, guarded
from tests.commands import printed
from tests.interpreter import fresh
from tests.places import ROOT


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ValueError("rate must be\npositive"), "rate must be positive"),
        (FileNotFoundError("folder must exist; x does not."), "folder must exist; x does not."),
        (OSError(errno.ENOSPC, "No space left on device"), "a file could not be read or written: No space left"),
        (PermissionError(errno.EACCES, "Permission denied", "a.csv"), "a.csv: Permission denied. Check the path"),
        (MemoryError(), "memory ran out. Use fewer --jobs"),
        (MemoryError("Unable to allocate 3 GiB"), "memory ran out (Unable to allocate 3 GiB). Use fewer --jobs"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: 3 bytes"),
            "memory ran out (torch can't allocate memory).",
        ),
        (
            UnicodeEncodeError("utf-8", "b\udcff", 1, 2, "surrogates not allowed"),
            r"names and texts must be UTF-8; got 'b\udcff'. Rename",
        ),
    ],
)
def test_what_a_user_can_mend_is_one_line(capsys, error, message):
    def command() -> None:
        raise error

    assert guarded(command) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith(f"ballfg: error: {message}")
    assert said.count("\n") == 1


def test_code_that_leaves_is_named(capsys):
    """Else a command would end well without a result, and without a word."""
    assert guarded(lambda: sys.exit(0)) == BAD_INPUT
    assert f"that in {__file__}, line" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        guarded(sys.exit)  # from a frame of ballfg's own


def test_torch_is_refused_more_memory_than_there_is():
    """What it says has changed between versions."""
    with pytest.raises(RuntimeError, match=NO_MEMORY):
        torch.empty(2**58, dtype=torch.uint8)


def test_a_name_that_is_no_text_is_refused_before_anything_is_done(tmp_path):
    name = os.fsdecode(bytes(tmp_path / "shots") + b"\xff")
    assert r"shots\udcff'. Rename" in printed("simulate", "--out", name, "--tracks", "2", status=BAD_INPUT).err
    assert not list(tmp_path.iterdir())


CLOSED = """
import os, sys
for number in (0, 1, 2):
    os.close(number)
sys.stdin = sys.stdout = sys.stderr = None  # as Python starts where somebody has closed them
from ballfg.cli import entry
entry._run("program_of_a_test")
"""
PROGRAM = """
import os, sys
def run():
    with open("result", "w") as file:
        print("to nobody", file=sys.stderr)
        os.write(1, b"a library speaks")
        os.write(2, b"and complains")
        file.write(f"{sys.stdin.read()!r} {sys.stdout.isatty()}")
"""


def test_closed_streams_lead_nowhere(tmp_path):
    """Not into the next file that is opened."""
    (tmp_path / "program_of_a_test.py").write_text(PROGRAM)
    fresh(CLOSED, cwd=tmp_path, check=True)
    assert (tmp_path / "result").read_text() == "'' False"


def test_a_current_folder_that_is_gone_is_one_line(tmp_path):
    code = "import os, sys; os.rmdir(os.getcwd()); from ballfg.cli.entry import ballfg; ballfg()"
    done = fresh(code, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (
        BAD_INPUT,
        "ballfg: error: the current folder: No such file or directory. Go to one that exists.\n",
    )


def test_a_fault_of_the_program_keeps_its_traceback():
    def command() -> None:
        raise KeyError("x")

    with pytest.raises(KeyError):
        guarded(command)


@pytest.mark.parametrize(
    "words",
    ["--help", "estimate --help", "info", pytest.param("simulate --out x --tracks 2", marks=pytest.mark.thorough)],
)
def test_a_reader_of_stdout_that_leaves_is_no_error(words, tmp_path):
    """As `| head`: no word, and the status that shells show of a program which SIGPIPE ends; results stay."""
    code = "from ballfg.cli.main import run; run()"
    there, here = os.pipe()
    os.close(there)
    command = [sys.executable, "-c", code, *words.split(), *(["--quiet"] if "simulate" in words else [])]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, stdout=here, stderr=subprocess.PIPE, cwd=tmp_path, env=environment, timeout=120)
    os.close(here)
    assert done.returncode == 141
    assert b"Error" not in done.stderr
    assert b"error" not in done.stderr
    assert (tmp_path / "x" / "tracks.csv").is_file() == ("simulate" in words)


def test_a_broken_pipe_to_another_place_is_told(capsys):
    """Only what was printed for a reader that left ends without a word."""

    def command() -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe", "a.fifo")

    assert guarded(command) == BAD_INPUT
    assert "a.fifo: Broken pipe" in capsys.readouterr().err

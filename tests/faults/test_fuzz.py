"""Damaged files of every kind: read, or refused in one line; and what the fuzzer itself must notice."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from ballfg.files.damaged import library_reads
from ballfg.importing.formats.containers import read_hdf5
from tests.faults import worker
from tests.faults.fuzz import corpus_cases
from tests.faults.readers import reader_of
from tests.faults.seeds import write_seeds
from tests.faults.worker import Worker, verdict
from tests.places import ROOT


@pytest.mark.filterwarnings("ignore")  # a damaged file may be warned of, as the command line hides
def test_the_corpus_is_refused_in_one_line(tmp_path: Path) -> None:
    """Damaged files that once were a fault, read in this process."""
    cases, place = list(corpus_cases()), tmp_path / "case"
    write_seeds(tmp_path / "seeds", {reader for reader, _, _ in cases})
    wrong = []
    for reader, name, content in cases:
        shutil.copytree(tmp_path / "seeds" / reader, place, symlinks=True)
        (place / name).write_bytes(content)
        wanted = reader_of(reader)
        found = verdict(
            partial(wanted.read, place, place / name), (Path(name).name, str(place)) if wanted.names_file else ()
        )
        wrong += [(reader, name, found)] if found[0] == "fault" else []
        shutil.rmtree(place)
    assert not wrong
    assert len(cases) > 30


@pytest.mark.thorough
@pytest.mark.parametrize("seconds", [6])
def test_every_reader_refuses_damaged_files_in_one_line(seconds: int) -> None:
    """The corpus, every file replaced as a whole, then some seconds of random damage."""
    command = [sys.executable, "-m", "tests.faults.fuzz", "--replay", "--seconds", str(seconds), "--seed", "1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert " 0 fault" in done.stdout


def _good() -> None:
    """Nothing happens."""


def _says(error: Exception) -> Callable[[], object]:
    def fail() -> None:
        raise error

    return fail


@pytest.mark.parametrize(
    ("read", "outcome", "words"),
    [
        (_good, "read", ""),
        (_says(ValueError("a.csv must be good")), "refused", "a.csv"),
        (_says(ValueError("must be good")), "fault", "names no file"),
        (_says(ValueError("a.csv must\nbe good")), "fault", "not one line"),
        (_says(ValueError("a.csv" + "x" * 3000)), "fault", "3005 characters"),
        (_says(KeyError("a.csv")), "fault", "KeyError"),
        (_says(np.linalg.LinAlgError("a.csv")), "fault", "numpy's own"),
    ],
)
def test_verdicts(read: Callable[[], object], outcome: str, words: str) -> None:
    found = verdict(read, ("a.csv",))
    assert found[0] == outcome
    assert words in found[1]


def test_hangs_crashes_and_memory_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each in a process that is really ended; the next case finds a new one."""
    monkeypatch.setattr(worker, "SECONDS", 0.2)
    monkeypatch.setattr(worker, "WAITING", 1.0)

    def spin() -> None:
        while True:
            pass

    cases = {
        "spin": spin, "sleep": lambda: time.sleep(60.0), "crash": os.abort, "leave": lambda: os._exit(0),
        "memory": lambda: bytearray(3 << 30), "good": _good,
    }  # fmt: skip
    judge = Worker(lambda reader, file: verdict(cases[reader], ()), _good)
    found = {name: judge(name, "") for name in cases}
    judge.close()
    assert found["spin"] == ("fault", "hang: over 0.2 s of the processor")
    assert found["sleep"] == ("fault", "hang: waits for over 1 s")
    assert found["crash"] == ("fault", "crash: SIGABRT")
    assert found["leave"][1].startswith("crash")
    assert found["memory"][1].startswith("MemoryError")
    assert found["good"] == ("read", "")


def test_empty_data_of_any_size_are_not_made(tmp_path: Path) -> None:
    """HDF5 keeps no room for what nobody has written; together these would take 96 MB, and say so in 3 kB."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name in ("t", "x", "y"):
            file.create_dataset(name, shape=(4_000_000,), dtype="f8")
    assert path.stat().st_size < 10_000
    with pytest.raises(ValueError, match=r"a\.h5 must unpack to at most 32 MB"):
        read_hdf5(path)


def test_a_librarys_error_becomes_one_line(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match=r"a must be a whole Excel file; 'two lines'\. Copy") as caught,
        library_reads(tmp_path / "a", "Excel"),
    ):
        raise KeyError("two lines")
    assert "\n" not in str(caught.value)

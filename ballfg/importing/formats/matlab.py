"""MATLAB files of any version. Those before 7.3 are read in a process of their own, which a damaged file may end."""

import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

from ballfg.files.damaged import check_unpacked, library_reads, most_unpacked
from ballfg.importing.formats.containers import read_hdf5
from ballfg.importing.formats.nested import nested_tables
from ballfg.importing.formats.raw import RawTable


def read_matlab(path: Path) -> list[RawTable]:
    """The tables of a MATLAB file of any version. Raises: ValueError: not one, or version 7.3 without h5py."""
    with library_reads(path, "MATLAB"):
        outcome, content = _in_a_process(path)
        if outcome == "error":
            raise ValueError(content)
    if outcome == "too large":
        check_unpacked(path, content)
    return read_hdf5(path) if outcome == "hdf5" else nested_tables(content, path.stem, str(path))


def _in_a_process(path: Path) -> tuple[str, Any]:
    """Outcome and content, as `matlab_child` says them. Raises: ValueError: the process ended without an answer."""
    child = Path(__file__).with_name("matlab_child.py")
    command = [sys.executable, "-P", str(child), str(path.absolute()), str(most_unpacked(path))]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise ValueError(said[-1] if done.returncode > 0 and said else "its parts have sizes that cannot be")
    found: tuple[str, Any] = pickle.loads(done.stdout)  # of this project's own process
    return found

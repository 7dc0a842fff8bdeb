"""Reads MATLAB files of any version, those before 7.3 in a process that a damaged file may crash."""

import pickle
import subprocess
import sys
import zlib
from pathlib import Path
from struct import unpack
from typing import Final

from ballfg.files.damaged import check_unpacked, library_reads, most_unpacked
from ballfg.importing.formats.containers import read_hdf5
from ballfg.importing.formats.nested import nested_tables
from ballfg.importing.formats.raw import RawTable

_HEADER: Final = 128  # Bytes before the first variable; the last two give the byte order
_COMPRESSED: Final = 15  # the kind of a compressed variable
_BLOCK: Final = 1 << 20


def read_matlab(path: Path) -> list[RawTable]:
    """The tables of a MATLAB file of any version. Raises: ValueError: not one, or version 7.3 without h5py."""
    child = Path(__file__).with_name("matlab_child.py")
    with library_reads(path, "MATLAB"):
        _check_packed(path)
        command = [sys.executable, "-P", str(child), str(path.absolute()), str(most_unpacked(path))]
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode("utf-8", "replace").strip().splitlines()
            raise ValueError(said[-1] if done.returncode > 0 and said else "its parts have sizes that cannot be")
        outcome, content = pickle.loads(done.stdout)  # from this project's own process
        if outcome == "error":
            raise ValueError(content)
    if outcome == "too large":
        check_unpacked(path, content)
    return read_hdf5(path) if outcome == "hdf5" else nested_tables(content, path.stem, str(path))


def _check_packed(path: Path) -> None:
    """Counts the unpacked bytes of a version 5 file (MathWorks, MAT-File Format, level 5). Raises: ValueError."""
    with path.open("rb") as file:
        order = {b"IM": "<II", b"MI": ">II"}.get(file.read(_HEADER)[-2:])
        size = 0
        while order and len(tag := file.read(8)) == 8:
            kind, length = unpack(order, tag)
            if kind != _COMPRESSED:
                file.seek(length, 1)
                continue
            packed, inflate = file.read(length), zlib.decompressobj()
            while packed and not inflate.eof:
                size += len(inflate.decompress(packed, _BLOCK))
                check_unpacked(path, size)
                packed = inflate.unconsumed_tail

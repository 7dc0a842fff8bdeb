"""Files that are small and unpack to much, or have no end: each must be refused within 2 s and 300 MB.

    python -m tests.faults.bombs              every bomb; --only parquet: those whose name begins so
    python -m tests.faults.bombs --large      large files that are good, which must be read

Each bomb is read as the commands read it, in a process of its own that has imported the program and read good files.
Time is that of the processor for the reading alone, so that other programs do not count; the wall's stands in brackets.
Memory is the largest that the process took beyond what it had before,
and all that processes took which it started. The exit status is 1 where a bomb was read, or cost more.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from ballfg.files.weights import read_tensors
from ballfg.importing import Choices
from ballfg.importing.proposal import propose
from ballfg.machine import collect_rarely
from ballfg.vision.calibration.boards import read_grey
from tests.faults.bombs_of_arrays import ARRAYS
from tests.faults.bombs_of_others import OTHERS
from tests.faults.bombs_of_tables import TABLES
from tests.faults.large_files import LARGE
from tests.faults.readers import reader_of
from tests.faults.seeds import write_reader
from tests.faults.worker import in_a_process, verdict

SECONDS = 2.0
MEMORY = 300e6
"""Bytes."""
LOOK_EVERY = 0.01
"""s between looks at the processes that a reader starts."""
GIVEN_UP = 60
"""s after which a reading is ended."""
BOMBS = TABLES | ARRAYS | OTHERS
"""By name, which begins with the format: the reader, the file in the folder of that reader, and what writes it."""
FREE_STANDING: dict[str, Callable[[Path], object]] = {
    "import": lambda file: propose(file, Choices()),
    "boards": read_grey,
    "weights": read_tensors,
}
"""Readers of one file, which need no other files beside it."""


@dataclass(frozen=True)
class Outcome:
    """How a reading ended.

    Attributes:
        outcome: read, refused or fault.  words: of the refusal.
        seconds: of the processor.  wall: s.  memory: bytes, at most, beyond those before.
    """

    outcome: str
    words: str
    seconds: float
    wall: float
    memory: float

    @property
    def good(self) -> bool:
        """Whether the bomb was refused in time and within its memory."""
        return self.outcome == "refused" and self.seconds <= SECONDS and self.memory <= MEMORY


def run(names: Iterable[str], folder: Path) -> dict[str, Outcome]:
    """Writes and reads bombs. Args: names: of `BOMBS`.  folder: to write to. Returns: outcomes by name."""
    names = list(names)
    readers = sorted({BOMBS[name][0] for name in names} - set(FREE_STANDING))
    seeds = folder / "seeds"
    in_a_process(lambda: [write_reader(seeds, reader) for reader in readers])
    warnings.simplefilter("ignore")
    collect_rarely()  # as the program does
    _warm(seeds, readers)
    found = {}
    for name in names:
        place = folder / "case"
        if BOMBS[name][0] in FREE_STANDING:
            place.mkdir()
        else:
            shutil.copytree(seeds / BOMBS[name][0], place, symlinks=True)
        file = place / BOMBS[name][1]
        file.parent.mkdir(exist_ok=True)
        in_a_process(lambda file=file, name=name: BOMBS[name][2](file))  # type: ignore[misc]
        found[name] = measured(lambda place=place, file=file, name=name: _read(name, place, file), str(place))  # type: ignore[misc]
        shutil.rmtree(place)
    return found


def read_large(folder: Path) -> dict[str, Outcome]:
    """Reads large files that are good. Args: folder: to write to. Returns: outcomes by name."""
    _warm(folder, ())
    found = {}
    for name, (file, write, read) in LARGE.items():
        place = folder / "large"
        place.mkdir()
        in_a_process(lambda place=place, file=file, write=write: write(place / file))  # type: ignore[misc]
        found[name] = measured(lambda place=place, file=file, read=read: read(place / file), str(place))  # type: ignore[misc]
        shutil.rmtree(place)
    return found


def measured(read: Callable[[], object], place: str) -> Outcome:
    """How a reading ends in a process of its own. Args: place: a path that messages must name."""
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        os.close(ours)
        signal.alarm(GIVEN_UP)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        before, begun, worked = _resident(), time.perf_counter(), _processor()
        outcome, words = verdict(read, (place,))
        seconds, wall = _processor() - worked, time.perf_counter() - begun
        peak = 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        os.write(theirs, json.dumps([outcome, words[:1000], seconds, wall, peak - before]).encode())
        os._exit(0)
    os.close(theirs)
    started = 0.0
    with os.fdopen(ours, "rb") as answer:
        while not select.select([answer], [], [], LOOK_EVERY)[0]:
            started = max([started, *(peak_of(one) for one in children_of(child) if _words(one) != _words(child))])
        said = answer.read()
    status = os.waitpid(child, 0)[1]
    if said:
        *found, memory = json.loads(said)
        return Outcome(*found, memory + 1e6 * started)
    return Outcome("fault", f"ended by signal {os.WTERMSIG(status)}", float(GIVEN_UP), float(GIVEN_UP), 0.0)


def _read(name: str, place: Path, file: Path) -> object:
    reader = BOMBS[name][0]
    if reader in FREE_STANDING:
        return FREE_STANDING[reader](place / file.relative_to(place).parts[0])
    return reader_of(reader).read(place, file)


def _warm(seeds: Path, readers: Iterable[str]) -> None:
    """What readers import on their first call is no part of a bomb."""
    for library in ("openpyxl", "h5py", "rosbags.highlevel", "PIL.ImageFile", "scipy.io", "sqlite3", "lz4.frame"):
        __import__(library)
    for reader in readers:
        for file in sorted(one for one in (seeds / reader).rglob("*") if one.is_file())[:1]:
            reader_of(reader).read(seeds / reader, file)


def _words(process: int) -> bytes:
    """The command line of a process, which is that of its parent until it has become another program."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:  # it has ended
        return b""


def _processor() -> float:
    """s that this process and those which it started and that have ended have worked."""
    return sum(os.times()[:4])


def _line(name: str, one: Outcome) -> str:
    """An outcome as a line of the table."""
    times = f"{one.seconds:6.2f} s ({one.wall:6.2f} s)"
    return f"{name:<36} {one.outcome:<8} {times} {one.memory / 1e6:5.0f} MB  {one.words[:80]}"


def _resident() -> int:
    """Bytes of memory that this process has."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def peak_of(pid: int) -> float:
    """VmHWM in MB; 0 for a process that has ended."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(encoding="ascii"))
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return int(found[1]) / 1024 if found else 0.0


def children_of(pid: int) -> list[int]:
    """The processes that a process has started and that live; none of one that has ended."""
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


def main() -> int:
    """Runs from the command line. Returns: 1 where a bomb went off."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="names of bombs begin so")
    parser.add_argument("--large", action="store_true", help="read large good files in place of bombs")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.large:
            found = read_large(Path(folder))
            for name, one in found.items():
                print(_line(name, one))
            return 0 if all(one.outcome == "read" for one in found.values()) else 1
        found = run([name for name in BOMBS if name.startswith(options.only)], Path(folder))
    for name, one in found.items():
        print(_line(name, one) + ("" if one.good else "  <- not refused in time"))
    good = sum(one.good for one in found.values())
    formats = len({name.split("/")[0] for name in found})
    worst = max(found.values(), key=lambda one: one.seconds), max(found.values(), key=lambda one: one.memory)
    print(
        f"{good} of {len(found)} bombs of {formats} formats refused within {SECONDS:g} s and {MEMORY / 1e6:g} MB; "
        f"the slowest took {worst[0].seconds:.2f} s, the largest {worst[1].memory / 1e6:.0f} MB"
    )
    return 0 if good == len(found) else 1


if __name__ == "__main__":
    sys.exit(main())

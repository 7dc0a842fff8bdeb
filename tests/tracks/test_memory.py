"""Peak memory of a fresh process, so that nothing an earlier test allocated hides a growth.

VmHWM belongs to the new process alone; getrusage's ru_maxrss would start at the size of the process that forked it.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ballfg.tracks import TABLE_TENNIS, Track, write_dataset
from ballfg.tracks.info import DatasetInfo

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")

SAMPLES = 300
FEW, MANY = 200, 1600
READ = """
import sys
from pathlib import Path
from ballfg.tracks import read_dataset
for _ in range(2):
    print(sum(len(track) for track in read_dataset(sys.argv[1])))
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(status["VmHWM"].split()[0])
"""


def _tracks(count: int):
    rng = np.random.default_rng(1)
    t = np.arange(SAMPLES) / 150
    sigmas = np.full((SAMPLES, 3), 0.002)
    for i in range(count):
        positions = rng.normal(0, 0.1, (SAMPLES, 3))
        yield Track(t, positions, sigmas, {"speed": rng.normal(), "group": "a"}, name=f"{i:05d}")


def _peak(folder, rows: int) -> int:
    plain = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}  # the other pools keep tens of MB that are free
    command = [sys.executable, "-c", READ, str(folder)]
    done = subprocess.run(command, env=plain, capture_output=True, text=True, check=True)
    first, second, peak = map(int, done.stdout.split())
    assert first == second == rows
    return peak


def _interleave(path) -> None:
    """Puts the rows into order of time, to 0.2 s."""
    header, *rows = path.read_text().splitlines(keepends=True)
    rows.sort(key=lambda row: int(5 * float(row.split(",", 2)[1])))
    path.write_text(header + "".join(rows))


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param("csv", marks=pytest.mark.thorough),
        "parquet",
        pytest.param("interleaved csv", marks=pytest.mark.thorough),
    ],
)
def test_memory_does_not_grow_with_the_number_of_tracks(tmp_path, kind):
    info = DatasetInfo("many", 0.76, TABLE_TENNIS, rate=150.0)
    peaks = []
    for count in (FEW, MANY):
        folder = tmp_path / f"{count}"
        write_dataset(folder, info, _tracks(count), kind.split()[-1])
        if kind.startswith("interleaved"):
            _interleave(folder / "tracks.csv")
        peaks.append(_peak(folder, count * SAMPLES))
    values = 7 * 8 * SAMPLES * (MANY - FEW) / 1024  # kB, of what the larger set has more: a copy would take that
    assert peaks[1] - peaks[0] < 0.5 * values, peaks

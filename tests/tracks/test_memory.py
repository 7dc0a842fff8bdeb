"""Peak memory of a fresh process, so that nothing an earlier test allocated hides a growth.

VmHWM belongs to the new process alone; getrusage's ru_maxrss would start at the size of the process that forked it.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ballfg.tracks import TABLE_TENNIS, DatasetInfo, Track, write_dataset

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")

SAMPLES = 300
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
    done = subprocess.run([sys.executable, "-c", READ, str(folder)], capture_output=True, text=True, check=True)
    first, second, peak = map(int, done.stdout.split())
    assert first == second == rows
    return peak


def _interleave(path) -> None:
    """Puts the rows into order of time, to 0.2 s."""
    header, *rows = path.read_text().splitlines(keepends=True)
    rows.sort(key=lambda row: int(5 * float(row.split(",", 2)[1])))
    path.write_text(header + "".join(rows))


@pytest.mark.parametrize("kind", ["csv", "parquet", "interleaved csv"])
def test_memory_does_not_grow_with_the_number_of_tracks(tmp_path, kind):
    info = DatasetInfo("many", 0.76, TABLE_TENNIS, rate=150.0)
    peaks = []
    for count in (300, 3000):
        folder = tmp_path / f"{count}"
        write_dataset(folder, info, _tracks(count), kind.split()[-1])
        if kind.startswith("interleaved"):
            _interleave(folder / "tracks.csv")
        peaks.append(_peak(folder, count * SAMPLES))
    # The values of the larger set alone take 50 MB (3000 x 300 x 7 float64), 0.4 of the smaller set's peak.
    assert peaks[1] < 1.3 * peaks[0], peaks

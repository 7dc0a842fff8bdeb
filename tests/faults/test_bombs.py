"""Small files that unpack to much are refused in time and within their memory, and what measures that can fail."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.faults.bombs import BOMBS, MEMORY, SECONDS, Outcome, measured, run
from tests.places import ROOT

QUICK = (
    "parquet/one long name, tracks", "parquet/one long name, import", "parquet/one long name, states",
    "parquet/lists of one long word", "csv/endless line, tracks", "csv/endless header", "csv/endless line, import",
    "json/numbers on one line", "json/small lists", "json/report", "yaml/aliases", "yaml/values", "npy/a header alone",
    "h5/nothing written", "h5/links that double", "h5/another file", "xlsx/cells of a small file",
    "xlsx/cells within the size", "safetensors/a length alone", "tiff/one huge tile", "bmp/a header alone",
    "ppm/a header alone", "avi/a header that says less", "db3/a view", "opencv/nodes",
)  # fmt: skip
"""Those that are written in a moment."""


@pytest.mark.thorough
def test_bombs_are_refused(tmp_path: Path) -> None:
    """In a process that has no threads yet; each gets twice its time, for processors that others use too are slower."""
    code = (
        "import json, sys; from pathlib import Path; from tests.faults.bombs import run; "
        "found = run(json.loads(sys.argv[1]), Path(sys.argv[2])); "
        "print(json.dumps({name: list(vars(one).values()) for name, one in found.items()}))"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    command = [sys.executable, "-c", code, json.dumps(QUICK), str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    found = {name: Outcome(*one) for name, one in json.loads(done.stdout).items()}
    assert tuple(found) == QUICK
    wrong = {
        name: one
        for name, one in found.items()
        if one.outcome != "refused" or one.memory > MEMORY or one.seconds > 2.0 * SECONDS
    }
    assert not wrong


@pytest.mark.parametrize(
    ("good", "outcome"),
    [
        (False, Outcome("read", "", 0.1, 9.0, 1e6)), (False, Outcome("fault", "a", 0.1, 9.0, 1e6)),
        (False, Outcome("refused", "a", 2.1, 9.0, 1e6)), (False, Outcome("refused", "a", 0.1, 9.0, 301e6)),
        (True, Outcome("refused", "a", 1.9, 9.0, 299e6)),
    ],
)  # fmt: skip
def test_what_is_good(good: bool, outcome: Outcome) -> None:
    assert outcome.good is good


def test_time_and_memory_are_those_of_the_reading() -> None:
    """Of this process's own memory nothing counts, and that of a process which the reader starts does."""
    held = bytearray(200_000_000)

    def reads() -> None:
        bytearray(b"x") * 100_000_000
        subprocess.run(
            [sys.executable, "-c", "import time; x = bytearray(b'x') * 60_000_000; time.sleep(0.3)"], check=True
        )
        time.sleep(0.2)
        raise ValueError("there is no a.csv")

    found = measured(reads, "a.csv")
    assert found.outcome == "refused"
    assert found.seconds < found.wall
    assert found.wall > 0.5
    assert 160e6 < found.memory < 260e6
    assert len(held) == 200_000_000


def test_every_format_has_bombs() -> None:
    assert len(BOMBS) >= 80
    assert {name.split("/")[0] for name in BOMBS} >= {
        "parquet", "csv", "json", "yaml", "npz", "npy", "mat", "h5", "xlsx", "safetensors", "png", "jpeg", "tiff",
        "bmp", "webp", "ppm", "avi", "mcap", "db3", "zstd", "zip", "gz", "opencv",
    }  # fmt: skip
    assert {kind for kind, _, _ in BOMBS.values()} >= {"dataset", "parquet_dataset", "import", "results", "video"}


def test_some_bombs_are_refused_in_this_process_too_and_their_path_is_named(tmp_path: Path) -> None:
    found = run(
        ["csv/endless header", "json/small lists", "yaml/aliases", "npy/a header alone", "safetensors/a length alone"],
        tmp_path,
    )
    assert {name for name, one in found.items() if one.outcome != "refused" or one.memory > MEMORY} == set()
    said = found["csv/endless header"].words
    assert "tracks.csv, line 1: the line of column names must have at most 65536 bytes" in said

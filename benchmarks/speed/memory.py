"""Measures the peak memory of `ballfg estimate`, with `python -m ballfg.benchmarks.speed.memory`.

Linux only: it reads each process's high-water mark (VmHWM) from /proc while the command runs.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LOOK_EVERY = 0.2  # s between looks at the processes


def main() -> None:
    """Simulate, estimate, and print the peaks and their ratio."""
    parser = argparse.ArgumentParser(prog="python -m ballfg.benchmarks.speed.memory", description=__doc__)
    parser.add_argument("--tracks", type=int, default=1000, help="the smaller number of tracks")
    parser.add_argument("--method", default="smoother", help="name of the estimator")
    parser.add_argument("--jobs", type=int, default=2, help="number of processes")
    options = parser.parse_args()
    peaks = []
    with tempfile.TemporaryDirectory() as folder:
        for count in (options.tracks, 10 * options.tracks):
            data = Path(folder) / f"tracks-{count}"
            _ballfg("simulate", "--out", data, "--tracks", count).wait()
            words = ("--method", options.method, "--jobs", options.jobs, "--out", f"{data}.parquet")
            command = _ballfg("estimate", data, *words)
            parent, worker = _watch(command)
            if command.returncode != 0:
                sys.exit(f"ballfg estimate ended with {command.returncode} on {count} tracks")
            peaks.append(parent)
            print(f"{count} tracks: peak {parent:.0f} MB, largest worker {worker:.0f} MB", flush=True)
    print(f"ratio of the peaks: {peaks[1] / peaks[0]:.2f}")


def _ballfg(*words: object) -> subprocess.Popen[bytes]:
    """A running command, whose progress goes to stderr."""
    code = "from ballfg.cli.main import run; run()"
    return subprocess.Popen([sys.executable, "-c", code, *map(str, words)], stdout=subprocess.DEVNULL)


def _watch(command: subprocess.Popen[bytes]) -> tuple[float, float]:
    """Peak memory in MB of a running command and of the largest of its children."""
    parent = worker = 0.0
    while command.poll() is None:
        parent = max(parent, peak_of(command.pid))
        worker = max([worker, *(peak_of(child) for child in children_of(command.pid))])
        time.sleep(LOOK_EVERY)
    return parent, worker


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


if __name__ == "__main__":
    main()

"""Solves one problem by one library in a process: `python worker.py LIBRARY TASK PROBLEM.npz`.

The module `with_LIBRARY` has a function for each task that it solves: from a problem to a function that solves it from
its start and returns named arrays. The worker solves once, writes a line of JSON with the costs, and then obeys lines
on its standard input: a number of timed solutions, or the name of a file for the solution. Runs in any environment that
has numpy and the library.
"""

import gc
import importlib
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

sys.path.insert(0, str(Path(__file__).parent))

from problem import Problem  # noqa: E402  the folder has to be known first


def main(library: str, task: str, path: str) -> None:
    """Solve, report, and obey until the input ends."""
    try:
        module = importlib.import_module(f"with_{library}")
        if not hasattr(module, task):
            raise NotImplementedError(f"no {task}")
        solve = getattr(module, task)(Problem.load(path))
    except (ImportError, NotImplementedError) as error:
        print(json.dumps({"error": f"{type(error).__name__}: {error}"}), flush=True)
        return
    prepared = time.perf_counter()
    solution = solve()
    print(json.dumps({"first": time.perf_counter() - prepared}), flush=True)
    for line in sys.stdin:
        word = line.strip()
        if word.isdigit():
            times = []
            gc.collect()
            for _ in range(int(word)):
                start = time.perf_counter()
                solution = solve()
                times.append(time.perf_counter() - start)
            print(json.dumps({"times": times, "peak": _peak()}), flush=True)
        else:
            np.savez(word, **solution)
            print(json.dumps({"saved": word}), flush=True)


def _peak() -> float:
    """MiB, the largest memory of this process; NaN where /proc does not tell (`ru_maxrss` would count the parent's)."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return float("nan")
    return float(status.split("VmHWM:")[1].split()[0]) / 1024.0


if __name__ == "__main__":
    main(*sys.argv[1:])

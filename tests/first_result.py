"""Measures the processor time from the start of Python to a first estimate, beside that of the imports it cannot avoid.

`python -m tests.first_result` prints medians of several processes; run `ballfg compile` before, and nothing beside it.
"""

import statistics
import subprocess
import sys

PROCESSES = 7
FIRST = """
import numpy as np
import ballfg as bf
t = np.linspace(0.0, 0.3, 40)
points = np.stack((3.0 * t, 0.0 * t, 0.3 + 2.0 * t - 4.9 * t**2), axis=1)
assert bf.estimate(bf.Track(t, points)).status.name == "OK"
"""
CONTROL = "import torch, gtsam, numpy, numba, scipy.linalg"
SPENT = "\nimport time\nprint(time.process_time())"


def seconds(code: str) -> float:
    """Median processor time, s, of processes that run the code."""
    command = [sys.executable, "-c", code + SPENT]
    said = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(PROCESSES)]
    return statistics.median(float(text) for text in said)


if __name__ == "__main__":
    print(f"import ballfg, first estimate: {seconds(FIRST):.2f} s; torch, gtsam, numba alone: {seconds(CONTROL):.2f} s")

"""A sender of 100 lines a second beside one that floods: how late its answers are, and how many are missing.

`python -m tests.live.flooded --seconds 20 --seed 1` starts `ballfg live` as a process, on this machine's own address;
`--rate` is for busy machines, which cannot answer 100 lines a second.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from tests.live.killed_recordings import COMMAND

SCHEMES = ("tcp", "udp")
FLOODS = ("none", "samples", "nonsense", "comments", "crowds")
"""What the other sender sends as fast as it can: nothing, positions elsewhere, text, comments, 64 positions a line."""
STEP = 1e-6
"""m in y from line to line of the first sender: it tells which line an answer is for."""
ELSEWHERE = 1.0
"""m in y, from which on positions are the flood's."""
LAST = 20.0
"""s in which the last answers come, on a machine however busy."""
SENT = """
import socket, sys, time
import numpy as np
scheme, port, flood, begun, seed = sys.argv[1], int(sys.argv[2]), sys.argv[3], float(sys.argv[4]), int(sys.argv[5])
rng = np.random.default_rng(seed)
kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
def lines():
    t = time.monotonic() - begun
    if flood == "samples":
        return "".join(f"{t:.6f},{x:.4f},{1 + y:.4f},{z:.4f}\\n" for x, y, z in rng.random((4, 3)))
    if flood == "nonsense":
        return "what is this, then?\\n" * 4
    if flood == "comments":
        return "#\\n" * 500
    places = ",".join(f"[{x:.3f},{1 + y:.3f},{z:.3f}]" for x, y, z in rng.random((64, 3)))
    return f'{{"t":{t:.6f},"positions":[{places}]}}\\n'
with socket.socket(socket.AF_INET, kind) as sender:
    sender.connect(("127.0.0.1", port))
    while True:
        sender.sendall(lines().encode())
"""
"""The program that floods."""


@contextmanager
def listening(scheme: str) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A process that listens, and its port; its messages go nowhere."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [*COMMAND, "--listen", f"{scheme}://:0"]
    with subprocess.Popen(command, env=environment, **pipes) as process:  # type: ignore[call-overload]
        try:
            while (place := re.search(rb"://127\.0\.0\.1:(\d+)", process.stderr.readline())) is None:
                assert process.poll() is None
            threading.Thread(target=process.stderr.read, daemon=True).start()
            yield process, int(place[1])
        finally:
            process.kill()


def send(scheme: str, port: int, begun: float, count: int, rate: float, answered: dict[int, float]) -> list[float]:
    """Send lines at their rate, and wait until all are answered. Returns: when each was sent, s of the clock."""
    sent: list[float] = []
    kind = socket.SOCK_STREAM if scheme == "tcp" else socket.SOCK_DGRAM
    with socket.socket(socket.AF_INET, kind) as sender:
        sender.connect(("127.0.0.1", port))
        first = time.monotonic()
        for k in range(count):
            time.sleep(max(0.0, first + k / rate - time.monotonic()))
            sent.append(time.monotonic())
            t = (k % 45) / 100.0
            sender.sendall(
                f"{sent[-1] - begun:.6f},{3 * t:.6f},{STEP * k:.6f},{0.5 + 2 * t - 4.905 * t * t:.6f}\n".encode()
            )
        end = time.monotonic() + LAST
        while len(answered) < len(sent) and time.monotonic() < end:
            time.sleep(0.01)
    return sent


def delays(scheme: str, flood: str, seconds: float, rate: float, seed: int) -> tuple[np.ndarray, int]:
    """Delays of the answers (n,) s, from sending a line to reading its answer, and the number of lines without one."""
    answered: dict[int, float] = {}
    with listening(scheme) as (process, port):
        begun = time.monotonic()
        words = [scheme, str(port), flood, str(begun), str(seed)]
        flooding = None if flood == "none" else subprocess.Popen([sys.executable, "-c", SENT, *words])

        def read() -> None:
            assert process.stdout is not None
            for text in process.stdout:
                now = time.monotonic()
                y = (json.loads(text).get("measured") or [0.0, ELSEWHERE])[1]
                if y < ELSEWHERE:
                    answered[round(y / STEP)] = now

        reader = threading.Thread(target=read)
        reader.start()
        try:
            if flooding is not None:
                time.sleep(1.0)  # until more of it waits than can be answered
            sent = send(scheme, port, begun, int(seconds * rate), rate, answered)
        finally:
            if flooding is not None:
                flooding.kill()
                flooding.wait()
            process.kill()
            reader.join()
    found = [answered[k] - at for k, at in enumerate(sent) if k in answered]
    return np.array(found), len(sent) - len(found)


def main(words: Sequence[str]) -> int:
    """Prints a line for each scheme and flood."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(words)
    missing = 0
    for scheme in SCHEMES:
        for flood in FLOODS:
            found, lost = delays(scheme, flood, given.seconds, given.rate, given.seed)
            missing += lost
            p50, p99, worst = 1e3 * np.quantile(found, (0.5, 0.99, 1.0))
            print(
                f"{scheme}, flood of {flood}: {len(found)} answers, {lost} missing; delay median {p50:.1f} ms, "
                f"99 % {p99:.1f} ms, worst {worst:.1f} ms",
                flush=True,
            )
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

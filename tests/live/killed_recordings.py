"""Recordings of `ballfg live` whose process is killed at a random moment: what is missing, and what is lost afterwards.

`python -m tests.live.killed_recordings --count 100 --seed 1` feeds real processes at a known rate, kills each, counts
the lines sent more than a second before the kill whose answers are not recorded, and types the same command again,
which continues JSON lines; a bag is read.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

COMMAND = [sys.executable, "-c", "from ballfg.cli.main import run; run()", "live"]
RATE = 100.0
"""Hz, of the lines."""
FLIGHT = 45
"""Lines of a flight; a later stamp begins the next one."""
NEW = 2
"""Lines of a flight before its ball is known: a bag has no message for them."""
SAFE = 1.0
"""s before the kill, from which on lines may be missing."""
ENDINGS = ("jsonl", "mcap")
WAYS = ("pipe", "tcp", "udp")


class Case(NamedTuple):
    """How a process is fed and what it writes, and how long after its first line it is killed, s."""

    ending: str
    way: str
    life: float


class Found(NamedTuple):
    """What a case showed.

    Attributes: sent: lines a second before the kill.  missing: of those.  lost: answers of the killed process that are
        gone after the same command was typed again.  added: answers of that command.
    """

    sent: int
    missing: int
    lost: int
    added: int


def stamp(k: int) -> float:
    """s, of line k."""
    return round(2.0 * (k // FLIGHT) + k % FLIGHT / RATE, 6)


def line(k: int) -> bytes:
    """Line k: a ball that is thrown again and again."""
    t = (k % FLIGHT) / RATE
    return f"{stamp(k)},{3.0 * t:.6f},0.0,{0.5 + 2.0 * t - 4.905 * t * t:.6f}\n".encode()


def recorded(out: Path) -> list[Any]:
    """The answers in a recording: stamps of the lines, or of the states of a bag."""
    if out.suffix == ".mcap":
        from ballfg.live.sources.bag import bag_samples

        return [round(sample.time, 6) for sample in bag_samples(out, "/ball/odometry")]
    whole = out.read_bytes().rpartition(b"\n")[0]
    answers = [json.loads(text) for text in whole.splitlines()]
    return [answer["t_input"] for answer in answers if "t_input" in answer]


@contextmanager
def recording(case: Case, out: Path) -> Iterator[tuple[subprocess.Popen[bytes], Any]]:
    """A process that is ready, and a function that sends it a line."""
    words = [] if case.way == "pipe" else ["--listen", f"{case.way}://:0"]
    command = [*COMMAND, *words, "--out", str(out)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            said: list[str] = []
            while not said or "reading" not in said[-1]:
                said.append(process.stderr.readline().decode())
                assert said[-1], f"the command ended: {said}"
            place = re.search(r"://127\.0\.0\.1:(\d+)", said[-1])
            if place is None:
                yield process, lambda text: os.write(process.stdin.fileno(), text)
                return
            kind = socket.SOCK_STREAM if case.way == "tcp" else socket.SOCK_DGRAM
            with socket.socket(socket.AF_INET, kind) as sender:
                sender.connect(("127.0.0.1", int(place[1])))
                yield process, sender.send
        finally:
            process.kill()


def feed(send: Any, life: float, first: int = 0) -> list[tuple[int, float]]:
    """Send lines at their rate for a time (s). Returns: the number of each line, and when it was sent."""
    begun, sent = time.monotonic(), []
    while (now := time.monotonic()) < begun + life:
        due = begun + len(sent) / RATE
        if now < due:
            time.sleep(min(due, begun + life) - now)
            continue
        send(line(first + len(sent)))
        sent.append((first + len(sent), time.monotonic()))
    return sent


def run(case: Case, folder: Path) -> Found:
    """One process, killed; then the same command again."""
    out = folder / f"states.{case.ending}"
    with recording(case, out) as (process, send):
        sent = feed(send, case.life)
        killed = time.monotonic()
        process.kill()
        process.wait()
    due = [stamp(k) for k, at in sent if at < killed - SAFE and (case.ending == "jsonl" or k % FLIGHT >= NEW)]
    before = recorded(out)
    missing = sum((Counter(due) - Counter(before)).values())
    if case.ending == "mcap":
        return Found(len(due), missing, 0, 0)
    raw = out.read_bytes()
    with recording(case, out) as (process, send):
        feed(send, 0.3)
        time.sleep(1.5)
        process.kill()
        process.wait()
    after = recorded(out)
    lost = sum((Counter(before) - Counter(after)).values())
    if not out.read_bytes().startswith(raw.rpartition(b"\n")[0]):
        lost = len(before)
    return Found(len(due), missing, lost, len(after) - len(before))


def cases(count: int, seed: int) -> Iterator[Case]:
    """Ways and forms in turn, killed at a random moment."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        yield Case(ENDINGS[k % 2], WAYS[k // 2 % 3], float(rng.uniform(1.1, 4.0)))


def main(words: list[str]) -> int:
    """Prints the sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(words)
    total = Counter[str]()
    for case in cases(given.count, given.seed):
        with tempfile.TemporaryDirectory(prefix="killed-") as folder:
            found = run(case, Path(folder))
        lines = case.ending == "jsonl"
        total.update(found._asdict() | {"killed": 1, "lines": lines, "continued": found.added > 0})
        if found.missing or found.lost or (lines and not found.added):
            print(f"{case}: {found}", flush=True)
    print(
        f"{total['killed']} recordings killed (seed {given.seed}): of {total['sent']} lines sent more than {SAFE:g} s "
        f"before {total['missing']} missing; the same command again: {total['continued']} continued, {total['lost']} "
        f"answers lost, {total['added']} added"
    )
    return 1 if total["missing"] or total["lost"] or total["continued"] < total["lines"] else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

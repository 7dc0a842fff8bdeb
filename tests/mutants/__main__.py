"""Small mistakes put into the code one by one: which of them does the test suite notice? `make mutants`.

The tests that reach each line come from one recorded run of the suite (README.md here). Every mistake is tried in a
copy of the tree. The table goes to `results.csv` in the folder of the recording.
"""

from __future__ import annotations

import argparse
import csv
import json
import queue
import random
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ballfg.files.strict_yaml import read_yaml
from ballfg.files.whole_file import whole_file
from tests.mutants.mutations import Mutation, by_line, mutations_of
from tests.mutants.reach import Recording, digest, record, recorded_tests
from tests.mutants.sources import has_machine_code, room_of, source_files
from tests.mutants.trial import Outcome, Workshop
from tests.places import ROOT

JUDGED: Final = Path(__file__).with_name("judged.yaml")
NEAR: Final = 4.0
"""Tests of the line's own room are tried before others that take up to so many times less."""


@dataclass(frozen=True)
class Verdict:
    """A mutation and what became of it: killed, survived, equivalent, doubtful or unreached; by which test, or why."""

    mutation: Mutation
    word: str
    by: str
    seconds: float


def sample(count: int, seed: int, rooms: Sequence[str]) -> list[Mutation]:
    """A fixed choice: rooms by their number of lines, in each of them lines at random, of a line one change.

    Args: rooms: names; none for all.
    Raises: SystemExit: a room that is not there.
    """
    files: dict[str, list[str]] = {}
    for name in source_files():
        files.setdefault(room_of(name), []).append(name)
    unknown = sorted(set(rooms) - set(files))
    if unknown:
        raise SystemExit(f"--rooms must be of {', '.join(sorted(files))}; got {', '.join(unknown)}")
    chosen = {room: files[room] for room in sorted(files) if room in rooms or not rooms}
    sources = {name: (ROOT / name).read_bytes() for names in chosen.values() for name in names}
    sizes = {room: sum(sources[name].count(b"\n") for name in names) for room, names in chosen.items()}
    found = []
    for room, number in _shares(sizes, count).items():
        rng = random.Random(f"{seed} {room}")
        lines = [line for name in chosen[room] for line in by_line(mutations_of(name, sources[name]))]
        found += [rng.choice(line) for line in rng.sample(lines, min(number, len(lines)))]
    return sorted(found, key=lambda m: (m.file, m.line))


def _shares(sizes: dict[str, int], count: int) -> dict[str, int]:
    """Whole numbers in proportion to sizes, of the given sum."""
    exact = {room: count * size / sum(sizes.values()) for room, size in sizes.items()}
    shares = {room: int(share) for room, share in exact.items()}
    rest = sorted(exact, key=lambda room: shares[room] - exact[room])[: count - sum(shares.values())]
    return {room: share + (room in rest) for room, share in shares.items()}


def ordered(tests: dict[str, float], file: str, budget: float) -> list[str]:
    """The tests to run: file by file, since tests of a file share what they set up; quick files first.

    Args: tests: s of each.  file: in which the change is.  budget: s that they may take together.
    """
    room, files = room_of(file), {}
    for test, seconds in sorted(tests.items(), key=lambda item: item[1]):
        files.setdefault(test.split("::")[0], []).append((test, seconds))

    def cost(name: str) -> float:
        near = f"/{room}/" in f"/{name}" or name.split("/")[-1] == f"test_{file.split('/')[-1]}"
        return sum(seconds for _, seconds in files[name]) / (NEAR if near else 1.0)

    chosen, spent = [], 0.0
    for name in sorted(files, key=cost):
        for test, seconds in files[name]:
            if not chosen or spent + seconds <= budget:
                chosen.append(test)
                spent += seconds
    return chosen


def judged() -> dict[tuple[str, str, str], str]:
    """Reasons by file, line before and line after."""
    return {(e["file"], e["line"], e["becomes"]): e["reason"] for e in read_yaml(JUDGED) or []}


class Killed:
    """The changes that a test noticed, kept as they are found: none needs to be tried twice on the same file.

    Args: path: of the file that keeps them.  begin: with none.
    """

    def __init__(self, path: Path, *, begin: bool) -> None:
        self.path = path
        if begin:
            path.unlink(missing_ok=True)
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self.by = {tuple(json.loads(line)[:-1]): json.loads(line)[-1] for line in lines}

    def add(self, verdict: Verdict) -> None:
        """Keep one."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([*self.key(verdict.mutation), verdict.by]) + "\n")

    @staticmethod
    def key(mutation: Mutation) -> tuple[str, str, int, str]:
        """A change of a file as it is now."""
        return mutation.file, digest(mutation.file), mutation.start, mutation.after


def run_all(
    mutations: Sequence[Mutation], recording: Recording, folder: Path, killed: Killed, jobs: int, budget: float
) -> list[Verdict]:
    """Try all, some at the same time, and say how it goes."""
    compiled = {name for name in source_files() if has_machine_code((ROOT / name).read_text(encoding="utf-8"))}
    known, verdicts, reading, begin = judged(), list[Verdict](), threading.Lock(), time.monotonic()

    def is_frozen(mutation: Mutation) -> bool:
        return recording.known.frozen_in_machine_code(mutation.file, mutation.line, compiled)

    with ExitStack() as stack:
        free: queue.SimpleQueue[Workshop] = queue.SimpleQueue()
        for _ in range(jobs):
            free.put(stack.enter_context(Workshop(folder / "machine_code")))

        def attempt(mutation: Mutation) -> Verdict:
            if (by := killed.by.get(Killed.key(mutation))) is not None:
                return Verdict(mutation, "killed", by, 0.0)
            with reading:
                last = mutation.line + mutation.before.count("\n")
                tests = recording.reaching(mutation.file, mutation.line, last)
            chosen = ordered(tests, mutation.file, budget)
            if not chosen:
                return Verdict(mutation, "unreached", "", 0.0)
            workshop = free.get()
            try:
                outcome = workshop.attempt(
                    mutation, chosen, sum(tests[t] for t in chosen), compile_anew=is_frozen(mutation)
                )
            finally:
                free.put(workshop)
            return _verdict(mutation, outcome, known, len(tests), len(chosen))

        pool = ThreadPoolExecutor(jobs)
        stack.callback(pool.shutdown, cancel_futures=True)  # Ctrl-C does not wait for all that is left
        for done, future in enumerate(as_completed([pool.submit(attempt, m) for m in mutations]), 1):
            verdict = future.result()
            verdicts.append(verdict)
            if verdict.word == "killed" and Killed.key(verdict.mutation) not in killed.by:
                killed.add(verdict)
            left = (time.monotonic() - begin) / done * (len(mutations) - done) / 60.0
            print(f"{done} of {len(mutations)}: {_line(verdict)}; {left:.0f} min left", flush=True)
        failing, workshop = set[tuple[bool, str]](), free.get()
        for frozen in (False, True):
            killers = {v.by for v in verdicts if v.by in recording.seconds and is_frozen(v.mutation) == frozen}
            again = sum(recording.seconds[test] for test in killers)
            if killers:
                found = workshop.failing(sorted(killers), again, compile_anew=frozen)
                failing |= {(frozen, test) for test in found}
    return sorted(
        (replace(v, word="doubtful") if (is_frozen(v.mutation), v.by) in failing else v for v in verdicts),
        key=lambda v: (v.mutation.file, v.mutation.line),
    )


def _verdict(
    mutation: Mutation, outcome: Outcome, known: dict[tuple[str, str, str], str], reaching: int, chosen: int
) -> Verdict:
    if outcome.killed:
        return Verdict(mutation, "killed", outcome.by, outcome.seconds)
    reason = known.get((mutation.file, mutation.old_line, mutation.new_line))
    if reason is not None:
        return Verdict(mutation, "equivalent", reason, outcome.seconds)
    return Verdict(mutation, "survived", f"{chosen} of {reaching} tests that reach it", outcome.seconds)


def _line(verdict: Verdict) -> str:
    m = verdict.mutation
    by = f" by {verdict.by}" if verdict.word == "killed" else ""
    return f"{verdict.word} {m.file}:{m.line} {_short(m.before)} -> {_short(m.after)}{by} ({verdict.seconds:.0f} s)"


def _short(text: str) -> str:
    words = " ".join(text.split())
    return f"`{words if len(words) <= 50 else words[:47] + '...'}`"


def report(verdicts: Sequence[Verdict], path: Path) -> str:
    """Write the table. Returns: the survivors and the score, for a reader."""
    with whole_file(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", "line", "before", "after", "line before", "line after", "verdict", "by", "seconds"])
        for v in verdicts:
            m = v.mutation
            row = [m.file, m.line, m.before, m.after, m.old_line, m.new_line, v.word, v.by, f"{v.seconds:.1f}"]
            writer.writerow(row)
    count = Counter(v.word for v in verdicts)
    judgeable = len(verdicts) - count["equivalent"] - count["doubtful"]
    lines = [
        f"{v.word}: {v.mutation.file}:{v.mutation.line}, {v.by}\n"
        f"    - {v.mutation.old_line}\n    + {v.mutation.new_line}"
        for v in verdicts
        if v.word != "killed"
    ]
    words = ", ".join(f"{number} {word}" for word, number in sorted(count.items()))
    lines.append(f"{len(verdicts)} mistakes: {words}. Score: {count['killed']} of {judgeable} noticed.")
    return "\n".join([*lines, f"Table: {path}"])


def unreached(recorded: Recording, rooms: Sequence[str]) -> str:
    """The lines of functions that no test reaches, for a reader; machine code, whose lines are not seen, left out."""
    lines = []
    for name in source_files():
        text = (ROOT / name).read_text(encoding="utf-8")
        if (not rooms or room_of(name) in rooms) and not has_machine_code(text):
            lines += [f"{name}:{line} {text.splitlines()[line - 1].strip()}" for line in recorded.unreached(name)]
    return "\n".join([*lines, f"{len(lines)} statements that no test reaches"])


def main() -> None:
    """Read the options, record where it is needed, try, report."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="mistakes (200)")
    parser.add_argument("--seed", type=int, default=0, help="of the choice (0)")
    parser.add_argument("--jobs", type=int, default=2, help="tried at the same time (2)")
    parser.add_argument("--budget", type=float, default=60.0, help="s of tests for each mistake (60)")
    parser.add_argument("--rooms", nargs="*", default=[], help="rooms to change (all)")
    parser.add_argument("--tests", nargs="*", default=["tests"], help="tests that may notice (tests)")
    parser.add_argument(
        "--folder", type=Path, default=ROOT / "build" / "mutants", help="of the recording and the table"
    )
    parser.add_argument("--refresh", action="store_true", help="record which test reaches which line anew")
    parser.add_argument("--keep", action="store_true", help="do not try again what a test noticed in the last run")
    parser.add_argument("--unreached", action="store_true", help="list the lines that no test reaches, and end")
    options = parser.parse_args()
    mutations = sample(options.count, options.seed, options.rooms)
    recording = options.folder / "recording"
    if options.refresh or recorded_tests(recording) != options.tests:
        print(f"recording which test reaches which line: {' '.join(options.tests)}", flush=True)
        record(recording, options.tests, options.jobs)
    recorded = Recording(recording)
    print(f"{len(recorded.seconds)} tests; {len(recorded.failed)} that fail or are skipped judge nothing", flush=True)
    if options.unreached:
        print(unreached(recorded, options.rooms))
        return
    killed = Killed(options.folder / "killed.jsonl", begin=not options.keep)
    verdicts = run_all(mutations, recorded, options.folder, killed, options.jobs, options.budget)
    print(report(verdicts, options.folder / "results.csv"))


if __name__ == "__main__":
    main()

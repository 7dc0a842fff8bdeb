"""Each command is killed, or its disk fails, at every call that changes files; then the folder is judged.

`python -m tests.faults.kills --all` runs every call of every scenario and prints what it found.
"""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.injection import FULL, KILL, Faults

PATIENCE = 120.0
"""s that a process may take."""
State = dict[str, str]
"""Digest of every file, by its path."""


@dataclass(frozen=True)
class Scenario:
    """A command and what is there before it.

    Attributes:
        name: of the scenario.
        prepare: writes the inputs, and earlier results, into a folder.
        work: the command, in a folder that is prepared; raises SystemExit with its status, or returns.
        read: reads the result as a command would; raises what a user sees as one line, where there is none.
        again: the command that is typed after a kill; None: the same.
        refused: words of a refusal that is right where the new result stands already; the command has no --force.
        steps: the command leaves whole steps in between, so that a folder need be neither old nor new.
        varying: files whose bytes differ from run to run, because they hold times.
        companions: names of files that tell of the result; they may be missing, and never tell of another one.
    """

    name: str
    prepare: Callable[[Path], None]
    work: Callable[[Path], None]
    read: Callable[[Path], object]
    again: Callable[[Path], None] | None = None
    refused: str = ""
    steps: bool = False
    varying: tuple[str, ...] = ()
    companions: tuple[str, ...] = ()


@dataclass
class Tally:
    """What was found, and the sentence on each thing that is wrong."""

    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def add(self, kind: str, sentence: str) -> None:
        self.counts[kind] += 1
        self.wrong.append(f"{kind}: {sentence}")


def succeed(work: Callable[[Path], None], folder: Path) -> None:
    """Does some work, which must end well."""
    try:
        work(folder)
    except SystemExit as exit_:
        if exit_.code:
            raise AssertionError(f"a command ended with status {exit_.code} without any fault") from exit_


def in_fork(work: Callable[[], object], said: Path, patience: float = PATIENCE) -> int:
    """Runs some work in a copy of this process. Returns: its status, 0 if it returns, or minus the signal."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of threads, which wait here
        process = os.fork()
    if process == 0:
        _in_child(work, said)
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.001)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    raise TimeoutError(f"a process took more than {patience:g} s: {said.read_text()[-500:]}")


def _in_child(work: Callable[[], object], said: Path) -> None:
    """Never returns."""
    status = 70
    try:
        handle = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(handle, stream)
        sys.stdout, sys.stderr = (os.fdopen(os.dup(handle), "w", buffering=1) for _ in range(2))
        work()
        status = 0
    except SystemExit as exit_:
        status = exit_.code if isinstance(exit_.code, int) else 71
    except BaseException as error:
        print(f"{type(error).__name__}: {error}", flush=True)
        status = 2 if isinstance(error, ValueError | TypeError | OSError) else 70
    finally:
        os._exit(status)


def state(folder: Path, varying: Collection[str] = ()) -> State:
    """Digests of all files but hidden ones, which are being made; `any` for those that differ from run to run."""
    files = {path.relative_to(folder): path for path in sorted(folder.rglob("*")) if path.is_file()}
    return {
        str(name): "any" if str(name) in varying else hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in files.items()
        if not any(part.startswith(".") for part in name.parts) and "tfevents" not in path.name
    }


def run(scenario: Scenario, tally: Tally, most: int | None, error: int = KILL, lasting: bool = False) -> None:
    """Runs a scenario with a fault at each of its calls, or at `most` of them, evenly."""
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        os.environ["XDG_STATE_HOME"] = str(Path(place, "state"))  # where killed commands leave their locks
        pristine, folder, said = Path(place, "pristine"), Path(place, "work"), Path(place, "said")
        pristine.mkdir()
        shutil.copytree(pristine, folder)
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            scenario.prepare(folder)
        shutil.rmtree(pristine)
        shutil.copytree(folder, pristine)
        _warm(scenario, folder)
        shutil.rmtree(folder)
        shutil.copytree(pristine, folder)
        old = state(folder, scenario.varying)
        calls = Path(place, "calls")
        status = in_fork(lambda: _counted(scenario, folder, calls), said)
        assert status == 0, f"{scenario.name}: {said.read_text()}"
        new = state(folder, scenario.varying)
        count = len(calls.read_text().splitlines())
        numbers = range(1, count + 1) if most is None else _spread(count, most)
        for number in numbers:
            shutil.rmtree(folder)
            shutil.copytree(pristine, folder)
            faults = Faults(folder, number, error, lasting)
            status = in_fork(lambda faults=faults: _faulty(scenario, folder, faults), said)  # type: ignore[misc]
            where = f"{scenario.name}, call {number} of {count} ({calls.read_text().splitlines()[number - 1]})"
            tally.counts["points"] += 1
            if error != KILL and (status not in (0, 2) or (status == 2 and len(said.read_text().splitlines()) < 1)):
                tally.add("not one line", f"{where}: status {status}: {said.read_text()[-300:]}")
            _judge(scenario, folder, said, old, new, where, tally)


def _warm(scenario: Scenario, folder: Path) -> None:
    """Once in this process, so that its copies need not import and compile again."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        succeed(scenario.work, folder)
        scenario.read(folder)


def _counted(scenario: Scenario, folder: Path, calls: Path) -> None:
    faults = Faults(folder)
    faults.install()
    succeed(scenario.work, folder)
    fd = os.open(calls, os.O_WRONLY | os.O_CREAT)
    os.write(fd, "\n".join(faults.calls).encode())


def _faulty(scenario: Scenario, folder: Path, faults: Faults) -> None:
    faults.install()
    scenario.work(folder)


def _judge(scenario: Scenario, folder: Path, said: Path, old: State, new: State, where: str, tally: Tally) -> None:
    """What a reader finds, and whether the command can be typed again."""
    status = in_fork(lambda: scenario.read(folder), said)
    if status not in (0, 2) or (status == 2 and len(said.read_text().splitlines()) != 1):
        tally.add("reader fails", f"{where}: {said.read_text()[-300:]}")
    found = state(folder, scenario.varying)
    whole = set(old.items()) | set(new.items())
    half = [name for name, digest in found.items() if (name, digest) not in whole]
    if not scenario.steps:
        if half:
            tally.add("half files", f"{where}: {half}")
        elif not any(_is_one(found, whole, scenario.companions) for whole in (old, new)):
            tally.add("mixed folders", f"{where}: {sorted(set(found.items()) ^ set(new.items()))[:4]}")
    if status == 2 and found == new:
        tally.add("reader refuses the new", f"{where}: {said.read_text()[-300:]}")
    status = in_fork(lambda: (scenario.again or scenario.work)(folder), said)
    right = bool(scenario.refused) and status == 2 and scenario.refused in said.read_text() and found == new
    if status != 0 and not right:
        tally.add("refused restarts", f"{where}: {said.read_text()[-300:]}")
    elif state(folder, scenario.varying) != new:
        differing = sorted(set(state(folder, scenario.varying).items()) ^ set(new.items()))[:4]
        tally.add("other results", f"{where}: {differing}")
    left = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.name.startswith(".")]
    if left:
        tally.add("left over", f"{where}: {left}")


def _is_one(found: State, result: State, companions: tuple[str, ...]) -> bool:
    """Whether a folder holds a result, with or without the files that tell of it."""
    missing = result.keys() - found.keys()
    return found.items() <= result.items() and all(Path(name).name in companions for name in missing)


def _spread(count: int, most: int) -> Iterator[int]:
    """Numbers from 1 to `count`, evenly; the last calls are always among them: they move the files."""
    first, last = max(1, most // 2), min(count, most - most // 2)
    early = {1 + round(k * (count - last - 1) / max(1, first - 1)) for k in range(first)} if count > last else set()
    return iter(sorted(early | set(range(count - last + 1, count + 1))))


def main(words: list[str]) -> int:
    """All scenarios, or those that are named; `--all`: every call."""
    from tests.faults.folders import FOLDERS

    most = None if "--all" in words else 12
    named = [word for word in words if not word.startswith("--")]
    scenarios = list(FOLDERS)
    if not named or set(named) - {scenario.name for scenario in FOLDERS}:  # else torch would make each copy slow
        from tests.faults.scenarios import SCENARIOS, warm_up

        warm_up()
        scenarios += SCENARIOS
    total = Tally()
    for scenario in scenarios:
        if named and scenario.name not in named:
            continue
        begun, tally = time.monotonic(), Tally()
        run(scenario, tally, most)
        if "--full-disk" in words:
            run(scenario, tally, most, FULL)
            run(scenario, tally, most, FULL, lasting=True)
        print(f"{scenario.name}: {dict(tally.counts)} in {time.monotonic() - begun:.1f} s", flush=True)
        print(*tally.wrong[:8], sep="\n", end="\n" if tally.wrong else "", flush=True)
        total.counts += tally.counts
        total.wrong += tally.wrong
    kinds = (
        "half files", "mixed folders", "refused restarts", "reader fails", "other results", "left over", "not one line",
    )  # fmt: skip
    print(f"{total.counts['points']} points: " + ", ".join(f"{kind} {total.counts[kind]}" for kind in kinds))
    return 1 if total.wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Each command, as a real process, gets SIGKILL, SIGTERM or SIGINT at a random moment; then what it left is judged.

`python -m tests.faults.signals --count 300 --seed 1` prints how many processes and semaphores were there 5 s later, how
many hidden files, and how many results were neither the old nor the new one. Words name scenarios that run alone.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from ballfg.machine import DATE
from tests.faults.kills import State, Tally, state
from tests.places import ROOT

PATIENCE: Final = 5.0
"""s that a command and its processes have to end."""
LONGEST: Final = 300.0
"""s that a command may take."""
MARK: Final = "BALLFG_TRIAL"
"""Environment variable by which processes of a trial are known, also those whose parent has ended."""
ENTRIES: Final = {"ballfg": "ballfg", "ballfg-train": "train", "ballfg-bench": "bench"}
SHARED: Final = Path("/dev/shm")
Step = str | Callable[[Path], None]
SIGNALS: Final = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


@dataclass(frozen=True)
class Scenario:
    """A command, and what is there before it; in a word, `@` is the folder in which it works.

    Attributes:
        name: of the scenario.
        before: commands, or functions of the folder, that make the inputs and an earlier result.
        command: its words.
        steps: it leaves whole steps in between, so that a folder need be neither old nor new.
    """

    name: str
    before: tuple[Step, ...]
    command: str
    steps: bool = False


@dataclass
class Prepared:
    """A scenario whose folder lies ready, and what the command makes of it when nothing disturbs it."""

    scenario: Scenario
    pristine: Path
    old: State
    new: State
    varying: frozenset[str]
    seconds: float


def words(command: str, folder: Path) -> list[str]:
    """A command as it is typed, in a new interpreter of the program."""
    program, *others = [word.replace("@", str(folder)) for word in command.split()]
    return [sys.executable, "-c", f"from ballfg.cli.entry import {ENTRIES[program]} as run; run()", *others]


def environment(**more: str) -> dict[str, str]:
    """Variables of a command: a single thread, ballfg of this checkout, and one date for all pages."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), DATE: "1700000000", **more}


def undisturbed(command: str, folder: Path) -> float:
    """Runs a command to its end. Returns: s that it took."""
    begun = time.monotonic()
    done = subprocess.run(
        words(command, folder), cwd=folder, env=environment(), capture_output=True, text=True, timeout=LONGEST
    )
    assert done.returncode in (0, 1, 3), f"{command}: {done.stderr[-500:]}"  # 1, 3: it said so and wrote its result
    return time.monotonic() - begun


@cache
def made(place: Path, steps: tuple[Step, ...]) -> Path:
    """The folder that some steps make; scenarios share what they have in common."""
    folder = Path(tempfile.mkdtemp(dir=place))
    if steps:
        shutil.copytree(made(place, steps[:-1]), folder, dirs_exist_ok=True)
        if callable(steps[-1]):
            steps[-1](folder)
        else:
            undisturbed(steps[-1], folder)
    return folder


def prepare(scenario: Scenario, place: Path) -> Prepared:
    """Makes the inputs of a scenario, and runs its command twice: what differs then differs by the time alone."""
    pristine, found, seconds = made(place, scenario.before), [], 0.0
    for _ in range(2):
        folder = copied(pristine, place)
        seconds = undisturbed(scenario.command, folder)
        found.append(state(folder))
    varying = frozenset(name for name in found[0].keys() | found[1] if found[0].get(name) != found[1].get(name))
    return Prepared(scenario, pristine, state(pristine, varying), state(folder, varying), varying, seconds)


def copied(pristine: Path, place: Path) -> Path:
    """A fresh copy of the prepared folder, always under the same name: results may hold it."""
    folder = place / "work"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(pristine, folder)
    return folder


def alive(trial: str) -> list[int]:
    """The processes that have a trial's mark."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            try:
                marked = f"{MARK}={trial}".encode() in (process / "environ").read_bytes()
            except OSError:
                continue
            found += [int(process.name)] if marked else []
    return found


def disturb(prepared: Prepared, place: Path, number: signal.Signals, after: float, tally: Tally) -> None:
    """One trial: a signal, `after` some seconds, to a command that works in a copy of the folder."""
    scenario, folder, trial = prepared.scenario, copied(prepared.pristine, place), uuid.uuid4().hex
    before, said = set(SHARED.iterdir()), place / "said"
    where = f"{scenario.name}, {number.name} after {after:.2f} of {prepared.seconds:.1f} s"
    tally.counts["moments"] += 1
    tally.counts[number.name] += 1
    with said.open("w+") as messages:
        process = subprocess.Popen(
            words(scenario.command, folder),
            cwd=folder,
            env=environment(**{MARK: trial}),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=messages,
            start_new_session=True,
            preexec_fn=_heeds_ctrl_c,
        )
        time.sleep(after)
        process.send_signal(number)
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and (process.poll() is None or alive(trial)):
            time.sleep(0.05)
    left = alive(trial)
    if left or process.poll() is None:
        tally.add(
            "processes", f"{where}: {len(left)} live {PATIENCE:g} s later, the command with status {process.poll()}"
        )
    for one in left:
        os.kill(one, signal.SIGKILL)
    process.wait()
    judge(prepared, folder, number, process.returncode, said.read_text(errors="replace"), where, tally)
    ours = [path.name for path in set(SHARED.iterdir()) - before if _is_of(path.name, process.pid)]
    if ours:
        tally.add("semaphores", f"{where}: {ours}")


def judge(
    prepared: Prepared, folder: Path, number: signal.Signals, status: int, said: str, where: str, tally: Tally
) -> None:
    """What the command left in its folder, and what it said."""
    hidden = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.name.startswith(".")]
    if hidden and number != signal.SIGKILL:
        tally.add("hidden", f"{where}: {hidden}")
    found = state(folder, prepared.varying)
    if not prepared.scenario.steps and found not in (prepared.old, prepared.new):
        differing = sorted(set(found.items()) ^ set(prepared.new.items()))[:4]
        tally.add("neither old nor new", f"{where}: {differing}")
    tally.counts["old" if found == prepared.old else "new" if found == prepared.new else "between"] += 1
    if number == signal.SIGKILL:
        return
    ended = (0, 1, 3) if found != prepared.old or status == 0 else ()
    if status not in (128 + number, -number, *ended):  # the negative one: Python had not begun, or was through
        tally.add("status", f"{where}: status {status}: {said[-300:]}")
    if "Traceback" in said:
        tally.add("tracebacks", f"{where}: {said[-1500:]}")


def _heeds_ctrl_c() -> None:
    """A shell lets what it starts in the background ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_of(name: str, process: int) -> bool:
    """Whether a semaphore may be of a process: some names say of which they are."""
    other = re.match(r"sem\.\w+-(\d+)-", name)
    return name.startswith("sem.") and (other is None or int(other[1]) == process)


# --- the commands ----------------------------------------------------------------------------------------------------


def capture(folder: Path) -> None:
    """A table of many shots as another program writes it."""
    rows = [
        f"{shot},{0.01 * k:.2f},{0.05 * k:.4f},{0.001 * shot:.4f},{1.0 + 0.02 * k - 4.9 * (0.01 * k) ** 2:.6f}\n"
        for shot in range(50)
        for k in range(30)
    ]
    (folder / "capture.csv").write_text("trajectory,t,x,y,z\n" + "".join(rows))


def surveyed(folder: Path) -> None:
    """Lenses and the pixels of the table's points."""
    from tests.faults.scenarios import surveyed as write

    write(folder)


def a_tune(folder: Path) -> None:
    """The config of a training."""
    (folder / "train.yaml").write_text("{kind: a-tune, optimizer: {epochs: 2, batch: 4}}")


def calibrate(folder: Path) -> None:
    """The config of a calibration."""
    (folder / "train.yaml").write_text("{kind: calibrate, max_iterations: 2}")


SHOTS: Final = "ballfg simulate --out @/shots --tracks 8 --rate 100 --seed 1 --quiet"
MANY: Final = "ballfg simulate --out @/shots --tracks 300 --rate 60 --seed 1 --quiet"
FILM: Final = "ballfg render --out @/scene --shots 1 --size 480x270 --no-distractors --force"
IMPORT: Final = (
    "ballfg import @/capture.csv --out @/mine --length m --time s --up z --ball table-tennis --table-height 0"
)
CALIBRATE: Final = "ballfg calibrate-cameras --intrinsics @/lenses.yaml --table @/table.yaml --out @/found.yaml"
TRACK: Final = (
    "ballfg track @/scene/left.mp4 @/scene/right.mp4 @/scene/far.mp4 --cameras @/scene/cameras.yaml --out @/tracked"
)
DIAGNOSE: Final = "ballfg diagnose @/shots --out @/report"
DESIGN: Final = "ballfg design @/shots --candidates speed=8..14:2 --between wind.x,drag.k --shots 3 --out @/plan.csv"
EARLIER: Final = "ballfg estimate @/shots --method ekf --jobs 1 --out @/s.csv"
ESTIMATE: Final = "ballfg estimate @/shots --out @/s.csv"
PREDICT: Final = "ballfg predict @/shots --out @/p.csv"
NOISE: Final = "ballfg noise @/shots --out @/model.yaml"
TRAIN: Final = "ballfg-train @/train.yaml --data @/shots --out @/run"

SCENARIOS: Final = (
    Scenario("simulate", (SHOTS,), "ballfg simulate --out @/shots --tracks 20 --seed 2 --force"),
    Scenario("estimate", (SHOTS, EARLIER), f"{ESTIMATE} --jobs 1"),
    Scenario("estimate-2", (MANY, EARLIER), f"{ESTIMATE} --jobs 2"),
    Scenario("predict", (SHOTS, f"{PREDICT} --observe 0.2 --jobs 1"), f"{PREDICT} --observe 0.3 --jobs 1"),
    Scenario("predict-2", (MANY, f"{PREDICT} --observe 0.2 --jobs 1"), f"{PREDICT} --observe 0.3 --jobs 2"),
    Scenario("noise", (SHOTS, f"{NOISE} --tracks 5"), f"{NOISE} --tracks 8"),
    Scenario(
        "show", (SHOTS, "ballfg show @/shots --track 000 --out @/page.html"), "ballfg show @/shots --out @/page.html"
    ),
    Scenario(
        "example",
        ("ballfg example --out @/example --tracks 6 --seed 5",),
        "ballfg example --out @/example --tracks 9 --force",
    ),
    Scenario("import", (capture, f"{IMPORT} --format parquet"), f"{IMPORT} --force"),
    Scenario("render", (f"{FILM} --rate 30 --seed 4",), f"{FILM} --rate 30 --seed 5"),
    Scenario("track-2", (f"{FILM} --rate 120",), f"{TRACK} --jobs 2"),
    Scenario("calibrate-cameras", (surveyed,), CALIBRATE),
    Scenario("diagnose", (SHOTS,), f"{DIAGNOSE} --jobs 1"),
    Scenario("diagnose-2", (SHOTS,), f"{DIAGNOSE} --jobs 2"),
    Scenario("design", (SHOTS,), f"{DESIGN} --jobs 1"),
    Scenario("design-2", (SHOTS,), f"{DESIGN} --jobs 2"),
    Scenario("compile", (), "ballfg compile"),
    Scenario("balls", (), "ballfg balls"),
    Scenario("info", (), "ballfg info"),
    Scenario("live", (SHOTS,), "ballfg live --replay @/shots --speed 0 --out @/lines.jsonl", steps=True),
    Scenario("train", (SHOTS, a_tune), f"{TRAIN} jobs=1", steps=True),
    Scenario("train-2", (SHOTS, a_tune), f"{TRAIN} jobs=2", steps=True),
    Scenario("calibrate-2", (SHOTS, calibrate), f"{TRAIN} jobs=2", steps=True),
    Scenario("bench-2", (), "ballfg-bench intervals --quick --jobs 2 --out @/results", steps=True),
)


def trials(count: int, seed: int, names: Sequence[str]) -> Tally:
    """Disturbs commands at random moments, as many as are asked for, shared out among the scenarios."""
    rng, tally = np.random.default_rng(seed), Tally()
    chosen = [scenario for scenario in SCENARIOS if not names or scenario.name in names]
    with tempfile.TemporaryDirectory(prefix="signals-") as name:
        place = Path(name)
        for share, scenario in zip(_shares(count, len(chosen)), chosen, strict=True):
            wrong, prepared = len(tally.wrong), prepare(scenario, place)
            for _ in range(share):
                number = SIGNALS[int(rng.integers(len(SIGNALS)))]
                disturb(prepared, place, number, float(rng.uniform(0.0, prepared.seconds)), tally)
            print(
                f"{scenario.name}: {share} moments in {prepared.seconds:.1f} s",
                *tally.wrong[wrong:],
                sep="\n",
                flush=True,
            )
    return tally


def _shares(count: int, parts: int) -> list[int]:
    return [count // parts + (number < count % parts) for number in range(parts)]


KINDS: Final = ("processes", "semaphores", "hidden", "neither old nor new", "status", "tracebacks")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.faults.signals", description=__doc__)
    parser.add_argument("names", nargs="*", help="scenarios; all of them by default")
    parser.add_argument("--count", type=int, default=300, help="moments")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    tally = trials(options.count, options.seed, options.names)
    told = ", ".join(f"{name} {tally.counts[name]}" for name in (*(s.name for s in SIGNALS), "old", "new", "between"))
    print(f"{tally.counts['moments']} moments ({told}): " + ", ".join(f"{kind} {tally.counts[kind]}" for kind in KINDS))
    return 1 if tally.wrong else 0


if __name__ == "__main__":
    sys.exit(main())

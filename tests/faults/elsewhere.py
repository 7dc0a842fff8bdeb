"""Folders from elsewhere: whatever somebody planted in them, a command that reads them changes no file, and ends.

`python -m tests.faults.elsewhere --count 500 --seed 7` makes as many at random, runs the reading commands on each, and
compares every other file of the sandbox, by content, mode, time and target, with what it was before. One command in
a hundred runs as a process of its own.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import random
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path

from ballfg.cli.main import run
from tests.faults.kills import in_fork
from tests.faults.scenarios import ballfg, filmed, learned, nominal_model, report, save_model, succeed, warm_up
from tests.places import ROOT

LONGEST = 30.0
"""s that a command may take; as a process, which loads and compiles, four times as long."""
OWN_PROCESS = 0.01
"""Share of the commands that run as a user starts them."""
PLACES = ("home", "home/hd", "home/models", "home/report", "home/out")
"""The parent of the dataset, the dataset, a model with weights, a diagnosis, and the folder of the results."""
State = dict[str, tuple[int, int, int, str]]

QUICK = (
    "show @/hd --out @/out/page.html",
    "show @/report --out @/out/report.html",
    "estimate @/hd --model @/models/model.yaml --out @/out/states.csv --jobs 1",
    "predict @/hd --observe 0.1 --out @/out/paths.csv --jobs 1",
    "design @/hd --candidates speed=8..10 --diagnosis @/report --out @/out/plan.csv --jobs 1",
    "design @/hd --candidates speed=8..10 --model @/models/learned.yaml --out @/out/plan.csv --jobs 1",
    "import @/hd/tracks.csv --out @/out/mine --length m --time s --up z --ball table-tennis --table-height 0",
    "diagnose @/hd --model @/report/model.yaml --out @/out/diagnosis --jobs 1",
)
SLOW = (
    "import @/hd --out @/out/mine --length m --time s --up z --ball table-tennis --table-height 0",
    "noise @/hd --out @/out/noise.yaml",
    "live --replay @/hd --speed 0 --model @/models/model.yaml --out @/out/lines.jsonl",
    "track @/hd/detections.csv --cameras @/hd/cameras.yaml --out @/out/tracked",
)
"""Of these each folder sees one."""
WRITTEN = sorted(
    {word.removeprefix("@/out/") for words in (*QUICK, *SLOW) for word in words.split() if "/out/" in word}
)


class HangError(BaseException):
    """A command took too long."""


def prepare(sandbox: Path) -> None:
    """A user's files, and good inputs of every command."""
    home = sandbox / "home"
    for name in ("precious", "home/src", "home/models", "home/out"):
        (sandbox / name).mkdir(parents=True)
    rows = [f"{s},{k / 100},{k / 20},{s / 10},{1 + k / 50 - 4.9 * (k / 100) ** 2}" for s in range(3) for k in range(20)]
    (home / "capture.csv").write_text("\n".join(("trajectory,t,x,y,z", *rows)) + "\n")
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        succeed(ballfg(*QUICK[6].replace("hd/tracks", "capture").replace("out/mine", "hd").split()), home)
        filmed(home / "hd")
        report(found=False)(home)
    (home / "diagnosis").rename(home / "report")
    (home / "hd" / "seen.csv").rename(home / "hd" / "detections.csv")
    save_model(nominal_model(), home / "models" / "model.yaml")
    save_model(learned(1), home / "models" / "learned.yaml")
    for name in ("precious/v.txt", "precious/data.csv", "home/thesis.tex", "home/src/main.c", "home/hd/notes.txt"):
        (sandbox / name).write_text(f"the only copy of {name}\n")
    (sandbox / "precious" / "data.csv").chmod(0o600)


# --- what is planted -----------------------------------------------------------------------------------------------


def plant(place: Path, sandbox: Path, draw: random.Random) -> str:
    """Puts one thing into a folder. Returns: what and where."""
    kind = draw.choice(tuple(PLANTS))
    with suppress(OSError):  # a name that is taken, or that this disk cannot have
        PLANTS[kind](place, sandbox, draw)
    return f"{kind} in {place.relative_to(sandbox)}"


def _free(place: Path, draw: random.Random) -> Path:
    """A name to put something at: that of an input, which goes, or another."""
    hidden = f".ballfg-{draw.getrandbits(64):016x}"
    names = [*sorted(path.name for path in place.iterdir() if path.is_file()), hidden, ".ballfg-writing", "labels.csv"]
    if place.name == "out":
        names = [*WRITTEN, hidden, *(f".{name}.ballfg-writing" for name in WRITTEN)]
    path = place / draw.choice(names)
    if place.name not in ("home", "out") and path.name != "notes.txt":
        path.unlink(missing_ok=True)
    return path


def _link(place: Path, sandbox: Path, draw: random.Random) -> None:
    path, precious = _free(place, draw), draw.choice(("precious/v.txt", "precious/data.csv", "precious", "home/src"))
    target = draw.choice(
        (sandbox / precious, os.path.relpath(sandbox / precious, place), "nowhere", path.name, "/", ".")
    )
    if path.name in WRITTEN and (place / target).exists() and target != path.name:
        return  # who names such a link as the output means what it leads to
    path.symlink_to(target)


def _plan(place: Path, sandbox: Path, draw: random.Random) -> None:
    """What earlier versions obeyed: a plan of moves, with a lock that leads elsewhere."""
    hidden = place / ".ballfg-writing"
    if place.name == "out":
        hidden = place / f".{draw.choice(WRITTEN)}.ballfg-writing"
    (hidden / "new").mkdir(parents=True)
    (hidden / "new" / "thesis.tex").write_text("theirs")
    names = ["thesis.tex", "src", "notes.txt", "../thesis.tex", "../../precious/v.txt", str(sandbox / "precious")]
    stale, new = (draw.sample(names, draw.randint(0, 3)) for _ in range(2))
    (hidden / "plan.json").write_text(draw.choice(("{}", "", json.dumps({"stale": stale, "new": new}))))
    target = draw.choice((os.path.relpath(sandbox / "precious" / "v.txt", hidden), sandbox / "home/thesis.tex", "no"))
    (hidden / "lock").symlink_to(target)


def _made(place: Path, sandbox: Path, draw: random.Random) -> None:
    """What a writer of today makes, with links in it."""
    hidden = place / f".ballfg-{draw.getrandbits(64):016x}"
    hidden.mkdir()
    for name in ("new", "old"):
        draw.choice((lambda p: p.mkdir(), lambda p: p.symlink_to(sandbox / "precious"), lambda p: p.touch()))(
            hidden / name
        )


def _deep(place: Path, sandbox: Path, draw: random.Random) -> None:
    path = _free(place, draw)
    path.joinpath(*["x"] * draw.choice((30, 120, 900))).mkdir(parents=True)


def _device(place: Path, sandbox: Path, draw: random.Random) -> None:
    os.mknod(_free(place, draw), stat.S_IFCHR | 0o666, os.makedev(1, draw.choice((3, 5, 7, 8))))


def _socket(place: Path, sandbox: Path, draw: random.Random) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(_free(place, draw)))


def _odd_name(place: Path, sandbox: Path, draw: random.Random) -> None:
    name = draw.choice((b"\xff\xfe", b"-rf", b"\x1b[31m", b"a\nb", b"*", "\u202egpj".encode(), b"n" * 255))
    path = os.path.join(os.fsencode(place), name)
    with open(path, "wb") as file:
        file.write(b"odd")


PLANTS: dict[str, Callable[[Path, Path, random.Random], None]] = {
    "link": _link,
    "plan": _plan,
    "hidden folder": _made,
    "pipe": lambda place, _, draw: os.mkfifo(_free(place, draw)),
    "device": _device,
    "socket": _socket,
    "deep tree": _deep,
    "unreadable": lambda place, _, draw: draw.choice(
        sorted(p for p in place.iterdir() if p.is_file()) or [place]
    ).chmod(0),
    "folder": lambda place, _, draw: _free(place, draw).mkdir(),
    "odd name": _odd_name,
}

# --- what is run and compared --------------------------------------------------------------------------------------


def state(sandbox: Path) -> State:
    """Of every entry: kind and mode, time, and content or target. The folder of the results has no time."""
    found: State = {}
    for folder, folders, files in os.walk(sandbox):
        for name in (".", *folders, *files):
            path = os.path.normpath(os.path.join(folder, name))
            one = os.lstat(path)
            content = ""
            if stat.S_ISREG(one.st_mode):
                with open(path, "rb") as file:
                    content = hashlib.sha256(file.read()).hexdigest()
            elif stat.S_ISLNK(one.st_mode):
                content = os.readlink(path)
            times = 0 if path == str(sandbox / "home" / "out") else one.st_mtime_ns
            found[path] = (one.st_mode, one.st_uid, times, content)
    return found


def changes(before: State, after: State, out: Path) -> list[str]:
    """Entries that are gone, or others, and new ones that are no results."""
    results = {str(out / name) for name in WRITTEN if stat.S_ISDIR(before.get(str(out / name), (0,))[0])}
    changed = [path for path, one in before.items() if after.get(path) != one and path not in results]
    new = [path for path in after.keys() - before.keys() if path.removeprefix(f"{out}/").split("/")[0] not in WRITTEN]
    return sorted({*changed, *new})


def words_of(command: str, home: Path) -> list[str]:
    """The words of a command; `@` is the folder in which all lies."""
    return [word.replace("@", str(home)) for word in command.split()]


def in_this_process(words: list[str], longest: float = LONGEST) -> tuple[int, str]:
    """Status and messages of a command that ends within the time."""

    def late(*_: object) -> None:
        raise HangError

    signal.signal(signal.SIGALRM, late)
    said = io.StringIO()
    signal.setitimer(signal.ITIMER_REAL, longest)
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(said):
            run(words)
    except SystemExit as end:
        return (end.code if isinstance(end.code, int) else 1), said.getvalue()
    except HangError:
        return -signal.SIGALRM, "hangs"
    except BaseException as error:
        return 1, f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return 0, said.getvalue()


def as_process(words: list[str], longest: float = 4 * LONGEST) -> tuple[int, str]:
    """The same of a command as a user starts it."""
    command = [sys.executable, "-c", "import sys; from ballfg.cli.main import run; run(sys.argv[1:])", *words]
    try:
        ended = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=longest, check=False)
    except subprocess.TimeoutExpired:
        return -signal.SIGALRM, "hangs"
    return ended.returncode, ended.stderr.decode(errors="replace")


def one_folder(pristine: Path, place: Path, number: int, seed: int) -> Iterator[tuple[str, str]]:
    """Makes a folder and runs the commands. Yields: a kind of what was seen, and a sentence."""
    draw = random.Random(f"{seed}/{number}")
    sandbox, told = place / "sandbox", place / "told"
    shutil.copytree(pristine, sandbox, symlinks=True)
    planted = [plant(sandbox / draw.choice(PLACES), sandbox, draw) for _ in range(draw.randint(1, 6))]
    commands = [*draw.sample(QUICK, len(QUICK)), draw.choice(SLOW)]
    alone = [draw.random() < OWN_PROCESS for _ in commands]
    before = state(sandbox)

    def work() -> None:
        with told.open("w", encoding="utf-8") as file:
            for command, apart in zip(commands, alone, strict=True):
                status, said = (as_process if apart else in_this_process)(words_of(command, sandbox / "home"))
                file.write(json.dumps([command, status, said[-400:]]) + "\n")
                file.flush()

    where = f"folder {number} ({'; '.join(planted)})"
    try:
        in_fork(work, place / "said", 600.0)
    except TimeoutError:
        yield "hangs", f"{where}: killed"
    for command, status, said in map(json.loads, told.read_text(encoding="utf-8").splitlines()):
        lines = [line for line in said.splitlines() if line.startswith("ballfg: error:")]
        right = status in (0, 3) or (status == 2 and len(lines) == 1)
        yield (
            ("done" if status != 2 else "refused") if right else "hangs" if status < 0 else "not one line",
            (f"{where}: {command}: {status} {said}"),
        )
    changed = changes(before, state(sandbox), sandbox / "home" / "out")
    if changed:
        yield "changed", f"{where}: {changed[:5]}"


def try_folders(count: int, seed: int) -> tuple[Counter[str], list[str]]:
    """What was seen in a number of folders, and the sentences on what is wrong."""
    warm_up()
    seen: Counter[str] = Counter()
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(prefix="elsewhere-") as text:
        top = Path(text)
        os.environ["XDG_STATE_HOME"] = str(top / "state")
        prepare(top / "pristine")
        for warm in ("warm", "again"):  # a command of each kind: some refuse a result that is there
            shutil.copytree(top / "pristine", top / warm, symlinks=True)
        for command in (*QUICK, *SLOW):  # what is imported and compiled here is there in each copy of this process
            as_process(words_of(command, top / "warm" / "home"), 600.0)
            status, said = in_this_process(words_of(command, top / "again" / "home"), 600.0)
            if status not in (0, 3) and not said.startswith("ballfg: error:"):
                raise RuntimeError(f"{command} must work without any fault; got {status}: {said}")
        for number in range(count):
            if number % 50 == 0:
                print(f"{number} folders: {dict(seen)}", file=sys.stderr, flush=True)
            place = top / "one"
            place.mkdir()
            for kind, sentence in one_folder(top / "pristine", place, number, seed):
                seen[kind] += 1
                if kind not in ("done", "refused"):
                    wrong.append(f"{kind}: {sentence}")
                    print(wrong[-1], flush=True)
            subprocess.run(["rm", "-rf", str(place)], check=True)  # Python's own has a limit of depth
    return seen, wrong


def main() -> int:
    """The count, and the seed of the folders."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    begun = time.monotonic()
    seen, wrong = try_folders(given.count, given.seed)
    kinds = ", ".join(f"{kind} {seen[kind]}" for kind in ("changed", "hangs", "not one line", "done", "refused"))
    print(f"{given.count} folders: {kinds} in {time.monotonic() - begun:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

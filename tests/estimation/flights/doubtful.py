"""Whether later commands repeat what is doubtful about a recording within their first three lines.

    python -m tests.estimation.flights.doubtful --count 30 --seed 20000

makes recordings that are doubtful in ten ways, imports each by the command, and looks for its doubt in the first lines
of estimate, predict, noise, diagnose, show and ballfg-train (kind: calibrate).
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ballfg.arrays import Array
from ballfg.learning.cli import run as train
from tests.commands import status
from tests.estimation.flights.recordings import recording

RATE = 100.0
FIRST = 3
"""Number of lines in which a doubt must stand."""
COMMANDS = ("estimate", "predict", "noise", "diagnose", "show", "train")


def throws(rng: np.random.Generator, count: int, speeds: tuple[float, float], noise: float = 0.002) -> list[Array]:
    """Thrown balls that bounce once on a table of height 0.76 m: (n, 4) s and m each."""
    found = []
    for _ in range(count):
        times = np.arange(0.0, 0.9, 1.0 / RATE)
        p, v, path = np.array([0.0, rng.uniform(-0.2, 0.2), 1.1]), np.zeros(3), []
        v[:] = rng.uniform(*speeds), rng.uniform(-0.4, 0.4), rng.uniform(0.0, 1.5)
        for _ in times:
            path.append(p.copy())
            for _ in range(20):
                v = v + (np.array([0.0, 0.0, -9.81]) - 0.13 * np.linalg.norm(v) * v) / (20 * RATE)
                p = p + v / (20 * RATE)
                if p[2] < 0.78 and v[2] < 0.0:
                    v = v * np.array([0.8, 0.8, -0.9])
        found.append(np.column_stack((times, np.array(path) + rng.normal(0.0, noise, (len(times), 3)))))
    return found


@dataclass(frozen=True)
class Case:
    """A doubtful recording: shots (n, 4) s and m, the options of its import, what its doubt says, and a model."""

    shots: list[Array]
    options: tuple[str, ...]
    said: str
    fitted_on: list[Array] | None = None
    """Shots whose calibrated model the commands get."""


def smoothed(rng: np.random.Generator) -> Case:
    """By a first-order low-pass of 6 Hz, both ways as trackers do it twice."""
    shots, share = throws(rng, 8, (2.5, 5.0)), 1.0 - np.exp(-2.0 * np.pi * 6.0 / RATE)
    for shot in shots:
        for _ in range(2):
            for i in range(1, len(shot)):
                shot[i, 1:] = shot[i - 1, 1:] + share * (shot[i, 1:] - shot[i - 1, 1:])
    return Case(shots, (), "smoothed")


def wrong_unit(rng: np.random.Generator) -> Case:
    """Metres that are called feet, or centimetres that are called inches."""
    shots, (unit, size) = throws(rng, 8, (2.5, 5.0)), [("ft", 1.0), ("in", 100.0)][int(rng.integers(2))]
    scaled = [shot * np.array([1.0, size, size, size]) for shot in shots]
    return Case(scaled, ("--length", unit, "--time", "s", "--up", "z", "--table-height", "0"), f"in {unit} ")


def wrong_axis(rng: np.random.Generator) -> Case:
    """Another axis is called up."""
    up = str(rng.choice(("x", "y", "-z")))
    options = ("--length", "m", "--time", "s", "--up", up, "--table-height", "0")
    return Case(throws(rng, 8, (2.5, 5.0)), options, f"{up} up")


def _recorded(rng: np.random.Generator, kinds: tuple[str, ...], said: str) -> Case:
    some = [recording(int(rng.integers(10**6)), kind=kinds[k % len(kinds)]).track for k in range(6)]
    shots = [np.column_stack((track.seconds, track.positions)) for track in some]
    return Case(shots, ("--length", "m", "--time", "s", "--up", "z", "--table-height", "0"), said)


def held(rng: np.random.Generator) -> Case:
    """Balls that are held most of the time."""
    return _recorded(rng, ("held", "held", "carried"), "fall like a ball")


def half(rng: np.random.Generator) -> Case:
    """Balls that are juggled, dribbled, thrown, caught."""
    return _recorded(rng, ("rolled", "carried", "held", "caught"), "fall like a ball|are flight")


def clipped(rng: np.random.Generator) -> Case:
    """Places beyond a limit are measured at the limit."""
    shots = throws(rng, 8, (4.0, 6.0))
    for shot in shots:
        shot[:, 1] = np.minimum(shot[:, 1], 1.6)
    return Case(shots, ("--length", "m", "--time", "s", "--up", "z", "--table-height", "0.76"), "clipped")


def two_balls(rng: np.random.Generator) -> Case:
    """The samples of two balls in turn, in one track."""
    one, other = throws(rng, 6, (2.5, 5.0)), throws(rng, 6, (2.5, 5.0))
    shots = []
    for a, b in zip(one, other, strict=True):
        b[:, 2] += 1.0
        shots.append(np.where((np.arange(len(a)) % 2 == 0)[:, None], a, b))
    return Case(shots, ("--length", "m", "--time", "s", "--up", "z", "--table-height", "0.76"), "another ball")


def few(rng: np.random.Generator) -> Case:
    """Three tracks."""
    return Case(throws(rng, 3, (2.5, 5.0)), (), "too few tracks|usual noise")


def faster(rng: np.random.Generator) -> Case:
    """Faster and farther than the tracks that the model was fitted on."""
    return Case(throws(rng, 8, (7.0, 9.0)), (), "fitted on", throws(rng, 16, (2.5, 4.0)))


def height_only(rng: np.random.Generator) -> Case:
    """The height alone is measured."""
    return Case([shot[:, [0, 3]] for shot in throws(rng, 8, (0.1, 0.2))], ("--length", "m"), "not measured")


KINDS: tuple[Callable[[np.random.Generator], Case], ...] = (
    smoothed, wrong_unit, wrong_axis, held, half, clipped, two_balls, few, faster, height_only,
)  # fmt: skip


def _written(shots: list[Array], path: Path) -> Path:
    with path.open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(("shot", "t", "x", "y", "z") if shots[0].shape[1] == 4 else ("shot", "t", "z"))
        for k, shot in enumerate(shots):
            table.writerows([k, *map(repr, row)] for row in shot.tolist())
    return path


def _said(work: Callable[[], object]) -> list[str]:
    """The lines that a command prints, on both streams."""
    with io.StringIO() as heard, contextlib.redirect_stdout(heard), contextlib.redirect_stderr(heard):
        with contextlib.suppress(SystemExit):
            work()
        return [line for line in heard.getvalue().splitlines() if line.strip()]


def trained(config: Path, data: Path, out: Path) -> list[str]:
    """What a calibration says."""
    return _said(lambda: train([str(config), "--data", str(data), "--out", str(out)]))


def answers(case: Case, folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Each command with its first lines."""
    data, config = folder / "data", folder / "cal.yaml"
    config.write_text("{kind: calibrate, max_iterations: 2}")
    imported = _said(lambda: status("import", _written(case.shots, folder / "shots.csv"), "--out", data, *case.options))
    if not data.is_dir():
        yield "import", imported
        return
    model: tuple[str, ...] = ()
    if case.fitted_on is not None:
        _said(lambda: status("import", _written(case.fitted_on or [], folder / "other.csv"), "--out", folder / "other"))
        trained(config, folder / "other", folder / "fit")
        model = ("--model", str(folder / "fit" / "model.yaml"))
    typed = {
        "estimate": ("--out", folder / "s.csv", *model),
        "predict": ("--observe", "0.3", "--out", folder / "p.csv", *model),
        "noise": model,
        "diagnose": ("--out", folder / "d", *model),
        "show": ("--out", folder / "page.html"),
    }
    for name, options in typed.items():
        if name != "show" or not model:  # a page of tracks has no model
            yield name, _said(lambda name=name, options=options: status(name, data, *options))
    if not model:
        yield "train", trained(config, data, folder / "run")


def main() -> None:
    """Prints the recordings with a command that keeps their doubt to itself."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind")
    chosen = parser.parse_args()
    right = 0
    kinds = [kind for kind in KINDS if chosen.kind in (None, kind.__name__)]
    for i in range(chosen.count):
        case = kinds[i % len(kinds)](np.random.default_rng(chosen.seed + i))
        silent = []
        with tempfile.TemporaryDirectory() as folder:
            for name, lines in answers(case, Path(folder)):
                if not any(re.search(case.said, line) for line in lines[:FIRST]):
                    silent.append((name, lines[: FIRST + 2]))
        right += not silent
        print(f"{kinds[i % len(kinds)].__name__} {chosen.seed + i}: {'said by all' if not silent else ''}", flush=True)
        for name, lines in silent:
            print(f"    {name}:", *(f"        {line[:150]}" for line in lines), sep="\n", flush=True)
    print(f"{right} of {chosen.count} recordings: every command says the doubt in its first {FIRST} lines")


if __name__ == "__main__":
    main()

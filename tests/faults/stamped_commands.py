"""What commands find in shots on a clock, as numbers by name."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ballfg.cli.main import run
from ballfg.learning.cli import run as train
from ballfg.learning.run.record import NOT_BETTER
from tests.faults.stamped_shots import write_detections

VARYING = ("latency", "seconds", "versions", "created", "duration")
"""Words of keys whose numbers differ from run to run."""

Numbers = Mapping[str, Any]
"""What a case found, by name. `a.sigma` has the standard deviations of `a`."""


def said(*words: object, command: Callable[[list[str]], object] = run, worst: int = 0) -> str:
    """What a command prints; its exit status may be `worst` at most."""
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            command([str(word) for word in words])
        except SystemExit as ended:
            if ended.code not in (None, *range(worst + 1)):
                raise RuntimeError(f"{words}: exit status {ended.code}: {error.getvalue()}") from None
    return out.getvalue()


def table(path: Path) -> Numbers:
    """The columns of a CSV file, with their sigmas beside them."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    found: dict[str, Any] = {}
    for name in rows[0]:
        cells = [row[name] for row in rows]
        try:
            found[name] = np.array([float(cell) for cell in cells])
        except ValueError:
            found[name] = cells
    for name in list(found):
        if f"sigma_{name}" in found:
            found[f"{name}.sigma"] = found[f"sigma_{name}"]
    return found


def flat(content: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of parsed JSON."""
    pairs = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else None
    if pairs is None:
        yield name, content
        return
    for key, value in pairs:
        if not any(word in str(key) for word in VARYING):
            yield from flat(value, f"{name}.{key}" if name else str(key))


def numbers_in(words: str) -> Numbers:
    """The numbers of printed lines, and the words between them."""
    pattern = r"-?\d+(?:\.\d+)?(?:e-?\d+)?"
    return {"numbers": np.array([float(n) for n in re.findall(pattern, words)]), "words": re.sub(pattern, "#", words)}


def estimated(method: str) -> Callable[[Path, int], Numbers]:
    """`ballfg estimate` by a method."""

    def case(folder: Path, _: int) -> Numbers:
        said("estimate", folder / "shots", "--method", method, "--out", folder / "s.csv", "--jobs", 1)
        return table(folder / "s.csv")

    return case


def predicted(folder: Path, _: int) -> Numbers:
    words = ("--observe", 0.25, "--out", folder / "p.csv", "--jobs", 1)
    said("predict", folder / "shots", *words)
    return table(folder / "p.csv")


def noise_found(folder: Path, _: int) -> Numbers:
    words = said("noise", folder / "shots", "--tracks", 6)
    return numbers_in(words.replace(str(folder), ""))


def diagnosed(folder: Path, _: int) -> Numbers:
    said("diagnose", folder / "shots", "--out", folder / "diagnosis", "--jobs", 1)
    return dict(flat(json.loads((folder / "diagnosis" / "report.json").read_text())))


def shown(folder: Path, _: int) -> Numbers:
    """The tables of the page: stamps in it count from each shot's first."""
    said("show", folder / "shots", "--out", folder / "page.html")
    page = (folder / "page.html").read_text().replace(str(folder), "")
    return {"page": re.sub(r"\d{4}-\d\d-\d\d[ T][\d:.]+", "", page)}


def replayed(folder: Path, _: int) -> Numbers:
    words = ("--speed", 0, "--out", folder / "live.jsonl", "--like", folder / "shots")
    said("live", "--replay", folder / "shots", *words)
    lines = [json.loads(line) for line in (folder / "live.jsonl").read_text().splitlines()]
    return dict(flat(lines))


def designed(folder: Path, _: int) -> Numbers:
    words = ("--candidates", "topspin=-3..5:4,speed=8..14:3", "--between", "wind.x,drag.k", "--shots", 2, "--jobs", 1)
    said("design", folder / "shots", *words, "--out", folder / "plan.csv")
    return table(folder / "plan.csv")


def imported(folder: Path, _: int) -> Numbers:
    said("import", folder / "shots" / "tracks.csv", "--out", folder / "own", "--name", "own", "--force")
    return {**table(folder / "own" / "tracks.csv"), "dataset": (folder / "own" / "dataset.yaml").read_text()}


def tracked(folder: Path, shift: int) -> Numbers:
    detections, rig = write_detections(folder, shift)
    said("track", detections, "--cameras", rig, "--out", folder / "balls", "--name", "balls", "--force", "--jobs", 1)
    return table(folder / "balls" / "tracks.csv")


def sighted(method: str) -> Callable[[Path, int], Numbers]:
    """`ballfg estimate --from detections` by a method."""

    def case(folder: Path, shift: int) -> Numbers:
        if not (folder / "balls").exists():
            tracked(folder, shift)
        words = ("--from", "detections", "--method", method, "--jobs", 1)
        said("estimate", folder / "balls", *words, "--out", folder / "b.csv")
        return table(folder / "b.csv")

    return case


def calibrated(folder: Path, _: int) -> Numbers:
    (folder / "calibrate.yaml").write_text("kind: calibrate\nseed: 1\n")
    short = ("max_iterations=2", "jobs=1", "coefficients=[flight.drag.k,bounce.restitution.e]")
    words = (folder / "calibrate.yaml", *short, "--data", folder / "shots", "--out", folder / "run")
    said(*words, command=train, worst=NOT_BETTER)  # the nominal model has made the shots: nothing beats it
    report = json.loads((folder / "run" / "report.json").read_text())
    return {name: value for name, value in flat(report) if "digest" not in name and "data" not in name}


COMMANDS = {
    **{f"ballfg estimate, {m}": estimated(m) for m in ("smoother", "online", "ekf", "sliding-window")},
    "ballfg predict --observe 0.25": predicted,
    "ballfg noise": noise_found,
    "ballfg show": shown,
    "ballfg live --replay": replayed,
    "ballfg import": imported,
    "ballfg design": designed,
    "ballfg track DETECTIONS": tracked,
    **{f"ballfg estimate --from detections, {m}": sighted(m) for m in ("smoother", "online", "ekf")},
    "ballfg-train, calibrate": calibrated,
    "ballfg diagnose": diagnosed,
}

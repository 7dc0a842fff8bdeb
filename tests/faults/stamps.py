"""Every command and call on the same shots with stamps from 0 and from 1.7e9 s, both written to the microsecond.

    python -m tests.faults.stamps

prints for each the largest difference of any number, in standard deviations. Numbers that come without one are compared
with their own size; a count, a name or a sentence that differs counts as infinite.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import ballfg as bf
from ballfg.cli.main import run
from ballfg.estimation import estimate_noise, estimate_time_offsets
from ballfg.estimation.configure import dataset_settings, dataset_surfaces
from ballfg.learning.cli import run as train
from ballfg.live.tracker import Tracker
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, write_simulation
from ballfg.vision.camera_file import write_cameras
from tests.estimation.observations.sighted_rig import RIG, launch, scene, track_of, truth, world

SHIFT = 1_700_000_000_123_457
"""us, the stamp of the first sample of all in the later data."""
TIMES = re.compile(r"(^|\.)(t|t_input|t_track|time)$")
"""Names of numbers on the data's clock."""
TIME_SIGMA = 1e-3
"""s. Stamps and contacts differ by a quarter of a microsecond, as doubles of that size do."""
LEAST = 1e-6
"""Numbers of less than that are zero, in any unit."""
WHITENED = "innovation"
"""Part of the names of numbers that are in standard deviations already."""
VARYING = ("latency", "seconds", "versions", "created", "duration")
"""Words of keys whose numbers differ from run to run."""

Numbers = Mapping[str, Any]
"""What a case found, by name. `a.sigma` has the standard deviations of `a`; names that match TIMES are stamps."""


def text(microseconds: int) -> str:
    """A stamp in s."""
    return f"{microseconds // 10**6}.{microseconds % 10**6:06d}"


def write_shots(folder: Path, shift: int, tracks: int, seed: int) -> Path:
    """A simulated dataset; its trajectories begin some seconds after one another, on a clock that begins at a shift."""
    noise = MeasurementNoise(position=0.002)
    folder.mkdir(parents=True, exist_ok=True)
    write_simulation(folder / "shots", SimulationConfig(tracks, 120.0, seed=seed, noise=noise, process=MotionNoise()))
    table = folder / "shots" / "tracks.csv"
    with table.open() as file:
        rows = list(csv.DictReader(file))
    first: dict[str, int] = {}
    for row in rows:
        begin = first.setdefault(row["trajectory"], len(first) * 3_700_000)
        row["t"] = text(shift + begin + round(1e6 * float(row["t"])))
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return folder / "shots"


def write_detections(folder: Path, shift: int) -> tuple[Path, Path]:
    """What three cameras saw of two balls one after the other, and the rig."""
    write_cameras(folder / "cameras.yaml", RIG)
    rows = []
    for number in range(2):
        rng = np.random.default_rng(number)
        times = np.arange(60) / 120.0
        states = truth(launch(rng), times, world())
        for camera in RIG:
            for time, state in zip(times, states, strict=True):
                if camera.in_view(state[:3]):
                    pixel = camera.project(state[:3]) + 0.3 * rng.standard_normal(2)
                    rows.append((shift + round(1e6 * (time + 2.0 * number)), camera.name, *np.ravel(pixel)))
    rows.sort(key=lambda row: row[0])
    with (folder / "detections.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("t", "camera", "u", "v", "sigma_u", "sigma_v", "score"))
        writer.writerows((text(t), name, u, v, 0.3, 0.3, 0.9) for t, name, u, v in rows)
    return folder / "detections.csv", folder / "cameras.yaml"


# --- commands --------------------------------------------------------------------------------------------------------


def said(*words: object, command: Callable[[list[str]], object] = run) -> str:
    """What a command prints; it has to succeed."""
    out, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            command([str(word) for word in words])
        except SystemExit as ended:
            if ended.code not in (0, None):
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
    said(folder / "calibrate.yaml", *short, "--data", folder / "shots", "--out", folder / "run", command=train)
    report = json.loads((folder / "run" / "report.json").read_text())
    return {name: value for name, value in flat(report) if "digest" not in name and "data" not in name}


# --- calls -----------------------------------------------------------------------------------------------------------


def of_states(states: list[Any]) -> dict[str, Any]:
    """Numbers of some `BallState`s."""
    return {
        "t": np.array([state.time for state in states]),
        "state": np.array([state.mean for state in states]),
        "state.sigma": np.array([np.sqrt(np.diagonal(state.joint)) for state in states]),
        "covariance": np.array([state.joint / np.sqrt(np.outer(*[np.diagonal(state.joint)] * 2)) for state in states]),
        "covariance.sigma": np.ones(1),
    }


def of_crossing(crossing: Any) -> dict[str, Any]:
    """Numbers of an event ahead."""
    if crossing is None:
        return {"none": "no event"}
    sigma = np.maximum(np.sqrt(np.diagonal(crossing.covariance)), 1e-9)
    return {"time": crossing.time, "state": crossing.state, "state.sigma": sigma, "sigma": crossing.time_sigma}


def call_estimate(folder: Path, _: int) -> Numbers:
    found: dict[str, Any] = {}
    for name, estimate in bf.estimate(folder / "shots").items():
        own = {
            "t": estimate.times,
            "contacts.time": np.array([c.time for c in estimate.contacts]),
            "notes": estimate.notes,
        }
        own |= {"states": estimate.states, "states.sigma": estimate.sigmas, "hits": estimate.hits}
        found |= {f"{name}.{key}": value for key, value in own.items()}
    return found


def call_ahead(folder: Path, _: int) -> Numbers:
    """The path of single tracks, and the events on it."""
    found: dict[str, Any] = {}
    for track in bf.read(folder / "shots"):
        ahead = bf.predict(track.opening(0.25), horizon=0.8, surfaces=0.76, settings=bf.Settings())
        own = {"t": ahead.times, "states": ahead.positions, "states.sigma": ahead.sigmas}
        events = {"contact": ahead.next_contact, "apex": ahead.apex, "plane": ahead.crossing(x=1.0)}
        own |= {f"{name}.{key}": v for name, event in events.items() for key, v in of_crossing(event).items()}
        found |= {f"{track.name}.{key}": value for key, value in own.items()}
    return found


def call_predict(folder: Path, _: int) -> Numbers:
    found: dict[str, Any] = {}
    for name, one in bf.predict(folder / "shots", observe=0.25, conformal=folder / "more" / "shots").items():
        found |= {f"{name}.t": one.times, f"{name}.p": one.positions, f"{name}.p.sigma": one.sigmas}
        found |= {f"{name}.sigmas": one.sigmas, f"{name}.estimate.t": one.estimate.times}
    return found


def call_noise(folder: Path, _: int) -> Numbers:
    data, model = bf.read(folder / "shots"), bf.nominal_model()
    found = estimate_noise(model, dataset_surfaces(data), dataset_settings(data, model), list(data)[:6])
    assert found is not None
    logs = {name: np.log(value) for name, value in flat(found.noise.to_mapping()) if value}
    return {**logs, "errors": np.array(list(found.relative_errors.values())), "starts": found.starts}


def call_push(folder: Path, _: int) -> Numbers:
    data, states = bf.read(folder / "shots"), []
    settings = dataset_settings(data, bf.nominal_model())
    for track in list(data)[:3]:
        for solver in ("ballfg", "gtsam"):
            live = bf.Online(bf.nominal_model(), dataset_surfaces(data), replace(settings, solver=solver))
            states += [live.push(t, p) for t, p in zip(track.times, track.positions, strict=True)]
    return of_states(states)


def call_tracker(folder: Path, _: int) -> Numbers:
    """All tracks one after the other; every seventh sample comes three frames late."""
    data = bf.read(folder / "shots")
    tracker = Tracker(bf.nominal_model(), dataset_surfaces(data), dataset_settings(data, bf.nominal_model()))
    updates = []
    for track in data:
        order = np.argsort(np.arange(len(track)) + np.where(np.arange(len(track)) % 7 == 5, 3.5, 0.0), kind="stable")
        for k in order:
            updates += tracker.push(float(track.times[k]), track.positions[k])
    updates += tracker.end()
    states = of_states([update.state for update in updates if update.state is not None])
    events = [event for update in updates for event in update.events]
    told = [(update.kind, update.ball, update.samples, update.reason) for update in updates]
    times = {"updates.t": np.array([u.time for u in updates]), "events.t": np.array([e.time for e in events])}
    return {**states, **times, "told": told, "events": [event.kind for event in events]}


def call_sightings(_: Path, shift: int) -> Numbers:
    """A sighted track by smoother and stream, and the time offsets of its cameras."""
    ball, found = world(), {}
    made = scene(3, ball)
    ticks = np.round(made.sightings.times * 1e6).astype(np.int64)
    stamps = np.array([float(text(shift + int(tick))) for tick in ticks])
    made = made._replace(sightings=bf.tracks.Sightings(
        made.sightings.cameras, made.sightings.camera, stamps, made.sightings.pixels, made.sightings.covariances
    ))  # fmt: skip
    track, settings = track_of(made), bf.Settings()
    estimate = bf.Smoother(ball.model, ball.surfaces, settings).estimate(track)
    found |= {"t": estimate.times, "states": estimate.states, "states.sigma": estimate.sigmas}
    offsets = estimate_time_offsets([track], ball.model, ball.surfaces, settings)
    found |= {"offsets": np.array([c.time_offset for c in offsets.cameras]), "offsets.sigma": 1e-4}
    live = bf.Online(ball.model, ball.surfaces, replace(settings, solver="ballfg"), cameras=RIG)
    sightings = made.sightings
    rows = zip(sightings.times, sightings.camera, sightings.pixels, sightings.covariances, strict=True)
    states = [s for t, c, p, v in rows if (s := live.push_sighting(t, sightings.cameras[c], p, v)) is not None]
    return found | {f"live.{key}": value for key, value in of_states(states).items()}


def call_readings(folder: Path, shift: int) -> Numbers:
    """A radar's readings between samples."""
    states = []
    for track in list(bf.read(folder / "shots"))[:2]:
        ticks = [round(1e6 * (time - shift * 1e-6)) for time in track.times.tolist()]
        middle = [float(text(shift + (one + other) // 2)) for one, other in pairwise(ticks)]
        speeds = np.linalg.norm(np.diff(track.positions, axis=0), axis=1) * 120.0
        radar = bf.RadarSpeed.at(track, middle, speeds, 0.5)
        states += list(bf.estimate(track.observed(radar), surfaces=0.76, settings=bf.Settings()))
    return of_states(states)


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
CALLS = {
    "bf.estimate(folder)": call_estimate,
    "bf.predict(track), events ahead": call_ahead,
    "bf.predict(folder, observe=0.25, conformal)": call_predict,
    "estimate_noise": call_noise,
    "Online.push": call_push,
    "Tracker.push": call_tracker,
    "sightings: Smoother, push_sighting, time offsets": call_sightings,
    "RadarSpeed.at, bf.estimate": call_readings,
}
CASES: dict[str, Callable[[Path, int], Numbers]] = {**COMMANDS, **CALLS}


# --- comparison ------------------------------------------------------------------------------------------------------


def difference(early: Numbers, late: Numbers, shift: float) -> tuple[float, str]:
    """The largest difference of two results, and of what; shift: s, of the later one's clock."""
    if early.keys() != late.keys():
        return np.inf, f"one has {sorted(early.keys() ^ late.keys())[:3]}"
    worst, where = 0.0, "nothing"
    for name, value in early.items():
        if not name.endswith("sigma"):
            apart = _apart(name, value, late[name], early.get(f"{name}.sigma"), shift)
            worst, where = max((worst, where), (apart, name))
    return worst, where


def _apart(name: str, early: Any, late: Any, sigma: Any, shift: float) -> float:
    if isinstance(early, str | list | tuple | bool) or early is None or late is None:
        return 0.0 if early == late else np.inf
    one, other = np.asarray(early, dtype=np.float64), np.asarray(late, dtype=np.float64)
    if one.shape != other.shape or (np.isnan(one) != np.isnan(other)).any():
        return np.inf
    stamps = bool(TIMES.search(name))
    # an imported dataset counts from its own first stamp
    moved = shift if stamps and one.size and abs(float(other.flat[0]) - float(one.flat[0])) > 1.0 else 0.0
    size = np.maximum(np.abs(one), np.abs(other))
    scale = np.maximum(size, LEAST) if sigma is None else np.asarray(sigma)
    scale = np.array(TIME_SIGMA if stamps else 1.0) if stamps or WHITENED in name else scale
    return float(np.nanmax(np.abs(one - (other - moved)) / scale, initial=0.0))


def measured(name: str, tracks: int, seed: int) -> tuple[float, str]:
    """The largest difference that a case shows, and of what."""
    results = []
    with tempfile.TemporaryDirectory(prefix="ballfg-stamps-") as place:
        for shift in (0, SHIFT):
            folder = Path(place) / str(shift)
            write_shots(folder, shift, tracks, seed)
            if name == "bf.predict(folder, observe=0.25, conformal)":
                write_shots(folder / "more", shift, 20, seed + 1)
            before = Path.cwd()
            os.chdir(folder)
            try:
                results.append(CASES[name](Path("."), shift))
            finally:
                os.chdir(before)
    return difference(*results, SHIFT * 1e-6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracks", type=int, default=12)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--only", default="", help="part of the names of cases")
    given = parser.parse_args()
    for name in CASES:
        if given.only in name:
            worst, where = measured(name, given.tracks, given.seed)
            print(f"{name:50} {worst:9.2g}  ({where})", flush=True)


if __name__ == "__main__":
    main()

"""What `ballfg track` makes of the real broadcast rally, against labels made by eye: required and measured.

    python -m tests.estimation.broadcast [--half --seed 1]

reads broadcast/ of the measured data (`BALLFG_DATA`). With `--half` the candidates are those of another detector: half
of the labelled balls, and twenty false ones in each picture.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.rally.video import Rally, track_moving_camera
from ballfg.simulation.balls import ball_kind
from ballfg.vision.broadcast.court import TABLE_TENNIS, Court, read_court
from ballfg.vision.broadcast.lines import moved, slopes
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.broadcast.pictures import read_candidates
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.video import open_video
from tests.places import DATA
from tests.vision.broadcast.own import write_candidates

FOLDER: Final = DATA / "broadcast"
PLACE: Final = ((0.0, -8.9, 4.85), 0.1)
"""m, where the labelled corners alone put the camera, and how well (README of the data)."""
LABELLED: Final = 1.5  # px, standard deviation of labelled balls
NEAR, HIT, BOUNCE = 5.0, 1.5, 0.5  # px, and frames, within which a ball, a hit, a bounce is found


def of_corners(first: Pinhole, court: Court, seen: Array, sigma: float) -> Pinhole:
    """The camera by labelled corners (4, 2) px, NaN where there is none, with a prior of its place alone."""
    camera, known = first, np.isfinite(seen).all(axis=1)
    for _ in range(10):
        pixels, slope = slopes(camera, court.corners[known])
        rows, left = slope.reshape(-1, 7) / sigma, (seen[known] - pixels).ravel() / sigma
        information, pull = rows.T @ rows, rows.T @ left
        information[3:6, 3:6] += np.eye(3) / PLACE[1] ** 2
        pull[3:6] += (np.array(PLACE[0]) - camera.place) / PLACE[1] ** 2
        information[6, 6] += 1e-6
        camera = moved(camera, np.linalg.solve(information, pull))
    return camera


def corners_of(label: dict[str, Any]) -> Array:
    """(4, 2) px: near left, near right, far right, far left; NaN where not seen."""
    return np.array([[np.nan, np.nan] if one is None else one for one in label["points"]])


def camera_errors(shot: Shot, court: Court, labels: dict[str, Any]) -> Array:
    """(n,) px, of the court's corners in the labelled frames."""
    errors = [
        np.linalg.norm(shot.cameras[one["frame"] - shot.first].project(court.corners) - corners_of(one), axis=1)
        for one in labels["corners"]
    ]
    left = np.concatenate(errors)
    return left[np.isfinite(left)]


def balls_found(rally: Rally, labels: dict[str, Any]) -> tuple[int, int]:
    """Labelled frames of flight in which the chosen ball is near, and all of them."""
    (shot,), (one,) = rally.motion.shots, rally.shots
    rows = np.concatenate([stroke.rows for stroke in one.chosen.strokes])
    chosen = {int(one.seen.frame[row]): one.seen.pixels[row] for row in rows}
    fixed = Pinhole(one.camera.rotation, one.camera.centre, float(one.camera.matrix[0, 0]), one.camera.size)
    good, flights = 0, [ball for ball in labels["ball"] if not ball.get("toss")]
    for ball in flights:
        at = chosen.get(ball["frame"])
        if at is not None:
            good += np.linalg.norm(fixed.onto(at, shot.cameras[ball["frame"]]) - (ball["u"], ball["v"])) < NEAR
    return int(good), len(flights)


def bounce_errors(rally: Rally, court: Court, labels: dict[str, Any], radius: float) -> Array:
    """(n,) m, between each labelled bounce that was found and its place."""
    (shot,), found = rally.motion.shots, [event for event in rally.events if event.kind == "bounce"]
    errors = []
    for label in labels["bounces"]:
        near = min(found, key=lambda event: abs(event.t * labels["fps"] - label["frame"]))
        corner = min(labels["corners"], key=lambda one: abs(one["frame"] - label["frame"]))
        camera = replace(shot.cameras[corner["frame"]], bend=0.0)
        camera = of_corners(camera, court, corners_of(corner), corner["sigma_px"])
        ray = camera.directions(np.array([label["u"], label["v"]])) @ camera.turn
        place = camera.place + ray * (radius - camera.place[2]) / ray[2]
        if abs(near.t * labels["fps"] - label["frame"]) < BOUNCE:
            errors.append(float(np.linalg.norm(near.place[:2] - place[:2])))
    return np.array(errors)


def reprojected(rally: Rally) -> float:
    """Root mean square, of the image's diagonal, of the chosen candidates about the flights."""
    (one,) = rally.shots
    shift = np.zeros((len(one.seen), 3)) if one.seen.shift is None else one.seen.shift
    left = [
        one.camera.project(estimate.states[:, :3] - shift[stroke.rows]) - one.seen.pixels[stroke.rows]
        for stroke, estimate in zip(one.chosen.strokes, one.estimates, strict=True)
    ]
    return float(np.sqrt((np.concatenate(left) ** 2).sum(axis=1).mean()) / np.hypot(*one.camera.size))


def matched(rally: Rally, kind: str, labels: list[dict[str, Any]], fps: float, within: float) -> list[tuple[Any, Any]]:
    """Labels with the event of a kind that lies within so many frames of them."""
    found = [event for event in rally.events if event.kind == kind]
    pairs = []
    for label in labels:
        near = [event for event in found if abs(event.t * fps - label["frame"]) < within]
        if near:
            pairs.append((label, min(near, key=lambda event: abs(event.t * fps - label["frame"]))))
    return pairs


def main() -> None:
    """Prints required and measured."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--half", action="store_true", help="candidates of another detector")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    labels = json.loads((FOLDER / "labels.json").read_text(encoding="utf-8"))
    video, court, kind = open_video(FOLDER / "rally.mp4"), read_court(TABLE_TENNIS), ball_kind(TABLE_TENNIS)
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "candidates.csv"
        balls = {ball["frame"]: np.array([ball["u"], ball["v"]]) for ball in labels["ball"]}
        write_candidates(path, balls, np.arange(video.count) / labels["fps"], (1280, 720), LABELLED, given.seed)
        own = partial(read_candidates, path) if given.half else None
        rally = track_moving_camera(video.frames, court, kind.model, count=video.count, candidates=own)
    spent = time.process_time() - begun
    errors = camera_errors(rally.motion.shots[0], court, labels)
    print(f"corners, px, median; 95 %     | 1.5; 4   | {np.median(errors):.2f}; {np.percentile(errors, 95):.2f}")
    good, count = balls_found(rally, labels)
    print(f"ball in labelled frames       | 92 %     | {good} of {count}, {100 * good / count:.1f} %")
    print(f"strokes                       | {labels['strokes']}        | {len(rally.strokes)}")
    fps = labels["fps"]
    hits = matched(rally, "hit", labels["hits"], fps, HIT)
    right = sum((label["player"] == "right") == (event.place[0] > 0.0) for label, event in hits)
    print(f"hits, right end               | 90 %     | {right} of {len(labels['hits'])}")
    bounces = matched(rally, "bounce", labels["bounces"], fps, BOUNCE)
    right = sum((label["half"] == "right") == (event.place[0] > 0.0) for label, event in bounces)
    print(f"bounces, right half           | 92 %     | {right} of {len(labels['bounces'])}")
    places = bounce_errors(rally, court, labels, kind.ball.radius)
    print(f"bounce places, median         | 60 mm    | {1e3 * np.median(places):.0f} mm, most {1e3 * places.max():.0f}")
    print(f"reprojection, of the diagonal | 0.11 %   | {100 * reprojected(rally):.3f} %")
    sane = sum(
        2.0 < row["speed_hit"] < 40.0 and np.nan_to_num(row["net_clearance"], nan=1.0) > 0.0 for row in rally.strokes
    )
    on = sum((np.abs(event.place[:2]) < court.size).all() for event in rally.events if event.kind == "bounce")
    total = sum(event.kind == "bounce" for event in rally.events)
    print(f"over the net, 2 - 40 m/s      | all      | {sane} of {len(rally.strokes)}; {on} of {total} bounces on it")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"processor time; memory        | 60 s for 13 s; 2 | {spent:.0f} s for 7 s; {peak:.2f} GiB")


if __name__ == "__main__":
    main()

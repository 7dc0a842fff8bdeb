"""Turns every camera's candidates into balls in space; docs/associate.md explains the steps.

The steps: pieces of smooth motion in each image; matching of pieces between cameras; points in space; joining of pieces
of one flight; unassigned candidates that fit; removal of tracks that do not fall like a ball.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.checks import check_count, check_range, shown
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.stamps import elapsed, written
from ballfg.vision.association import gathering
from ballfg.vision.association.flights import is_ball, successions
from ballfg.vision.association.matching import Piece, match
from ballfg.vision.association.tracklets import find_tracklets
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

_NONE: Final = np.zeros(0, dtype=np.int64)
_DISPUTED: Final = 2  # most frames in which two parts of one flight both have a candidate, one of them wrong


@dataclass(frozen=True)
class AssociationSettings:
    """How candidates become balls. Raises: ValueError: a number out of its range."""

    least_score: float = 0.3
    """In [0, 1]; candidates with a lower score are not used."""
    least_points: int = 6
    """Points of the shortest track that is kept; at least 3."""

    def __post_init__(self) -> None:
        check_range("least_score", self.least_score, 0.0, 1.0)
        check_count("least_points", self.least_points, 3)


def associate(
    detections: Sequence[Detections], cameras: Sequence[Camera], settings: AssociationSettings | None = None
) -> list[gathering.SeenBall]:
    """The balls that several cameras saw, in the order of their first points.

    Cameras need not share a shutter or a rate, and frames may be missing. If the cameras share stamps, the points are
    at those; otherwise at the stamps of the camera that saw most of the ball, and the other cameras are interpolated.
    A ball is one track through bounces and short gaps.

    Args: detections: one for each camera, in any order.  cameras: at least two, with the detections' names.
        settings: the default ones if None.
    Raises: ValueError: cameras and detections that do not go together.
    """
    settings = settings or AssociationSettings()
    footage = _footage(detections, cameras, settings)
    pieces = []
    for number, (camera, seen) in enumerate(zip(footage.cameras, footage.detections, strict=True)):
        focal = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
        pieces += [Piece(number, rows, footage.path(number, rows)) for rows in find_tracklets(seen, focal)]
    groups, offset = match(pieces, footage.cameras)
    footage, balls = replace(footage, offset=offset), []
    for group in groups:
        rows = [[pieces[i].rows for i in group if pieces[i].camera == c] for c in range(len(cameras))]
        balls.append(gathering.gather(footage, [np.sort(np.concatenate([_NONE, *own])) for own in rows]))
    balls = _joined(footage, [ball for ball in balls if len(ball.track.times) >= 2])
    balls = _joined(footage, gathering.complete(footage, balls))
    balls = [ball for ball in balls if len(ball.track.times) >= settings.least_points and is_ball(ball.track)]
    return sorted((_seen_ball(footage, ball) for ball in balls), key=lambda ball: float(ball.times[0]))


def _footage(
    detections: Sequence[Detections], cameras: Sequence[Camera], settings: AssociationSettings
) -> gathering.Footage:
    names = [camera.name for camera in cameras]
    by_name = {seen.camera: seen for seen in detections}
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(f"cameras must be two or more with different names; got {names}. Add or rename cameras.")
    if len(by_name) < len(detections) or set(by_name) != set(names):
        raise ValueError(
            f"detections must be one for each of the cameras {names}; got those of {[d.camera for d in detections]}. "
            "Leave out cameras without detections, or rename."
        )
    ordered = [by_name[name] for name in names]
    for seen in ordered:
        if seen.shifts is not None:
            raise ValueError(
                f"camera {shown(seen.camera)} must stand where the calibration has it; its detections have shifts. Of "
                "several cameras none may move: leave the others out with --without, or the columns shift_x, shift_y, "
                "shift_z."
            )
    stamps = [seen.frames for seen in ordered]
    origin = min((float(frames[0]) for frames in stamps if len(frames)), default=0.0)
    counted = [replace(seen, frames=elapsed(seen.frames, origin)) for seen in ordered]
    chosen = [seen.select(seen.scores >= settings.least_score) for seen in counted]
    frames = [seen.frames - camera.time_offset for seen, camera in zip(chosen, cameras, strict=True)]
    return gathering.Footage(
        list(cameras), chosen, gathering.shared_stamps(frames, gathering.SAME_SHUTTER), origin, stamps
    )


def _joined(footage: gathering.Footage, balls: list[gathering.Gathered]) -> list[gathering.Gathered]:
    following = dict(successions([ball.track for ball in balls]))
    later = set(following.values())
    joined = []
    for number in range(len(balls)):
        if number in later:
            continue
        chain = [number]
        while chain[-1] in following and _may_follow(footage, balls[chain[-1]], balls[following[chain[-1]]]):
            chain.append(following[chain[-1]])
        rest = following.get(chain[-1])
        while rest is not None:
            joined.append(balls[rest])
            rest = following.get(rest)
        if len(chain) == 1:
            joined.append(balls[number])
            continue
        undisputed = []  # rows in ascending order, without frames that have two
        for seen, *parts in zip(footage.detections, *(balls[i].rows for i in chain), strict=True):
            rows = np.concatenate(parts)
            _, position, count = np.unique(seen.frame[rows], return_inverse=True, return_counts=True)
            undisputed.append(np.sort(rows[count[position] == 1]))
        joined.append(gathering.gather(footage, undisputed))
    return joined


def _may_follow(footage: gathering.Footage, one: gathering.Gathered, other: gathering.Gathered) -> bool:
    """True if hardly any camera saw both in one frame; where one did, one of the candidates is wrong."""
    pairs = zip(footage.detections, one.rows, other.rows, strict=True)
    return all(np.isin(seen.frame[mine], seen.frame[theirs]).sum() <= _DISPUTED for seen, mine, theirs in pairs)


def _seen_ball(footage: gathering.Footage, ball: gathering.Gathered) -> gathering.SeenBall:
    camera = np.repeat(np.arange(len(ball.rows)), [len(rows) for rows in ball.rows])
    pairs = list(zip(footage.detections, ball.rows, strict=True))
    since = np.concatenate([footage.times(number, rows) for number, rows in enumerate(ball.rows)])
    order = np.argsort(since, kind="stable")
    stamps = np.concatenate([own[seen.frame[rows]] for own, (seen, rows) in zip(footage.stamps, pairs, strict=True)])
    pixels = np.concatenate([seen.pixels[rows] for seen, rows in pairs])
    spread = np.concatenate([seen.covariances[rows] for seen, rows in pairs])
    names = tuple(c.name for c in footage.cameras)
    sightings = Sightings(names, camera[order], stamps[order], pixels[order], spread[order])
    times = written(ball.track.times, footage.origin)
    return gathering.SeenBall(times, ball.track.values, ball.covariances, sightings, ball.views)

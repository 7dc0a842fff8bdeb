"""Turns a video of one camera that pans and zooms into strokes: camera, candidates, strokes, events."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.rally.events import events_in_play, stroke_row
from ballfg.estimation.rally.field import SEEN, UNKNOWN
from ballfg.estimation.rally.moments import Event
from ballfg.estimation.rally.reconstruct import ShotRally, reconstruct
from ballfg.estimation.result import Status
from ballfg.progress import Watch, unwatched
from ballfg.vision.broadcast.candidates import BALLS, find_candidates
from ballfg.vision.broadcast.court import Court
from ballfg.vision.broadcast.motion import Frames, Motion, Shot, find_motion
from ballfg.vision.broadcast.pictures import Kept, Scale, without_doubled
from ballfg.vision.detection.detections import Detections
from ballfg.vision.one_thread import one_thread

OwnCandidates = Callable[[Shot, Array, Kept], Detections]
"""Gives the candidates of a user's detector in the pictures of a shot, from the stamps (f,) s of the kept pictures."""


@dataclass(frozen=True, eq=False)
class Rally:
    """What a video shows: its shots with their cameras, their strokes, the events, and a row of numbers a stroke.

    Attributes: doubled: number of pictures that repeat the one before and were left out.
    """

    motion: Motion
    shots: tuple[ShotRally, ...]
    events: tuple[Event, ...]
    strokes: tuple[dict[str, Any], ...]
    doubled: int = 0

    @property
    def notes(self) -> list[str]:
        """Sentences on what is left out or not sure."""
        seen = sum(len(shot) for shot in self.motion.shots)
        notes = [] if seen == len(self.motion.times) else [f"{len(self.motion.times) - seen} pictures show no court"]
        if self.doubled:
            notes.append(f"{self.doubled} pictures repeat the one before, as after a change of frame rate: left out")
        for shot in self.motion.shots:
            if shot.shifts is not None:
                far = np.ptp(shot.shifts, axis=0).max()
                notes.append(f"the camera of frame {shot.first} on moves, by {far:.2f} m: each picture has its place")
        notes += [
            f"the shutter of {one.camera.name} rolls: {1e3 * one.camera.readout:.1f} ms from the first row to the last"
            for one in self.shots
            if one.camera.readout
        ]
        for one in self.shots:
            unsure = (estimate for estimate in one.estimates if estimate.status is not Status.OK)
            notes += [f"stroke {estimate.name}: {estimate.status.value}" for estimate in unsure]
        return notes


def surfaces_of(court: Court) -> Surfaces:
    """What a ball bounces on: the court at z = 0 within its ends, and the floor below it, if there is one."""
    x, y = court.size.tolist()
    return Surfaces(0.0, court.floor, (-x, x, -y, y))


@one_thread()  # pictures are shared out among threads of our own
def track_moving_camera(
    frames: Frames,
    court: Court,
    model: BallModel,
    *,
    count: int,
    corners: dict[int, Array] | None = None,
    candidates: OwnCandidates | None = None,
    watch: Watch = unwatched,
) -> Rally:
    """The strokes in a video of one camera that turns and zooms, and may move.

    Args:
        frames: opens the video, each time anew.  count: of its pictures, about.  court: in them.  model: the ball.
        corners: number of a picture -> (4, 2) px of the court's corners, in any order; None: the court is found.
        candidates: of a detector of one's own; None: bright moving spots, as of a white ball, or else an orange one.
    Raises: ValueError: no picture shows the court, or corners or candidates are of no picture.
    """
    kept = without_doubled(frames, count, watch)
    scale = Scale.of(_size(kept.frames))
    if corners is not None:
        if strange := [picture for picture in corners if not 0 <= picture < len(kept.stamps)]:
            raise ValueError(
                f"--corners must be of pictures 0 to {len(kept.stamps) - 1} of the video; got picture {strange[0]}. "
                "Correct the column frame."
            )
        places = np.searchsorted(kept.numbers, list(corners), side="right") - 1
        fours = [scale.to_searched(four) for four in corners.values()]
        corners = {int(place): four for place, four in zip(places, fours, strict=True)}
    frames = scale.frames(kept.frames)
    motion = replace(find_motion(frames, court, len(kept.numbers), corners, watch), numbers=kept.numbers)
    surfaces = surfaces_of(court)
    step = float(np.median(np.diff(motion.times)))
    shots, events, rows = list[ShotRally](), list[Event](), list[dict[str, Any]]()
    for shot in motion.shots:
        if candidates is None:
            sought = (find_candidates(frames, shot, court, model.radius, motion.times, one, watch) for one in BALLS)
            share = SEEN
        else:
            own = candidates(scale.shot_of_video(shot), motion.times, kept)
            sought, share = (scale.detections_searched(one) for one in (own,)), UNKNOWN
        one = _first_with_strokes(
            reconstruct(found, shot, model, surfaces, first=len(rows), seen_share=share, watch=watch)
            for found in sought
        )
        mine = events_in_play(one, model, surfaces, step, court.net)
        seen = scale.detections_of_video(one.seen)
        shots.append(replace(one, camera=scale.camera_of_video(one.camera), seen=seen))
        events += mine
        rows += [stroke_row(estimate, mine, model, court.net) for estimate in one.estimates]
    return Rally(scale.motion_of_video(motion), tuple(shots), tuple(events), tuple(rows), kept.doubled)


def _first_with_strokes(rallies: Iterator[ShotRally]) -> ShotRally:
    """The first that holds strokes; without any the first of all."""
    one = next(rallies)
    return one if one.estimates else next((other for other in rallies if other.estimates), one)


def _size(frames: Frames) -> tuple[int, int]:
    """(width, height) px of the first picture."""
    for _, image in frames():
        return image.shape[1], image.shape[0]
    raise ValueError("the video must hold at least one picture; it holds none. Check the file.")

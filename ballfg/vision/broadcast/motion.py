"""Finds the camera of each picture of a video from the court: shots between cuts, and the camera's turn and zoom."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.parallel.parts import in_parts, in_threads
from ballfg.progress import Watch, unwatched
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.background import ALIKE, Match, linked
from ballfg.vision.broadcast.court import Court
from ballfg.vision.broadcast.find import cameras_of, find_court
from ballfg.vision.broadcast.graph import solve
from ballfg.vision.broadcast.lines import REACHES, Ridges, brightness, corrected, moved, ridges, slopes
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.one_thread import one_thread

Frames = Callable[[], Iterator[tuple[float, Image]]]  # opens a video and gives stamps (s) and images (h, w, 3), BGR
Pair = tuple[Image | None, Image]  # the picture before, if there is one, and a picture
EVERY: Final = 0.5  # s between the pictures in which the court is looked for
SEEDS: Final = 4  # pictures of a shot in which it is found, after which it is followed only
TRIED: Final = 30  # quadrilaterals of a picture that are compared by all lines
FITS: Final = 0.7  # share of the court's lines without which a picture does not show the court
FOLLOWED: Final = 0.45
"""The same where the camera before and the background foretell it: a player may stand before a line."""
SHORTEST: Final = 10  # pictures of a shot; a shorter one is not used
TURNED: Final = np.r_[0:3, 6]  # numbers of turn and log focal length among the seven of a camera
ROUNDS: Final = 6  # steps in which a camera takes over the motion of the background
REACH: Final = 4.0  # px, in which ridges are looked for at last


@dataclass(frozen=True, eq=False)
class Shot:
    """Pictures first, first + 1, ... between two cuts, and their cameras.

    Attributes: cameras: one a picture.  covariances: (n, 7, 7) of turn (rad, in the camera's frame), place (m), log
        focal length.  fit: (n,) share of the court's lines that fit.
        near: 1/m, one over the background's distance, of a camera that moves; 0: it stands at one place.
        readout: of the time between pictures, from the first row to the last; 0: all rows are seen at once.
    """

    first: int
    cameras: tuple[Pinhole, ...]
    covariances: Array
    fit: Array
    near: float = 0.0
    readout: float = 0.0

    @property
    def shifts(self) -> Array | None:
        """(n, 3) m, to the place of each picture from that of `middle`; None of a camera that stands."""
        places = np.stack([camera.place for camera in self.cameras])
        return places - places[self.middle] if self.near else None

    @property
    def middle(self) -> int:
        """Number of the picture that looks where the shot looks on the whole."""
        axes = np.array([camera.turn[2] for camera in self.cameras])
        return int(np.argmin(np.linalg.norm(axes - np.median(axes, axis=0), axis=1)))

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True, eq=False)
class Motion:
    """The shots that show the court.

    Attributes:
        times: (f,) s, stamps of all pictures.  cuts: numbers of the pictures that follow a cut.
        numbers: (f,) of the pictures in the video; None: all of them are there.
    """

    shots: tuple[Shot, ...]
    times: Array
    cuts: tuple[int, ...]
    numbers: Index | None = None


def find_motion(
    frames: Frames, court: Court, count: int, corners: dict[int, Array] | None = None, watch: Watch = unwatched
) -> Motion:
    """The camera of each picture.

    Args: count: pictures, about.  corners: (4, 2) px of the court's corners in some pictures; None: the court is found.
    Raises: ValueError: no picture shows the court.
    """
    times, links, seeds = _first_pass(
        frames, court, corners, lambda images: watch(images, count, "pictures searched for the court")
    )
    cuts = [0, *(k + 1 for k, link in enumerate(links) if link is None), len(times)]
    shots = list[Shot]()
    for first, end in pairwise(cuts):
        mine = {k: seed for k, seed in seeds.items() if first <= k < end}
        if mine and end - first >= SHORTEST:
            chain = [link for link in links[first : end - 1] if link is not None]
            shots.append(_followed(frames, court, first, mine, chain))
    if corners is None:
        shots = [shot for shot in shots if np.median(shot.fit) > FOLLOWED]
    if not shots:
        raise ValueError(
            f"the video must show the whole court in {SHORTEST} pictures in a row; frames 0 to {len(times) - 1} do "
            "not. Give its corners in some of them with --corners FILE (frame,u,v), or check --court."
        )
    return Motion(tuple(shots), times, tuple(cuts[1:-1]))


def _first_pass(
    frames: Frames,
    court: Court,
    corners: dict[int, Array] | None,
    watched: Callable[[Iterator[Pair]], Iterable[Pair]],
) -> tuple[Array, list[Match | None], dict[int, list[tuple[Pinhole, float]]]]:
    """Stamps, matches of neighbours, and the cameras in the pictures in which the court was found."""
    times, seeds = list[float](), dict[int, list[tuple[Pinhole, float]]]()
    found, looked = 0, -np.inf

    def pairs() -> Iterator[Pair]:
        last: Image | None = None
        for stamp, image in frames():
            times.append(stamp)
            yield last, image
            last = image

    def look() -> int:
        """Looks for the court in the waiting pictures; the number of those that show it."""
        here = dict(zip(waiting, in_parts(partial(_found, court), list(waiting.values()), 1), strict=True))
        waiting.clear()
        seeds.update({k: cameras for k, cameras in here.items() if cameras})
        return sum(map(bool, here.values()))

    links, waiting = list[Match | None](), dict[int, Image]()
    for k, (image, link) in enumerate(in_threads(linked, watched(pairs()))):
        links.append(link)
        if link is None:
            look()
            found, looked = 0, -np.inf
        if corners is not None:
            here = _of_corners(image, court, corners[k]) if k in corners else []
            seeds |= {k: here} if here else {}
        elif found < SEEDS and times[k] - looked >= EVERY:
            looked, waiting[k] = times[k], image
            if found + len(waiting) == SEEDS:  # together, as none of them can make another one needless
                found += look()
    look()
    return np.array(times), links[1:], seeds


@one_thread()  # pictures are shared out among processes
def _found(court: Court, image: Image) -> list[tuple[Pinhole, float]]:
    """The cameras that see the court in a picture."""
    return likely(image, find_court(image, court)[:TRIED], court)


def _of_corners(image: Image, court: Court, corners: Array) -> list[tuple[Pinhole, float]]:
    """The cameras that see a court's corners (4, 2) px, those first whose lines fit."""
    away = corners - corners.mean(axis=0)
    quad = corners[np.argsort(np.arctan2(away[:, 1], away[:, 0]))]  # clockwise as seen
    cameras = cameras_of(quad[None], court, (image.shape[1], image.shape[0]))
    better = likely(image, [(camera, 0.0) for camera in cameras], court)
    return better or [(camera, 0.0) for camera in cameras]


def likely(image: Image, tried: Sequence[tuple[Pinhole, float]], court: Court) -> list[tuple[Pinhole, float]]:
    """The cameras whose lines fit a picture, best first, and how well; those at about one place once only."""
    fine, picture = list[tuple[Pinhole, float]](), brightness(image)
    for camera, _ in tried:
        better, fit = corrected(picture, camera, court)
        if fit > FITS and better.place[2] > 0.0:
            fine.append((better, ridges(picture, better, court, REACHES[-1]).whole_fit))
    fine = [(camera, fit) for camera, fit in fine if fit > FITS]
    fine.sort(key=lambda pair: -pair[1])
    apart = list[tuple[Pinhole, float]]()
    for camera, fit in fine:
        if all(np.linalg.norm(camera.place - other.place) > 0.2 * np.linalg.norm(other.place) for other, _ in apart):
            apart.append((camera, fit))
    return apart


def _followed(
    frames: Frames, court: Court, first: int, seeds: dict[int, list[tuple[Pinhole, float]]], links: Sequence[Match]
) -> Shot:
    """The shot from picture `first` on, with the place of the camera that fits best."""
    ranked = sorted(((fit, k, camera) for k, found in seeds.items() for camera, fit in found), key=lambda one: -one[0])
    _, at, camera = ranked[0]
    for k in range(at - first, 0, -1):
        camera = carried(camera, links[k - 1].now, links[k - 1].before)
    cameras, seen, fits = list[Pinhole](), list[Ridges | None](), list[float]()
    count = len(links) + 1
    for k, (_, image) in enumerate(frames()):
        if not first <= k < first + count:
            continue
        if k > first:
            camera = carried(camera, links[k - first - 1].before, links[k - first - 1].now)
        picture = brightness(image)
        better, fit = corrected(picture, camera, court, TURNED)
        if fit < FITS:
            elsewhere, better_fit = corrected(picture, camera, court)
            if better_fit > FITS and elsewhere.place[2] > 0.0:  # it moves
                better, fit = elsewhere, better_fit
        camera = better if fit > FOLLOWED else camera
        lines = ridges(picture, camera, court, REACH)
        cameras.append(camera)
        seen.append(lines if fit > FOLLOWED else None)
        fits.append(lines.fit)
    found = solve(cameras, seen, links)
    near, readout = found.unknowns.near, found.unknowns.readout
    return Shot(first, found.cameras, found.covariances(), np.array(fits), near, readout)


def carried(camera: Pinhole, before: Array, now: Array) -> Pinhole:
    """The camera after the turn and the zoom that move points (n, 2) px of the background from `before` to `now`."""
    points, one = camera.place + camera.directions(before) @ camera.turn, camera
    for _ in range(ROUNDS):
        pixels, slope = slopes(one, points)
        left, slope = now - pixels, slope[..., TURNED]
        weight = 1.0 / (1.0 + (left**2).sum(axis=1) / ALIKE**2)
        pulled = slope * weight[:, None, None]
        step = np.zeros(7)
        information = np.einsum("nai,naj->ij", pulled, slope)
        step[TURNED] = np.linalg.solve(information, np.einsum("nai,na->i", pulled, left))
        one = moved(one, step)
    return one

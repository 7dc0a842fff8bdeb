"""Draws videos of rendered rallies, of a camera that pans and zooms, stands or is in a hand, with their truth.

Strokes are those of `strokes`, for which the intervals are; pictures have bars of motion blur, players as moving shapes
with white shoes, noise and video compression. Each seed draws its view (from the side, behind a player, a corner, or
near behind a player who hides part of the table), the light, the focal length (and so the ball's size), the compression
and how much the camera shakes. Those of varied looks draw colours, the size of the pictures and judges, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.hall import (
    PLAIN,
    SHIRTS,
    SIZE,
    SIZES,
    Colour,
    Look,
    drawn_look,
    hall,
    judges,
    looking,
    panned,
    picture,
)
from ballfg.benchmarks.cameras.strokes import STEP, TABLE, Scattered, drawn_ball, scattered
from ballfg.dynamics import AnalyticModel
from ballfg.state import POSITION, VZ
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.video import write_video

EXPOSURE: Final = 0.45
"""Of the time between pictures."""
LENGTH: Final = 6.0
"""s, of a rally."""
VIEWS: Final = {
    "side": ((0.4, -8.0, 3.6), 1000.0),
    "behind": ((-8.5, -0.8, 3.2), 1350.0),
    "corner": ((-5.5, -5.5, 3.0), 1050.0),
    "near": ((-5.5, 0.9, 2.2), 800.0),
}
"""Places, m, and focal lengths, px."""
MINUTE: Final = 60.0
"""s, of play before a camera that stands."""
STANDING: Final = {"side": ((-0.2, -4.0, 1.44), 750.0), "oblique": ((-3.6, -3.0, 1.64), 750.0)}
"""Its places, m, and focal lengths, px."""
HIDDEN, BURSTS = 0.08, 25
"""Of it: share of pictures in which something hides the ball, and number of further runs of two to four."""
WALKED, SWAY = 0.2, ((0.3, 0.03), (0.9, 0.015), (1.7, 0.008))
"""Of a camera in a hand: m/s at most; Hz and m of its sway along each axis."""
BANDS: Final = 9
"""Parts of a picture of a rolling shutter, each seen at one moment."""
LIGHT, ZOOM, QUALITY, SHAKE = (0.5, 1.0), (0.7, 1.0), (35, 90), 4e-4
"""Ranges of the share of the full light, of the view's focal length and of JPEG's quality; rad a picture."""


@dataclass(frozen=True)
class Truth:
    """Strokes with times in the video, s, the cameras of its pictures, the share of light and JPEG's quality.

    Attributes: judges: polygons and colours of people who sit.  shirts: of both players.
        readout: of the time between pictures, from the first row to the last.
        hidden: numbers of pictures in which something hides the ball.
    """

    view: str
    strokes: tuple[Scattered, ...]
    cameras: tuple[Pinhole, ...]
    light: float
    quality: int
    look: Look = PLAIN
    judges: tuple[tuple[Array, Colour], ...] = ()
    shirts: tuple[Colour, Colour] = ((45, 45, 45), (45, 45, 45))
    readout: float = 0.0
    hidden: frozenset[int] = frozenset()

    @property
    def bounces(self) -> list[float]:
        """Times, s, of the bounces."""
        return [
            one.begin + STEP * (1 + row)
            for one in self.strokes
            for row in np.flatnonzero(np.diff(one.path[:, VZ]) > 1.0)
        ]

    def at(self, t: float) -> Array | None:
        """(9,) state with the table's surface at z = 0; None where no ball is in play."""
        for one in self.strokes:
            if one.begin < t <= one.end:
                state = one.at(t)
                state[2] -= TABLE
                return state
        return None


def truth(view: str, rate: float, seed: int) -> Truth:
    """Strokes of a rally, and a camera that follows a little."""
    rng = np.random.default_rng(seed)
    found = _point(0.6, LENGTH - 1.0, drawn_ball(rng), rng)
    centre, focal = VIEWS[view]
    first = looking(np.add(centre, rng.normal(0.0, 0.3, 3)).tolist(), (0.0, 0.0, 0.1), focal * rng.uniform(*ZOOM))
    cameras = panned(first, int(LENGTH * rate), rng.normal(0.0, 0.06), rng.normal(0.0, 0.05))
    shaken = [moved(one, np.append(rng.normal(0.0, SHAKE, 3), np.zeros(4))) for one in cameras]
    return Truth(view, tuple(found), tuple(shaken), rng.uniform(*LIGHT), int(rng.integers(*QUALITY)))


def minute(view: str, rate: float, seed: int) -> Truth:
    """Points of a minute with pauses between them, and a camera that stands."""
    rng, now, found = np.random.default_rng([seed, 5]), 0.6, list[Scattered]()
    ball, count = drawn_ball(rng), int(MINUTE * rate)
    while now < MINUTE - 2.0:
        found += _point(now, MINUTE - 1.0, ball, rng, most=int(rng.integers(3, 10)))
        now = found[-1].end + rng.uniform(1.5, 3.0)
    runs = [first + np.arange(rng.integers(2, 5)) for first in rng.integers(0, count, BURSTS)]
    hidden = np.concatenate([*runs, np.flatnonzero(rng.uniform(size=count) < HIDDEN)])
    centre, focal = STANDING[view]
    cameras = (looking(centre, (0.0, 0.0, 0.14), focal),) * count
    light, quality = rng.uniform(*LIGHT), int(rng.integers(*QUALITY))
    return Truth(view, tuple(found), cameras, light, quality, hidden=frozenset(hidden.tolist()))


def _point(
    now: float, end: float, ball: AnalyticModel, rng: np.random.Generator, most: int | None = None
) -> list[Scattered]:
    """Strokes from a time on, none that begins after `end`, s, each from where the one before ends."""
    found = list[Scattered]()
    side = float(rng.choice([-1, 1]))
    place = np.array([side * 1.5, rng.uniform(-0.4, 0.4), TABLE + 0.25])
    while now < end and len(found) != most and (drawn := scattered(now, place, -side, ball, rng)) is not None:
        found.append(drawn)
        place, now, side = drawn.at(drawn.end)[POSITION], drawn.end, -side
    return found


def varied(of: Truth, seed: int) -> Truth:
    """The same rally in a hall of another look, in pictures of another size."""
    rng = np.random.default_rng([seed, 3])
    size = SIZES[rng.integers(len(SIZES))]
    cameras = tuple(replace(one, size=size, focal=one.focal * size[0] / SIZE[0]) for one in of.cameras)
    left, right = (SHIRTS[k] for k in rng.integers(len(SHIRTS), size=2))
    return replace(of, cameras=cameras, look=drawn_look(rng), judges=tuple(judges(rng)), shirts=(left, right))


def held(of: Truth, rate: float, seed: int) -> Truth:
    """The same rally by a camera in a hand: it sways, and its holder walks."""
    rng, count = np.random.default_rng([seed, 4]), len(of.cameras)
    t, way = np.arange(count)[:, None] / rate, rng.normal(size=3) * [1.0, 1.0, 0.2]
    path = rng.uniform(0.0, WALKED) * (t - t.mean()) * way / np.linalg.norm(way)
    for often, far in SWAY:
        path = path + far * np.sin(2.0 * np.pi * (often * t + rng.uniform(size=3)))
    places = zip(of.cameras, path, strict=True)
    return replace(of, cameras=tuple(replace(camera, place=camera.place + step) for camera, step in places))


def pictures(of: Truth, rate: float, seed: int) -> Iterator[Image]:
    """The pictures, with two players who sway behind the ends of the table."""
    rng, stands = np.random.default_rng([seed, 1]), all(one is of.cameras[0] for one in of.cameras)
    empty = hall(of.cameras[0], of.look) if stands else None
    for number, camera in enumerate(of.cameras):
        if of.readout == 0.0:
            image = _seen(of, camera, number / rate, rate, rng, shown=number not in of.hidden, empty=empty)
        else:
            height = camera.size[1]
            bands = np.array_split(np.arange(height), BANDS)
            when = [number + of.readout * ((float(band.mean()) + 0.5) / height - 0.5) for band in bands]
            every = [_seen(of, _between(of, moment), moment / rate, rate, rng) for moment in when]
            image = np.concatenate([one[band] for one, band in zip(every, bands, strict=True)])
        dark = np.asarray(np.round(of.light * image), dtype=np.uint8)
        packed = cv2.imencode(".jpg", dark, (cv2.IMWRITE_JPEG_QUALITY, of.quality))[1]
        yield np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)


def _seen(
    of: Truth,
    camera: Pinhole,
    t: float,
    rate: float,
    rng: np.random.Generator,
    *,
    shown: bool = True,
    empty: Image | None = None,
) -> Image:
    """What a camera sees at a time t, s.

    Args: shown: whether nothing hides the ball.  empty: as of `picture`.
    """
    half = 0.5 * EXPOSURE / rate
    ends = [of.at(t - half), of.at(t + half)]
    bar = [one[POSITION] for one in ends if one is not None and shown]
    others = list(of.judges)
    for end, shirt in zip((-1.0, 1.0), of.shirts, strict=True):
        sway = 0.35 * np.sin(2.0 * t + end) + 0.1 * np.sin(7.0 * t) - 0.5 * (of.view == "near")
        for low, high, wide, colour in ((-0.7, 0.75, 0.2, shirt), (-0.76, -0.66, 0.14, (235, 235, 235))):
            box = [(end * 2.3, sway + y, z) for y, z in ((-wide, low), (wide, low), (wide, high), (-wide, high))]
            if of.view != "behind" or end > 0.0:  # there he would hide most of the table
                others.append((np.array(box), colour))
    return picture(camera, rng, [np.stack(bar)] if len(bar) == len(ends) else [], others, look=of.look, empty=empty)


def _between(of: Truth, number: float) -> Pinhole:
    """The camera at a moment between two pictures; beyond the ends it goes on."""
    first = int(np.clip(np.floor(number), 0, len(of.cameras) - 2))
    one, after = of.cameras[first : first + 2]
    turn, zoom = cv2.Rodrigues(one.turn @ after.turn.T)[0].ravel(), np.log(after.focal / one.focal)
    return moved(one, np.asarray((number - first) * np.concatenate((turn, after.place - one.place, [zoom]))))


def film(of: Truth, path: Path, rate: float, seed: int) -> None:
    """Writes the pictures as a compressed video."""
    write_video(path, pictures(of, rate, seed), rate, of.cameras[0].size, "Check the disk.")


@dataclass(frozen=True)
class Filmed:
    """A rally to film: its seed, Hz, its view (None: that of its seed), and whether its look is drawn.

    And whether the camera is in a hand, its readout, of the time between pictures, and whether it stands for a minute.
    """

    seed: int
    rate: float
    view: str | None = None
    varied: bool = False
    by_hand: bool = False
    readout: float = 0.0
    stands: bool = False

    @property
    def truth(self) -> Truth:
        """What happens in it."""
        if self.stands:
            return minute(self.view or list(STANDING)[self.seed % len(STANDING)], self.rate, self.seed)
        plain = truth(self.view or list(VIEWS)[self.seed % len(VIEWS)], self.rate, self.seed)
        plain = varied(plain, self.seed) if self.varied else plain
        plain = held(plain, self.rate, self.seed) if self.by_hand else plain
        return replace(plain, readout=self.readout)

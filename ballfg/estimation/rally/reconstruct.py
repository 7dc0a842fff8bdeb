"""Reconstructs the strokes that one camera saw, a moving one as a fixed one would see them: strokes and estimates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Mask
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.noise.sightings import Noise, settled
from ballfg.estimation.rally.arcs import NOISE, arcs
from ballfg.estimation.rally.choose import rally
from ballfg.estimation.rally.doubtful import balls, kept_of
from ballfg.estimation.rally.field import SEEN, SEEN_RANGE, UNKNOWN, Field, at_court, without_lens
from ballfg.estimation.rally.moments import Event, joined_estimates
from ballfg.estimation.rally.sequence import Chosen
from ballfg.estimation.rally.strokes import LEAST, Grower, track_of
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.progress import Watch, unwatched
from ballfg.tracks.stamps import elapsed
from ballfg.tracks.track import Track
from ballfg.vision.broadcast.measured import Flow
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import UNSIZED, Detections

FRAME_SIGMA: Final = 0.3
"""px, of a picture's camera beside the error that all of a shot share."""

KINK: Final = 2.0
"""px, standard deviation of the middle of a bar in which the ball bounced."""

ROUNDS, SETTLED = 3, 0.1
"""In which the probability to see the ball is found, and its change that ends them."""
THINNER: Final = 3.0
"""Ratio of the densities of smooth clutter with and without the ball, above which another round follows."""
NOTHING: Final = Chosen((), np.zeros(0), ())
"""No stroke."""


@dataclass(frozen=True, eq=False)
class ShotRally:
    """The strokes of a shot, or of a fixed camera's recording.

    Attributes:
        camera: fixed, at the shot's place, with the covariance of its turn, place and focal length.
        seen: the candidates as that camera sees them, with the noise that the strokes show.
        chosen: strokes with their probabilities; they count time from the first picture.
        estimates: of each stroke, in the same order, joined at hits.
        hits: at the begin of each, None where it follows none.  exposure: of the time between pictures.
    """

    camera: Camera
    seen: Detections
    chosen: Chosen
    estimates: tuple[Estimate, ...]
    hits: tuple[Event | None, ...]
    exposure: float


def fixed_camera(shot: Shot, name: str) -> tuple[Pinhole, Camera]:
    """A camera without distortion that looks where the shot looks on the whole, and the same with its covariance."""
    one = replace(shot.cameras[shot.middle], bend=0.0)
    to_world = np.eye(7)
    to_world[:3, :3] = one.turn.T
    covariance = to_world @ shot.covariances[shot.middle] @ to_world.T
    return one, one.camera(name, 0.5 * (covariance + covariance.T))


def on_fixed_camera(found: Detections, shot: Shot, onto: Pinhole, name: str) -> Detections:
    """The candidates of a moving camera where one that looks another way sees them from the same place."""
    pixels, streaks, spread = found.pixels.copy(), found.streaks.copy(), found.covariances.copy()
    flow = Flow(shot.cameras)
    for number, camera in enumerate(shot.cameras):
        rows = slice(*np.searchsorted(found.frame, (number, number + 1)))
        if shot.readout:  # as the camera looked when these rows were seen, which is not when the middle one was
            turned = shot.readout * flow.late(pixels[rows]) * flow.of_background(number, pixels[rows])
            pixels[rows] -= turned
            streaks[rows] -= turned[:, None]
        pixels[rows], streaks[rows] = camera.onto(pixels[rows], onto), camera.onto(streaks[rows], onto)
        spread[rows] *= (onto.focal / camera.focal) ** 2
    seen: Mask = np.asarray(np.isfinite(pixels).all(axis=1))  # a wide pan leaves something behind
    spread += FRAME_SIGMA**2 * np.eye(2)
    moved = replace(found, camera=name, pixels=np.nan_to_num(pixels), covariances=spread, streaks=streaks)
    return replace(moved, shifts=shot.shifts).select(seen)


def reconstruct(
    found: Detections,
    shot: Shot,
    model: BallModel,
    surfaces: Surfaces,
    *,
    first: int = 0,
    seen_share: float = SEEN,
    watch: Watch = unwatched,
) -> ShotRally:
    """The strokes of a shot of a moving camera, with the estimate of each.

    Args: found: candidates in the pictures of the shot; others as for `strokes_of`.
    """
    name = f"shot{shot.first}"
    pinhole, camera = fixed_camera(shot, name)
    if shot.readout:
        camera = replace(camera, readout=shot.readout * float(np.median(np.diff(found.frames))))
    seen = on_fixed_camera(found, shot, pinhole, name)
    return strokes_of(seen, camera, model, surfaces, first=first, seen_share=seen_share, play=True, watch=watch)


def strokes_of(
    seen: Detections,
    camera: Camera,
    model: BallModel,
    surfaces: Surfaces,
    *,
    first: int = 0,
    seen_share: float = UNKNOWN,
    play: bool = False,
    watch: Watch = unwatched,
) -> ShotRally:
    """The strokes that a fixed camera saw, with the estimate of each.

    Args:
        seen: its candidates.  model: the ball.  surfaces: with the court's ends, if they are known.
        first: number of the first stroke; strokes are named by three digits, in order of time.
        seen_share: probability that the ball is among the candidates of a picture, at first.
        play: True for one ball in play, as `Field` has it; False for all flights, of several balls too.
    """
    chosen, field = search(seen, camera, model, surfaces, seen_share, play=play, watch=watch)
    if field is None:
        return ShotRally(camera, seen, chosen, (), (), 0.0)
    smoother = Smoother(model, surfaces, Settings.for_measured(model, find_events=False))
    radii, seen = seen.radii, replace(seen, radii=UNSIZED)
    # a ball's for sure: a bounce shows in the picture, which no parabola explains
    sure = [not play and bool(one.bounces) and field.off(one.rows, 2) > NOISE for one in chosen.strokes]
    telling = kept_of(chosen, sure) if any(sure) else chosen
    kinked = _kinked(telling, field)
    noise = _noise(smoother, seen, replace(camera, covariance=None, exposure=0.0), telling, kinked)
    seen = _with_noise(seen, noise, kinked)
    if not play:
        chosen, seen = balls(smoother, seen, radii, camera, chosen, sure, watch)
    tracks = [track_of(stroke, seen, camera, model, surfaces) for stroke in chosen.strokes]
    alone = [smoother.estimate(track) for track in watch(tracks, len(tracks), "strokes estimated")]
    begun, end = _in_play(alone) if play else (0, len(alone))
    joined = (False, *chosen.joined[begun + 1 : end])
    estimates, hits = joined_estimates(smoother, tracks[begun:end], alone[begun:end], joined, field.step)
    places = np.argsort(np.argsort([one.times[0] for one in estimates], kind="stable"), kind="stable")
    named = [replace(one, name=f"{first + k:03d}") for k, one in zip(places.tolist(), estimates, strict=True)]
    parts = (chosen.strokes[begun:end], chosen.probabilities[begun:end], joined)
    return ShotRally(camera, seen, Chosen(*parts) if named else chosen, tuple(named), tuple(hits), field.exposure)


def search(
    seen: Detections,
    camera: Camera,
    model: BallModel,
    surfaces: Surfaces,
    seen_share: float = UNKNOWN,
    *,
    play: bool = False,
    watch: Watch = unwatched,
) -> tuple[Chosen, Field | None]:
    """The likeliest strokes and the field in which they were found, with stamps since the first picture.

    Args: as for `strokes_of`.  Returns: None as field of pictures of which too few have candidates for any stroke.
    """
    if len(np.unique(seen.frame)) < LEAST:
        return NOTHING, None
    flat, pinhole = without_lens(replace(seen, frames=elapsed(seen.frames, float(seen.frames[0]))), camera)
    scale, fall = at_court(pinhole, surfaces)
    times = replace(camera, time_offset=0.0).true_times(flat.times, seen.pixels)
    seeds, plain, foretold = arcs(replace(Field.of(flat, scale, seen_share, fall), play=play))
    density = foretold.density(np.zeros(0, dtype=np.int64))  # with the ball, which is not known yet
    chosen = NOTHING
    for _ in range(ROUNDS):
        field = plain.smooth(density)
        grower = Grower.of(field, times, pinhole, physics_of(model), surfaces, seen.shift)
        chosen = rally(grower, seeds, chosen.strokes, watch)
        if not chosen.strokes:
            break
        plain, before = replace(plain, seen=_seen_share(field, chosen)), density
        density = foretold.density(np.concatenate([stroke.rows for stroke in chosen.strokes]))
        if abs(plain.seen - field.seen) < SETTLED and before < THINNER * density:
            break
    return chosen, field


def _kinked(chosen: Chosen, field: Field) -> Mask:
    """(n,) True for the chosen candidates in whose bars the ball bounced."""
    kinked, half = np.zeros(len(field.frame), dtype=bool), 0.5 * field.exposure * field.step
    for stroke in chosen.strokes:
        apart = np.abs(field.stamps[field.frame[stroke.rows]][:, None] - np.array(stroke.bounces))
        kinked[stroke.rows] = (apart < half).any(axis=1)
    return kinked


def _with_noise(seen: Detections, noise: Noise, kinked: Mask) -> Detections:
    """The candidates with a noise, and less certain centres of those bars in which the ball bounced."""
    return replace(seen, covariances=noise.of(seen.covariances) + KINK**2 * kinked[:, None, None] * np.eye(2))


def _noise(smoother: Smoother, seen: Detections, camera: Camera, chosen: Chosen, kinked: Mask) -> Noise:
    """The noise of the candidates, from the strokes alone as an exact camera sees them, without kinked bars.

    An error of the camera moves a whole stroke: it hardly shows in what is left of single candidates.
    """
    if not chosen.strokes:
        return Noise()
    rows = np.concatenate([stroke.rows for stroke in chosen.strokes])

    def tracks_of(noises: list[Noise]) -> list[Track]:
        now = _with_noise(seen, noises[0], kinked)
        return [track_of(stroke, now, camera, smoother.model, smoother.surfaces) for stroke in chosen.strokes]

    return settled(smoother, tracks_of, seen.covariances[rows], np.zeros(len(rows), dtype=np.int64), ~kinked[rows])[0]


def _in_play(estimates: Sequence[Estimate]) -> tuple[int, int]:
    """Numbers of the first stroke of a rally and of the one after its last.

    Before a service and after a rally a ball is tossed, bounced and picked up: what a flight does not explain, or shows
    from nowhere near, is no stroke there. Between two strokes it is one.
    """
    sure = [number for number, one in enumerate(estimates) if one.status is Status.OK]
    return (sure[0], sure[-1] + 1) if sure else (0, len(estimates))


def _seen_share(field: Field, chosen: Chosen) -> float:
    """Share of the pictures of strokes in which the ball is among the candidates."""
    pictures = sum(int(np.ptp(field.frame[stroke.rows])) + 1 for stroke in chosen.strokes)
    share = sum(len(stroke.rows) for stroke in chosen.strokes) / pictures
    return float(np.clip(share, *SEEN_RANGE))

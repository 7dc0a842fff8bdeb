"""Evaluates unsynchronised cameras: velocities from camera factors and from points, and clock offsets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.scenes import Filmed, truth_at
from ballfg.dynamics import nominal_model
from ballfg.estimation import Estimate, Online, Settings, Smoother, estimate_time_offsets, sighted_track
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.smoother.time_offsets import TimeOffsets
from ballfg.progress import progress
from ballfg.state import POSITION, VELOCITY, VZ
from ballfg.tracks import Track
from ballfg.vision import Camera, triangulate
from ballfg.vision.association.gathering import SeenBall, nearest

NAIVE, FACTORS = "smoother, as if synchronised", "smoother, camera factors"
"""Two of the ways to estimate, for comparison."""
NEAR_BOUNCE: Final = 1.0
"""Frame intervals about a bounce that do not count: a stamp's velocity is before it or after it by chance."""
BLIND: Final = 20.0  # px, motion of a ball of 10 m/s in half a frame at 120 Hz, 3 m away
OTHER_BALL: Final = 0.5  # m. Distance of a state from a flight beyond which it belongs to another one.


@dataclass(frozen=True, eq=False)
class Velocities:
    """Errors of one way to estimate.

    Attributes:
        squares: for each flight the sum of squared velocity errors, (m/s)^2.  counts: of how many stamps.
        positions: for each flight the sum of squared position errors, m^2.
    """

    squares: Array
    counts: Array
    positions: Array


def sighted(filmed: Filmed) -> list[Track]:
    """The balls of a recording with their sightings."""
    tracking = filmed.tracking
    pairs = zip(tracking.names, tracking.balls, strict=True)
    return [sighted_track(name, ball.sightings, tracking.cameras) for name, ball in pairs]


def compare(filmed: Filmed) -> dict[str, Velocities]:
    """Velocities of the same balls from camera factors, and from points made in two ways.

    All estimates are the smoother's or the online estimator's with the same model, priors and process noise; the noise
    of points is what they scatter by. Each is judged at its own stamps.
    """
    rate, cameras, balls = filmed.recording.config.rate, filmed.recording.cameras, filmed.tracking.balls
    ways: dict[str, Callable[[], list[Estimate]]] = {
        NAIVE: lambda: _from_points(filmed, [_as_if_synchronised(ball, cameras, rate) for ball in balls]),
        "smoother, interpolated": lambda: _from_points(filmed, [(ball.times, ball.points) for ball in balls]),
        FACTORS: lambda: _from_sightings(filmed, Smoother),
        "online, camera factors": lambda: _from_sightings(filmed, Online),
    }
    return {name: _judged(filmed, ways[name]()) for name in progress(ways, len(ways), "ways of estimating compared")}


def _from_sightings(filmed: Filmed, kind: type[Smoother] | type[Online]) -> list[Estimate]:
    estimator = kind(nominal_model(), filmed.recording.config.ball.surfaces, Settings.for_measured(nominal_model()))
    return [estimator.estimate(track) for track in sighted(filmed)]


def _from_points(filmed: Filmed, balls: Sequence[tuple[Array, Array]]) -> list[Estimate]:
    tracks = [Track(times, points, name=f"{k:03d}") for k, (times, points) in enumerate(balls)]
    x, y, z = estimate_position_noise(tracks).tolist()
    settings = Settings.for_measured(nominal_model(), position_noise=(x, y, z))
    smoother = Smoother(nominal_model(), filmed.recording.config.ball.surfaces, settings)
    return [smoother.estimate(track) for track in tracks]


def _as_if_synchronised(ball: SeenBall, cameras: Sequence[Camera], rate: float) -> tuple[Array, Array]:
    """Times (n,) s and points (n, 3) m of the nearest frames, as one would who believes in one shutter.

    The frames are those of the camera that saw most; of the others the nearest sighting within half a frame counts. The
    pixels' noise includes the ball's motion meanwhile, so that no view is refused for that.
    """
    seen = ball.sightings
    offsets = np.array([camera.time_offset for camera in cameras])
    true = seen.times - offsets[seen.camera]
    base = int(np.bincount(seen.camera, minlength=len(cameras)).argmax())
    times = true[seen.camera == base]
    pixels = np.full((len(times), len(cameras), 2), np.nan)
    for number in range(len(cameras)):
        own = np.flatnonzero(seen.camera == number)
        if len(own):
            near = own[nearest(true[own], times)]
            close = np.abs(true[near] - times) <= 0.5 / rate
            pixels[close, number] = seen.pixels[near[close]]
    loose = np.broadcast_to(BLIND**2 * np.eye(2), (*pixels.shape[:2], 2, 2))
    points = triangulate(cameras, pixels, loose).points
    kept = np.isfinite(points).all(axis=1)
    return times[kept], points[kept]


def clocks(filmed: Filmed) -> TimeOffsets:
    """The cameras' time offsets, from all balls."""
    surfaces = filmed.recording.config.ball.surfaces
    return estimate_time_offsets(sighted(filmed), nominal_model(), surfaces, Settings.for_measured(nominal_model()))


def _judged(filmed: Filmed, estimates: Sequence[Estimate]) -> Velocities:
    step = 1.0 / filmed.recording.config.rate
    sums = np.zeros((3, len(filmed.recording.flights)))
    for number, flight in enumerate(filmed.recording.flights):
        knots = flight.start + np.arange(len(flight.knots)) * (flight.end - flight.start) / (len(flight.knots) - 1)
        bounces = knots[1:][np.diff(flight.knots[:, VZ]) > 0.5]
        margin = NEAR_BOUNCE * step + np.diff(knots[:2])
        for estimate in estimates:
            error = estimate.states - truth_at(flight, estimate.times)
            far = np.nan_to_num(np.linalg.norm(error[:, POSITION], axis=1), nan=np.inf)
            apart = (np.abs(estimate.times[:, None] - bounces) > margin).all(axis=1)
            error = error[(far < OTHER_BALL) & apart]
            sums[:, number] += (error[:, VELOCITY] ** 2).sum(), len(error), (error[:, POSITION] ** 2).sum()
    return Velocities(*sums)

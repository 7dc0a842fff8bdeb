"""Recordings with known truth: simulated shots seen by three cameras, with noise, misses, clutter and a moving arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.optimize import brentq

from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

TARGET = (1.37, 0.0, 0.9)
HEIGHT = 0.78
DRAG = 0.6
TERMINAL = np.array([0.0, 0.0, -9.81]) / DRAG
BOUNCE = np.array([0.75, 0.75, -0.9])
CENTRES = ((1.0, -3.0, 2.2), (-1.4, 1.6, 2.3), (3.6, 2.0, 2.4))


def looking(name: str, centre: Sequence[float], target: Sequence[float] = TARGET, **fields: object) -> Camera:
    """A camera at `centre` that looks at `target`, upright."""
    forward = np.subtract(target, centre)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(forward, right), forward))
    rvec = cv2.Rodrigues(rotation)[0].ravel()
    matrix = [[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]]
    settings = {"size": (1280, 720), "matrix": matrix, "distortion": [-0.2, 0.05, 0.001, -0.002, 0.01]} | fields
    return Camera(name=name, rvec=rvec, tvec=-rotation @ np.asarray(centre), **settings)


def level(name: str, turn: float, away: float, height: float = 0.0, scale: float = 1.0) -> Camera:
    """A camera `away` m from a point `height` m above the origin, looking at it level, from a direction about z."""
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    rotation, (width, height_px) = upright @ about_z, (round(640 * scale), round(360 * scale))
    matrix = [[500.0 * scale, 0.0, (width - 1) / 2], [0.0, 500.0 * scale, (height_px - 1) / 2], [0.0, 0.0, 1.0]]
    tvec = np.array([0.0, 0.0, away]) - rotation @ (0.0, 0.0, height)
    return Camera(name, (width, height_px), matrix, np.zeros(5), cv2.Rodrigues(rotation)[0].ravel(), tvec)


def rig() -> list[Camera]:
    return [looking(name, centre) for name, centre in zip(("left", "right", "far"), CENTRES, strict=True)]


def turned(camera: Camera, degrees: float, axis: Sequence[float] = (0.0, 1.0, 0.0)) -> Camera:
    """The camera turned where it stands, about an axis of its own frame."""
    rotation = cv2.Rodrigues(np.radians(degrees) * np.asarray(axis, dtype=np.float64))[0] @ camera.rotation
    return replace(camera, rvec=cv2.Rodrigues(rotation)[0].ravel(), tvec=-rotation @ camera.centre)


@dataclass(frozen=True)
class Shot:
    """A ball that falls through air whose drag is linear, and bounces on a table: every number in closed form."""

    start: float
    end: float
    state: tuple[float, ...]

    @cached_property
    def flights(self) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Start (s, since the shot's), position and velocity of every flight."""
        since, position, velocity = 0.0, np.array(self.state[:3]), np.array(self.state[3:])
        flights = [(since, position, velocity)]
        while True:
            times = np.linspace(1e-6, 2.0, 400)
            heights = flown(position, velocity, times)[:, 2] - HEIGHT
            if not (heights < 0.0).any() or heights[0] < 0.0:
                return flights
            k = int(np.argmax(heights < 0.0))
            down = brentq(
                lambda t, p, v: flown(p, v, np.array([t]))[0, 2] - HEIGHT, *times[k - 1 : k + 1], (position, velocity)
            )
            place = flown(position, velocity, np.array([down]))[0]
            inside = 0.0 < place[0] < 2.74 and abs(place[1]) < 0.7625
            if not inside or since + down > self.end - self.start:
                return flights
            velocity = (TERMINAL + (velocity - TERMINAL) * np.exp(-DRAG * down)) * BOUNCE
            since, position = since + down, place
            flights.append((since, position, velocity))

    def at(self, times: np.ndarray) -> np.ndarray:
        """(k, 3) m, NaN outside the shot."""
        found = np.full((len(times), 3), np.nan)
        for number, (since, position, velocity) in enumerate(self.flights):
            stop = self.flights[number + 1][0] if number + 1 < len(self.flights) else np.inf
            rows = (times - self.start >= since - 1e-9) & (times - self.start < stop) & (times <= self.end + 1e-9)
            found[rows] = flown(position, velocity, times[rows] - self.start - since)
        return found


def flown(position: np.ndarray, velocity: np.ndarray, times: np.ndarray) -> np.ndarray:
    """(k, 3) m, after falling for times (k,) with dv/dt = g - DRAG v."""
    shrunk = -np.expm1(-DRAG * times)[:, None] / DRAG
    return position + TERMINAL * times[:, None] + (velocity - TERMINAL) * shrunk


def shots(count: int, rng: np.random.Generator, every: float = 1.0, lasting: float = 0.75) -> list[Shot]:
    """Shots from either end of the table, one after the other."""
    made = []
    for k in range(count):
        way = 1.0 if k % 2 == 0 else -1.0
        x = 0.1 if way > 0 else 2.64
        place = (x, rng.uniform(-0.5, 0.5), rng.uniform(0.95, 1.2))
        velocity = (way * rng.uniform(2.5, 6.0), rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 1.5))
        made.append(Shot(0.2 + k * every, 0.2 + k * every + lasting, (*place, *velocity)))
    return made


ROLLED = 6
"""Rounds in which the row and the moment at which it is read agree: each is a hundredth of the one before off."""


@dataclass(frozen=True)
class World:
    """What is filmed, and how."""

    shots: Sequence[Shot]
    duration: float
    rates: Sequence[float] = (60.0, 60.0, 60.0)
    phases: Sequence[float] = (0.0, 1 / 3, 2 / 3)
    noise: float = 0.2
    missed: float = 0.05
    clutter: int = 2
    arm: bool = True
    blind: Mapping[int, tuple[float, float]] | None = None
    seed: int = 0


def arm(times: np.ndarray) -> np.ndarray:
    """(k, 3) m, a hand waved beside the table."""
    return np.stack(
        (0.4 + 0.3 * np.sin(5.0 * times), -0.9 + 0.25 * np.sin(6.3 * times + 1.0), 1.2 + 0.3 * np.cos(4.1 * times)),
        axis=1,
    )


def film(cameras: Sequence[Camera], world: World) -> list[Detections]:
    """All candidates of every camera; the time offsets of the cameras count."""
    return [_filmed(number, camera, world) for number, camera in enumerate(cameras)]


def _filmed(number: int, camera: Camera, world: World) -> Detections:
    rng = np.random.default_rng((world.seed, number))
    period = 1.0 / world.rates[number]
    times = np.arange(world.phases[number] * period, world.duration, period)
    seen = [shot.at for shot in world.shots] + ([arm] if world.arm else [])
    frame, pixels = [], []
    for moving in seen:
        points = moving(times)
        there = np.isfinite(points).all(axis=1)
        there[there] = camera.in_view(points[there])
        there &= rng.random(len(times)) >= world.missed
        if world.blind and number in world.blind:
            start, end = world.blind[number]
            there &= (times < start) | (times > end)
        frame.append(np.flatnonzero(there))
        points = points[there]
        for _ in range(ROLLED if camera.readout else 0):  # a row is seen when it is read, and where the ball then is
            then = moving(camera.true_times(times[there] + camera.time_offset, camera.project(points)))
            points = np.where(np.isfinite(then), then, points)
        pixels.append(camera.project(points) + world.noise * rng.standard_normal((int(there.sum()), 2)))
    frame.append(np.repeat(np.arange(len(times)), world.clutter))
    pixels.append(rng.uniform((0, 0), camera.size, (len(frame[-1]), 2)))
    frames, places = np.concatenate(frame), np.concatenate(pixels)
    order = np.lexsort((places[:, 0], frames))
    count = len(order)
    return Detections(
        camera.name,
        times + camera.time_offset,
        frames[order],
        places[order],
        np.tile(world.noise**2 * np.eye(2), (count, 1, 1)),
        np.ones(count),
        np.full((count, 2, 2), np.nan),
    )

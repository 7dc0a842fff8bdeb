"""Three cameras about a table, a ball that bounces on it, and what they see of it, each at its own stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch

from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model
from ballfg.dynamics.motion.rollout import advance
from ballfg.estimation.observations.rig import in_order
from ballfg.estimation.observations.sightings import sighted_track
from ballfg.tracks import Track
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera

TABLE = 0.76
RATE = 120.0
NOISE = 0.3
"""px"""


class World(NamedTuple):
    """The ball's model and what it bounces on."""

    model: AnalyticModel
    surfaces: Surfaces


def world() -> World:
    return World(nominal_model(), Surfaces.table_tennis(TABLE))


def looking(name: str, centre: Sequence[float]) -> Camera:
    """A camera at a place, looking at a point above the table."""
    place = np.array(centre)
    z = np.array([0.0, 0.0, 0.9]) - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    matrix = [[1000.0, 0, 640.0], [0, 1000.0, 360.0], [0, 0, 1]]
    rvec = cv2.Rodrigues(rotation)[0].ravel()
    return Camera(name, (1280, 720), matrix, [-0.1, 0.02, 0, 0, 0], rvec, -rotation @ place)


RIG = (looking("left", (-1.5, -2.6, 2.0)), looking("right", (1.5, -2.6, 2.0)), looking("back", (0.3, 3.0, 2.2)))


def truth(start: np.ndarray, times: np.ndarray, ball: World) -> np.ndarray:
    """(n, 9) states at ascending times, from a start at time 0."""
    state, now, found = torch.from_numpy(start)[None], 0.0, np.empty((len(times), 9))
    with torch.no_grad():
        for k, time in enumerate(times.tolist()):
            state = advance(ball.model, state, torch.tensor([time - now], dtype=torch.float64), ball.surfaces)
            found[k], now = state[0].numpy(), time
    return found


def launch(rng: np.random.Generator) -> np.ndarray:
    """(9,) a ball that bounces after some 0.3 s."""
    start = np.array([-1.2, -0.2, 1.05, 4.5, 0.3, 0.5, 20.0, 60.0, 10.0])
    return start + np.repeat((0.0, 0.4, 20.0), 3) * rng.standard_normal(9)


class Scene(NamedTuple):
    """What cameras saw, and the true states (m, 9) at the sightings."""

    sightings: Sightings
    truth: np.ndarray


def seen(
    states: np.ndarray, camera: np.ndarray, times: np.ndarray, rng: np.random.Generator, rig: Sequence[Camera] = RIG
) -> Scene:
    """Sightings of states at ascending true times, each by its camera, with noise, with the stamps of its clock."""
    pixels = np.stack([rig[c].project(x[:3]) for c, x in zip(camera, states, strict=True)])
    inside = np.array([bool(rig[c].in_view(x[:3])) for c, x in zip(camera, states, strict=True)])
    pixels = pixels + NOISE * rng.standard_normal(pixels.shape)
    pairs = zip(camera, times, pixels, strict=True)
    late = times - np.array([rig[c].true_times(np.array([t]), z[None])[0] for c, t, z in pairs])
    noise = np.tile(NOISE**2 * np.eye(2), (len(times), 1, 1))
    names = tuple(c.name for c in rig)
    return Scene(Sightings(names, camera, times + late, pixels, noise).select(inside), states[inside])


def scene(
    seed: int,
    ball: World,
    phases: Sequence[float] = (0.0, 1 / 3, 2 / 3),
    duration: float = 0.6,
    rig: Sequence[Camera] = RIG,
) -> Scene:
    """A flight with a bounce; each camera's frames begin a share of the period late."""
    rng = np.random.default_rng(seed)
    count = int(duration * RATE)
    camera = np.repeat(np.arange(len(phases)), count)
    times = ((np.arange(count) + np.array(phases)[:, None]) / RATE).ravel()
    order = np.argsort(times, kind="stable")
    return seen(truth(launch(rng), times[order], ball), camera[order], times[order], rng, rig)


def track_of(made: Scene, name: str = "ball", cameras: Sequence[Camera] = RIG) -> Track:
    """The track of a scene, as cameras with these time offsets take it."""
    return sighted_track(name, in_order(made.sightings, cameras), cameras)


def late(offsets: Sequence[float]) -> tuple[Camera, ...]:
    """The rig with time offsets."""
    return tuple(replace(camera, time_offset=offset) for camera, offset in zip(RIG, offsets, strict=True))

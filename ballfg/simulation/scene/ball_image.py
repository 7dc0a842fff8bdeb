"""Draws the image of a moving ball: its cover of each pixel over the exposure, and its light.

A pixel sees the ball where the angle between its ray and the ball's centre is below asin(R / distance): the exact
outline of a sphere through the full camera model, the small ellipse of perspective included. Over the exposure the
outline is averaged along the path.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.simulation.scene.view import Rect, clipped
from ballfg.vision.camera import Camera

STEP: Final = 0.25  # px, longest step of the path for averaging the outline
MARGIN: Final = 2  # px of empty margin around the outline
SHADING: Final = 0.12  # Depth of the ball's shading: a point facing away from the lamp has 1 - 2 `SHADING` of the light
TINY: Final = 1e-12  # Replaces the zero distance of a pixel at the very centre; any small number makes it covered
_LAMP: Final = np.array([0.3, 0.25, 0.92]) / np.linalg.norm([0.3, 0.25, 0.92])  # Direction to the lamp, world


@dataclass(frozen=True, eq=False)
class BallImage:
    """A ball within a part of the image."""

    rect: Rect  # Its part of the image
    cover: Array  # (h, w) share of the exposure and of the pixel that the ball covers, 0 to 1
    light: Array  # (h, w) light from the ball: `cover` times the shading, at most `cover`


def ball_image(camera: Camera, path: Array, radius: float) -> BallImage | None:
    """The image of a ball that moves along a path while the shutter is open.

    Args: path: (m, 3) m, its centre, evenly in time from the opening to the closing.  radius: m.
    Returns: None if no pixel of the camera sees it.
    """
    pixels = camera.project(path)
    if not np.isfinite(pixels).all():
        return None
    rect = clipped(camera, pixels, camera.matrix.max() * radius / camera.depth(path).min() + MARGIN)
    if rect is None:
        return None
    left, top, right, bottom = rect
    u, v = np.meshgrid(np.arange(left, right, dtype=np.float64), np.arange(top, bottom, dtype=np.float64))
    rays = _unit_rays(camera, np.stack((u, v), axis=-1))
    steps = max(1, int(np.ceil(np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum() / STEP)))
    centres = _resampled(path, steps) @ camera.rotation.T + camera.tvec
    middle = camera.project(path[len(path) // 2])
    around = _unit_rays(camera, middle + np.array([[[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]]]))[0]
    per_pixel = around[1:3] - around[3:5]
    cover, light = _swept(rays, per_pixel, centres, radius, camera.rotation @ _LAMP)
    shape = (bottom - top, right - left)
    return BallImage(rect, cover.reshape(shape), light.reshape(shape))


def _unit_rays(camera: Camera, pixels: Array) -> Array:
    """(h, w, 3) unit vectors in the camera's frame."""
    plane = camera.normalized(pixels)
    rays = np.concatenate((plane, np.ones((*plane.shape[:-1], 1))), axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _resampled(path: Array, steps: int) -> Array:
    """(steps, 3) the path at the middles of equal shares of its time."""
    place = (np.arange(steps) + 0.5) / steps * (len(path) - 1)
    before = np.minimum(place.astype(int), len(path) - 2)
    share = (place - before)[:, None]
    return np.asarray((1 - share) * path[before] + share * path[before + 1])


def _swept(rays: Array, per_pixel: Array, centres: Array, radius: float, lamp: Array) -> tuple[Array, Array]:
    """Cover and light (p,) of the pixels of rays (h, w, 3), averaged over centres (s, 3) m, camera's frame.

    `per_pixel` (2, 3) is the change of a ray from one pixel to the next, to the right and down.
    Chords between unit vectors stand for angles: the outline is where |ray - towards| is the chord of asin(R / d). The
    signed distance to it, divided by how fast the chord grows per pixel, is in pixels; a pixel whose middle is x px
    inside is covered by 1/2 + x, between 0 and 1.
    """
    flat = rays.reshape(-1, 3)
    distance = np.linalg.norm(centres, axis=1, keepdims=True)
    towards = centres / distance  # (s, 3)
    sine = radius / distance
    edge = np.sqrt(2 - 2 * np.sqrt(1 - sine**2))  # (s, 1) chord of the outline
    off = flat[None] - towards[:, None]  # (s, p, 3)
    chord = np.sqrt(np.einsum("spk,spk->sp", off, off))
    growth = np.linalg.norm(off @ per_pixel.T, axis=-1) / np.maximum(chord, TINY)
    cover = np.clip(0.5 + (edge - chord) / np.maximum(growth, TINY), 0.0, 1.0)
    along = np.sqrt(np.maximum(1 - (chord / edge) ** 2, 0.0))
    facing = (off @ lamp) / edge - along * (towards @ lamp)[:, None]
    light = cover * (1 - SHADING + SHADING * np.clip(facing, -1.0, 1.0))
    return cover.mean(axis=0), light.mean(axis=0)

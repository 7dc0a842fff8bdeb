"""Renders the frames of one camera: still room, moving ball and objects, lens, flickering light, noise, eight bits.

The room is drawn once. A frame redraws only the moving parts; the lens and the level of noise are redone there.

A pixel sees the ball where the angle between its ray and the ball's centre is below asin(R / distance): the exact
outline of a sphere through the full camera model, the small ellipse of perspective included. Over the exposure the
outline is averaged along the path.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.simulation.scene.backdrop import backdrop
from ballfg.simulation.scene.config import SceneConfig
from ballfg.simulation.scene.room import Colour, Rect, clipped, draw, grown, movers
from ballfg.simulation.scene.shutter import Frames, Passage
from ballfg.simulation.streams import Purpose, generator
from ballfg.vision.arrays import Array32, Image
from ballfg.vision.camera import Camera

LENS_BLUR: Final = 0.7  # px, standard deviation of the point spread of the lens
_REACH: Final = 3  # px, extent of the blur: four standard deviations
MAINS: Final = 100.0  # Hz at which lamps flicker on a 50 Hz mains
MIDDLE_GREY: Final = 128.0  # Grey level at which the noise has twice the variance of black
NOISE_MARGIN: Final = 256
"""px by which the field of noise exceeds the image: each frame cuts its noise from another place of it."""
BALL_COLOURS: Final[dict[str, Colour]] = {"white": (226.0, 230.0, 230.0), "orange": (40.0, 128.0, 236.0)}
"""Blue, green, red of a ball in full light, grey levels."""


class Renderer:
    """Draws a camera's images of a recording.

    Args: number: of the camera in the rig; it picks the random streams.
    """

    def __init__(self, config: SceneConfig, camera: Camera, number: int) -> None:
        self._config = config
        self._camera = camera
        self._radius = config.ball.ball.radius
        still = backdrop(camera, config.ball, generator(config.seed, Purpose.SCENE_TEXTURE))
        self._distance = still.distance
        self._still_sharp = still.image
        self._still = _blurred(still.image)
        self._still_noise = self._noise_level(self._still)
        self._sharp, self._image = self._still_sharp.copy(), self._still.copy()
        self._sigma = self._still_noise.copy()
        self._grain = np.zeros_like(self._still)
        self._rng = generator(config.seed, Purpose.SCENE_NOISE, number)
        shape = (camera.size[1] + NOISE_MARGIN, camera.size[0] + NOISE_MARGIN, 3)
        self._field = self._rng.standard_normal(shape, dtype=np.float32)

    def frames(self, frames: Frames, passages: Sequence[Passage]) -> Iterator[Image]:
        """The images (h, w, 3) of a camera's frames, blue green red, one after the other."""
        at_frame: dict[int, list[Array]] = {}
        for passage in passages:
            for frame, path in zip(passage.frames.tolist(), passage.paths, strict=True):
                at_frame.setdefault(frame, []).append(path)
        for frame, time in enumerate(frames.times.tolist()):
            yield self.draw(time, at_frame.get(frame, []))

    def draw(self, time: float, paths: Sequence[Array]) -> Image:
        """One frame.

        Args:
            time: s, true time of the middle of the exposure.
            paths: for each ball, (m, 3) m, its centre from the shutter's opening to its closing. Balls are drawn in
                front of everything else.
        """
        moving = movers(time) if self._config.distractors else []
        drawn = [draw(self._sharp, self._distance, self._camera, thing, self._config.exposure) for thing in moving]
        drawn += [self._draw_ball(path) for path in paths]
        changed = [self._through_lens(rect) for rect in drawn if rect is not None]
        image = self._developed(time)
        for left, top, right, bottom in changed:
            window = (slice(top, bottom), slice(left, right))
            self._sharp[window] = self._still_sharp[window]
            self._image[window] = self._still[window]
            self._sigma[window] = self._still_noise[window]
        return image

    def _draw_ball(self, path: Array) -> Rect | None:
        ball = ball_image(self._camera, path, self._radius)
        if ball is None:
            return None
        left, top, right, bottom = ball.rect
        part = self._sharp[top:bottom, left:right]
        colour = np.array(BALL_COLOURS[self._config.colour])
        part[...] = part * (1 - ball.cover[..., None]) + ball.light[..., None] * colour
        return ball.rect

    def _through_lens(self, rect: Rect) -> Rect:
        """Blurs a part of the sharp image into the image; returns the part changed by the blur."""
        outer, wider = (grown(self._camera, rect, by) for by in (_REACH, 2 * _REACH))
        part = _blurred(self._sharp[wider[1] : wider[3], wider[0] : wider[2]])
        x, y = outer[0] - wider[0], outer[1] - wider[1]
        part = part[y : y + outer[3] - outer[1], x : x + outer[2] - outer[0]]
        window = (slice(outer[1], outer[3]), slice(outer[0], outer[2]))
        self._image[window] = part
        self._sigma[window] = self._noise_level(part)
        return outer

    def _developed(self, time: float) -> Image:
        """The image in the light of the moment, with noise, in eight bits."""
        light = 1 + self._config.flicker * np.sinc(MAINS * self._config.exposure) * np.sin(2 * np.pi * MAINS * time)
        x, y = self._rng.integers(0, NOISE_MARGIN, 2).tolist()
        height, width = self._image.shape[:2]
        cv2.multiply(self._field[y : y + height, x : x + width], self._sigma, dst=self._grain)
        image = cv2.addWeighted(self._image, float(light), self._grain, 1.0, 0.0, dtype=cv2.CV_8U)
        return np.asarray(image, dtype=np.uint8)

    def _noise_level(self, image: Array32) -> Array32:
        """(h, w, 3) grey levels, standard deviation of the noise of pixels."""
        return np.asarray(np.float32(self._config.noise) * np.sqrt(1 + image / np.float32(MIDDLE_GREY)))


def _blurred(image: Array32) -> Array32:
    side = 2 * _REACH + 1
    return np.asarray(cv2.GaussianBlur(image, (side, side), LENS_BLUR, borderType=cv2.BORDER_REPLICATE))


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
    rays = camera.directions(pixels)
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

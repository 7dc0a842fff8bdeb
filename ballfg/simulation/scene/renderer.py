"""Renders the frames of one camera: still room, moving objects, lens, flickering light, noise, eight bits.

The room is drawn once. A frame redraws only the moving parts; the lens and the level of noise are redone there.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.simulation.scene.backdrop import backdrop
from ballfg.simulation.scene.ball_image import ball_image
from ballfg.simulation.scene.config import SceneConfig
from ballfg.simulation.scene.movers import draw, movers
from ballfg.simulation.scene.room import Colour
from ballfg.simulation.scene.shutter import Frames, Passage
from ballfg.simulation.scene.view import Rect, grown
from ballfg.simulation.streams import Purpose, generator
from ballfg.vision.camera import Camera

Image = NDArray[np.float32]
Pixels = NDArray[np.uint8]

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

    def frames(self, frames: Frames, passages: Sequence[Passage]) -> Iterator[Pixels]:
        """The images (h, w, 3) of a camera's frames, blue green red, one after the other."""
        at_frame: dict[int, list[Array]] = {}
        for passage in passages:
            for frame, path in zip(passage.frames.tolist(), passage.paths, strict=True):
                at_frame.setdefault(frame, []).append(path)
        for frame, time in enumerate(frames.times.tolist()):
            yield self.draw(time, at_frame.get(frame, []))

    def draw(self, time: float, paths: Sequence[Array]) -> Pixels:
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

    def _developed(self, time: float) -> Pixels:
        """The image in the light of the moment, with noise, in eight bits."""
        light = 1 + self._config.flicker * np.sinc(MAINS * self._config.exposure) * np.sin(2 * np.pi * MAINS * time)
        x, y = self._rng.integers(0, NOISE_MARGIN, 2).tolist()
        height, width = self._image.shape[:2]
        cv2.multiply(self._field[y : y + height, x : x + width], self._sigma, dst=self._grain)
        image = cv2.addWeighted(self._image, float(light), self._grain, 1.0, 0.0, dtype=cv2.CV_8U)
        return np.asarray(image, dtype=np.uint8)

    def _noise_level(self, image: Image) -> Image:
        """(h, w, 3) grey levels, standard deviation of the noise of pixels."""
        return np.asarray(np.float32(self._config.noise) * np.sqrt(1 + image / np.float32(MIDDLE_GREY)))


def _blurred(image: Image) -> Image:
    side = 2 * _REACH + 1
    return np.asarray(cv2.GaussianBlur(image, (side, side), LENS_BLUR, borderType=cv2.BORDER_REPLICATE))

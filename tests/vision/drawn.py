"""Balls drawn by counting: a disc swept over the exposure, 6 x 6 points a pixel; nothing shared with what is tested."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

SUB = 6
BLUR = 0.7


def coverage(size: int, centre: np.ndarray, half: np.ndarray, radius: float, shade: np.ndarray) -> np.ndarray:
    """(2, size, size): share of the exposure on the ball, and the same weighted with the shading there."""
    steps = 2 * int(np.ceil(2 * np.hypot(*half))) + 1
    points = (np.arange(size * SUB) + 0.5) / SUB - 0.5
    total = np.zeros((2, size * SUB, size * SUB), dtype=np.float32)
    for s in (2 * np.arange(steps) + 1) / steps - 1:
        x, y = points - centre[0] - s * half[0], (points - centre[1] - s * half[1])[:, None]
        on = x**2 + y**2 < radius**2
        total[0] += on
        total[1] += on * (shade[0] * x + shade[1] * y) / radius
    means = total.reshape(2, size, SUB, size, SUB).mean(axis=(2, 4)) / steps
    return np.stack([cv2.GaussianBlur(image, (0, 0), BLUR) for image in means])


@dataclass
class Shot:
    image: np.ndarray
    centre: np.ndarray
    half: np.ndarray


class Film:
    """Frames of a ball that jumps about before a still room, in flickering light, with a swinging arm and a shirt."""

    def __init__(
        self, size: tuple[int, int] = (320, 240), seed: int = 0, noise: float = 3.0, **changes: object
    ) -> None:
        self.size, self.noise = size, noise
        self.radius, self.shade, self.colour, self.ball = 6.5, np.array([0.06, -0.08]), (225, 230, 230), True
        for name, value in changes.items():
            assert hasattr(self, name)
            setattr(self, name, value)
        self.rng = np.random.default_rng(seed)
        width, height = size
        coarse = self.rng.normal(0, 20, (9, 16, 3)).astype(np.float32)
        room = np.float32([90, 80, 70]) + cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
        cv2.rectangle(room, (width // 2, height // 4), (width // 2 + 40, height // 2), (190, 195, 195), -1)
        cv2.line(room, (0, height - 40), (width, height - 30), (220, 220, 220), 5)
        self.room = cv2.GaussianBlur(room, (0, 0), BLUR)

    def shots(self, count: int, streak: float = 8.0) -> Iterator[Shot]:
        """Frames; the ball moves `streak` px during each exposure, in all directions."""
        width, height = self.size
        for number in range(count):
            angle = self.rng.uniform(0, 2 * np.pi)
            half = streak / 2 * np.array([np.cos(angle), np.sin(angle)])
            centre = np.array([self.rng.uniform(90, width - 40), self.rng.uniform(40, height - 60)])
            image = self.room.copy()
            arm = (30, int(100 + 30 * np.sin(0.1 * number)))
            cv2.ellipse(image, arm, (22, 60), 10 * np.sin(0.1 * number), 0, 360, (60, 90, 160), -1, cv2.LINE_AA)
            if self.ball:
                self._draw(image, centre, half)
            image *= 1.0 + 0.03 * np.sin(2.1 * number)
            image += self.rng.normal(0, self.noise, image.shape)
            yield Shot(np.clip(np.round(image), 0, 255).astype(np.uint8), centre, half)

    def _draw(self, image: np.ndarray, centre: np.ndarray, half: np.ndarray) -> None:
        reach = int(np.ceil(np.hypot(*half) + self.radius + 4))
        corner = np.floor(centre).astype(int) - reach
        on, lit = coverage(2 * reach + 1, centre - corner, half, self.radius, self.shade)
        part = image[corner[1] : corner[1] + 2 * reach + 1, corner[0] : corner[0] + 2 * reach + 1]
        ball = np.float32(self.colour)
        part += on[..., None] * (ball - part) + lit[..., None] * ball

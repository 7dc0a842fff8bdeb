"""Detects small fast balls: background, regions, a swept disc fitted to each, and a score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_array, check_choice, check_count, check_range
from ballfg.vision.arrays import Image
from ballfg.vision.camera import MOST_PIXELS
from ballfg.vision.detection.background import Background
from ballfg.vision.detection.detections import Candidates
from ballfg.vision.detection.regions import Region, find_regions
from ballfg.vision.detection.scoring import score
from ballfg.vision.detection.streak import LOOK, Look, Patch, StreakFit, fit_streak, start

Colour = Literal["white", "orange"]

MODEL_ERROR: Final = 0.02
"""px per px of blotches, sigma that every centre has besides the noise's: the disc's edge is not quite the lens's, and
compression, which makes the blotches, moves edges."""
LEARNS: Final = 0.8  # score from which a candidate teaches what edge and shading to expect
FORGETS: Final = 0.98  # factor on earlier information per teaching candidate: the light on the ball changes as it flies
SUREST: Final = (0.15, 0.08, 0.08)  # least sigmas of the expected edge (px) and shading: they change along a flight
VISIBLE_STREAK: Final = 3.0  # px, and sigmas of its length: a shorter streak's direction is chance


@dataclass(frozen=True)
class DetectorSettings:
    """Assumptions on the balls' images.

    Raises: ValueError: sizes that are not positive or out of order, an unknown colour.
    """

    diameter: tuple[float, float] = (4.0, 40.0)
    """px, least and greatest diameter."""
    longest_streak: float = 60.0
    """px, largest motion of a ball during an exposure."""
    colour: Colour | None = None
    """Colour of the ball; None: any colour that differs from the background's."""
    most: int = 6
    """Largest number of closely examined candidates per frame."""

    def __post_init__(self) -> None:
        low, high = check_array("diameter", self.diameter, (2,), "Give the smallest and the largest in px.").tolist()
        if not 0.0 < low < high < np.inf:
            raise ValueError(f"diameter must be two increasing positive numbers, px; got {self.diameter}.")
        check_range("longest_streak", self.longest_streak, 0.0, MOST_PIXELS)
        if self.colour is not None:
            check_choice("colour", self.colour, ("white", "orange"))
        check_count("most", self.most, 1)


class BallDetector:
    """Finds small fast balls before a background that hardly moves; one per camera, called with each frame in order."""

    def __init__(self, background: Background, settings: DetectorSettings | None = None) -> None:
        self.background = background
        self.settings = settings or DetectorSettings()
        self._look = Look.unknown()

    @classmethod
    def learn(cls, images: Sequence[Image], settings: DetectorSettings | None = None) -> BallDetector:
        """A detector with the background that frames of the recording show.

        Args: images: at least three, (h, w, 3) grey levels, spread over the recording; see `Background`.
            settings: assumptions on the ball; None: the default ones.
        Raises: ValueError: too few images, or of several sizes.
        """
        return cls(Background(images), settings)

    def __call__(self, image: Image) -> Candidates:
        """The candidates of the next frame (h, w, 3), BGR. Raises: ValueError: another size than the background's."""
        if image.shape != self.background.full.shape:
            problem = f"image must have the background's shape {self.background.full.shape}; got {image.shape}"
            raise ValueError(f"{problem}. Learn a detector for each camera.")
        known = self.settings
        regions = find_regions(self.background, image, known.diameter[1], known.longest_streak, known.most)
        rated = [found for region in regions if (found := self._fitted(image, region)) is not None]
        for fit, rating in rated:
            if rating >= LEARNS:
                self._look = learned(self._look, fit, self.background.blotches)
        return _candidates(rated, MODEL_ERROR * self.background.blotches)

    def _fitted(self, image: Image, region: Region) -> tuple[StreakFit, float] | None:
        """The swept disc that explains a region, in pixels of the image, and its score; None where none does."""
        behind = self.background.patch(region.rows, region.columns)
        change = region.free_of(image[region.rows, region.columns] - behind)
        behind = region.free_of(behind)
        patch = patch_of(change, behind, region, self.background.noise)
        first = None if patch is None else start(patch, self._look)
        if patch is None or first is None or not self._plausible(first):
            return None
        fit = fit_streak(patch, first, self._look)
        height, width = self.background.shape
        x, y = fit.centre
        if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5 and self._plausible(fit.values)):
            return None
        fit = replace(fit, covariance=fit.covariance * self.background.blotches)
        return fit, score(fit, patch, change, behind, self.settings.diameter, self.settings.colour)

    def _plausible(self, values: Array) -> bool:
        """True if radius and streak are within a factor of two of the limits."""
        low, high = self.settings.diameter
        return bool(low / 4.0 <= values[4] <= high and np.hypot(*values[2:4]) <= self.settings.longest_streak)


def patch_of(change: np.ndarray, behind: np.ndarray, region: Region, noise: Array) -> Patch | None:
    """The region's pixels along the colour by which it differs from its background; None where it does not.

    Args: change, behind: (m, 3) grey levels, difference to the background and the background, of the free pixels.
        noise: (3, 3) grey levels^2, covariance of the channels.
    """
    strength = np.abs(change).max(axis=1)
    colour = change[strength > 0.5 * strength.max()].mean(axis=0).astype(np.float64)
    direction = np.linalg.solve(noise, colour)
    length = np.linalg.norm(direction)
    if not length > 0.0:
        return None
    direction /= length
    along = direction.astype(np.float32)
    shade = behind @ along
    sigma = float(np.sqrt(direction @ noise @ direction))
    return Patch(*region.places(), change @ along, shade - shade.mean(), float(shade.mean()), sigma)


def learned(look: Look, fit: StreakFit, blotches: float) -> Look:
    """Expected look after another ball: means weighted by information, which decays towards the first."""
    doubt = max(fit.scatter, 1.0) ** 2 * blotches
    first = Look.unknown()
    old = FORGETS * (look.information - first.information)
    pull = (look.information + fit.tells) @ (fit.values[LOOK] - look.mean) / doubt
    new = fit.tells / doubt
    information = first.information + old + new
    mean = np.linalg.solve(information, first.information @ first.mean + (old + new) @ look.mean + pull)
    scale = np.minimum(1.0, np.array(SUREST) ** -1.0 / np.sqrt(np.diagonal(information)))
    return Look(np.asarray(mean, dtype=np.float64), information * np.outer(scale, scale))


def _candidates(rated: Sequence[tuple[StreakFit, float]], floor: float) -> Candidates:
    """Candidates from the fits of a frame and their scores; floor: px, sigma added to each centre's."""
    if not rated:
        return Candidates.none()
    covariances = np.stack([fit.covariance for fit, _ in rated])
    centres = np.stack([fit.centre for fit, _ in rated])
    halves = np.stack([fit.half for fit, _ in rated])
    lengths = 2.0 * np.hypot(halves[:, 0], halves[:, 1])
    spread = 2.0 * np.sqrt(np.trace(covariances[:, 2:4, 2:4], axis1=1, axis2=2))
    halves[(lengths < VISIBLE_STREAK) | (lengths < VISIBLE_STREAK * spread)] = np.nan
    spread_of_centres, scores = covariances[:, :2, :2] + floor**2 * np.eye(2), np.array([mark for _, mark in rated])
    return Candidates(centres, spread_of_centres, scores, np.stack((centres - halves, centres + halves), axis=1))

"""Detects small fast balls: background, regions, a swept disc fitted to each, and a score.

The score marks the similarity of a candidate to a ball by shape, contrast, size and colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_array, check_choice, check_count, check_range
from ballfg.vision.arrays import Array32, Image
from ballfg.vision.camera import MOST_PIXELS
from ballfg.vision.detection.background import Background, Region, find_regions
from ballfg.vision.detection.detections import UNKNOWN_RADIUS, Candidates
from ballfg.vision.detection.streak import LOOK, RADIUS, Look, Patch, StreakFit, fit_streak, start, swept

Colour = Literal["white", "orange"]

MODEL_ERROR: Final = 0.02  # px per px of blotches, sigma of every centre besides noise: compression moves edges
LEARNS: Final = 0.8  # score from which a candidate teaches what edge and shading to expect
SIZED: Final = 0.05  # score up to which no radius is stated: shape or edge are not a ball's
FORGETS: Final = 0.98  # factor on earlier information per teaching candidate: the light on the ball changes as it flies
SUREST: Final = (0.15, 0.08, 0.08)  # least sigmas of the expected edge (px) and shading: they change along a flight
VISIBLE_STREAK: Final = 3.0  # px, and sigmas of its length: a shorter streak's direction is chance
UNEXPLAINED: Final = 0.06  # share of the change left over at which the mark for shape is 1/e; hands leave 0.1 and more
ODD: Final = 2.0  # sigmas from the `Look` first expected beyond which the mark for looks falls by half per sigma
STRENGTH: Final = 15.0  # ratio of signal to noise, over the whole candidate, at which the mark for contrast is 1 - 1/e
SIZE: Final = 0.2  # relative error of the diameter, beyond the limits, at which the mark for size is 1/e
UNSETTLED: Final = 0.5  # mark of a fit that did not converge
WHITE: Final = (0.25, 0.2)  # saturation up to which a ball is white, and the scale beyond
ORANGE: Final = (8.0, 48.0, 12.0)  # degrees of hue of an orange or yellow ball, and the scale beyond
PALE: Final = (0.35, 0.15)  # saturation from which a ball is orange, and the scale below that


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
    """Finds small fast balls before a background that hardly moves; one per camera, called with each frame in order.

    Args: images: frames (h, w, 3), of which the background is learned.  settings: the default ones if None.
    Raises: ValueError: too few frames, or of several sizes.
    """

    def __init__(self, images: Sequence[Image], settings: DetectorSettings | None = None) -> None:
        self.background = Background(images)
        self.settings = settings or DetectorSettings()
        self._look = Look.unknown()

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
        if not rated:
            return Candidates.none()
        covariances = np.stack([fit.covariance for fit, _ in rated])
        centres = np.stack([fit.centre for fit, _ in rated])
        halves = np.stack([fit.half for fit, _ in rated])
        lengths = 2.0 * np.hypot(halves[:, 0], halves[:, 1])
        spread = 2.0 * np.sqrt(np.trace(covariances[:, 2:4, 2:4], axis1=1, axis2=2))
        halves[(lengths < VISIBLE_STREAK) | (lengths < VISIBLE_STREAK * spread)] = np.nan
        floor = MODEL_ERROR * self.background.blotches
        of_centres, scores = covariances[:, :2, :2] + floor**2 * np.eye(2), np.array([mark for _, mark in rated])
        radii = np.array([radius_of(fit, mark) for fit, mark in rated])
        return Candidates(centres, of_centres, scores, np.stack((centres - halves, centres + halves), axis=1), radii)

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


def radius_of(fit: StreakFit, mark: float) -> tuple[float, float]:
    """px, radius and standard deviation of a fit with a score; unknown of a thing that has not a ball's shape."""
    sigma = float(np.sqrt(max(fit.covariance[RADIUS, RADIUS], 0.0)))  # NaN where the fit fell together
    return (fit.radius, sigma) if mark > SIZED and 0.0 < sigma < np.inf else UNKNOWN_RADIUS


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


def score(
    fit: StreakFit,
    patch: Patch,
    change: Array32,
    behind: Array32,
    diameter: tuple[float, float],
    colour: Colour | None,
) -> float:
    """Mark of a candidate, 0 to 1.

    Args: change, behind: (m, 3) grey levels, difference to the background and background of these pixels.
        diameter: px, least and greatest.
    """
    shape = np.exp(-((fit.unexplained / UNEXPLAINED) ** 2)) * (1.0 if fit.settled else UNSETTLED)
    strength = 1.0 - np.exp(-((fit.strength / STRENGTH) ** 2))
    looks = 0.5 ** max(fit.oddness - ODD, 0.0)
    size = 2.0 * fit.radius
    off = max(diameter[0] / size - 1.0, size / diameter[1] - 1.0, 0.0)
    mark = shape * looks * strength * np.exp(-((off / SIZE) ** 2))
    if colour is not None:
        mark *= _colour_mark(swept(patch.x, patch.y, fit.values)[0], change, behind, colour)
    return float(np.clip(mark, 0.0, 1.0))


def _colour_mark(coverage: Array32, change: Array32, behind: Array32, colour: Colour) -> float:
    column = coverage[:, None]  # without the background that shines through the streak
    ball = (column * (change + column * behind)).sum(axis=0) / (column**2).sum()
    blue, green, red = np.maximum(ball.astype(np.float64), 0.0)
    most, least = max(blue, green, red, 1.0), min(blue, green, red)
    saturation = (most - least) / most
    if colour == "white":
        lighter = coverage @ change.sum(axis=1) > 0.0
        return float(np.exp(-((max(saturation - WHITE[0], 0.0) / WHITE[1]) ** 2))) * float(lighter)
    if not red >= green >= blue or red == blue:
        return 0.0
    hue = 60.0 * (green - blue) / (red - blue)
    off = max(ORANGE[0] - hue, hue - ORANGE[1], 0.0) / ORANGE[2]
    pale = max(PALE[0] - saturation, 0.0) / PALE[1]
    return float(np.exp(-(off**2) - pale**2))

"""Scores the similarity of a fitted candidate to a ball: shape, contrast, size and colour."""

from typing import Final, Literal

import numpy as np

from ballfg.vision.arrays import Array32
from ballfg.vision.detection.streak import Patch, StreakFit, swept

UNEXPLAINED: Final = 0.06
"""Share of the change that a swept disc leaves over at which the mark for shape is 1/e. Balls: 0.001 to 0.02; hands and
sleeves: 0.1 and more."""
ODD: Final = 2.0
"""Sigmas from the `Look` first expected, root mean square of its three, beyond which the mark for looks falls by half
per sigma. Sleeves, with the light on their upper side, pass for half a ball in deep shade."""
STRENGTH: Final = 15.0  # ratio of signal to noise, over the whole candidate, at which the mark for contrast is 1 - 1/e
SIZE: Final = 0.2  # relative error of the diameter, beyond the limits, at which the mark for size is 1/e
UNSETTLED: Final = 0.5  # mark of a fit that did not converge
WHITE: Final = (0.25, 0.2)  # saturation up to which a ball is white, and the scale beyond
ORANGE: Final = (8.0, 48.0, 12.0)  # degrees of hue of an orange or yellow ball, and the scale beyond
PALE: Final = (0.35, 0.15)  # saturation from which a ball is orange, and the scale below that


def score(
    fit: StreakFit,
    patch: Patch,
    change: Array32,
    behind: Array32,
    diameter: tuple[float, float],
    colour: Literal["white", "orange"] | None,
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


def _colour_mark(coverage: Array32, change: Array32, behind: Array32, colour: Literal["white", "orange"]) -> float:
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

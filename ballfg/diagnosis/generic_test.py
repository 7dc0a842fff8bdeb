"""Holds the results of tests: for patterns of any cause, and of spin labels, the probability that each is wrong."""

from dataclasses import dataclass
from typing import Final

import numpy as np

ALARM: Final = 0.005  # Probability that any test of a complete fit raises an alarm: smaller p-values are alarms

APART: Final = "tracks"  # Name of the test for whiteness where nothing is left once each track has its own coefficients

PREDICTED: Final = "predictions"  # Name of the test of a model's noise on tracks that it was not fitted to


@dataclass(frozen=True)
class GenericTest:
    """A test for a pattern of any cause.

    Attributes:
        name: `flight`, `contact`, `measurement`, `recording` (coefficients from track to track), `label` (spin labels
            against flights), `time` (whiteness along the tracks), `tracks` (the same, where each track's own
            coefficients explain it) or `predictions` (errors on the held-out half against the noise).
        where: place, dependence and size of the pattern in words.
        p_value: probability of such a pattern by chance; for `label`, that every label is right.
        share: remaining part of the initial pattern, 0 to 1.
    """

    name: str
    where: str
    p_value: float
    share: float


SURE: Final = 0.95  # Probability from which a label is reported as wrong


@dataclass(frozen=True)
class LabelVerdict:
    """The verdict on one spin label.

    Attributes:
        track: its name.
        probability: that the label is wrong.
        off: rad/s, distance of the label from the flight's spin.
        sigma: rad/s, standard deviation of that spin along this distance, from noise and from the scatter of flight and
            bounces.
    """

    track: str
    probability: float
    off: float
    sigma: float


@dataclass(frozen=True)
class LabelCheck:
    """The verdicts on all spin labels.

    Attributes:
        p_all_right: probability that every label is right.
        verdicts: on each label, the least probable first.
    """

    p_all_right: float
    verdicts: tuple[LabelVerdict, ...]

    @property
    def contradicted(self) -> tuple[LabelVerdict, ...]:
        """Verdicts on labels that are almost surely wrong; none if all labels may well be right."""
        if not self.p_all_right < ALARM:
            return ()
        return tuple(verdict for verdict in self.verdicts if verdict.probability >= SURE)

    @property
    def where(self) -> str:
        """A description of the labels that contradict their flights."""
        wrong, labels = self.contradicted, len(self.verdicts)
        if not wrong:
            return (
                f"label: none of {labels} spin labels contradicts its flight beyond the scatter of flight and bounces"
            )
        shown = ", ".join(verdict.track for verdict in wrong[:4]) + (", ..." if len(wrong) > 4 else "")
        off, sigma = (np.median([getattr(verdict, name) for verdict in wrong]) for name in ("off", "sigma"))
        return (
            f"label: {len(wrong)} of {labels} spin labels contradict their flights, typically by {off:.0f} rad/s where "
            f"flight and bounces leave the spin open by {sigma:.0f} rad/s (tracks {shown}; each of these is "
            f"wrong with a probability of at least {percent(wrong[-1].probability)})"
        )


def percent(probability: float) -> str:
    """For instance `97 %`, `99.9 %`: rounded towards doubt, and never to certainty."""
    for digits in (0, 1):
        least = np.floor(100.0 * 10.0**digits * probability) / 10.0**digits
        if least < 99.0:
            break
    return f"{min(least, 99.9):.{digits}f} %"

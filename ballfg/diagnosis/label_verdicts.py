"""The verdicts on spin labels: which are wrong, how surely, and by how much."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.diagnosis.generic_test import ALARM

SURE: Final = 0.95
"""Probability from which on a label is called wrong."""


@dataclass(frozen=True)
class LabelVerdict:
    """What is said of one spin label.

    Attributes:
        track: its name.
        probability: that the label is wrong.
        off: rad/s, its distance from the spin that the flight shows.
        sigma: rad/s, standard deviation of that spin along this distance, by noise and by the scatter of flight and
            bounces.
    """

    track: str
    probability: float
    off: float
    sigma: float


@dataclass(frozen=True)
class LabelCheck:
    """What is said of all spin labels.

    Attributes:
        p_all_right: probability that every label is right.
        verdicts: on each label, the least probable first.
    """

    p_all_right: float
    verdicts: tuple[LabelVerdict, ...]

    @property
    def contradicted(self) -> tuple[LabelVerdict, ...]:
        """Verdicts on labels that are wrong as good as surely; none where all of them may well be right."""
        if not self.p_all_right < ALARM:
            return ()
        return tuple(verdict for verdict in self.verdicts if verdict.probability >= SURE)

    @property
    def where(self) -> str:
        """In words, which labels contradict their flights."""
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

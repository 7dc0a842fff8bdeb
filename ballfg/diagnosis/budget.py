"""Holds an error budget: the prediction error of a dataset in parts that add up in squares."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

PARTS: Final[Mapping[str, str]] = {
    "observed": "noise of the observed part",
    "spin": "spin that nobody measured",
    "coefficients": "coefficients that differ from track to track",
    "tracker": "memory of the tracker and errors of stamps",
    "bounces": "random motion at bounces",
    "motion": "motion that the model leaves open",
    "samples": "noise of the predicted samples",
    "named": "what the named effects took away",
    "left": "what is left",
}
"""The parts of a budget in words."""
EXPECTED: Final = tuple(name for name in PARTS if name not in ("named", "left"))
"""Parts that the model with its noise expects."""
RECORDED: Final = ("observed", "spin", "tracker", "samples")
"""Parts that come from the recording and that even an exact model would have."""


@dataclass(frozen=True)
class ErrorBudget:
    """The prediction error of the held-out tracks in parts, mm, root mean square over the predicted samples.

    The squares of all parts add up to the square of `total`. A part with a negative square is a negative number: the
    named effects made predictions worse, or errors are smaller than expected.

    Attributes:
        observed: white noise of the observed samples.
        spin: the first spin: the error of its label, or the scatter of spins without a label.
        coefficients: their scatter from track to track.
        tracker: memory of the tracker and errors of stamps, in observed and in predicted samples.
        bounces: random velocity and spin after impacts.
        motion: random acceleration and change of spin between impacts.
        samples: white noise of the predicted samples.
        named: what the named effects of a diagnosis took away; 0 without any.
        left: the rest of the measured error with these effects in the model.
        tracks: number of tracks from which the expected parts come.
    """

    observed: float
    spin: float
    coefficients: float
    tracker: float
    bounces: float
    motion: float
    samples: float
    named: float
    left: float
    tracks: int

    @classmethod
    def of(cls, expected: Mapping[str, float], tracks: int, before_mm: float, after_mm: float) -> "ErrorBudget":
        """The budget of measured errors.

        Args:
            expected: mm^2, mean squares by the names of `EXPECTED`.
            tracks: from which they come.
            before_mm, after_mm: root mean square prediction errors without and with the named effects.
        """
        rest = {"named": before_mm**2 - after_mm**2, "left": after_mm**2 - sum(expected.values())}
        parts = {name: math.copysign(math.sqrt(abs(square)), square) for name, square in {**expected, **rest}.items()}
        return cls(**parts, tracks=tracks)

    @property
    def squares(self) -> dict[str, float]:
        """mm^2, the squares of all parts by name, with the parts' signs; they add up to that of `total`."""
        return {name: getattr(self, name) * abs(getattr(self, name)) for name in PARTS}

    @property
    def floor(self) -> float:
        """mm, the error that the model with its noise expects: the sum of all parts but `named` and `left`."""
        return self._sum(*EXPECTED)

    @property
    def exact(self) -> float:
        """mm, the error that even an exact model would have: the sum of `observed`, `spin`, `tracker`, `samples`."""
        return self._sum(*RECORDED)

    @property
    def measured(self) -> float:
        """mm, the measured error with the named effects: the sum of all parts but `named`."""
        return self._sum(*EXPECTED, "left")

    @property
    def total(self) -> float:
        """mm, the measured error without the named effects: the sum of all parts."""
        return self._sum(*PARTS)

    @property
    def sentence(self) -> str:
        """The distance of the error from its floor, and the largest part of the floor."""
        most = max(EXPECTED, key=self.squares.__getitem__)
        share = 100.0 * self.squares[most] / self.floor**2
        return (
            f"Predictions are off by {self.measured:.1f} mm, {self.measured / self.floor:.2f} times the floor of "
            f"{self.floor:.1f} mm that the model with its noise expects. {share:.0f} % of the floor's square is "
            f"{PARTS[most]}."
        )

    def __repr__(self) -> str:
        rows = {words: getattr(self, name) for name, words in PARTS.items()}
        rows |= {"floor: all but the last two": self.floor, "total": self.total}
        return "\n".join((f"{'prediction error, mm':46}", *(f"{words:46}{part:8.2f}" for words, part in rows.items())))

    def _sum(self, *names: str) -> float:
        """mm, root of the sum of some squares."""
        squares = self.squares
        return math.sqrt(max(sum(squares[name] for name in names), 0.0))

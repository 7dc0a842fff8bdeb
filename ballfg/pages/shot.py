"""A shot holds samples, states, predictions, contacts and hits of one track for drawing."""

from dataclasses import dataclass, field

import numpy as np

from ballfg.arrays import Array
from ballfg.pages.marks import Mark


@dataclass(frozen=True, eq=False)
class ShownShot:
    """The contents of one track's drawing; arrays without rows stand for missing ones.

    Attributes:
        name: of the track.  times: (n,) s, stamps of the samples.  positions: (n, 3) m, as measured.
        noise: (n, 3) m, standard deviation of each measured coordinate; NaN if unknown.  state_times: (m,) s.
        states: (m, 9) position m, velocity m/s, spin rad/s.  state_sigmas: (m, 9) in the same units.
        predicted_times: (k,) s.  predicted: (k, 3) m.  predicted_sigmas: (k, 3) m, of a measured position.
        marks: contacts and hits in the states.
    """

    name: str
    times: Array = field(default_factory=lambda: np.zeros(0))
    positions: Array = field(default_factory=lambda: np.zeros((0, 3)))
    noise: Array = field(default_factory=lambda: np.zeros((0, 3)))
    state_times: Array = field(default_factory=lambda: np.zeros(0))
    states: Array = field(default_factory=lambda: np.zeros((0, 9)))
    state_sigmas: Array = field(default_factory=lambda: np.zeros((0, 9)))
    predicted_times: Array = field(default_factory=lambda: np.zeros(0))
    predicted: Array = field(default_factory=lambda: np.zeros((0, 3)))
    predicted_sigmas: Array = field(default_factory=lambda: np.zeros((0, 3)))
    marks: tuple[Mark, ...] = ()

    @property
    def start(self) -> float:
        """s, the first stamp of all."""
        return float(min(t[0] for t in (self.times, self.state_times, self.predicted_times) if len(t)))

    @property
    def rows(self) -> int:
        """Number of samples, states and predictions."""
        return len(self.times) + len(self.state_times) + len(self.predicted_times)

    def residuals(self) -> Array:
        """(n, 3) m, measured less estimated; NaN at samples without a state."""
        return self.positions - _at(self.times, self.state_times, self.states[:, :3])

    def prediction_errors(self) -> Array:
        """(k, 3) m, measured less predicted; NaN without a measurement."""
        return _at(self.predicted_times, self.times, self.positions) - self.predicted


def _at(times: Array, known: Array, values: Array) -> Array:
    """Rows (m, 3) of the known stamps (m,) at times (n,); NaN at other times."""
    found = np.full((len(times), 3), np.nan)
    if len(known):
        i = np.clip(np.searchsorted(known, times - SAME_STAMP), 0, len(known) - 1)
        same = np.abs(known[i] - times) <= SAME_STAMP
        found[same] = values[i[same]]
    return found


SAME_STAMP = 1e-9  # s. Tables keep all digits of a stamp, so that those of one sample agree far better.

"""The range of speeds, spins and places that a model was fitted on, and what lies outside of it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_instance, check_number, shown
from ballfg.tracks import Track

RADIUS: Final = "radius"
UNITS: Final = {RADIUS: "m", "x": "m", "y": "m", "z": "m", "speed": "m/s", "spin": "rad/s"}
"""Quantities with their units; a spin is known of labelled tracks alone."""
SPAN: Final = 0.1  # s, over which a speed is measured: 5 mm of noise are 0.07 m/s
RARE: Final = 0.002  # share of the samples at either end that are no part of the range: outliers of trackers
BESIDE: Final = 0.1  # share of its width by which a range may be left: tracks of the same shots do
FEW: Final = 0.05  # share of samples outside that is not worth a word


@dataclass(frozen=True)
class Domain:
    """The tracks that a model was fitted on: smallest and largest value of the quantities of `UNITS` that are known.

    Raises: ValueError: an unknown quantity, or a range that is not a pair of growing numbers.
    """

    ranges: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        check_instance("domain", self.ranges, Mapping, "Write domain: {speed: [2.0, 9.0]}.")
        for name, ends in self.ranges.items():
            pair = isinstance(ends, list | tuple) and len(ends) == 2
            if name not in UNITS or not pair or not check_number(name, ends[0]) <= check_number(name, ends[1]):
                rule = f"domain must map {', '.join(UNITS)} to pairs of growing numbers"
                raise ValueError(f"{rule}; got {shown(name)}: {shown(ends)}. Write domain: {{speed: [2.0, 9.0]}}.")
        object.__setattr__(self, "ranges", {name: (float(a), float(b)) for name, (a, b) in self.ranges.items()})

    @classmethod
    def of(cls, tracks: Iterable[Track], radii: Sequence[float] = ()) -> Self | None:
        """The ranges of tracks; None without samples. Args: radii: m, of their balls."""
        found = [quantities(track) for track in tracks]
        held = {name: [own[name] for own in found if name in own] for name in UNITS}
        ends = {n: np.quantile(np.concatenate(v), (RARE, 1.0 - RARE)) for n, v in held.items() if v}
        if not ends:
            return None
        balls = {RADIUS: (min(radii), max(radii))} if radii else {}
        return cls(balls | {name: (float(f"{a:.4g}"), float(f"{b:.4g}")) for name, (a, b) in ends.items()})

    def nearest_radius(self, radius: float) -> float | None:
        """m, the radius nearest to another one among those of its balls; None where they are not known."""
        return float(np.clip(radius, *self.ranges[RADIUS])) if RADIUS in self.ranges else None

    def to_mapping(self) -> dict[str, list[float]]:
        """The section of a model file."""
        return {name: list(ends) for name, ends in self.ranges.items()}

    def doubts(self, tracks: Iterable[Track], model: object) -> list[str]:
        """A sentence on samples of tracks outside of the ranges, if they are more than `FEW`. Args: model: its name."""
        found = [quantities(track) for track in tracks]
        beyond = [{name: self._beyond(name, own[name]) for name in self.ranges if name in own} for own in found]
        outside = np.concatenate([np.any(list(own.values()), axis=0) for own in beyond]).mean() if beyond else 0.0
        if not outside > FEW:
            return []
        shares = {n: np.mean([own[n].mean() for own in beyond if n in own] or [0]) for n in self.ranges}
        far = [n for n in shares if shares[n] > FEW] or [n for n in shares if shares[n] > 0.0]  # few each, many in all
        words = (f"{n} {self.ranges[n][0]:.3g} to {self.ranges[n][1]:.3g} {UNITS[n]}" for n in far)
        return [f"{100 * outside:.0f} % of the samples lie outside of what {model} was fitted on ({', '.join(words)})"]

    def _beyond(self, name: str, values: Array) -> Any:
        """Whether values (n,) of a quantity lie outside of its range."""
        low, high = self.ranges[name]
        return np.abs(values - 0.5 * (low + high)) > (0.5 + BESIDE) * (high - low)


def quantities(track: Track) -> dict[str, Array]:
    """(n,) places m, speed m/s and, where it is labelled, spin rad/s at the n samples of a track."""
    t, found = track.seconds, dict(zip("xyz", track.positions.T, strict=True))
    after = np.minimum(np.searchsorted(t, t + SPAN), len(t) - 1)
    before = np.minimum(np.searchsorted(t, t[after] - SPAN), np.maximum(after - 1, 0))
    way = np.linalg.norm(track.positions[after] - track.positions[before], axis=1)
    found["speed"] = way / np.maximum(t[after] - t[before], 1e-9)
    if track.spin_label is not None:
        found["spin"] = np.full(len(t), float(np.linalg.norm(track.spin_label)))
    return found

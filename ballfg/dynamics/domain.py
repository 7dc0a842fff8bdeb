"""The range of speeds, spins and places that a model was fitted on, and what lies outside of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_instance, check_number, shown
from ballfg.tracks import Track

UNITS: Final = {"x": "m", "y": "m", "z": "m", "speed": "m/s", "spin": "rad/s"}
"""Quantities with their units; a spin is known of labelled tracks alone."""
SPAN: Final = 0.1
"""s, over which a speed is measured: 5 mm of noise are 0.07 m/s."""
RARE: Final = 0.002
"""Share of the samples at either end that are no part of the range: outliers of trackers."""
BESIDE: Final = 0.1
"""Share of its width by which a range may be left: tracks of the same shots do."""
FEW: Final = 0.05
"""Share of samples outside that is not worth a word."""


@dataclass(frozen=True)
class Domain:
    """The tracks that a model was fitted on, by their ranges.

    Attributes:
        ranges: smallest and largest value of the quantities of `UNITS` that are known.
    Raises: ValueError: an unknown quantity, or a range that is not a pair of growing numbers.
    """

    ranges: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        check_instance("domain", self.ranges, Mapping, "Write domain: {speed: [2.0, 9.0]}.")
        for name, limits in self.ranges.items():
            pair = isinstance(limits, list | tuple) and len(limits) == 2
            if name not in UNITS or not pair or not check_number(name, limits[0]) <= check_number(name, limits[1]):
                rule = f"domain must map {', '.join(UNITS)} to pairs of growing numbers"
                raise ValueError(f"{rule}; got {shown(name)}: {shown(limits)}. Write domain: {{speed: [2.0, 9.0]}}.")
        object.__setattr__(
            self, "ranges", {name: (float(low), float(high)) for name, (low, high) in self.ranges.items()}
        )

    @classmethod
    def of(cls, tracks: Iterable[Track]) -> Domain | None:
        """The ranges of tracks; None without samples."""
        held: dict[str, list[Array]] = {}
        for track in tracks:
            for name, values in quantities(track).items():
                held.setdefault(name, []).append(values)
        limits = {name: np.quantile(np.concatenate(values), (RARE, 1.0 - RARE)) for name, values in held.items()}
        ranges = {name: (float(f"{low:.4g}"), float(f"{high:.4g}")) for name, (low, high) in limits.items()}
        return cls(ranges) if ranges else None

    def to_mapping(self) -> dict[str, list[float]]:
        """The section of a model file."""
        return {name: list(limits) for name, limits in self.ranges.items()}

    def doubts(self, tracks: Iterable[Track], model: object) -> list[str]:
        """A sentence on samples of tracks outside of the ranges, if they are more than `FEW`. Args: model: its name."""
        count, outside, by_name = 0, 0, dict.fromkeys(self.ranges, 0)
        for track in tracks:
            held = quantities(track)
            beyond = {name: self._beyond(name, held[name]) for name in self.ranges if name in held}
            count, outside = count + len(track), outside + int(np.any(list(beyond.values()), axis=0).sum())
            for name, values in beyond.items():
                by_name[name] += int(values.sum())
        if outside <= FEW * count:
            return []
        far = [name for name, number in by_name.items() if number > FEW * count]
        ranges = ", ".join(
            f"{name} {self.ranges[name][0]:.3g} to {self.ranges[name][1]:.3g} {UNITS[name]}" for name in far
        )
        return [f"{100 * outside / count:.0f} % of the samples lie outside of what {model} was fitted on ({ranges})"]

    def _beyond(self, name: str, values: Array) -> Any:
        """Whether values (n,) of a quantity lie outside of its range."""
        low, high = self.ranges[name]
        margin = BESIDE * (high - low)
        return (values < low - margin) | (values > high + margin)


def quantities(track: Track) -> dict[str, Array]:
    """(n,) places m, speed m/s and, where it is labelled, spin rad/s at the n samples of a track."""
    found = dict(zip("xyz", track.positions.T, strict=True))
    after = np.minimum(np.searchsorted(track.seconds, track.seconds + SPAN), len(track) - 1)
    before = np.searchsorted(track.seconds, track.seconds[after] - SPAN)
    before = np.minimum(before, np.maximum(after - 1, 0))
    if len(track) > 1:
        way = np.linalg.norm(track.positions[after] - track.positions[before], axis=1)
        found["speed"] = way / np.maximum(track.seconds[after] - track.seconds[before], 1e-9)
    if track.spin_label is not None:
        found["spin"] = np.full(len(track), float(np.linalg.norm(track.spin_label)))
    return found

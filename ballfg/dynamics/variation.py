"""A variation gives a coefficient another value for each group of tracks, by a label or along the recording.

A ball may be a new one after the lunch break, or a table may lean in one of two sessions. A model then holds one value
for each group of tracks, or for each part of the recording, and `BallModel.for_track` gives the model of one track.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ballfg.checks import check_number, listed, shown
from ballfg.tracks import Track
from ballfg.tracks.track import level_of

TRACK: Final = "track"  # Takes the place of a label's name: tracks are told apart by their own names
_FIELDS: Final = ("by", "values", "line")


def place_of(name: str) -> tuple[tuple[bool, int, str], ...]:
    """A key that sorts names of tracks as people do: "9" before "10", and "a2" before "b1"."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((False, int(part), "") if part[0] in "0123456789" else (True, 0, part) for part in parts)


def number_of(name: str) -> int | None:
    """The last number in the name of a track; None if it has none."""
    numbers = re.findall(r"[0-9]+", name)
    return int(numbers[-1]) if numbers else None


@dataclass(frozen=True)
class Variation:
    """The differences of one coefficient between tracks.

    Attributes:
        by: the label that tells tracks apart, or "track" for their place in the recording, which their names tell.
        values: the coefficient by the label's text; or by the name of the track from which it holds until the next
            named one. A track with another label, or before the first name, has the model's own value.
        line: for places in the recording: the coefficient is interpolated linearly over the numbers in the tracks'
            names, and constant beyond them.

    Raises:
        ValueError: if there is no value, one is not finite, or a line lacks numbers in its names.
        TypeError: if a value is no number.
    """

    by: str
    values: Mapping[str, float]
    line: bool = False

    def __post_init__(self) -> None:
        if not self.values:
            raise ValueError("values must hold at least one number, by label or by name of a track; got none")
        for key, value in self.values.items():
            check_number(f"values[{shown(key)}]", value)
        if self.line and (self.by != TRACK or any(number_of(name) is None for name in self.values)):
            raise ValueError(
                f"line must be false unless by is '{TRACK}' and every track in values has a number in its name; got by "
                f"{shown(self.by)} and {listed(self.values)}. Leave line out for values that hold until the next one."
            )

    def value(self, track: Track) -> float | None:
        """The coefficient of a track; None for the model's own value."""
        if self.by != TRACK:
            label = track.labels.get(self.by)
            return None if label is None else self.of_label(label)
        if self.line:
            place = number_of(track.name)
            known = np.array(sorted((float(number_of(name) or 0), value) for name, value in self.values.items()))
            return None if place is None else float(np.interp(place, known[:, 0], known[:, 1]))
        begun = [name for name in self.values if place_of(name) <= place_of(track.name)]
        return self.values[max(begun, key=place_of)] if begun else None

    def of_label(self, label: float | str) -> float | None:
        """The coefficient by a label's value; None for the model's own value."""
        level = level_of(label, self.values)
        return None if level is None else self.values[level]

    @classmethod
    def from_mapping(cls, content: Any) -> "Variation":
        """A variation from its section in a model file.

        Raises:
            ValueError: if an entry is missing, unknown or of another kind.
            TypeError: if a value is no number.
        """
        if not isinstance(content, Mapping) or not {"by", "values"} <= set(content) <= set(_FIELDS):
            raise ValueError(
                f"must be a mapping with 'by' (a label, or '{TRACK}'), 'values' (numbers by label or by name of a "
                f"track) and perhaps 'line' (true or false); got {shown(content)}"
            )
        by, values, line = content["by"], content["values"], content.get("line", False)
        if not isinstance(by, str) or not isinstance(values, Mapping) or not isinstance(line, bool):
            raise ValueError(f"'by' must be text, 'values' a mapping and 'line' true or false; got {shown(content)}")
        return cls(by, {str(key): check_number(f"values[{shown(str(key))}]", v) for key, v in values.items()}, line)

    def to_mapping(self) -> dict[str, Any]:
        """The mapping that `from_mapping` reads."""
        line = {"line": True} if self.line else {}
        return {"by": self.by, "values": dict(self.values), **line}


def values_of_track(variations: Mapping[str, Variation], track: Track) -> dict[str, float]:
    """The values that a track gives to varying coefficients, by name."""
    found = {name: variation.value(track) for name, variation in variations.items()}
    return {name: value for name, value in found.items() if value is not None}


def values_of_group(variations: Mapping[str, Variation], by: str, group: str) -> dict[str, float]:
    """The values that a group of tracks gives to varying coefficients, by name.

    Args: by: the label that names groups.  group: its value.
    """
    found = {name: variation.of_label(group) for name, variation in variations.items() if variation.by == by}
    return {name: value for name, value in found.items() if value is not None}

"""Determines units and up axis from names and from the fall, and rotates positions to a frame with z up."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.importing.choices import Choices, Guess, UndecidedError
from ballfg.importing.fall import AXES, LENGTHS, TIMES, Scale, Shot, odds, scales
from ballfg.tracks.track import SPIN_LABELS, Label

_LIKELY: Final = 2.0  # least odds of the best reading against the next
SURE: Final = 4.0
_AGAINST: Final = 4.0  # odds against a stated unit from which it is doubted
_LEAST_SCORE: Final = 0.12  # least score of a falling ball
_CLEAR_SCORE: Final = 0.3  # the same of a reading that is proposed against a stated one
_CHANCE: Final = 5  # stretches that fall as well by chance at one of many rates
RATES: Final = (24, 25, 30, 50, 60, 90, 100, 120, 125, 150, 180, 200, 240, 250, 300, 360, 400, 480, 500, 600, 960, 1000)
"""Hz, of usual cameras."""
_NAMES: Final = {"length": "unit of length", "time": "unit of time", "up": "up axis"}
_DECIMAL: Final = ("m", "cm", "mm")

TURNS: Final = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
"""For each up axis the rotation to a frame with z up; its determinant is one."""


@dataclass(frozen=True)
class Frame:
    """The conversion of numbers to metres and seconds in a frame with z up."""

    length: str
    time: str
    up: str
    flip: str | None
    drag: float | None  # 1/m, from the falls
    windows: int = 0
    doubts: tuple[str, ...] = ()
    other_ball: float = 1.0  # as of `Scale`

    def metres(self, positions: Array) -> Array:
        """(n, 3) m, in the axes of the source."""
        size = LENGTHS[self.length]
        inverse = round(1.0 / size)
        return positions / inverse if abs(inverse * size - 1.0) < 1e-12 else positions * size

    def turned(self, positions: Array) -> Array:
        """(n, 3) in the frame with z up."""
        signs = np.array([-1.0 if axis == self.flip else 1.0 for axis in "xyz"])
        return (positions * signs) @ np.array(TURNS[self.up], dtype=np.float64).T + 0.0

    def turned_spin(self, labels: Mapping[str, Label]) -> Mapping[str, Label]:
        """The labels of a shot with its spin in the frame with z up; of a mirrored frame it turns the other way."""
        spin = [labels.get(name) for name in SPIN_LABELS]
        if not all(isinstance(one, int | float) for one in spin):
            return labels
        (turned,) = self.turned(np.array([spin], dtype=np.float64)) * (1.0 if self.flip is None else -1.0) + 0.0
        return {**labels, **dict(zip(SPIN_LABELS, turned.tolist(), strict=True))}

    @property
    def rotation(self) -> str:
        """The turn in words."""
        axes = []
        for row in TURNS[self.up]:
            i = int(np.flatnonzero(row)[0])
            minus = (row[i] < 0) != ("xyz"[i] == self.flip)
            axes.append(f"{'-' if minus else ''}{'xyz'[i]}")
        return f"new x, y, z = old {', '.join(axes)}"


def find_frame(
    shots: Sequence[Shot], choices: Choices, stated_length: str | None, stated_time: str | None, time_why: str
) -> tuple[Frame, list[Guess]]:
    """The units and the up axis, with a line of the proposal for each.

    Args: shots: stamps (n,) and positions (n, 3).  stated_length, stated_time: from the source's names.
        time_why: the reason for a known unit of time.
    Raises: UndecidedError: nothing falls, two readings are alike, or names contradict the fall.
    """
    if choices.flip:
        signs = np.array([-1.0 if axis == choices.flip else 1.0 for axis in "xyz"])
        shots = [(t, p * signs) for t, p in shots]
    known_length = choices.length or (stated_length if stated_length in LENGTHS else None)
    known_time = choices.time or (stated_time if stated_time in TIMES else None)
    lengths = (known_length,) if known_length else tuple(LENGTHS)
    times = (known_time,) if known_time else tuple(TIMES)
    ups = (choices.up,) if choices.up else AXES
    found = scales(shots, lengths, times, ups)
    decided = len(lengths) == len(times) == len(ups) == 1
    _contradiction(shots, found, choices, {"length": known_length, "time": known_time}, ups)
    if not found and not decided:
        _no_flight(shots, known_length, known_time)
    best = found[0] if found else Scale(lengths[0], times[0], ups[0], 0.0, 0, 0.0)
    for option, values in (("length", lengths), ("time", times), ("up", ups)):
        if len(values) > 1:
            _decide(option, best, found)
    lines = [
        _line("length", best, found, choices.length, stated_length, "named in the source"),
        _line("time", best, found, choices.time, stated_time, time_why),
        _line("up", best, found, choices.up, None, ""),
    ]
    drag = best.drag if best.score >= _LEAST_SCORE else None
    doubts = [f"the {line.what} is likely {line.value}: {line.why}" for line in lines if line.sure == "likely"]
    doubts += _better(shots, best) if choices.length or choices.time or choices.up else []
    frame = Frame(best.length, best.time, best.up, choices.flip, drag, best.windows, tuple(doubts), best.other_ball)
    hand, sure = "taken for right-handed: positions cannot show it", "likely"
    if choices.flip:
        hand, sure = f"mirrored along {choices.flip} as stated", "stated"
    lines.append(Guess("turn", frame.rotation, hand, sure, "--flip y"))
    return frame, lines


def _better(shots: Sequence[Shot], chosen: Scale) -> list[str]:
    """A sentence where the balls fall in another reading than the stated one."""
    free = scales(shots)
    if not free or free[0].score < _CLEAR_SCORE or odds(free[0].score, chosen.score) < _AGAINST:
        return []
    best = free[0]
    given = f"{chosen.length} and {chosen.time} with {chosen.up} up as given"
    return [f"balls fall at 9.81 m/s^2 in {best.length} and {best.time} with {best.up} up, not in {given}"]


def likely_rate(shots: Sequence[Shot], length: str | None) -> int | None:
    """The usual camera rate at which balls fall with gravity, of frames (n,) and positions (n, 3) in a unit."""
    lengths = (length,) if length in LENGTHS else _DECIMAL
    found = {rate: scales([(t / rate, p) for t, p in shots], lengths, ("s",)) for rate in RATES}
    known = {rate: best[0] for rate, best in found.items() if best and best[0].score >= _LEAST_SCORE}
    shrunk = {rate: one.score * one.windows / (one.windows + _CHANCE) for rate, one in known.items()}
    return max(shrunk, key=shrunk.__getitem__, default=None)


def _line(
    option: str, best: Scale, found: Sequence[Scale], chosen: str | None, stated: str | None, named: str
) -> Guess:
    value = getattr(best, option)
    why, sure = f"balls fall at 9.81 m/s^2 in it: {best.score:.0%} of {best.windows} short stretches agree", "likely"
    if chosen:
        why, sure = "as given", "stated"
    elif stated == value:
        why, sure = f"{named}, and the fall agrees" if best.score > _LEAST_SCORE else named, "sure"
    elif _ratio(option, best, found) >= SURE:
        sure = "sure"
    return Guess(_NAMES[option], value, why, sure, f"--{option} {value}")


def _ratio(option: str, best: Scale, found: Sequence[Scale]) -> float:
    other = next((one for one in found if getattr(one, option) != getattr(best, option)), None)
    return np.inf if other is None else odds(best.score, other.score)


def _decide(option: str, best: Scale, found: Sequence[Scale]) -> None:
    ratio = _ratio(option, best, found)
    if ratio >= _LIKELY and best.score >= _LEAST_SCORE:
        return
    values = list(dict.fromkeys(getattr(one, option) for one in found))[:3]
    if ratio == np.inf:
        values = [getattr(best, option)]
    what = f"the {_NAMES[option]} does not show in the fall of the ball, which fits {best.score:.0%} of the flight"
    raise UndecidedError(what, option, values)


def _no_flight(shots: Sequence[Shot], length: str | None, time: str | None) -> None:
    steps = np.concatenate([np.diff(t) for t, _ in shots]) if shots else np.zeros(1)
    step = float(np.median(steps))
    if not step > 0.0 and (steps > 0.0).any():
        raise UndecidedError("most stamps have several positions, as of two balls", "columns", (), "trajectory=NAME")
    if not step > 0.0:
        raise UndecidedError("the times do not increase", "columns", (), "t=NAME")
    what = f"no stretch of flight is long enough to show the units: the median step of the times is {step:g}"
    option, example = ("time", "ms") if time is None else ("length", "mm") if length is None else ("up", "z")
    raise UndecidedError(what, option, (), example)


def _contradiction(
    shots: Sequence[Shot],
    found: Sequence[Scale],
    choices: Choices,
    stated: Mapping[str, str | None],
    ups: Sequence[str],
) -> None:
    """Refuses units from names with which nothing falls, if other units fit."""
    given = {"length": choices.length, "time": choices.time}
    doubted = {option: value for option, value in stated.items() if value and not given[option]}
    if not doubted:
        return
    lengths = (choices.length,) if choices.length else tuple(LENGTHS)
    times = (choices.time,) if choices.time else tuple(TIMES)
    free = scales(shots, lengths, times, ups)
    score = found[0].score if found else 0.0
    if not free or free[0].score < _LEAST_SCORE or odds(free[0].score, score) < _AGAINST:
        return
    # of two stated units, the one that has to change is wrong; if either would do, both are tried in turn
    for option, value in doubted.items():
        others = [one for one in free if getattr(one, option) != value]
        kept = {name: unit for name, unit in doubted.items() if name != option}
        alone = [one for one in others if all(getattr(one, name) == unit for name, unit in kept.items())]
        if alone and odds(alone[0].score, score) >= _AGAINST:
            other = getattr(alone[0], option)
            what = f"the names say {value}, but balls fall at 9.81 m/s^2 if it is {other}"
            raise UndecidedError(what, option, (other, value))

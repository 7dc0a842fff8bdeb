"""Determines role and unit of a column from its name."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

LENGTH_UNITS: Final = {
    "m": "m", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "cm": "cm", "centimeter": "cm", "centimeters": "cm", "centimetre": "cm", "centimetres": "cm",
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "in": "in", "inch": "in", "inches": "in",
    "ft": "ft", "foot": "ft", "feet": "ft",
}  # fmt: skip
TIME_UNITS: Final = {
    "s": "s", "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sek": "s",
    "ms": "ms", "msec": "ms", "millis": "ms", "millisecond": "ms", "milliseconds": "ms",
    "us": "us", "µs": "us", "μs": "us", "usec": "us", "micros": "us", "microsecond": "us", "microseconds": "us",
    "ns": "ns", "nsec": "ns", "nanos": "ns", "nanosec": "ns", "nanosecond": "ns", "nanoseconds": "ns",
}  # fmt: skip
PIXELS: Final = ("px", "pix", "pixel", "pixels")

_TIME: Final = (
    "t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "ts", "seconds", "second", "secs", "sec",
    "datetime", "clock", "elapsed", "date", "zeit",
    "temps", "tiempo", "tempo", "tid", "czas", "waktu", "millis", "时间",
)  # fmt: skip
_FRAME: Final = ("frame", "frames", "framenumber", "frameid", "frameidx", "frameno", "bild", "imagen", "fr")
_TRAJECTORY: Final = (
    "trajectory", "trajectories", "traj", "shot", "track", "throw", "rally", "run", "trial", "serve", "stroke",
    "ball", "wurf", "schuss", "versuch", "tir", "essai", "tiro", "sequence", "segment", "recording", "episode", "file",
    "object", "marker", "body", "player", "id",
)  # fmt: skip
_NOT_A_POSITION: Final = frozenset((
    "v", "vx", "vy", "vz", "vel", "velocity", "speed", "a", "acc", "accel", "acceleration", "w", "omega", "spin", "ang",
    "angular", "rot", "rotation", "q", "quat", "quaternion", "orientation", "dx", "dy", "dz", "racket", "paddle", "bat",
    "robot", "target", "camera", "cam", "player", "euler", "force", "gyro", "hand", "truth",
))  # fmt: skip
IDENTITIES: Final = ("ball", "object", "marker", "body", "player", "id", "name", "label", "target")
"""Names of columns that tell several balls apart."""
_SEEN: Final = frozenset(("valid", "visible", "tracked", "detected", "seen", "visibility", "validity"))
_SIGMA: Final = frozenset(("sigma", "std", "stddev", "stdev", "sd", "err", "error", "uncertainty", "unc"))
_FILLER: Final = frozenset((
    "pos", "position", "positions", "ball", "center", "centre", "coord", "coords", "coordinate", "p", "point", "loc",
    "location", "translation", "axis", "world", "xyz", "pose", "koordinate", "header", "data", "col", "column", "achse",
    "measured", "measurement", "tracked", "value", "ballpos",
))  # fmt: skip
_AXIS: Final = {"x": "x", "y": "y", "z": "z", "0": "x", "1": "y", "2": "z", "east": "x", "north": "y", "up": "z",
    "height": "z", "altitude": "z", "elevation": "z"}  # fmt: skip
_WORDS: Final = re.compile(r"[^\W\d_]+|\d+")
_CAMEL: Final = re.compile(r"(?<=[a-zµ])(?=[A-Z])")
_BRACKET: Final = re.compile(r"[\[(/{]\s*([^\W\d]+)\s*[\])}]?\s*$")


@dataclass(frozen=True)
class Meaning:
    """One reading of a column's name."""

    role: str
    """t, frame, trajectory, x, y, z, sigma_x, sigma_y, sigma_z, seconds or nanoseconds (of a stamp in two parts)."""
    rank: int  # 0 for an unambiguous name; larger for vaguer ones
    unit: str | None = None  # as in the name, normalised; unknown text in brackets stays as it is
    group: str = ""  # the other words of the name: x, y and z with the same ones belong together


def unit_of_text(text: str) -> str | None:
    """The unit in a text, normalised; None without one."""
    word = text.strip().strip("[](){}").strip().lower()
    return LENGTH_UNITS.get(word) or TIME_UNITS.get(word) or ("px" if word in PIXELS else None)


def words_of(name: str) -> list[str]:
    """The words of a column's name, in small letters."""
    return [word.lower() for part in _WORDS.findall(name) for word in _CAMEL.split(part)]


def meanings(name: str) -> list[Meaning]:
    """Possible roles of a column with this name."""
    name, _, copy = name.partition("#")
    bracket = _BRACKET.search(name)
    unit_text = bracket[1] if bracket else None
    bare = name[: bracket.start()] if bracket else name
    words = words_of(bare)
    found = [_as_time(words, unit_text), _as_place(words, unit_text), _as_trajectory(words)]
    known = [meaning for meaning in found if meaning is not None]
    return [replace(one, rank=one.rank + 1, group=f"{one.group}#{copy}") for one in known] if copy else known


def says_seen(name: str) -> bool:
    """True of a column that tells whether the ball was seen, such as `is_valid` or `ball visible`."""
    words = set(words_of(name)) - {"is", "ball", "was"}
    return len(words) == 1 and words <= _SEEN


def names_ball(name: str) -> bool:
    """True of a column that tells balls apart, such as `marker` or `id`: a ball may be thrown again and again."""
    return bool(set(words_of(name)) & set(IDENTITIES)) and not set(words_of(name)) & (
        set(_TRAJECTORY) - set(IDENTITIES)
    )


def _as_time(words: list[str], bracket: str | None) -> Meaning | None:
    unit = _unit(bracket, TIME_UNITS)
    if not words:
        return None
    rest = [word for word in words if word not in ("header", "frame", "capture", "ros", "unix", "epoch", "data")]
    if words[-1] in ("nanosec", "nsec", "nsecs", "nanosecs") and {"stamp", "sec"} & set(words):
        return Meaning("nanoseconds", 0)
    if words[-1] in ("sec", "secs") and "stamp" in words:
        return Meaning("seconds", 0)
    if len(rest) > 1 and unit is None and rest[-1] in TIME_UNITS:
        unit, rest = TIME_UNITS[rest[-1]], rest[:-1]
    if rest == ["time", "stamp"]:
        rest = ["timestamp"]
    if len(rest) == 1 and rest[0] in _TIME:
        own = TIME_UNITS.get(rest[0]) if rest[0] not in ("t", "s") else None
        exact = rest[0] in ("t", "time", "timestamp", "stamp") and rest == words
        return Meaning("t", 0 if exact else 1, unit or own)
    joined = "".join(words)
    if joined in _FRAME or (
        words[0] in _FRAME and len(words) <= 2 and words[-1] in ("frame", "id", "no", "index", "number", "idx", "nr")
    ):
        return Meaning("frame", 0)
    if set(rest) & set(_TIME[:7]):
        return Meaning("t", 2, unit)
    return None


def _as_place(words: list[str], bracket: str | None) -> Meaning | None:
    unit = _unit(bracket, LENGTH_UNITS)
    if bracket is not None and bracket.lower() in PIXELS:
        unit = "px"
    if unit is None and len(words) > 1 and words[-1] in (*LENGTH_UNITS, "px"):
        unit, words = LENGTH_UNITS.get(words[-1], words[-1]), words[:-1]
    words = [part for word in words for part in (word if word in ("xyz",) else _split(word))]
    axes = [word for word in words if word in _AXIS]
    axes = [word for word in axes if not word.isdigit()] or axes  # "marker1_x" and "x_1" are both along x
    if not axes:
        return None
    others = [word for word in words if word != axes[-1]]
    axis, group, unique = _AXIS[axes[-1]], ".".join(others), set(others)
    if unique & _NOT_A_POSITION:
        return None
    if unique & _SIGMA:
        return Meaning(f"sigma_{axis}", 0, unit, group)
    if axes[-1].isdigit() and not unique & _FILLER:
        return None
    rank = 0 if not others else 1 if unique <= _FILLER or "ball" in unique else 2
    return Meaning(axis, rank, unit, group)


def _split(word: str) -> list[str]:
    """Names written in one word, such as posx or ballz."""
    for start in ("position", "ballpos", "coord", "ball", "pos", "sigma", "std", "p", "s"):
        if word.startswith(start) and word.removeprefix(start) in ("x", "y", "z"):
            return [{"s": "sigma"}.get(start, start), word[-1]]
    return [word]


def _as_trajectory(words: list[str]) -> Meaning | None:
    kept = [word for word in words if word not in ("id", "nr", "no", "number", "index", "name", "num", "idx")]
    word = kept[0] if kept else "id"
    word = word if word in _TRAJECTORY else word.removesuffix("id")
    known = len(kept) <= 1 and words and word in _TRAJECTORY
    return Meaning("trajectory", _TRAJECTORY.index(word)) if known else None


def _unit(text: str | None, units: Mapping[str, str]) -> str | None:
    return None if text is None else units.get(text.lower(), text)

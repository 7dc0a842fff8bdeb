"""Reads, checks and writes `dataset.yaml`, the description of a dataset."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from ballfg.checks import (
    MAX_LISTED,
    check_name,
    check_number,
    check_range,
    check_text,
    did_you_mean,
    is_text,
    listed,
    nearest,
    shown,
    type_name,
)
from ballfg.files.strict_yaml import YamlError, read_yaml
from ballfg.tracks.noise import TrackNoise

INFO_FILE = "dataset.yaml"
NO_SURFACE = "none"  # in place of a table's height
_REQUIRED = ("name", "frame", "ball")
_OPTIONAL = ("rate", "position_noise", "spin_noise", "source", "licence")
_FIELDS = {"frame": ("up", "table_height", "table"), "ball": ("radius", "mass"), "lamp": ("place", "sigma")}
_KNOWN = (*_REQUIRED, *_OPTIONAL, "noise", "labels", "import", "doubts", "lamp")

# The largest plausible values in SI units; larger ones are almost surely in another unit.
_RADII = (1e-4, 0.5)  # m
_MASSES = (1e-6, 2.0)  # kg
MAX_HEIGHT = 50.0  # m
_MAX_POSITION_NOISE = 1.0  # m
_MAX_SPIN_NOISE = 5000.0  # rad/s
_MIN_NOISE = 1e-9  # m or rad/s; weights of less leave no digits for the motion
_MAX_TABLE_PLACE = 1000.0  # m from the origin, as for positions
_TABLE_SIZES = (0.1, 50.0)  # m, least and most from one end to the other; a tennis court is 24 m long


@dataclass(frozen=True)
class Ball:
    """A homogeneous ball.

    Raises: ValueError: a value that is not a positive number or cannot be in SI units.
    """

    radius: float
    """m"""
    mass: float
    """kg"""

    def __post_init__(self) -> None:
        for key, unit, (least, limit), other in (("radius", "m", _RADII, "mm"), ("mass", "kg", _MASSES, "g")):
            value, label = getattr(self, key), f"ball.{key}"
            checked = check_number(label, value, unit, above=0.0, least=least, limit=limit, instead=other)
            object.__setattr__(self, key, checked)


TABLE_TENNIS = Ball(radius=0.02, mass=0.0027)
"""ITTF, The Laws of Table Tennis, 2.3: diameter 40 mm, 2.7 g."""
TENNIS = Ball(radius=0.0335, mass=0.0577)  # ITF Rules of Tennis, Appendix I, type 2: middle of the limits


@dataclass(frozen=True)
class Lamp:
    """A lamp whose shadow of the ball on the table was seen. Raises: ValueError, TypeError: a place that is none."""

    place: tuple[float, float, float]  # (x, y, z) m, in the frame of the dataset
    sigma: float = 0.0  # m, standard deviation of each coordinate; 0: exact

    def __post_init__(self) -> None:
        if not isinstance(self.place, tuple | list) or len(self.place) != 3:
            raise TypeError(f"lamp.place must be three numbers in m; got {shown(self.place)}. Write [x, y, z].")
        place = (check_number("lamp.place", one, "m", limit=MAX_HEIGHT, instead="mm") for one in self.place)
        object.__setattr__(self, "place", tuple(place))
        object.__setattr__(self, "sigma", check_range("lamp.sigma", self.sigma, 0.0, _MAX_POSITION_NOISE))


@dataclass(frozen=True)
class DatasetInfo:
    """The content of `dataset.yaml`. The frame's up axis is always z.

    Raises: ValueError, TypeError: a field of a wrong type or range; the message names it.
    """

    name: str  # one line of text
    table_height: float | None
    """z of the table's surface, m; None where balls meet no surface (`table_height: none` in the file)."""
    ball: Ball  # radius (m) and mass (kg)
    rate: float | None = None  # nominal sampling rate, Hz. Computations use the stamps of the tracks
    position_noise: float | None = None  # standard deviation of one measured coordinate, m
    spin_noise: float | None = None  # standard deviation of one component of the spin labels, rad/s
    source: str | None = None  # origin of the data
    licence: str | None = None  # terms of use
    table_extent: tuple[float, float, float, float] | None = None
    """(x_low, x_high, y_low, y_high) m, the table's ends; None if unknown."""
    noise: TrackNoise | None = None
    """All known noise of the tracks, as from `ballfg noise`; it takes precedence over the two numbers above."""
    imported: Mapping[str, Any] | None = None
    """Origin and conversion of the tracks, as `ballfg import` records them in the section `import`; for people."""
    doubts: tuple[str, ...] = ()  # what is not sure about the tracks, one line of text each; commands repeat it
    lamp: Lamp | None = None  # lamp of the shadows that the dataset holds

    def __post_init__(self) -> None:
        check_name("name", self.name)
        if not isinstance(self.doubts, tuple | list) or not all(
            isinstance(one, str) and is_text(one) for one in self.doubts
        ):
            rule = "doubts must be a list of texts, each of one line"
            raise ValueError(f"{rule}; got {shown(self.doubts)}. Write doubts: ['units were guessed'].")
        object.__setattr__(self, "doubts", tuple(self.doubts))
        for key in ("source", "licence"):
            check_text(key, getattr(self, key), optional=True)
        if not isinstance(self.noise, TrackNoise | None):
            raise TypeError(f"noise must be a TrackNoise or None; got {type(self.noise).__name__}.")
        if not isinstance(self.imported, Mapping | None):
            raise TypeError(f"import must be a mapping; got {type_name(self.imported)}. Delete the section.")
        if not isinstance(self.ball, Ball):
            raise TypeError(f"ball must be a Ball; got {type(self.ball).__name__}. Pass Ball(radius, mass).")
        if self.table_height is not None:
            height = check_number("frame.table_height", self.table_height, "m", limit=MAX_HEIGHT, instead="mm")
            object.__setattr__(self, "table_height", height)
        elif self.table_extent is not None:
            raise ValueError(
                "frame.table must be absent where frame.table_height is none. Delete it, or give the height."
            )
        for key, unit, least, limit, instead in (
            ("rate", "Hz", 1e-3, 1e7, "mHz"),
            ("position_noise", "m", _MIN_NOISE, _MAX_POSITION_NOISE, "mm"),
            ("spin_noise", "rad/s", _MIN_NOISE, _MAX_SPIN_NOISE, "deg/s"),
        ):
            value = getattr(self, key)
            if value is not None:
                checked = check_number(key, value, unit, above=0.0, least=least, limit=limit, instead=instead)
                object.__setattr__(self, key, checked)
        if self.table_extent is not None:
            object.__setattr__(self, "table_extent", _checked_extent(self.table_extent))

    @classmethod
    def from_mapping(cls, content: Mapping[str, Any]) -> "DatasetInfo":
        """The info in a parsed `dataset.yaml`.

        Args:
            content: the file's content: `name`, `frame: {up, table_height}` with an optional `table: {x, y}`, `ball:
                {radius, mass}` and the optional fields; unknown keys are ignored.
        Raises: ValueError: a missing field, a wrong type or range, an up axis other than z.
        """
        frame = _section(content, "frame", {"up": "...", "table_height": "..."})
        ball = _section(content, "ball", {"radius": "...", "mass": "..."})
        if frame["up"] != "z":
            problem = f"frame.up must be 'z', the only up axis that is supported; got {shown(frame['up'])}"
            raise ValueError(f"{problem}. Rotate the positions so that z points up.")
        _need(content, "name", "")
        lamp = None if content.get("lamp") is None else _section(content, "lamp", {"place": "[x, y, z]"})
        return cls(
            name=content["name"],
            table_height=None if frame["table_height"] == NO_SURFACE else frame["table_height"],
            ball=Ball(radius=ball["radius"], mass=ball["mass"]),
            table_extent=_stated_extent(frame),
            noise=None if content.get("noise") is None else TrackNoise.from_mapping(content["noise"]),
            imported=content.get("import"),
            doubts=() if content.get("doubts") is None else content["doubts"],
            lamp=None if lamp is None else Lamp(lamp["place"], lamp.get("sigma", 0.0)),
            **{key: content.get(key) for key in _OPTIONAL},
        )

    def to_mapping(self) -> dict[str, Any]:
        """The content of the corresponding `dataset.yaml`, without fields that are None."""
        height = NO_SURFACE if self.table_height is None else self.table_height
        frame: dict[str, Any] = {"up": "z", "table_height": height}
        if self.table_extent is not None:
            frame["table"] = {"x": list(self.table_extent[:2]), "y": list(self.table_extent[2:])}
        content: dict[str, Any] = {"name": self.name, "frame": frame, "ball": asdict(self.ball)}
        optional = {key: getattr(self, key) for key in _OPTIONAL}
        content |= {key: value for key, value in optional.items() if value is not None}
        if self.noise is not None:
            content["noise"] = self.noise.to_mapping()
        content |= {"doubts": list(self.doubts)} if self.doubts else {}
        content |= {"lamp": {"place": list(self.lamp.place), "sigma": self.lamp.sigma}} if self.lamp else {}
        return content if self.imported is None else content | {"import": dict(self.imported)}


class TrackFolder:
    """Ball and table of a dataset.

    Attributes:
        info: the content of `dataset.yaml`.
        one_view: True if one camera alone saw each ball.
    """

    info: DatasetInfo
    one_view: bool = False

    @property
    def ball(self) -> Ball:
        """The ball in `dataset.yaml`."""
        return self.info.ball

    @property
    def table(self) -> float:
        """m, height of the table's surface; -inf where there is none."""
        return -math.inf if self.info.table_height is None else self.info.table_height


def read_info(path: Path) -> tuple[DatasetInfo, list[str]]:
    """The info in a `dataset.yaml`, and notes on unknown keys. Raises: ValueError: no YAML, or a bad field."""
    try:
        content = read_yaml(path)
    except YamlError as error:
        place = "" if error.line is None else f", line {error.line}"
        raise ValueError(f"{path}{place}: must be valid YAML; {error.problem}. Correct it.") from None
    if not isinstance(content, dict):
        problem = f"{path}: must hold fields such as 'name: my_shots'; got {type_name(content)}"
        raise ValueError(f"{problem}. Give at least {', '.join(_REQUIRED)}.")
    content = {str(key): value for key, value in content.items()}
    try:
        info = DatasetInfo.from_mapping(content)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None
    unknown: list[tuple[str, str, tuple[str, ...], dict[str, Any]]] = [
        (key, key, _OPTIONAL, content) for key in content if key not in _KNOWN
    ]
    for name, fields in _FIELDS.items():
        section = content.get(name)
        if isinstance(section, dict):
            unknown += [(f"{name}.{key}", str(key), fields, section) for key in section if key not in fields]
    notes = []
    for label, key, fields, section in unknown[:MAX_LISTED]:
        hint = did_you_mean(key, (field for field in fields if field not in section))
        notes.append(f"{INFO_FILE}: field {shown(label)} ignored{'.' + hint if hint else ''}")
    if len(unknown) > MAX_LISTED:
        notes.append(f"{INFO_FILE}: {len(unknown) - MAX_LISTED} more fields ignored")
    return info, notes


def write_info(path: Path, info: DatasetInfo) -> None:
    """Writes a `dataset.yaml`; floats read back bit for bit."""
    path.write_text(yaml.safe_dump(info.to_mapping(), sort_keys=False, allow_unicode=True), encoding="utf-8")


def _section(content: Mapping[str, Any], key: str, fields: Mapping[str, str], prefix: str = "") -> dict[str, Any]:
    """A section with all its fields; `fields` gives the format of each."""
    _need(content, key, prefix)
    section = content[key]
    if not isinstance(section, dict):
        raise ValueError(
            f"{prefix}{key} must be a mapping with {' and '.join(fields)}; got {shown(section)}. "
            f"Write {key}: {{{', '.join(f'{name}: {text}' for name, text in fields.items())}}}."
        )
    for name in fields:
        _need(section, name, f"{prefix}{key}.")
    if commas := [name for name, value in section.items() if value is None and str(name).isdigit()]:
        raise ValueError(f"{prefix}{key} must have a decimal point in each number; got a comma before {commas[0]}.")
    return section


def _stated_extent(frame: Mapping[str, Any]) -> tuple[Any, ...] | None:
    if frame.get("table") is None:
        return None
    table = _section(frame, "table", {"x": "[0.0, 2.74]", "y": "[-0.76, 0.76]"}, "frame.")
    for axis in "xy":
        if not isinstance(table[axis], list) or len(table[axis]) != 2:
            what = f"frame.table.{axis} must be two numbers in m, the table's ends along {axis}"
            raise ValueError(f"{what}; got {shown(table[axis])}. Write {axis}: [low, high].")
    return (*table["x"], *table["y"])


def _checked_extent(extent: Any) -> tuple[float, ...]:
    if not isinstance(extent, tuple | list) or len(extent) != 4:
        raise TypeError(
            f"table_extent must be (x_low, x_high, y_low, y_high) in m; got {shown(extent)}. Give four numbers."
        )
    ends: list[float] = []
    for axis, pair in (("x", extent[:2]), ("y", extent[2:])):
        label = f"frame.table.{axis}"
        low, high = (check_number(label, end, "m", limit=_MAX_TABLE_PLACE, instead="mm") for end in pair)
        if not low < high:
            raise ValueError(f"{label} must increase; got [{low:g}, {high:g}]. Give the lower end first.")
        if not _TABLE_SIZES[0] <= high - low <= _TABLE_SIZES[1]:
            rule = f"{label} must be in m, its ends {_TABLE_SIZES[0]:g} to {_TABLE_SIZES[1]:g} m apart"
            raise ValueError(f"{rule}; got [{low:g}, {high:g}]. Convert it to m.")
        ends += [low, high]
    return tuple(ends)


def _need(content: Mapping[str, Any], key: str, prefix: str) -> None:
    if key in content and content[key] is None:
        problem = f"{prefix}{key} is required; nothing stands after {shown(f'{key}:')}"
        none = f", or {NO_SURFACE} where balls meet no surface" * (key == "table_height")
        raise ValueError(f"{problem}. Write its value there{none}.")
    if key not in content:
        found = nearest(key, (str(name) for name in content if name not in _KNOWN))
        remedy = f"Add it, or rename {shown(found)}." if found else "Add it."
        raise ValueError(f"{prefix}{key} is required; got {listed(content)}. {remedy}")

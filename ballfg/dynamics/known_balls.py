"""Lists the balls that have a nominal model, with size and mass from the rules of their game."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from importlib.resources.abc import Traversable
from typing import Any, Final

from ballfg.checks import check_text, did_you_mean
from ballfg.dynamics.coefficient import THIN_SHELL
from ballfg.files.strict_yaml import parse_yaml
from ballfg.tracks import Ball

SHUTTLE: Final = (
    "a badminton shuttle is no ball: it turns its cork ahead, and its drag depends on how it is turned. "
    "No model here describes that; choose another ball."
)
"""The error message for badminton."""
ALIASES: Final[Mapping[str, str]] = {"soccer": "football", "golf_ball": "golf", "tabletennis": "table_tennis"}
"""Other names of known balls."""


@dataclass(frozen=True)
class KnownBall:
    """A ball whose nominal model is the file of its name in `ballfg/dynamics`.

    Attributes:
        ball: radius m and mass kg, the middle of what the rules allow.
        source: of radius and mass.
        spreads: prior standard deviations as shares of the values, by effect; the effect's own where it is not named.
        inertia_factor: moment of inertia over m R^2, dimensionless.
        court: (length, width) m of table, court or pitch; None where the rules have no rectangle.
    """

    ball: Ball
    source: str
    spreads: Mapping[str, float] = field(default_factory=dict)
    inertia_factor: float = THIN_SHELL
    court: tuple[float, float] | None = None


def _read_ball(path: Traversable) -> tuple[KnownBall, dict[str, Any]]:
    """A ball and the content of its model file, from one file."""
    content = dict(parse_yaml(path.read_text(encoding="utf-8"), path.name))
    stated = content.pop("ball")
    ball = Ball(stated.pop("radius"), stated.pop("mass"))
    court = stated.pop("court", None)
    return KnownBall(ball, court=None if court is None else (court[0], court[1]), **stated), content


_FILES: Final = {
    path.name.removesuffix(".yaml"): _read_ball(path)
    for path in sorted(resources.files("ballfg.dynamics").iterdir(), key=lambda path: path.name)
    if path.name.endswith(".yaml")
}
KNOWN_BALLS: Final[Mapping[str, KnownBall]] = {name: known for name, (known, _) in _FILES.items()}
"""The known balls by name: one for each file beside this module."""


def nominal_content(name: str) -> dict[str, Any]:
    """The declarations in the model file of a known ball; name: in `KNOWN_BALLS`."""
    return _FILES[name][1]


def known_ball(name: str) -> str:
    """The name in `KNOWN_BALLS` of a ball that a user names; `-` and blanks stand for `_`.

    Raises: ValueError: no such ball, or a badminton shuttle.
    """
    check_text("ball", name)
    key = name.strip().lower().replace("-", "_").replace(" ", "_")
    key = ALIASES.get(key, key)
    if key in ("badminton", "shuttle", "shuttlecock"):
        raise ValueError(f"ball must be a ball; got '{name}': {SHUTTLE}")
    if key not in KNOWN_BALLS:
        raise ValueError(
            f"ball must be {', '.join(KNOWN_BALLS)}; got '{name}'{did_you_mean(key, list(KNOWN_BALLS))}. "
            "See ballfg balls."
        )
    return key

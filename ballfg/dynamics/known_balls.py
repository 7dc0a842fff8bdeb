"""The balls with a nominal model of their own: size and mass by the rules of their game, and how sure the model is."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from ballfg.checks import check_text, did_you_mean
from ballfg.dynamics.model import THIN_SHELL
from ballfg.tracks import TABLE_TENNIS, TENNIS, Ball

SOLID: Final = 2.0 / 5.0
"""Moment of inertia over m R^2 of a ball that is filled evenly; baseballs and golf balls are nearly so."""
SHUTTLE: Final = (
    "a badminton shuttle is no ball: it turns its cork ahead, and its drag depends on how it is turned. "
    "No model here describes that; choose another ball."
)
"""The answer to somebody who asks for badminton."""
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


KNOWN_BALLS: Final[Mapping[str, KnownBall]] = {
    "table_tennis": KnownBall(TABLE_TENNIS, "ITTF Laws of Table Tennis 2.3", court=(2.74, 1.525)),
    "tennis": KnownBall(
        TENNIS,
        "ITF Rules of Tennis, App. I",
        {"drag": 0.3, "magnus": 0.3, "restitution": 0.06, "friction": 0.15},  # courts differ more than balls do
        court=(23.77, 10.97),
    ),
    "basketball": KnownBall(
        Ball(0.121, 0.6),  # circumference 750 to 770 mm, 580 to 620 g
        "FIBA Basketball Equipment 2020, size 7",
        {"drag": 0.3, "magnus": 0.5, "restitution": 0.05, "friction": 0.3},
        court=(28.0, 15.0),
    ),
    "volleyball": KnownBall(
        Ball(0.105, 0.27),  # circumference 650 to 670 mm, 260 to 280 g
        "FIVB Official Volleyball Rules, rule 3",
        {"drag": 0.45, "magnus": 0.5, "restitution": 0.08, "friction": 0.3},
        court=(18.0, 9.0),
    ),
    "football": KnownBall(
        Ball(0.1098, 0.43),  # circumference 680 to 700 mm, 410 to 450 g
        "IFAB Laws of the Game, law 2",
        {"drag": 0.5, "magnus": 0.4, "restitution": 0.15, "friction": 0.4},
        court=(105.0, 68.0),  # the usual size of a stadium; law 1 leaves a range
    ),
    "baseball": KnownBall(
        Ball(0.0369, 0.1453),  # circumference 9 to 9.25 in, 5 to 5.25 oz
        "MLB Official Baseball Rules 3.01",
        {"drag": 0.25, "magnus": 0.3, "restitution": 0.2, "friction": 0.4},
        SOLID,
    ),
    "golf": KnownBall(
        Ball(0.021335, 0.04593),  # at least 42.67 mm across, at most 45.93 g
        "R&A and USGA Equipment Rules, part 4",
        {"drag": 0.3, "magnus": 0.4, "restitution": 0.4, "friction": 0.5},
        SOLID,
    ),
}
"""The known balls by name."""


def known_ball(name: str) -> str:
    """The name in `KNOWN_BALLS` of a ball that a user names, with `-` or blanks for `_`.

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

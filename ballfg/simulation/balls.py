"""Balls that can be launched: what they are, how they move, and on what they bounce."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from ballfg.checks import check_number
from ballfg.dynamics import AnalyticModel, Surfaces, model_from_dict, model_to_dict, nominal_model
from ballfg.dynamics.model import THIN_SHELL
from ballfg.dynamics.surfaces import TABLE_ABOVE_FLOOR
from ballfg.files.strict_yaml import read_yaml
from ballfg.simulation.launcher import TABLE_LAUNCHER, TABLE_LENGTH, TABLE_WIDTH, TENNIS_LAUNCHER, Launcher
from ballfg.tracks import TABLE_TENNIS, TENNIS, Ball

AIR_DENSITY: Final = 1.2
"""kg/m^3, dry air at 20 degrees C and 1013 hPa."""
TENNIS_DRAG: Final = 0.6
"""Drag coefficient of a tennis ball: 0.5 to 0.65 (R. Cross and C. Lindsey, "Measurements of drag and lift on tennis
balls in flight", Sports Engineering 17, 2014)."""
TENNIS_SPIN_RATIO: Final = 0.2
"""R w / v at which the lift is made linear: 25 m/s with 150 rad/s."""
TENNIS_RESTITUTION: Final = 0.75
"""Hard court; a drop from 2.54 m must rebound to 1.35 - 1.47 m, e = 0.73 - 0.76 (ITF Rules of Tennis, Appendix I)."""
TENNIS_FRICTION: Final = 0.6
"""Hard court (H. Brody, "That's how the ball bounces", The Physics Teacher 22, 1984: 0.5 to 0.7)."""

TABLE: Final = Surfaces(TABLE_ABOVE_FLOOR, 0.0, (0.0, TABLE_LENGTH, -TABLE_WIDTH / 2, TABLE_WIDTH / 2))
"""A table-tennis table in a room: the floor at z = 0, x along the table from the launcher's end, y from its middle."""
COURT: Final = Surfaces(0.0)
"""A court is its own floor and does not end."""

_FILE_KEYS: Final = ("name", "radius", "mass", "inertia_factor", "surface", "flight", "bounce", "launcher")


@dataclass(frozen=True)
class BallKind:
    """A ball with the model that is declared for it, the surface it bounces on and the machine that launches it."""

    name: str
    """Stands in the dataset's name."""

    ball: Ball
    """Radius m, mass kg."""

    model: AnalyticModel
    """How it moves; holds the radius too."""

    surfaces: Surfaces
    """Where it bounces; z of the table's or the court's surface in `table_height`, m."""

    launcher: Launcher = field(default=TABLE_LAUNCHER)
    """Where and how fast it starts, and where its track ends."""


def table_tennis() -> BallKind:
    """A 40+ ball with the nominal model, on a table, before the launcher of the paper."""
    return BallKind("table-tennis", TABLE_TENNIS, nominal_model(TABLE_TENNIS.radius), TABLE)


def tennis() -> BallKind:
    """A tennis ball on a hard court, before a machine behind the baseline; coefficients in `tennis_coefficients`.

    Its inertia is that of a thin shell, as everywhere in ballfg: a dataset has no place for another.
    """
    k_drag, k_magnus = tennis_coefficients(TENNIS)
    content = {
        "flight": {"gravity": {}, "drag": {"k": k_drag}, "magnus": {"k": k_magnus}},
        "bounce": {"restitution": {"e": TENNIS_RESTITUTION}, "friction": {"mu": TENNIS_FRICTION}},
    }
    return BallKind("tennis", TENNIS, model_from_dict(content, radius=TENNIS.radius), COURT, TENNIS_LAUNCHER)


def tennis_coefficients(ball: Ball) -> tuple[float, float]:
    """Drag k (1/m) and Magnus k (dimensionless) of a tennis ball, from its size, mass and lift law.

    Drag: a = rho Cd A v^2 / (2 m), so k = rho Cd A / (2 m). Lift: a = rho Cl A v^2 / (2 m) with
    Cl = 1 / (2 + v / (R w)) = S / (1 + 2 S), S = R w / v; divided by w v that is k = rho A R / (2 m (1 + 2 S)), taken
    at S = `TENNIS_SPIN_RATIO`. What this leaves out is the undeclared effect `magnus_saturation`.

    Source: A. Stepanek, "The aerodynamics of tennis balls - the topspin lob", American Journal of Physics 56, 1988.
    """
    area_over_mass = AIR_DENSITY * math.pi * ball.radius**2 / (2 * ball.mass)
    return TENNIS_DRAG * area_over_mass, area_over_mass * ball.radius / (1 + 2 * TENNIS_SPIN_RATIO)


BALLS: Final = {"table-tennis": table_tennis, "tennis": tennis}


def ball_kind(name: str) -> BallKind:
    """A ball by name, `table-tennis` or `tennis`, or from a YAML file; docs/simulate.md shows one.

    Raises: FileNotFoundError: neither a name nor a file. ValueError: a file that breaks a rule; the message says which.
    """
    if name in BALLS:
        return BALLS[name]()
    path = Path(name)
    if not path.is_file():
        raise FileNotFoundError(
            f"ball must be {' or '.join(BALLS)} or a YAML file that exists; got '{name}'. See docs/simulate.md."
        )
    content = read_yaml(path)
    try:
        return ball_from_mapping(content, default_name=path.stem)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def ball_from_mapping(content: Any, default_name: str = "ball") -> BallKind:
    """The ball that a parsed ball file describes.

    Args:
        content: `radius` (m), `mass` (kg), `flight` and `bounce` as in a model file; optional `name`,
            `inertia_factor`, `surface` (`table` or `court`) and `launcher` (fields of `Launcher` that differ).
        default_name: the name if the content has none.
    Raises: ValueError, TypeError: a missing or unknown key, or a value out of its bounds.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f"a ball must be a mapping with radius, mass, flight and bounce; got {content!r}. Rewrite it.")
    for key in content:
        if key not in _FILE_KEYS:
            raise ValueError(f"keys must be among {', '.join(_FILE_KEYS)}; got '{key}'. Rename or delete it.")
    for key in ("radius", "mass", "flight", "bounce"):
        if key not in content:
            raise ValueError(f"key '{key}' is required; got {', '.join(map(str, content))}. Add it.")
    ball = Ball(content["radius"], content["mass"])
    model = model_from_dict(
        {"flight": content["flight"], "bounce": content["bounce"]},
        radius=ball.radius,
        inertia_factor=check_number("inertia_factor", content.get("inertia_factor", THIN_SHELL)),
        where="ball",
    )
    surface = _surface(content.get("surface", "table"))
    launcher = TABLE_LAUNCHER if surface == "table" else TENNIS_LAUNCHER
    return BallKind(
        str(content.get("name", default_name)),
        ball,
        model,
        TABLE if surface == "table" else COURT,
        launcher.with_fields(content.get("launcher", {})),
    )


def _surface(value: Any) -> Literal["table", "court"]:
    if value not in ("table", "court"):
        raise ValueError(f"surface must be 'table' or 'court'; got {value!r}. Choose one of them.")
    return "table" if value == "table" else "court"


def with_model(kind: BallKind, model: AnalyticModel) -> BallKind:
    """The same ball with another declared model.

    Raises: ValueError: if the model was made for another radius.
    """
    if model.radius != kind.ball.radius:
        raise ValueError(
            f"model must have the ball's radius {kind.ball.radius:g} m; got {model.radius:g} m. "
            "Load it with radius=ball.radius."
        )
    return BallKind(kind.name, kind.ball, model, kind.surfaces, kind.launcher)


def describe(kind: BallKind) -> dict[str, Any]:
    """What the truth file says about a ball: radius m, mass kg, inertia factor and the declared model."""
    return {
        "ball": {"name": kind.name, "radius": kind.ball.radius, "mass": kind.ball.mass},
        "inertia_factor": kind.model.inertia_factor,
        "model": model_to_dict(kind.model),
    }

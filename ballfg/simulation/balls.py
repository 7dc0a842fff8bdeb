"""Defines the balls that can be launched, their models, surfaces and launchers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from ballfg.checks import check_keys, check_number, listed, shown
from ballfg.dynamics import AnalyticModel, Surfaces, nominal_model
from ballfg.dynamics.known_balls import KNOWN_BALLS, known_ball
from ballfg.dynamics.model_file import model_from_dict, model_to_dict
from ballfg.dynamics.nominal import spread_like
from ballfg.dynamics.surfaces import TABLE_ABOVE_FLOOR, TABLE_LENGTH, TABLE_WIDTH
from ballfg.files.strict_yaml import read_yaml
from ballfg.simulation.launcher import LAUNCHERS, TABLE_LAUNCHER, SimulatedLauncher
from ballfg.tracks import Ball

TABLE: Final = Surfaces(TABLE_ABOVE_FLOOR, 0.0, (0.0, TABLE_LENGTH, -TABLE_WIDTH / 2, TABLE_WIDTH / 2))
"""A table-tennis table in a room: the floor at z = 0, x along the table from the launcher's end, y from its middle."""
COURT: Final = Surfaces(0.0)
"""A court is its own floor, and a ball beyond its lines bounces as well, so the surface is unbounded."""

_FILE_KEYS: Final = ("name", "radius", "mass", "inertia_factor", "surface", "flight", "bounce", "launcher")


@dataclass(frozen=True)
class BallKind:
    """A ball with its declared model, its surface and its launcher."""

    name: str  # Part of the dataset's name
    ball: Ball  # Radius m, mass kg
    model: AnalyticModel  # Model of its motion, with the radius
    surfaces: Surfaces  # Its surfaces; z of the table's or the court's surface in `table_height`, m
    launcher: SimulatedLauncher = field(default=TABLE_LAUNCHER)
    """Place and speed of its start, and the end of its track."""


def table_tennis() -> BallKind:
    """A 40+ ball with the nominal model, on a table, before the launcher of the paper."""
    return _known("table_tennis")


def tennis() -> BallKind:
    """A tennis ball with the nominal model, on a hard court, before a machine behind the baseline."""
    return _known("tennis")


def ball_kind(name: str) -> BallKind:
    """A known ball by name (`ballfg balls` lists them), or one from a YAML file; docs/simulate.md shows one.

    Raises: FileNotFoundError: neither a name nor a file. ValueError: a file that breaks a rule, with the rule; or
        badminton, whose shuttle is no ball.
    """
    path = Path(name)
    if not path.is_file():
        try:
            return _known(known_ball(name))
        except ValueError as error:
            if "badminton" in str(error):
                raise
            known = ", ".join(key.replace("_", "-") for key in KNOWN_BALLS)
            raise FileNotFoundError(
                f"ball must be {known} or a YAML file that exists; got '{name}'. See ballfg balls and docs/simulate.md."
            ) from None
    content = read_yaml(path)
    try:
        return ball_from_mapping(content, default_name=path.stem)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from None


def _known(name: str) -> BallKind:
    """A known ball with its nominal model on its ground, before its launcher."""
    surfaces = TABLE if name == "table_tennis" else COURT
    launcher = LAUNCHERS.get(name, LAUNCHERS["tennis"])
    return BallKind(name.replace("_", "-"), KNOWN_BALLS[name].ball, nominal_model(name), surfaces, launcher)


def ball_from_mapping(content: Any, default_name: str = "ball") -> BallKind:
    """The ball of a parsed ball file.

    Args:
        content: `radius` (m) and `mass` (kg); optional `flight` and `bounce` as in a model file (else those of the
            nominal model of such a ball), `inertia_factor`, `name`, `surface` (`table` or `court`) and `launcher`
            (fields of `SimulatedLauncher` that differ).
        default_name: the name if the content has none.
    Raises: ValueError, TypeError: a missing or unknown key, or a value out of its bounds.
    """
    if not isinstance(content, Mapping):
        raise ValueError(f"a ball must be a mapping with radius and mass; got {shown(content)}. Rewrite it.")
    check_keys("a ball", dict(content), _FILE_KEYS, ())
    for key in ("radius", "mass"):
        if key not in content:
            raise ValueError(f"key '{key}' is required; got {listed(content)}. Add it.")
    ball = Ball(content["radius"], content["mass"])
    known = nominal_model(ball)
    usual = model_to_dict(known)
    stated = {part: content.get(part, usual[part]) for part in ("flight", "bounce")}
    factor = check_number("inertia_factor", content.get("inertia_factor", known.inertia_factor))
    model = model_from_dict(stated, radius=ball.radius, inertia_factor=factor, where="ball")
    spread_like(model, known)
    surface = content.get("surface", "table")
    if surface not in ("table", "court"):
        raise ValueError(f"surface must be 'table' or 'court'; got {shown(surface)}. Choose one of them.")
    surfaces, near = (TABLE, "table_tennis") if surface == "table" else (COURT, "tennis")
    launcher = LAUNCHERS[near].with_fields(content.get("launcher", {}))
    return BallKind(str(content.get("name", default_name)), ball, model, surfaces, launcher)


def with_model(kind: BallKind, model: AnalyticModel) -> BallKind:
    """The same ball with another declared model. Raises: ValueError: if the model was made for another radius."""
    if model.radius != kind.ball.radius:
        raise ValueError(
            f"model must have the ball's radius {kind.ball.radius:g} m; got {model.radius:g} m. "
            "Load it with radius=ball.radius."
        )
    return replace(kind, model=model)

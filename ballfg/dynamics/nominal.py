"""Chooses the nominal model of a ball: a known ball's model, else a guess from radius and mass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Final, cast

from ballfg.checks import is_number, shown, type_name
from ballfg.dynamics.coefficient import THIN_SHELL
from ballfg.dynamics.compiled.kept_model import keep, ready
from ballfg.dynamics.known_balls import KNOWN_BALLS, known_ball, nominal_content
from ballfg.tracks import TABLE_TENNIS, Ball

if TYPE_CHECKING:
    from ballfg.dynamics.analytic import AnalyticModel
    from ballfg.dynamics.effect import Effect
    from ballfg.dynamics.model import BallModel

TOLERANCE: Final = 0.15  # Relative. A ball whose radius and mass differ by less from a known ball's counts as that ball
AIR_DENSITY: Final = 1.2  # kg/m^3, dry air at 20 degrees C and 1013 hPa
DRAG_COEFFICIENT: Final = 0.5
"""Of an unknown ball: rough or smooth spheres have 0.4 to 0.6 below the drag crisis, 0.2 beyond it."""
SPIN_RATIO: Final = 0.2  # R w / v at which the lift is made linear: a tennis ball at 25 m/s with 150 rad/s
GUESSED_BOUNCE: Final = {"restitution": {"e": 0.75}, "friction": {"mu": 0.4}, "tangential_restitution": {"e_t": 0.15}}
"""Between those of table-tennis, tennis and rubber balls on hard ground."""
WIDE: Final = {"drag": 0.5, "magnus": 0.6, "restitution": 0.2, "friction": 0.5, "tangential_restitution": 2.0}
"""Prior standard deviation of a guessed coefficient, as a share of its value."""
TAKEN_UP: Final = frozenset({"magnus"})
"""Effects whose spread no track has for its own: flights show the product of the Magnus coefficient and the spin."""


def nominal_model(ball: Ball | float | str = TABLE_TENNIS) -> AnalyticModel:
    """The model to start from when only the ball is known.

    A ball that matches a known one (see `TOLERANCE`) gets its model, with the ball's own radius. For any other ball
    drag and Magnus force follow from radius and mass, the bounce is guessed, and all priors are wide; `nominal_note`
    says so. A model file does not hold priors: a guessed model that is saved and loaded has the usual ones.

    Args: ball: radius m and mass kg; a number is the radius in m of a table-tennis ball, a text the name of a known
        ball, such as "basketball" (`ballfg balls` lists them).
    Returns: a model of its own, which the caller may change.
    Raises: ValueError: if the radius is not one of a ball (0.001 to 1 m), the ball so light that its drag leaves
        the bounds of the effect, or the name not known. TypeError: neither a ball nor a number nor a name.
    """
    if isinstance(ball, str):
        chosen = known_ball(ball)
        return _known_model(chosen, KNOWN_BALLS[chosen].ball.radius)
    if not isinstance(ball, Ball):
        if not is_number(ball):
            got = f"{type_name(ball)} {shown(ball)}"
            raise TypeError(f"ball must be a Ball, a radius in m or a name; got {got}. Give one of them.")
        return _known_model("table_tennis", ball)
    name = known_name(ball)
    return _guessed_model(ball) if name is None else _known_model(name, ball.radius)


def ready_nominal(ball: Ball = TABLE_TENNIS) -> BallModel:
    """`nominal_model` for an estimate, which does not change it: without torch where its machine code is kept."""
    return ready(partial(_about, ball), partial(nominal_model, ball))


def keep_nominal(ball: Ball) -> None:
    """Keeps what `ready_nominal` needs."""
    keep(_about(ball), nominal_model(ball))


def _about(ball: Ball) -> str:
    return f"nominal, {known_name(ball) or ball.mass!r}, {ball.radius!r}"


def nominal_note(ball: Ball) -> str | None:
    """A sentence on the nominal model of an unknown ball; None for a known ball."""
    if known_name(ball) is not None:
        return None
    return (
        f"no nominal model for a ball of {ball.radius:g} m radius and {ball.mass:g} kg: drag and Magnus force follow "
        "from radius and mass, the bounce is guessed, priors are wide. Fit a model to your tracks or give a model file."
    )


def inertia_factor(ball: Ball) -> float:
    """Moment of inertia over m R^2 of the matching known ball, else of a thin shell; dimensionless."""
    name = known_name(ball)
    return THIN_SHELL if name is None else KNOWN_BALLS[name].inertia_factor


def air_coefficients(ball: Ball, drag_coefficient: float = DRAG_COEFFICIENT) -> tuple[float, float]:
    """Drag k (1/m) and Magnus k (dimensionless) of a ball, from its size, its mass and a law of lift.

    Drag: a = rho Cd A v^2 / (2 m), so k = rho Cd A / (2 m). Lift: a = rho Cl A v^2 / (2 m) with
    Cl = 1 / (2 + v / (R w)) = S / (1 + 2 S), S = R w / v; divided by w v that is k = rho A R / (2 m (1 + 2 S)), taken
    at S = `SPIN_RATIO`. The effect `magnus_saturation` gives the dependence on S.

    Source: A. Stepanek, "The aerodynamics of tennis balls - the topspin lob", American Journal of Physics 56, 1988.
    """
    area_over_mass = AIR_DENSITY * math.pi * ball.radius**2 / (2 * ball.mass)
    return drag_coefficient * area_over_mass, area_over_mass * ball.radius / (1 + 2 * SPIN_RATIO)


def known_name(ball: Ball) -> str | None:
    """Name of the known ball that matches; None if there is none."""
    nearest = min(KNOWN_BALLS, key=lambda name: mismatch(ball, KNOWN_BALLS[name].ball))
    return nearest if mismatch(ball, KNOWN_BALLS[nearest].ball) <= TOLERANCE else None


def mismatch(ball: Ball, known: Ball) -> float:
    """Largest relative difference of radius and mass from those of a known ball; they match up to `TOLERANCE`."""
    return max(abs(ball.radius / known.radius - 1.0), abs(ball.mass / known.mass - 1.0))


def _known_model(name: str, radius: float) -> AnalyticModel:
    from ballfg.dynamics.model_file import model_from_dict

    known = KNOWN_BALLS[name]
    content, where = nominal_content(name), f"{name}.yaml"
    model = model_from_dict(content, radius=radius, inertia_factor=known.inertia_factor, where=where)
    _set_spread(model, known.spreads)
    return model


def _guessed_model(ball: Ball) -> AnalyticModel:
    from ballfg.dynamics.model_file import model_from_dict

    drag, magnus = air_coefficients(ball)
    flight = {"gravity": {}, "drag": {"k": drag}, "magnus": {"k": magnus}}
    bounce = {**GUESSED_BOUNCE, "table_height": {}}
    model = model_from_dict({"flight": flight, "bounce": bounce}, radius=ball.radius, where="nominal model")
    _set_spread(model, WIDE)
    return model


def _set_spread(model: AnalyticModel, shares: Mapping[str, float]) -> None:
    """Let the one coefficient of some effects vary, with a prior standard deviation that is a share of its value."""
    effects = {name: effect for group in (model.flight, model.bounce) for name, effect in group.items()}
    for name, share in shares.items():
        effect = cast("Effect", effects[name])
        (coefficient,) = effect.coefficients
        give = effect.set_sigmas if name in TAKEN_UP else effect.vary
        give(**{coefficient.name: share * abs(float(getattr(effect, coefficient.name).detach()))})


def spread_like(model: AnalyticModel, usual: AnalyticModel) -> None:
    """Gives coefficients the prior standard deviations of another model, in proportion to their values."""
    for own, others in ((model.flight, usual.flight), (model.bounce, usual.bounce)):
        effects, known = dict(own.items()), dict(others.items())
        for name in effects.keys() & known.keys():
            effect, other = cast("Effect", effects[name]), cast("Effect", known[name])
            for one in other.coefficients:
                value, size = (abs(float(getattr(each, one.name).detach())) for each in (effect, other))
                if one.sigma is not None and size > 0.0:
                    give = effect.vary if one.varies else effect.set_sigmas
                    give(**{one.name: one.sigma * value / size})

"""`ballfg balls`: the balls with a nominal model."""

import math
from collections.abc import Iterator

import typer


def balls() -> None:
    """List the balls with a nominal model: size, mass, drag, terminal speed, bounce and court.

    A dataset is of one of them if its radius and mass are within 15 %. Spreads and sources of the coefficients
    stand in docs/physics.md. A badminton shuttle is no ball and has no model.

    Example: ballfg balls
    """
    for line in _lines():
        typer.echo(line)


def _lines() -> Iterator[str]:
    from ballfg.dynamics import KNOWN_BALLS, model_to_dict, nominal_model

    titles = ("name", "radius mm", "mass g", "drag k 1/m", "terminal m/s", "restitution", "court m")
    yield f"{titles[0]:<13}" + "".join(f"{title:>14}" for title in titles[1:]) + "  radius and mass by"
    for name, known in KNOWN_BALLS.items():
        model = model_to_dict(nominal_model(name))
        drag, gravity = model["flight"]["drag"]["k"], model["flight"]["gravity"]["g"]
        numbers = (
            f"{1e3 * known.ball.radius:.2f}",
            f"{1e3 * known.ball.mass:.1f}",
            f"{drag:.4g}",
            f"{math.sqrt(gravity / drag):.1f}",  # where the drag k v^2 is g
            f"{model['bounce']['restitution']['e']:.3g}",
            "-" if known.court is None else "{:g} x {:g}".format(*known.court),
        )
        yield f"{name:<13}" + "".join(f"{number:>14}" for number in numbers) + f"  {known.source}"

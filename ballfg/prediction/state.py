"""Holds the estimated state of a ball at one time, the type that all estimators pass to prediction."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel
    from ballfg.prediction.forecast import Forecast


@dataclass(frozen=True)
class World:
    """The model, surfaces and noise for predictions from a state.

    Attributes: model: of the ball.  surfaces: table and floor.  process: noise of the motion.
    """

    model: BallModel
    surfaces: Surfaces
    process: ProcessNoise = field(default_factory=ProcessNoise)


@dataclass(frozen=True, eq=False)
class BallState:
    """The state of a ball at one time, with the estimated coefficients of its model and the covariance.

    Attributes:
        time: s.
        mean: (9 + p,) position m, velocity m/s, spin rad/s, then the coefficients in their own units.
        joint: (9 + p, 9 + p) covariance of that, in the products of those units.
        coefficient_names: of the p model parameters.
        world: model, surfaces and noise for predictions; None without a model.
        name: of the track.
        other_side: (9, 9) part of the covariance for the chance that the ball is on the other side of a near contact,
            or None. Predictions leave it out, since both sides soon move alike; the next contact alone has it.
        struck: (9 + p, 9 + p) part of the covariance for the chance that the ball was hit just before, or None.
            Predicted paths have the mean of a ball that flies on, and the covariance of both.
    """

    time: float
    mean: Array
    joint: Array
    coefficient_names: tuple[str, ...] = ()
    world: World | None = None
    name: str = ""
    other_side: Array | None = None
    struck: Array | None = None

    def __repr__(self) -> str:
        rows = (("position", POSITION, 3, "m", 1e3, "mm"), ("velocity", VELOCITY, 2, "m/s", 1e2, "cm/s"))
        parts = []
        for label, part, digits, unit, scale, small in (*rows, ("spin", SPIN, 0, "rad/s", 1.0, "rad/s")):
            numbers = ", ".join(f"{x:.{digits}f}" for x in self.mean[part])
            spread = ", ".join(f"{scale * x:.3g}" for x in self.sigmas[part])
            parts.append(f"{label} ({numbers}) {unit} +- ({spread}) {small}")
        return f"{type(self).__name__}(t = {self.time:.4f} s, " + ",\n    ".join(parts) + ")"

    @property
    def state(self) -> Array:
        """(9,) position m, velocity m/s, spin rad/s."""
        return self.mean[:STATE_DIM]

    @property
    def covariance(self) -> Array:
        """(9, 9) of the state, in the products of m, m/s and rad/s."""
        return self.joint[:STATE_DIM, :STATE_DIM]

    @property
    def sigmas(self) -> Array:
        """(9,) standard deviations of the state, m, m/s and rad/s."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def position(self) -> Array:
        """(3,) m."""
        return self.mean[POSITION]

    @property
    def velocity(self) -> Array:
        """(3,) m/s."""
        return self.mean[VELOCITY]

    @property
    def spin(self) -> Array:
        """(3,) rad/s."""
        return self.mean[SPIN]

    @property
    def coefficients(self) -> Array:
        """(p,) model parameters, in their own units."""
        return self.mean[STATE_DIM:]

    def predict(self, horizon: float, step: float = 0.01) -> Forecast:
        """The path of the ball from this state.

        Args: horizon: s.  step: s between the times of the path.
        Raises: ValueError: a horizon or step that is not positive, or a state without a model.
        """
        from ballfg.prediction.forecast import look_ahead

        return look_ahead(self, horizon, step)

    def on(self, world: World) -> BallState:
        """The same state with another model, surfaces and noise for predictions."""
        return replace(self, world=world)

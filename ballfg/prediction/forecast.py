"""Predicts the path of one ball, with standard deviations and the events on the way."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array, frame_of
from ballfg.checks import check_number, check_text
from ballfg.factors.linear.definite import definite
from ballfg.prediction.belief import Belief
from ballfg.prediction.crossing import Crossing
from ballfg.prediction.event_ahead import EventAhead, contact_ahead, event_on
from ballfg.prediction.path import Carried, Path
from ballfg.prediction.plane import AXES, Plane, asked_event
from ballfg.prediction.propagate import Propagator
from ballfg.prediction.state import BallState
from ballfg.state import POSITION

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


MOST_STEPS = 100_000
"""Largest number of times in a path. They take some seconds and 100 MB; the longest flight of a ball lasts 10 s."""


@dataclass(frozen=True, eq=False)
class Forecast:
    """The predicted path of a ball.

    Near a contact of uncertain time some of the possible balls have bounced at a stamp and others have not. The state
    there is the mean of all of them, and the covariance is that of all of them about it: an average of a falling and a
    rising velocity, with a sigma of up to half of the jump. `next_contact` has the velocity of the bounce itself.

    Attributes:
        start: the initial state of the path.
        horizon: s, range of the search for events.
        times: (k,) s, on the clock of the start.
        states: (k, 9) position m, velocity m/s, spin rad/s.
        covariances: (k, 9, 9) in the products of those units; without measurement noise.
    """

    start: BallState
    horizon: float
    times: Array
    states: Array
    covariances: Array
    _carried: Carried

    def __repr__(self) -> str:
        end, spread = self.positions[-1], self.sigmas[-1]
        numbers = ", ".join(f"{x:.3f} +- {s:.3f}" for x, s in zip(end, spread, strict=True))
        return f"Forecast({len(self.times)} times to t = {self.times[-1]:.3f} s, there at ({numbers}) m)"

    @property
    def positions(self) -> Array:
        """(k, 3) m."""
        return self.states[:, POSITION]

    @property
    def sigmas(self) -> Array:
        """(k, 3) m, standard deviations of the positions; without measurement noise."""
        return np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2)[:, POSITION])

    @cached_property
    def next_contact(self) -> Crossing | None:
        """The state right before the next contact with a surface; None if there is none within the horizon."""
        return contact_ahead(self._path)[0]

    @cached_property
    def apex(self) -> Crossing | None:
        """The next highest point; None if there is none within the horizon.

        Where some balls may be past it just now, the covariance holds those and their next one.
        """
        return self._path.apex()

    def crossing(
        self,
        *,
        x: float | None = None,
        y: float | None = None,
        z: float | None = None,
        direction: str = "either",
        after: int = 0,
    ) -> Crossing | None:
        """Place and time of the ball's crossing of a plane across one axis.

        Near a bounce the covariance holds the balls that cross before it and those that cross after it.

        Args:
            x, y, z: m, the place of the plane on its axis; exactly one of them.
            direction: `up` along the axis, `down` against it, or `either`.
            after: number of bounces before the crossing.
        Returns: None if the ball does not get there within the horizon.
        Raises: ValueError: if not exactly one is given, or an unknown direction.
        """
        given = [(i, place) for i, place in enumerate((x, y, z)) if place is not None]
        if len(given) != 1:
            raise ValueError(f"crossing takes exactly one of x, y, z; got {len(given)} of them. Ask for one plane.")
        axis, place = given[0]
        along = (float(axis == 0), float(axis == 1), float(axis == 2))
        return self._path.crossing(Plane(along, place, direction, after))

    def event(self, asked: Plane | str) -> EventAhead:
        """An event ahead with its probability.

        Args: asked: `apex`, `next-contact`, a plane, or its text, such as `z=3.05,down` (`Plane.parse`).
        Returns: the event on the mean path, and the probability that there is one within the horizon.
        Raises: ValueError: another text.
        """
        if not isinstance(asked, Plane):
            check_text("asked", asked)
            asked = asked_event(asked)
        return event_on(self._path, asked)

    def path(self) -> Path:
        """The path for several events."""
        return self._path

    @cached_property
    def _path(self) -> Path:
        return Path(self.start, self._carried, self.horizon)

    def to_frame(self) -> "DataFrame":
        """A pandas table: t, x, y, z and sigma_x, sigma_y, sigma_z, s and m, one row a time.

        Raises: ImportError: without pandas.
        """
        columns = {"t": self.times, **dict(zip(AXES, self.positions.T, strict=True))}
        return frame_of(columns | {f"sigma_{a}": s for a, s in zip(AXES, self.sigmas.T, strict=True)})

    def plot(self) -> "Figure":
        """A picture of x, y and z over time, each with the band that holds 90 %; without measurement noise."""
        from ballfg.pages.pictures import by_axis
        from ballfg.pages.shot import ShownShot

        name, places = self.start.name, self.positions
        return by_axis(ShownShot(name, predicted_times=self.times, predicted=places, predicted_sigmas=self.sigmas))


def look_ahead(start: BallState, horizon: float, step: float = 0.01) -> Forecast:
    """The path of a ball from a state.

    Args: start: a state with its model.  horizon: s.  step: s between the times of the path.
    Raises: ValueError: a horizon or step that is not positive, more than `MOST_STEPS` steps, or a state without a
        model. TypeError: a horizon or step that is no number.
    """
    horizon, step = check_number("horizon", horizon, "s", above=0.0), check_number("step", step, "s", above=0.0)
    if horizon > MOST_STEPS * step:
        raise ValueError(
            f"horizon / step must be at most {MOST_STEPS}; got {horizon:g} s in steps of {step:g} s. Look less far "
            "ahead, or in longer steps."
        )
    propagator, belief = carried_by(start)
    count = max(int(np.ceil(horizon / step - 1e-9)), 1)
    since = np.minimum(step * np.arange(1, count + 1), horizon)
    path = propagator.rollout(belief.from_zero(), since)
    covariances = definite(path.covariances[0])
    return Forecast(start, horizon, start.time + since, path.states[0], covariances, (propagator, belief))


def carried_by(start: BallState) -> tuple[Propagator, Belief]:
    """The propagator of a state's model and surfaces, and the state as a belief.

    Raises: ValueError: a state without a model.
    """
    if start.world is None:
        raise ValueError(
            "a state must know its model to be predicted; this one does not, as where no flight was found. Take one in "
            "flight, or give it a model with state.on."
        )
    return Propagator(start.world.surfaces, start.world.process), Belief.of(start.world.model, [start])

"""Measures the distance of a model from the analytic one on random states, for pretraining and as a loss.

An untrained network makes the estimate ill-posed, and spin without an effect on the flight cannot be learned from
positions. Training therefore starts from physics that is roughly right, and tracks correct it. A few dozen shots say
nothing about speeds and spins other than those of their launchers; as a term of the loss, the distance keeps the model
close to the analytic one there.
"""

import copy
from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.model import BallModel, Rates
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.state import SPIN, STATE_DIM, VELOCITY, VZ

SAMPLES: Final = 3000  # Flights, and as many bounces, that a network is fitted to
ANCHORS: Final = 256  # The same of an anchor: enough for a smooth function of six numbers
SPEED: Final = 4.0  # m/s, standard deviation of each component of the velocities
SPIN_SPREAD: Final = 120.0  # rad/s, the same of the spins
LEAST_FALL: Final = 0.3  # m/s, slowest fall of a bounce
ACCELERATION_UNIT: Final = 1.0  # m/s^2. Errors are divided by this unit and the next two
VELOCITY_UNIT: Final = 0.1  # m/s
SPIN_UNIT: Final = 10.0  # rad/s


def pretrain(model: LearnedModel, teacher: BallModel, seed: int, iterations: int, *, samples: int = SAMPLES) -> float:
    """Fit a model, in place, to a teacher on so many random flights and bounces by L-BFGS.

    The same seed gives the same weights.

    Returns: the root mean square of the remaining errors, in their units.
    """
    flying, bouncing = random_states(seed, samples)
    with torch.no_grad():
        rates, after = teacher.rates(flying), teacher.after_bounce(bouncing)
    parameters = [*model.flight.parameters(), *model.contact.parameters()]
    optimizer = torch.optim.LBFGS(parameters, max_iter=iterations, history_size=50, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = difference(model, flying, bouncing, rates, after)
        value.backward()
        return value

    optimizer.step(loss)
    return float(loss().detach()) ** 0.5


class Anchor:
    """The mean square difference of a model in training from another one, as that is now, on random states."""

    def __init__(self, model: BallModel, start: BallModel, seed: int) -> None:
        self.model = model
        self.flying, self.bouncing = random_states(seed, ANCHORS)
        fixed = copy.deepcopy(start)  # rates may be views of parameters, which training changes
        with torch.no_grad():
            self.rates, self.after = fixed.rates(self.flying), fixed.after_bounce(self.bouncing)

    def __call__(self) -> Tensor:
        """() mean square; one means 1 m/s^2, 0.1 m/s or 10 rad/s."""
        return difference(self.model, self.flying, self.bouncing, self.rates, self.after)


def difference(model: BallModel, flying: Tensor, bouncing: Tensor, rates: Rates, after: Tensor) -> Tensor:
    """() sum of the mean square differences of a model's flight and bounce from given ones, in their units.

    Given are the rates of flying states (n, 9), and the states (n, 9) after those before a bounce (n, 9).
    """
    acceleration, spin_rate = model.rates(flying)
    bounced = model.after_bounce(bouncing)
    value = ((acceleration - rates[0]) / ACCELERATION_UNIT).square().mean()
    value = value + ((bounced - after)[:, VELOCITY] / VELOCITY_UNIT).square().mean()
    value = value + ((bounced - after)[:, SPIN] / SPIN_UNIT).square().mean()
    if spin_rate is not None and rates[1] is not None:
        value = value + ((spin_rate - rates[1]) / SPIN_UNIT).square().mean()
    return value


def random_states(seed: int, count: int) -> tuple[Tensor, Tensor]:
    """States (n, 9) of flying and of falling balls, with velocities and spins in all directions."""
    generator = torch.Generator().manual_seed(seed)
    flying, falling = torch.zeros((2, count, STATE_DIM), dtype=torch.float64)
    for states in (flying, falling):
        states[:, VELOCITY] = SPEED * torch.randn((count, 3), generator=generator, dtype=torch.float64)
        states[:, SPIN] = SPIN_SPREAD * torch.randn((count, 3), generator=generator, dtype=torch.float64)
    falling[:, VZ] = -LEAST_FALL - falling[:, VZ].abs()
    return flying, falling

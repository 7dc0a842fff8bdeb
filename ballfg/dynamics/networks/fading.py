"""Fades a network's correction away from its training data and keeps an unknown share of it as uncertainty."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from ballfg.arrays import Array, Index
from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.networks.gram_schmidt import CONTACT_FEATURES, FLIGHT_FEATURES, contact_frame, flight_frame
from ballfg.state import SPIN, VELOCITY, VZ

MOST_CENTRES: Final = 200
"""Largest number of kernels: more cost time in every step of a flight and hardly change the density."""
LEAST_GROUPS: Final = 8  # Smallest number of tracks for a density; with fewer its weight is zero
LEAST_SPREAD: Final = 0.03  # Smallest spread of a feature in [-1, 1], for a launcher that always does the same
EDGE: Final = 0.05  # Share of held-out training features whose weight is below one half
GOLDEN: Final = 0.5 * (5.0**0.5 - 1.0)
BANDWIDTHS: Final = np.geomspace(0.05, 2.0, 30)  # Kernel widths to choose from, in standard deviations of the features


class FeatureDensity(nn.Module):
    """The weight p / (p + edge) of the density p of Gaussian kernels; without kernels it is zero everywhere.

    Attributes:
        centres: (c, f) features over their spreads.  spread: (f,) unit of each feature.
        width: () standard deviation of a kernel in these units.
        edge: () density at which the weight is one half; the peak of a kernel counts as one.
    """

    centres: Tensor
    spread: Tensor
    width: Tensor
    edge: Tensor

    def __init__(self, centres: int, features: int) -> None:
        super().__init__()
        self.register_buffer("centres", torch.zeros(centres, features, dtype=torch.float64))
        self.register_buffer("spread", torch.ones(features, dtype=torch.float64))
        self.register_buffer("width", torch.ones((), dtype=torch.float64))
        self.register_buffer("edge", torch.ones((), dtype=torch.float64))

    def forward(self, features: Tensor) -> Tensor:
        """Weights (..., 1) in [0, 1) of features (..., f), smooth in them."""
        if not len(self.centres):
            return features.new_zeros((*features.shape[:-1], 1))
        away = ((features / self.spread).unsqueeze(-2) - self.centres) / self.width
        density = torch.exp(-0.5 * away.square().sum(-1)).mean(-1, keepdim=True)
        weight: Tensor = density / (density + self.edge)
        return weight

    @classmethod
    def of(cls, groups: Sequence[Array], features: int) -> "FeatureDensity":
        """The density of training features, with the kernel width that is most probable for held-out tracks.

        Every track counts the same, however many samples it has.

        Args: groups: (n, f) features of each track.  features: f.
        """
        groups = [group for group in groups if len(group)]
        if len(groups) < LEAST_GROUPS:
            return cls(0, features)
        spread = np.concatenate(groups).std(axis=0) + LEAST_SPREAD
        groups = [
            groups[i] for i in np.linspace(0, len(groups) - 1, min(MOST_CENTRES, len(groups))).round().astype(int)
        ]
        rows = [_rows(number, len(group), MOST_CENTRES // len(groups)) for number, group in enumerate(groups)]
        kept = np.concatenate([group[row] for group, row in zip(groups, rows, strict=True)])
        owner = np.repeat(np.arange(len(groups)), [len(row) for row in rows])
        centres = kept / spread
        square = ((centres[:, None] - centres[None]) ** 2).sum(axis=-1)
        other = owner[:, None] != owner[None]
        densities = [np.where(other, np.exp(-0.5 * square / h**2), 0.0).sum(1) / other.sum(1) for h in BANDWIDTHS]
        scores = [
            np.log(density / h**features + 1e-12).mean() for density, h in zip(densities, BANDWIDTHS, strict=True)
        ]
        best = int(np.argmax(scores))
        density = cls(len(centres), features)
        density.centres = torch.from_numpy(centres)
        density.spread = torch.from_numpy(spread)
        density.width = torch.tensor(BANDWIDTHS[best], dtype=torch.float64)
        density.edge = torch.tensor(max(np.quantile(densities[best], EDGE), 1e-9), dtype=torch.float64)
        return density


def _rows(number: int, size: int, most: int) -> Index:
    """Up to `most` rows of a track of some size, evenly over it; they begin elsewhere in each track.

    The golden ratio spreads the beginnings, so that one row of each of many tracks shows all of a flight.
    """
    count = min(most, size)
    begin = number * GOLDEN % 1.0
    return np.asarray((np.arange(count) + begin) * size / count).astype(np.int64)


ABROAD: Final = 0.5
"""Largest share of a correction that is used in a room outside of the training: a few rooms cannot separate the ball's
part of a correction from theirs. Whichever it is, at least half of it is right."""
DOUBTS: Final = tuple(Coefficient(name, 0.0, 1.0, "1", -3.0, 3.0, varies=True) for name in ("flight", "contact"))
"""Unknown shares, with mean zero, of the correction that remains outside of the training data."""


class Fading(nn.Module):
    """Weights of a correction: one where the training tracks were, zero far from them.

    The part that fades away may still be right. Its size, at most the usual correction in training, times an unknown
    share is the uncertainty that grows with the distance. The share is estimated with each track, like a coefficient,
    so that it enters estimates, predictions and their derivatives.

    Attributes:
        flying, bouncing: densities of the features of flights and of contacts.
        flight, contact: () the unknown shares; zero.  acceleration: () m/s^2, usual size of the correction of a flight.
        velocity: () m/s, of the correction of a contact; that of the spin counts as velocity of the ball's surface.
        strength: share of the correction that is used at weight one; 1, in a foreign room `abroad`.
        abroad: () that share: `ABROAD` if held-out training tracks are predicted better with it, else 0.
    """

    abroad: Tensor
    acceleration: Tensor
    velocity: Tensor

    def __init__(self, flying: FeatureDensity, bouncing: FeatureDensity, radius: float) -> None:
        super().__init__()
        self.flying, self.bouncing, self.radius = flying, bouncing, radius
        self.strength = 1.0
        self.flight = nn.Parameter(torch.zeros((), dtype=torch.float64), requires_grad=False)
        self.contact = nn.Parameter(torch.zeros((), dtype=torch.float64), requires_grad=False)
        self.register_buffer("abroad", torch.tensor(ABROAD, dtype=torch.float64))
        self.register_buffer("acceleration", torch.zeros((), dtype=torch.float64))
        self.register_buffer("velocity", torch.zeros((), dtype=torch.float64))

    @classmethod
    def empty(cls, flying: int, bouncing: int, radius: float) -> "Fading":
        """An object with this many kernels of each density, to be filled from a file."""
        return cls(FeatureDensity(flying, FLIGHT_FEATURES), FeatureDensity(bouncing, CONTACT_FEATURES), radius)

    @classmethod
    def of(cls, flights: Sequence[Tensor], contacts: Sequence[Tensor], radius: float) -> "Fading":
        """Fits the densities to training tracks.

        Args:
            flights: (n, 9) states of each track in flight.  contacts: (n, 9) states of each track before its contacts.
            radius: m.
        """
        seen = [flight_frame(states).features.numpy() for states in flights]
        touched = [contact_frame(states, radius).features.numpy() for states in contacts]
        return cls(FeatureDensity.of(seen, FLIGHT_FEATURES), FeatureDensity.of(touched, CONTACT_FEATURES), radius)

    def measure(self, accelerations: Tensor, changes: Tensor) -> None:
        """Sets the usual sizes from the corrections in training: (n, 3) m/s^2 in flight, (n, 9) after contacts."""
        self.acceleration = accelerations.square().sum(-1).mean().sqrt() if len(accelerations) else self.acceleration
        self.velocity = self._square(changes).mean().sqrt() if len(changes) else self.velocity

    def inside(self, state: Tensor) -> Tensor:
        """(..., 1) weight of the correction in flight, of states (..., 9)."""
        weight: Tensor = self.flying(flight_frame(state).features)
        return weight

    def in_flight(self, state: Tensor, correction: Tensor) -> Tensor:
        """The faded correction (..., 3) m/s^2 of states (..., 9), with the unknown share of the rest."""
        weight = self.inside(state)
        limited = _limited(correction, correction.square().sum(-1, keepdim=True), self.acceleration)
        return self.strength * weight * correction + (1.0 - weight) * self.flight * limited

    def at_contact(self, state: Tensor, change: Tensor) -> Tensor:
        """The faded change (..., 9) of a bounce from states (..., 9), with the unknown share of the rest."""
        weight = self.bouncing(contact_frame(state, self.radius).features)
        limited = _limited(change, self._square(change), self.velocity)
        return self.strength * weight * change + (1.0 - weight) * self.contact * limited

    def _square(self, change: Tensor) -> Tensor:
        """(..., 1) m^2/s^2 of changes (..., 9)."""
        velocity = change[..., VELOCITY].square().sum(-1, keepdim=True)
        return velocity + self.radius**2 * change[..., SPIN].square().sum(-1, keepdim=True)


def _limited(correction: Tensor, square: Tensor, size: Tensor | nn.Module) -> Tensor:
    """A correction whose length (the root of `square`) is limited smoothly to `size`."""
    assert isinstance(size, Tensor)
    return correction * (size / (size.square() + square + 1e-12).sqrt())


def states_before_contacts(states: Tensor, least: float = 0.3) -> Tensor:
    """(k, 9) of states (n, 9) along a flight: the last ones before the ball turns from falling to rising.

    Args: states: at the stamps of a track.  least: m/s, slowest fall and rise; a slower ball is at rest.
    """
    turns = (states[:-1, VZ] < -least) & (states[1:, VZ] > least)
    return states[:-1][turns]

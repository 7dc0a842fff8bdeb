"""A launcher gives the spin of a shot from the launcher settings in a track's labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from ballfg.checks import check_number
from ballfg.deferred import torch
from ballfg.dynamics.population import launch_axes
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.tracks import Track
from ballfg.tracks.track import SPIN_LABELS, label_text

if TYPE_CHECKING:
    from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
    from ballfg.dynamics.population import SpinPopulation

FIRST_SAMPLES = 10  # Number of samples whose mean direction of flight is the launch direction
SHOWN = 20.0
"""Horizontal way of a ball, in standard deviations of a position, from which on its direction is known to 4 degrees."""


@dataclass(frozen=True)
class SpinLabel:
    """A spin known before the flight, from a label or from the population of shots.

    Attributes:
        spin: (3,) rad/s.  sigma: rad/s, standard deviation per axis, one number or (3,).
        axes: (3, 3), one unit vector a row, along which sigma counts.
        measured: True if a label gives it; False if the population does.
    """

    spin: NDArray[np.float64]
    sigma: float | NDArray[np.float64]
    axes: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    measured: bool = True

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """(3,) rad/s, along the axes."""
        return np.broadcast_to(np.asarray(self.sigma, dtype=np.float64), (3,))

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(3, 3) rad^2/s^2, in the world."""
        return np.asarray((self.axes.T * self.sigmas**2) @ self.axes)


@dataclass(frozen=True)
class Launcher:
    """Spin from the labels of a track.

    Attributes:
        embedding: from the settings to a spin.  sigma: rad/s, standard deviation per axis of that spin.
        defaults: labels for tracks that lack them, for instance `group` for a dataset that is one group.

    Raises: ValueError: a sigma that is not positive and finite.
    """

    embedding: SpinEmbedding
    sigma: float
    defaults: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma, "rad/s", above=0.0)

    @classmethod
    def of_levels(cls, topspin: float, sidespin: float, sigma: float) -> Self:
        """A launcher with a known spin per level of the labels `topspin` and `sidespin`.

        Topspin turns about the horizontal axis across the flight (the top of the ball moves forward), sidespin about
        the vertical.

        Args: topspin, sidespin: rad/s per level.  sigma: as in the class.
        """
        from ballfg.dynamics.networks.spin_embedding import SpinEmbedding

        rows = torch.tensor([[0.0, topspin, 0.0], [0.0, 0.0, sidespin]], dtype=torch.float64)
        return cls(SpinEmbedding(("topspin", "sidespin"), {}, rows), sigma)

    def settings(self, track: Track) -> NDArray[np.float64] | None:
        """(k,) settings of a shot, in the launcher's own units; None without them, or with a spin label."""
        if track.spin_label is not None:
            return None
        found = self.embedding.settings({**self.defaults, **track.labels})
        return None if found is None else found.numpy()

    def label(self, track: Track) -> SpinLabel | None:
        """The spin from the settings and the first samples; None for a track without settings.

        For estimators that need the spin before the velocity; the smoother estimates both together.
        """
        settings = self.settings(track)
        if settings is None or len(track) < 2:
            return None
        velocity = launch_velocity(track)
        with torch.no_grad():
            spin = self.embedding.spin(torch.from_numpy(settings), torch.from_numpy(velocity))
        return SpinLabel(spin.numpy(), self.sigma)

    def labelled(self, track: Track) -> Track:
        """The track with spin labels from its settings, for methods that use labels only; else unchanged."""
        label = self.label(track)
        if label is None:
            return track
        return replace(track, labels={**track.labels, **dict(zip(SPIN_LABELS, label.spin.tolist(), strict=True))})


def group_spin(spins: SpinPopulation, track: Track, group: str | None) -> SpinLabel:
    """The spin of a new shot of the group that the track's label names, else of `group`."""
    mean, covariance = spins.spin(label_text(track.labels[spins.by]) if spins.by in track.labels else group)
    axes = launch_axes(launch_velocity(track))
    variances, vectors = np.linalg.eigh(covariance)
    return SpinLabel(mean @ axes, np.sqrt(variances), vectors.T @ axes, measured=False)


def undirected_spin(spins: SpinPopulation, group: str | None) -> SpinLabel:
    """The spin of a group's new shot before its direction shows: turned about the vertical by any angle."""
    mean, covariance = spins.spin(group)
    moment = covariance + np.outer(mean, mean)
    level = (moment[0, 0] + moment[1, 1]) / 2.0
    return SpinLabel(mean * (0.0, 0.0, 1.0), np.sqrt([level, level, covariance[2, 2]]), measured=False)


def launch_velocity(track: Track) -> NDArray[np.float64]:
    """(3,) m/s, mean of a track's first samples."""
    first = slice(0, FIRST_SAMPLES)
    return window_velocities(track.seconds[first], track.positions[first]).mean(axis=0)

"""Turns residuals into the axes of the motion and averages them over bins, for the pictures."""

from dataclasses import dataclass

import numpy as np
import torch

from ballfg.arrays import Array, Index
from ballfg.diagnosis.result import ContactResiduals, FlightResiduals
from ballfg.dynamics.motion.impact import slip_velocity
from ballfg.state import SPIN, VELOCITY

MOST_BINS, LEAST_BINS = 12, 3  # Limits of the number of bins, which hold equal counts
STRETCHES_A_BIN = 6  # Number of stretches per bin, so that each mean is over several stretches
LEAST_STRETCHES = 3  # Least number of stretches for the standard error of a bin
STEEP = 1e-6
"""Horizontal share of a velocity below which it counts as vertical: its direction along the ground is then x."""


@dataclass(frozen=True)
class Bins:
    """Means over b bins: (b,) centres, means and standard errors."""

    centres: Array
    means: Array
    errors: Array


def motion_axes(velocity: Array) -> Array:
    """(m, 3, 3) rows: unit vectors along a velocity (m, 3), horizontally to its left, and upwards across both."""
    speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
    along = np.where(speed > 0.0, velocity / np.where(speed > 0.0, speed, 1.0), np.array([1.0, 0.0, 0.0]))
    level = np.linalg.norm(along[:, :2], axis=-1, keepdims=True)
    ahead = np.where(level > STEEP, along[:, :2] / np.maximum(level, STEEP), np.array([1.0, 0.0]))
    left = np.stack((-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))), axis=-1)
    return np.stack((along, left, np.cross(along, left)), axis=1)


def turned(vectors: Array, covariances: Array, axes: Array) -> tuple[Array, Array]:
    """(m, 3) components of vectors in other axes, and their (m, 3) standard deviations."""
    components = np.einsum("mij,mj->mi", axes, vectors)
    variances = np.einsum("mij,mjk,mik->mi", axes, covariances, axes)
    return components, np.sqrt(variances)


def in_flight(residuals: FlightResiduals) -> tuple[Array, Array]:
    """(m, 3) m/s^2 of acceleration along the flight, to its left and upwards across it, with standard deviations."""
    axes = motion_axes(residuals.states[:, VELOCITY])
    return turned(residuals.acceleration, residuals.covariance, axes)


def at_contact(residuals: ContactResiduals) -> tuple[Array, Array]:
    """(m, 3) m/s of kick along the ground in the direction of flight, to its left and up, with standard deviations."""
    level = residuals.incoming[:, VELOCITY] * np.array([1.0, 1.0, 0.0])
    return turned(residuals.velocity, residuals.covariance[:, :3, :3], motion_axes(level))


def slip_speed(states: Array, radius: float) -> Array:
    """(m,) m/s at which the lowest point of a ball of `radius` m slides over the ground."""
    velocity, spin = torch.from_numpy(states[:, VELOCITY]), torch.from_numpy(states[:, SPIN])
    return slip_velocity(velocity, spin, radius).norm(dim=-1).numpy()


def binned(against: Array, values: Array, sigmas: Array, stretch: Index) -> Bins:
    """Weighted means of values (m,) with standard deviations (m,) over bins of equal counts, against a quantity (m,).

    Values of one stretch, by its number (m,), are correlated and count as one: bins need enough stretches, and the
    standard errors come from the scatter between stretches alone.
    """
    rows: list[tuple[float, float, float]] = []
    if len(against):
        count = int(np.clip(len(np.unique(stretch)) // STRETCHES_A_BIN, LEAST_BINS, MOST_BINS))
        edges = np.unique(np.quantile(against, np.linspace(0.0, 1.0, count + 1)))
        place = np.searchsorted(edges[1:-1], against, side="right")
        for i in range(max(len(edges) - 1, 1)):
            inside = place == i
            groups, member = np.unique(stretch[inside], return_inverse=True)
            if len(groups) < LEAST_STRETCHES:
                continue
            weight = sigmas[inside] ** -2
            weight /= weight.sum()
            mean = float(weight @ values[inside])
            pulls = np.bincount(member, weight * (values[inside] - mean), len(groups))
            spread = np.sqrt((pulls**2).sum() * len(groups) / (len(groups) - 1))
            rows.append((float(weight @ against[inside]), mean, float(spread)))
    return Bins(*np.array(rows).reshape(-1, 3).T)

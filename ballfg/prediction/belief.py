"""A belief holds Gaussian states at one time, with the model coefficients of their estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.dynamics.compiled.kept_model import augmented, carried
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.prediction.state import BallState
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel


@dataclass(frozen=True)
class Belief:
    """Gaussian states and coefficients of n balls, each ball at its own time.

    Attributes:
        model: the ball; an `AugmentedModel` if coefficients are uncertain.
        time: (n,) s.
        mean: (n, 9 + p) states, then coefficients in their own units.
        covariance: (n, 9 + p, 9 + p) in the products of those units.
        struck: (n, 9 + p, 9 + p) part of the covariance for the chance that a ball was hit just before, or None.
    """

    model: BallModel
    time: Array
    mean: Array
    covariance: Array
    struck: Array | None = None

    def __post_init__(self) -> None:
        for name in ("time", "mean", "covariance"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))  # also from tensors

    @classmethod
    def of(
        cls, model: BallModel, states: Sequence[BallState], coefficients: Mapping[str, float] | None = None
    ) -> Belief:
        """The belief of some states that were estimated with the same model.

        A coefficient beyond the bounds of its effect (a restitution above 1, say) is moved to the bound, and the state
        to its conditional mean.

        Args:
            model: the ball.
            states: n of them.
            coefficients: prior standard deviations by parameter name, as in `Settings.coefficients`. A state without
                one of them (from the sliding window or a failed filter) gets the model's value with this standard
                deviation. None: the coefficients of the states, the same in all.
        Raises: ValueError: if there is no state, or states have coefficients that are not among these.
        """
        if not states:
            raise ValueError("states must hold at least one; got none")
        prior = dict.fromkeys(states[0].coefficient_names, np.nan) if coefficients is None else coefficients
        names = tuple(prior)
        for state in states:
            own = state.coefficient_names
            if not set(own) <= set(names) or (coefficients is None and own != names):
                raise ValueError(
                    f"states must share their coefficients; that of track {shown(state.name)} has {list(own)}, "
                    f"not {list(names)}. Make them with the same settings."
                )
        bounded = augmented(model, names)
        prior_mean = np.array([numbers_of(model).value(name) for name in names])
        low, high = _bounds(model, names)
        joints = [_joint(state, names, prior_mean, np.array(list(prior.values()))) for state in states]
        mean = np.stack([_held(m, covariance, low, high) for m, covariance in joints])
        times = np.array([state.time for state in states])
        return cls(bounded, times, mean, np.stack([covariance for _, covariance in joints]), _struck(states, names))

    def within_bounds(self, states: Array) -> Array:
        """Balls whose coefficients lie within the bounds of their effects.

        Args: states: (n, 9 + p) m, m/s, rad/s, then the coefficients in their own units.
        Returns: (n, 9 + p) in the same units, with coefficients beyond a bound moved to it.
        """
        held = np.clip(states[:, STATE_DIM:], *_bounds(*carried(self.model)))
        return np.concatenate((states[:, :STATE_DIM], held), axis=1)

    def __len__(self) -> int:
        return len(self.time)

    def from_zero(self) -> Belief:
        """The belief with time counted from now, against the rounding of large stamps."""
        return replace(self, time=np.zeros_like(self.time))


def _bounds(model: BallModel, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Least and largest values (p,) of coefficients by their effects."""
    known = model.declared_coefficients()
    declared = [known.get(name) for name in names]
    low = np.array([-np.inf if c is None else c.low for c in declared])
    return low, np.array([np.inf if c is None else c.high for c in declared])


def _joint(state: BallState, names: tuple[str, ...], prior_mean: Array, prior_sigma: Array) -> tuple[Array, Array]:
    """Mean (9 + p,) and covariance (9 + p, 9 + p) of a state and of all coefficients."""
    mean, covariance = state.mean.copy(), state.joint.copy()
    if state.coefficient_names != names:
        mean = np.concatenate((state.state, prior_mean))
        covariance = np.diag(np.concatenate((np.zeros(STATE_DIM), prior_sigma**2)))
        own = np.array([*range(STATE_DIM), *(STATE_DIM + names.index(name) for name in state.coefficient_names)])
        mean[own] = state.mean
        covariance[np.ix_(own, own)] = state.joint
    if state.other_side is not None:
        covariance[:STATE_DIM, :STATE_DIM] -= state.other_side
    return mean, (covariance + covariance.T) / 2


def _struck(states: Sequence[BallState], names: tuple[str, ...]) -> Array | None:
    """As of `Belief`, with all coefficients."""
    if all(state.struck is None for state in states):
        return None
    found = np.zeros((len(states), STATE_DIM + len(names), STATE_DIM + len(names)))
    for share, state in zip(found, states, strict=True):
        if state.struck is not None:
            own = [*range(STATE_DIM), *(STATE_DIM + names.index(name) for name in state.coefficient_names)]
            share[np.ix_(own, own)] = state.struck
    return found


def _held(mean: Array, covariance: Array, low: Array, high: Array) -> Array:
    """The most probable mean (9 + p,) with its out-of-bounds coefficients fixed at the bounds."""
    change = np.clip(mean[STATE_DIM:], low, high) - mean[STATE_DIM:]
    out = STATE_DIM + np.flatnonzero(change)
    if not len(out):
        return mean
    held = mean + covariance[:, out] @ np.linalg.solve(covariance[np.ix_(out, out)], change[out - STATE_DIM])
    held[STATE_DIM:] = np.clip(held[STATE_DIM:], low, high)  # others may have been pulled along
    return np.asarray(held)


@cache
def normal_points(pairs: int, width: int, seed: int = 0) -> Array:
    """(2 pairs, width) points of a standard normal, each with its negative; mean and covariance are exactly right.

    Args: width: at most the number of pairs.
    """
    rng, normal = np.random.default_rng(seed), NormalDist()
    half = np.array([normal.inv_cdf(0.5 + (k + 0.5) / (2 * pairs)) for k in range(pairs)])
    points = np.stack([rng.permutation(half) * rng.choice((-1.0, 1.0), pairs) for _ in range(width)], axis=1)
    across, mixed = np.linalg.qr(points)
    points = np.sqrt(pairs) * across * np.sign(np.diagonal(mixed))
    return np.concatenate((points, -points))


def root_of(covariance: Array) -> Array:
    """Root (d, d) of a covariance, which may be singular."""
    sigmas = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(sigmas > 0.0, sigmas, 1.0)
    values, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))

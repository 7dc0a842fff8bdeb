"""The extended Kalman filter on filterpy, with the same dynamics and noise as the smoother, and an RTS pass.

docs/estimators_ekf.md has the equations, what the filter does at contacts, hits and outliers, and what it cannot do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Literal

import numpy as np
import torch
from filterpy.kalman import ExtendedKalmanFilter as FilterpyEKF
from scipy.stats import chi2
from torch import Tensor

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.contact import contact_time, fly_through_jacobian
from ballfg.dynamics.integrate import batch_jacobian, fly, fly_jacobian, step_count
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.rollout import MAX_CONTACTS_PER_STEP, REST_SPEED, is_resting, roll
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimate.estimator import Estimator
from ballfg.estimate.problem import coefficient_means, trackwise_model
from ballfg.estimate.result import Array, Estimate, Status, leave_one_out
from ballfg.estimate.rts import FilterRecord, rts_smooth
from ballfg.estimate.segmentation import Contact, Quality
from ballfg.estimate.settings import Settings, sample_sigmas
from ballfg.estimate.sliding_window import WINDOW, SlidingWindow, spin_start
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY, VZ, Z
from ballfg.tracks import Track

GATE = float(chi2.isf(1e-6, 3))
"""Squared whitened innovation, 30.7, beyond which a sample is not used: one good sample in a million."""
REJECTED_FOR_HIT = 4
"""So many samples in a row beyond the gate are no outliers: something hit the ball before the first of them."""
HIT_POSITION = 1.0
"""m, standard deviation of the position after a hit: it starts anew at the measurement."""
WIDE_VELOCITY = 1.0
"""m/s. While the velocity is less well known, a step is linearised at the velocity that its sample suggests."""
START_SEARCH = 12
"""How many samples may be tried as the first one of a flight."""
START_ACCELERATION = 20.0
"""m/s^2, standard deviation of what bends three samples beside gravity: twice a fast ball's drag."""
NEAR_SURFACE = 0.05
"""m. Three samples, one of them this close to a surface, need not lie on one parabola: there may be a bounce."""

_OBSERVE = np.eye(3, STATE_DIM)


@dataclass(frozen=True)
class Motion:
    """A motion over an interval.

    Attributes:
        after: (1, d) the state at the end.
        jacobian: (d, d) its derivative by the state at the start, at fixed duration.
        contacts: time since the start, s, and the surface's height, m, of each contact.
    """

    after: Tensor
    jacobian: Tensor
    contacts: tuple[tuple[float, float], ...]


@torch.no_grad()
def advance_jacobian(model: BallModel, state: Tensor, dt: float, surfaces: Surfaces) -> Motion:
    """`rollout.advance` of one state (1, d) over dt s, with its Jacobian: flight, contacts, rest."""
    steps = step_count(torch.tensor([dt]))
    jacobian = torch.eye(state.shape[-1], dtype=state.dtype)
    contacts: list[tuple[float, float]] = []
    for i in range(steps):
        part = _advance_step(model, state, dt / steps, surfaces)
        state, jacobian = part.after, part.jacobian @ jacobian
        contacts += [(i * dt / steps + time, height) for time, height in part.contacts]
    return Motion(state, jacobian, tuple(contacts))


def _advance_step(model: BallModel, state: Tensor, h: float, surfaces: Surfaces) -> Motion:
    """One step of at most `integrate.MAX_STEP`, cut at its contacts."""
    height = float(surfaces.height_below(state))
    jacobian: Tensor | None = None
    contacts: list[tuple[float, float]] = []
    elapsed = 0.0
    while True:
        if bool(is_resting(model, state, height)):
            after, step = _rolled(model, state, h - elapsed, height)
        else:
            after, step = _flown(model, state, h - elapsed)
            if len(contacts) < MAX_CONTACTS_PER_STEP and _lands(model, state, after, height, surfaces):
                state, step, tau, rests = _bounced(model, state, height)
                contacts.append((elapsed + tau, height))
                elapsed += tau
                jacobian = step if jacobian is None else step @ jacobian
                if not rests:
                    continue
                after, step = _rolled(model, state, h - elapsed, height)
        return Motion(after, step if jacobian is None else step @ jacobian, tuple(contacts))


def _flown(model: BallModel, state: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    after, jacobian = fly_jacobian(model, state, state.new_tensor([dt]))
    return after, jacobian[0]


def _rolled(model: BallModel, state: Tensor, dt: float, height: float) -> tuple[Tensor, Tensor]:
    def motion(x: Tensor) -> Tensor:
        return roll(model, x, x.new_tensor([dt]), height)

    after, jacobian = batch_jacobian(motion, state)
    return after, jacobian[0]


def _lands(model: BallModel, state: Tensor, after: Tensor, height: float, surfaces: Surfaces) -> bool:
    """Whether a flight that ends at `after` went through the surface, and not past the table's edge."""
    if not (float(model.gap(after, height)) < 0.0 and float(after[0, VZ]) < 0.0):
        return False
    if surfaces.extent is None or height != surfaces.table_height:
        return True
    tau = torch.nan_to_num(contact_time(model, state, height))
    return bool(surfaces.over_table(fly(model, state, tau)))


def _bounced(model: BallModel, state: Tensor, height: float) -> tuple[Tensor, Tensor, float, bool]:
    """State just after the next contact, Jacobian at that fixed time, the time, whether the ball now rests.

    As in `rollout`: a ball below the surface that never comes up again (its contact time is NaN) is put on it.
    """
    tau = contact_time(model, state, height)
    if bool(tau.isnan()):
        after, impact = batch_jacobian(model.bounce, state)
        return after, impact[0], 0.0, True
    after, _, jacobian = fly_through_jacobian(model, state, tau, (height,))
    return after, jacobian[0], float(tau), float(after[0, VZ]) < REST_SPEED


class _BallFilter(FilterpyEKF):
    """filterpy's filter with the ball's own prediction: x, P, F, Q, R are its attributes, the update is its own.

    Its update uses the Joseph form (I - K H) P (I - K H)^T + K R K^T, positive definite under rounding.
    """

    def __init__(self, model: BallModel, surfaces: Surfaces, mean: Array, covariance: Array) -> None:
        super().__init__(dim_x=len(mean), dim_z=3)
        self.model = model
        self.surfaces = surfaces
        self.x = mean
        self.P = covariance
        self.H = np.eye(3, len(mean))
        self.predicted = mean

    def move(self, point: Array, dt: float) -> Motion:
        """Sets F at the linearisation point, and the mean that `predict_x` will put into x."""
        motion = advance_jacobian(self.model, torch.from_numpy(point)[None], dt, self.surfaces)
        self.F = motion.jacobian.numpy()
        self.predicted = motion.after[0].numpy() + self.F @ (self.x - point)
        return motion

    def predict_x(self, u: float = 0) -> None:
        """The mean follows the nonlinear motion, not F x."""
        self.x = self.predicted

    def linearisation_point(self, measured: Array, dt: float, R: Array) -> Array:
        """(d,) the mean; while the velocity is wide, the mean given the interval's sample in drag-free flight.

        It is no information, only the place of the tangent: the sample itself still updates the state once.
        """
        P = self.P
        if np.trace(P[VELOCITY, VELOCITY]) < WIDE_VELOCITY**2:
            return self.x
        H = self.H.copy()
        H[:, VELOCITY] = dt * np.eye(3)
        miss = measured - H @ self.x
        miss[Z] += 0.5 * STANDARD_GRAVITY * dt**2
        point = self.x.copy()
        point[:6] += (P @ H.T @ np.linalg.solve(H @ P @ H.T + R, miss))[:6]
        return point

    def innovation(self, measured: Array) -> Array:
        """(3,) whitened: measured minus predicted position over the root of its covariance H P H^T + R."""
        root = np.linalg.cholesky(self.P[POSITION, POSITION] + self.R)
        return np.asarray(np.linalg.solve(root, measured - self.x[POSITION]))

    def correct(self, measured: Array) -> None:
        """filterpy's update with a measured position."""
        self.update(measured, lambda _: self.H, lambda x: x[POSITION])


class ExtendedKalmanFilter(Estimator):
    """The extended Kalman filter; with `smooth`, followed by a Rauch-Tung-Striebel pass.

    The state is the 9-vector and, with `settings.coefficients`, the model's uncertain coefficients. Contacts happen
    where the predicted flight meets a surface. With `settings.find_events`, samples beyond the gate are outliers,
    and four of them in a row make a hit: the filter goes back to before the first one, widens velocity and spin by
    `settings.process.hit_velocity` and `hit_spin`, and starts anew at the measurements.

    Args:
        model: the ball.  surfaces: what it may bounce on.  settings: noise and priors.
        smooth: adds the backward pass; the name is then "ekf+rts", innovations are leave-one-out.
        initialise: "prior": the first sample with its own noise as the position, velocity 0 +- `velocity_prior`,
            spin label or prior, so that each sample is used once. "window": the sliding window's state at its fifth
            sample with the sliding window's covariance (noise and lag); the filter then starts with the sixth, and
            the states before are the sliding window's. Each sample is used once there, too.

    Raises: ValueError: for another `initialise`, or coefficients that the model does not have.
    """

    name = "ekf"

    def __init__(
        self,
        model: BallModel,
        surfaces: Surfaces,
        settings: Settings,
        smooth: bool = False,
        initialise: Literal["prior", "window"] = "prior",
    ) -> None:
        super().__init__(model, surfaces, settings)
        if initialise not in ("prior", "window"):
            raise ValueError(f"initialise must be 'prior' or 'window'; got {initialise!r}")
        self.trackwise = trackwise_model(model, settings)
        self.smooth = smooth
        self.initialise = initialise
        if smooth:
            self.name = "ekf+rts"  # type: ignore[misc]  # the class's name is that of its default

    def estimate(self, track: Track) -> Estimate:
        """The states of a track, each given the samples so far; with `smooth` given all samples.

        Coefficients are those of the last sample; cross covariances tie each state to the coefficients at that state.
        """
        run = _Run(self, track)
        record = run.record
        if not run.finite():
            return self._failed(track, run)
        mean, covariance = rts_smooth(record) if self.smooth else (record.mean, record.covariance)
        if record.start > 0 and (self.smooth or self.initialise == "prior"):
            run.fly_back(mean, covariance)
        whitened = record.whitened
        if self.smooth:
            whitened = leave_one_out(mean, covariance, track.positions, run.sigma, record.used.astype(np.float64))
        return self._result(track, run, mean, covariance, whitened)

    def _result(self, track: Track, run: _Run, mean: Array, covariance: Array, whitened: Array) -> Estimate:
        return Estimate(
            name=track.name,
            times=track.times,
            states=mean[:, :STATE_DIM],
            covariances=covariance[:, :STATE_DIM, :STATE_DIM],
            status=Status.OK if run.record.used.sum() > 1 else Status.NO_VELOCITY,
            whitened=whitened,
            coefficient_names=tuple(self.settings.coefficients),
            coefficients=mean[-1, STATE_DIM:],
            coefficient_covariance=covariance[-1, STATE_DIM:, STATE_DIM:],
            cross_covariances=covariance[:, :STATE_DIM, STATE_DIM:],
            contacts=tuple(contact for i in sorted(run.record.contacts) for contact in run.record.contacts[i]),
            hits=np.array(run.record.hits, dtype=np.int64),
            quality=run.record.quality,
        )

    def _failed(self, track: Track, run: _Run) -> Estimate:
        """Measured positions and priors."""
        pairs = [run.prior(i) for i in range(len(track))]
        mean, covariance = (np.stack(part) for part in zip(*pairs, strict=True))
        result = self._result(track, run, mean, covariance, np.full((len(track), 3), np.nan))
        return replace(result, status=Status.FAILED)

"""The extended Kalman filter on filterpy shares dynamics and noise with the smoother and may add an RTS pass.

docs/estimators_ekf.md has the equations, the rules at contacts, hits and outliers, and the limits.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.linalg import LinAlgWarning

from ballfg.arrays import Array
from ballfg.checks import check_choice, check_flag
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.arrays import Advance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.rts import FilterRecord, fly_back, rts_smooth
from ballfg.estimation.filters.sliding_window import SlidingWindow, first_pair
from ballfg.estimation.filters.window_velocity import WINDOW, window_velocities
from ballfg.estimation.observations.observation import Context, refuse_unknowns
from ballfg.estimation.observations.reading import FARTHEST
from ballfg.estimation.plausible import plausible
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.result import Contact, Quality, Segmentation
from ballfg.estimation.settings import Settings, sample_sigmas, spin_start, stamp_covariance, total_sigmas
from ballfg.estimation.sides.hypotheses import HypothesisModel, SampleMeasurement, measured_at
from ballfg.estimation.sides.monitor import ContactMonitor, ContactState, widened_near_contacts, with_contact_states
from ballfg.estimation.smoother.problem import coefficient_means, trackwise_model
from ballfg.estimation.smoother.second_look.low_hops import low_hops, uncounted_note, with_low_hops
from ballfg.factors.batch import FactorBatch
from ballfg.factors.correlated_noise import bias_step
from ballfg.factors.linear.definite import raised
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, Z
from ballfg.tracks import Ball, Track

if TYPE_CHECKING:
    from ballfg.estimation.filters.ball_filter import BallFilter

REJECTED_FOR_HIT = 4  # Number of consecutive samples beyond the gate that make a hit before the first of them
HIT_POSITION = 1.0  # m, standard deviation of the position after a hit, where it restarts at the measurement
LEAST_USED = 0.5  # Least share of samples within the gate for a filter that has followed the ball
LEAST_SHARE = 1e-3
"""Least standard deviation, as a share of one sample's noise over the root of their number, or of a prior."""
LEAST_MOTION = 1e-6  # m/s and rad/s, the same for velocity and spin
NEAR_SURFACE = 0.05
"""m. Samples this close to a surface need not lie on one parabola with others: a bounce may be between."""


class ExtendedKalmanFilter(Estimator):
    """The extended Kalman filter; with `smooth`, followed by a Rauch-Tung-Striebel pass.

    The state is the 9-vector and, with `settings.coefficients`, the model's uncertain coefficients; with
    `settings.memory` the tracker's bias follows, which no estimate contains. Contacts happen where the predicted flight
    meets a surface. With `settings.find_events`, samples beyond the gate are outliers, and four of them in a row make a
    hit: the filter goes back to before the first one, widens velocity and spin by `settings.process.hit_velocity` and
    `hit_spin`, and restarts at the measurements.

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
        model: BallModel | Ball,
        surfaces: Surfaces | float,
        settings: Settings | None = None,
        smooth: bool = False,
        initialise: Literal["prior", "window"] = "prior",
    ) -> None:
        super().__init__(model, surfaces, settings)
        check_choice("initialise", initialise, ("prior", "window"))
        check_flag("smooth", smooth)
        self.ball = trackwise_model(self.model, self.settings)
        self.smooth = smooth
        self.initialise = initialise
        if smooth:
            self.name = "ekf+rts"  # type: ignore[misc]  # the class's name is that of its default

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The states of a track, each given the samples so far; with `smooth` given all samples.

        Coefficients are those of the last sample; cross covariances tie each state to the coefficients at that state.
        """
        written = self.prepared(track, factors)
        track = written.since_first()
        run = _Run(self, track)
        record = run.record
        if not (np.isfinite(record.mean).all() and np.isfinite(record.covariance).all()):
            pairs = [run.prior(i) for i in range(len(track))]
            mean, covariance = (np.stack(part) for part in zip(*pairs, strict=True))
            nothing = np.full((len(track), 3), np.nan)
            return self._result(track, run, mean, covariance, nothing, Status.FAILED).dated(written.times)
        mean, covariance = rts_smooth(record) if self.smooth else (record.mean, record.covariance)
        if record.start > 0 and (self.smooth or self.initialise == "prior"):
            fly_back(self.ball, record.start, track.times, run.flight_noise, run.fading, (mean, covariance))
        whitened = record.innovations(run.H, mean, covariance, track.positions) if self.smooth else record.whitened
        estimate = self._result(track, run, mean, covariance, whitened)
        found = run.states_near_contacts()
        if self.smooth:  # later samples show the side, except at the end
            estimate = widened_near_contacts(estimate, self.ball)
            found = {k: state for k, state in found.items() if k == len(track) - 1}
        return self._doubted(track, run, with_contact_states(estimate, found)).dated(written.times)

    def _doubted(self, track: Track, run: "_Run", estimate: Estimate) -> Estimate:
        """An estimate whose covariances allow for all hops too low to tell from rest, as the smoother's do."""
        hits = np.array(run.record.hits, dtype=np.int64)
        events = replace(Segmentation.of_contacts((), len(track)), hits=hits)
        hops = low_hops(track, events, self.model, self.surfaces, self.settings)
        estimate = replace(estimate, notes=estimate.notes + uncounted_note(hops, track.times))
        return with_low_hops(estimate, hops, self.model)

    def _result(
        self, track: Track, run: "_Run", mean: Array, covariance: Array, whitened: Array, status: Status | None = None
    ) -> Estimate:
        states, own = mean[:, :STATE_DIM], slice(STATE_DIM, STATE_DIM + len(run.means))
        estimate = Estimate(
            name=track.name,
            times=track.times,
            states=states,
            covariances=covariance[:, :STATE_DIM, :STATE_DIM],
            status=status or run.status(),
            innovations={"position": whitened, **run.innovations},
            world=self.world,
            notes=self.doubts(track),
            coefficient_names=tuple(self.settings.coefficients),
            coefficients=mean[-1, own],
            coefficient_covariance=covariance[-1, own, own],
            cross_covariances=covariance[:, :STATE_DIM, own],
            contacts=tuple(contact for i in sorted(run.record.contacts) for contact in run.record.contacts[i]),
            hits=np.array(run.record.hits, dtype=np.int64),
            quality=run.record.quality,
        )
        return plausible(estimate, track, run.sigma, self.settings)


class _Run:
    """One pass of the filter over one track; `record` holds the result."""

    def __init__(self, owner: ExtendedKalmanFilter, track: Track) -> None:
        self.owner = owner
        self.track = track
        self.settings = owner.settings.for_track(track)
        self.sigma = sample_sigmas(owner.settings, len(track), track.sigmas)
        self.velocities = window_velocities(track.times, track.positions)
        self.flight_noise = owner.settings.process.flight(np.diff(track.times))
        self.means = coefficient_means(owner.model, owner.settings)
        self.own_sigmas = np.array(list(owner.settings.coefficients.values()))
        self.bias_sigmas = self.settings.bias_sigmas[: 3 * self.settings.has_memory]
        self.fading = bias_step(np.diff(track.times), self.bias_sigmas, self.settings.memory_time)
        self.H = np.concatenate((np.eye(3, STATE_DIM + len(self.means)), np.eye(3, len(self.bias_sigmas))), axis=1)
        self.skipped: set[int] = set()
        context = Context(track, owner.model, owner.settings, self.sigma)
        beside = [one for one in track.observations if not one.locates]
        refuse_unknowns(beside, owner.settings, owner.name)
        self.beside = {one: one.batch(context) for one in beside}
        self.innovations = {one.name: np.full((len(batch), batch.dim), np.nan) for one, batch in self.beside.items()}
        self.record = FilterRecord(len(track), self.H.shape[1])
        position = LEAST_SHARE * float(self.sigma.min()) / np.sqrt(len(track))
        shares = LEAST_SHARE * np.append(self.own_sigmas, self.bias_sigmas)
        self.record.least = np.concatenate((np.full(3, position), np.full(6, LEAST_MOTION), shares))
        for k in range(len(track)):
            self.record.measurement_noise[k] = self._measurement_noise(k, self.velocities[k])
        calm = np.errstate(over="ignore", invalid="ignore", divide="ignore")
        with calm, warnings.catch_warnings(category=LinAlgWarning, action="ignore"):  # ends in a status that failed
            self._filter()

    def status(self) -> Status:
        """The status of the result: a filter that set most samples aside has lost the ball."""
        used = self.record.used
        if used.sum() < 2:
            return Status.NO_VELOCITY
        return Status.OK if used.mean() >= LEAST_USED else Status.NOT_CONVERGED

    def prior(self, i: int) -> tuple[Array, Array]:
        """The prior at sample i from that sample alone: mean (d,) and covariance (d, d)."""
        known = spin_start(self.settings.spin_label(self.track), self.settings)
        none, speed = np.zeros(len(self.bias_sigmas)), np.full(3, self.settings.velocity_prior)
        mean = np.concatenate((self.track.positions[i], np.zeros(3), known.spin, self.means, none))
        sigma = (self.sigma[i], speed, known.sigmas, self.own_sigmas, self.bias_sigmas)
        covariance = np.diag(np.concatenate(sigma) ** 2)
        covariance[SPIN, SPIN] = known.covariance
        covariance[POSITION, POSITION] = self._measurement_noise(i, self.velocities[i])
        if len(self.bias_sigmas):  # the position is the measured one less its bias
            lasting = covariance[-3:, -3:]
            covariance[POSITION, POSITION] += lasting
            covariance[POSITION, -3:] = covariance[-3:, POSITION] = -lasting
        return mean, covariance

    def states_near_contacts(self) -> dict[int, ContactState]:
        """The states to report at samples where the ball may be on either side of a contact."""
        record, times = self.record, self.track.times
        model = HypothesisModel(self.owner.ball, self.owner.surfaces, self.settings, len(self.bias_sigmas))
        monitor, found = ContactMonitor(model), dict[int, ContactState]()
        for k in range(record.start + 1, len(times)):
            if k - 1 in record.hits:
                monitor.reset()
                continue
            before, measured = (record.mean[k - 1], record.covariance[k - 1]), SampleMeasurement()
            if record.quality[k] != Quality.OUTLIER:
                measured = measured_at(self.track, self.sigma, self.beside, k)

            def bounced(count: int, k: int = k) -> bool:
                return any(i in record.contacts for i in range(k - count, k))

            state = monitor.step(before, float(times[k] - times[k - 1]), measured, bounced)
            if state is not None:
                found[k] = state
        return found

    def _measurement_noise(self, k: int, velocity: Array) -> Array:
        """(3, 3) m^2, of a sample's white error and of its stamp's error at a velocity (3,) m/s."""
        return np.diag(self.sigma[k] ** 2) + stamp_covariance(self.settings, velocity)

    def _filter(self) -> None:
        """Filters all samples in turn; after four rejected ones it goes back to before the first, with a hit there."""
        n, record = len(self.track), self.record
        ball, rejected = self._begin(), list[int]()
        k = record.start + 1
        while k < n:
            self._predict(ball, k)
            if not (np.isfinite(ball.x).all() and np.isfinite(ball.P).all()):
                record.mean[k:] = np.nan
                return
            if k in self.skipped:
                self._store(ball, k, used=False)
            elif self._accept(ball, k):
                rejected = []
            else:
                rejected.append(k)
            if len(rejected) < REJECTED_FOR_HIT:
                k += 1
                continue
            k, rejected = rejected[0], []  # the flight restarts at the first good sample from there on
            first, second = self._first_pair(k)
            self.skipped.update(range(k, first), range(first + 1, second))
            record.hits.append(first - 1)
            self.velocities = window_velocities(self.track.times, self.track.positions, record.hits)
            ball.x, ball.P = record.mean[k - 1].copy(), record.covariance[k - 1].copy()

    def _begin(self) -> "BallFilter":
        """The filter at its first sample, or at the window's end."""
        record, owner = self.record, self.owner
        first, second = self._first_pair(0)
        (mean, covariance), start = self.prior(first), first
        if owner.initialise == "window":
            start = min(first + WINDOW - 1, len(self.track) - 1)
            window = SlidingWindow(owner.model, owner.surfaces, self.settings).estimate(self.track)
            record.mean[:, :STATE_DIM] = window.states
            record.mean[:, STATE_DIM:] = mean[STATE_DIM:]
            record.covariance[:] = covariance
            record.covariance[:, :STATE_DIM, :STATE_DIM] = window.covariances
            mean, covariance = record.mean[start].copy(), record.covariance[start].copy()
            if len(self.bias_sigmas) and start > 0:  # the window takes the errors of its two ends to be independent
                span = self.track.times[start] - self.track.times[max(start - WINDOW + 1, 0)]
                slope = covariance[POSITION, -3:] / span
                covariance[VELOCITY, -3:] = covariance[-3:, VELOCITY] = slope
        record.start = start
        record.quality[:first] = Quality.OUTLIER
        self.skipped.update(range(first + 1, second))
        from ballfg.estimation.filters.ball_filter import BallFilter  # filterpy takes half a second to import

        ball = BallFilter(owner.ball, owner.surfaces, mean, covariance, self.H)
        self._correct_beside(ball, start)
        self._store(ball, start, used=True)
        return ball

    def _first_pair(self, first: int) -> tuple[int, int]:
        """The first two good samples of a flight from sample `first` on; the filter uses them without a gate."""
        if not self.settings.find_events:
            return first, first + 1
        z = self.track.positions[:, Z, None] - self.owner.model.radius
        near = np.abs(z - np.array(self.owner.surfaces.heights())).min(axis=-1, initial=np.inf) < NEAR_SURFACE
        sigma = total_sigmas(self.settings, self.sigma, lambda: self.velocities)
        return first_pair(self.track.times, self.track.positions, sigma, near, first)

    def _predict(self, ball: "BallFilter", k: int) -> None:
        times, record = self.track.times, self.record
        used = next((i for i in range(k, len(times)) if i not in self.skipped), k)
        R = self._measurement_noise(used, self.velocities[used])
        point = ball.linearisation_point(self.track.positions[used], times[used] - times[k - 1], R)
        motion = ball.move(point, times[k] - times[k - 1], float(self.fading[0][k - 1]))
        ball.Q = self._noise(k, motion)
        ball.predict()
        if np.isfinite(ball.P).all():
            ball.P = raised(ball.P, record.least)
        velocity = self.velocities[k] if ball.velocity_is_wide else ball.x[VELOCITY]
        ball.R = record.measurement_noise[k] = self._measurement_noise(k, velocity)
        record.contacts.pop(k - 1, None)
        if motion.contacts:
            begin = float(times[k - 1])
            record.contacts[k - 1] = tuple(Contact(k - 1, begin + time, height) for time, height in motion.contacts)
        record.prior_mean[k], record.prior_covariance[k] = ball.x, ball.P
        record.transition[k], record.noise[k] = ball.F, ball.Q

    def _noise(self, k: int, motion: Advance) -> Array:
        """(d, d) process noise from sample k - 1 to k: flight, contacts, a hit at an unknown time."""
        process, dt = self.settings.process, np.diff(self.track.times[k - 1 : k + 1])
        covariance = self.flight_noise[k - 1].copy()
        for time, _ in motion.contacts:
            covariance += process.contact(dt, np.array([time]))[0]
        if k - 1 in self.record.hits:
            covariance += process.hit(dt)[0]
            covariance[POSITION, POSITION] += HIT_POSITION**2 * np.eye(3)
        noise = np.zeros((len(self.record.mean[k]),) * 2)
        noise[:STATE_DIM, :STATE_DIM] = covariance
        renewed = np.arange(len(noise))[len(noise) - len(self.bias_sigmas) :]
        noise[renewed, renewed] = self.fading[1][k - 1] ** 2
        return noise

    def _accept(self, ball: "BallFilter", k: int) -> bool:
        """Updates with sample k unless it lies beyond the gate; the first sample after a hit always counts."""
        measured = self.track.positions[k]
        whitened = self.record.whitened[k] = ball.innovation(measured)
        used = not self.settings.find_events or k - 1 in self.record.hits or ball.passes(whitened)
        if used:
            ball.correct(measured)
        self._correct_beside(ball, k)
        self._store(ball, k, used)
        return used

    def _correct_beside(self, ball: "BallFilter", k: int) -> None:
        """Updates with all other measurements at sample k.

        At the first sample a speed, whose Jacobian is zero without a velocity, is skipped with an innovation of NaN. So
        is a measurement on the other side of a contact: the motion there does not follow from this state.
        """
        begins = k == self.record.start
        since = max((c.time for c in self.record.contacts.get(k - 1, ())), default=-np.inf) - self.track.times[k]
        until = ball.time_to_contact(FARTHEST) if self.beside else np.inf
        for observation, batch in self.beside.items():
            for row in observation.filter_rows(k, float(since), until):
                one = batch.select(np.array([row]))
                whitened = ball.correct_by(one, self.settings.find_events or begins)
                if not begins or ball.passes(whitened):
                    self.innovations[observation.name][row] = whitened

    def _store(self, ball: "BallFilter", k: int, used: bool) -> None:
        self.record.mean[k] = ball.x
        self.record.covariance[k] = ball.P = raised(ball.P, self.record.least)
        self.record.quality[k] = Quality.GOOD if used else Quality.OUTLIER

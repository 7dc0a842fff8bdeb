"""The online estimator updates a window of states by one observation at a time, with iSAM2 or the own solver."""

from __future__ import annotations

import copy
import gc
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.checks import (
    as_float,
    check_array,
    check_choice,
    check_count,
    check_each,
    check_flag,
    check_iterable,
    is_number,
    shown,
)
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.window_velocity import WINDOW, window_velocities
from ballfg.estimation.launcher import FIRST_SAMPLES, SHOWN, SpinLabel, group_spin, undirected_spin
from ballfg.estimation.observations.observation import Observation
from ballfg.estimation.online.events import EventTracker, explain, move_contacts, path_of, tell_velocities
from ballfg.estimation.online.final import Leaving
from ballfg.estimation.online.newest import Newest, Update
from ballfg.estimation.online.scatter import StreamScatter
from ballfg.estimation.online.state import Measurement, OnlineState, Sample, measurements_beside
from ballfg.estimation.online.stream import SightingStream
from ballfg.estimation.online.warm_up import reach_within, warmed_up
from ballfg.estimation.online.windows.chain import ChainWindow
from ballfg.estimation.online.windows.stream_window import StreamWindow
from ballfg.estimation.plausible import plausible
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.settings import Settings, Solver, sample_sigmas, spin_start, total_sigmas
from ballfg.estimation.smoother.motion import FLIGHT
from ballfg.estimation.smoother.problem import trackwise_model
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import FactorBatch
from ballfg.machine import collecting_later
from ballfg.state import STATE_DIM
from ballfg.tracks import Ball, Track
from ballfg.tracks.stamps import StreamOrigin
from ballfg.vision.camera import Camera

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

LAG = 128
"""States that stay when the window is cut: 0.7 s at 180 Hz; new samples carry no information on older ones."""
EARLIER: Final[Mapping[str, Solver]] = {"isam2": "gtsam", "chain": "ballfg"}
"""Earlier names of solvers as an argument of `Online`."""


class Online(Estimator):
    """Incremental smoothing: every observation updates the states of the whole window.

    Use `push` on a live stream of positions, `push_sighting` on one of sightings, or `estimate` on a track, which ends
    by minimising over the window to a tight tolerance.

    The settings' solver holds the linear system: "gtsam", the default, is iSAM2, which can be inspected and takes
    further factors; "ballfg" gives the same results in less time.

    Args:
        model: the ball.  surfaces: table and floor.
        settings: noise and priors; time offsets of cameras are not estimated here, see `estimate_time_offsets`.
        lag: the window is cut to this many states whenever it holds twice as many.
        cameras: that sightings come from.
        solver: earlier name of the settings' solver, "isam2" or "chain"; deprecated.
        budget_ms: that a push may take, on the machine as it is when `warm_up` measures it, or the first push. States
            too old to be linearised anew within it keep their points: with a budget of a few ms spins are a tenth to
            two fifths less accurate, positions and velocities 1 %. None: all states that moved are. The push with
            which a ball's hops become too low to count takes 20 to 100 ms all the same.
        shown_noise: True: positions without a sigma have the noise that the stream shows, not the settings'. None: if
            neither settings nor the model's file state it. Samples from before a noise showed get it too, each at the
            cost of a push, but not with a budget: with a noise of 10 mm, velocities are then up to twice as far off as
            stated for half a second.

    Attributes:
        window: the samples, states and factors that are held; None before the first observation.
        reach: number of the newest states that a push may linearise anew; None: all.
        scatter: of the stream, where it gives the noise; else None.

    Raises: ValueError: a lag below 2, time offsets in the settings, or as `Estimator`.
    """

    name = "online"
    has_graph = True

    def __init__(
        self,
        model: BallModel | Ball,
        surfaces: Surfaces | float,
        settings: Settings | None = None,
        lag: int = LAG,
        cameras: Sequence[Camera] = (),
        solver: str | None = None,
        budget_ms: float | None = None,
        shown_noise: bool | None = None,
    ) -> None:
        super().__init__(model, surfaces, settings)
        if solver is not None:
            check_choice("solver", solver, EARLIER)
            known = EARLIER[solver]
            self.settings = replace(self.settings, solver=known)
            note = f"Online(solver='{solver}') ends with version 0.2; write Settings(solver='{known}')."
            warnings.warn(note, DeprecationWarning, stacklevel=2)
        check_count("lag", lag, 2)
        if self.settings.time_offsets:
            raise ValueError(
                "settings.time_offsets must be empty for the estimator 'online': it cannot move stamps that have "
                "passed. Find the offsets beforehand with estimate_time_offsets and give the cameras that it returns."
            )
        if budget_ms is not None and not as_float("budget_ms", budget_ms, "ms") > 0.0:
            raise ValueError(f"budget_ms must be positive; got {budget_ms}. Leave it out for pushes of any length.")
        self.budget_ms = budget_ms
        self.reach: int | None = None
        self.cameras = tuple(check_each("cameras", cameras, Camera, "Read them with read_cameras."))
        self.ball = trackwise_model(self.model, self.settings)
        self.physics = physics_of(self.model)
        self.lag = lag
        unstated = settings is None and not self.model.states_position_noise
        self.shown_noise = unstated if shown_noise is None else check_flag("shown_noise", shown_noise)
        self.reset()

    def reset(self) -> None:
        """Forgets everything: the next observation begins a new stream."""
        self._begin()
        self._stream = SightingStream(self.cameras, self.settings.sighting_loss) if self.cameras else None
        self.scatter = StreamScatter(sample_sigmas(self.settings, 1, None)[0]) if self.shown_noise else None
        self._leaving: Leaving | None = None  # where someone asks for states that left the window
        self._origin = StreamOrigin()

    def _begin(self) -> None:
        """Forgets the window and what explains it."""
        self.window: StreamWindow | None = None
        self.events = EventTracker(self.surfaces, self.physics, self.settings.find_events)
        self._samples: list[Sample] = []  # of the window, also while iSAM2 is out of order
        self._undirected: SpinLabel | None = None  # prior of the spin until the launch shows its direction
        self._newest: Newest | None = None  # of the window

    def copy(self) -> Online:
        """An independent estimator with the same observations.

        A copy from before a late sample lets a stream go back: the sample and its successors are pushed into the copy
        in order, and its states are those of the ordered samples. It costs about as much as one sample.
        """
        other = copy.copy(self)
        other._samples = [copy.copy(sample) for sample in self._samples]
        for sample in other._samples:
            sample.measurements = list(sample.measurements)
        if self.window is not None:
            other.window = self.window.copy(other._samples[: len(self.window)])
        other.events = self.events.copy()
        other._newest = None if self._newest is None else self._newest.copy()
        other._stream = copy.deepcopy(self._stream)
        other.scatter = None if self.scatter is None else self.scatter.copy()
        other._origin = copy.copy(self._origin)
        return other

    def warm_up(self) -> None:
        """Runs a made-up ball through the estimator, so that a stream's first samples are no slower than later ones.

        Updates through a bounce, predictions and events are compiled or loaded. All present objects of the process are
        excluded from later garbage collections (`gc.freeze`), each of which would scan torch and take 0.2 s. The stream
        itself stays untouched.
        """
        self._keep_budget()
        warmed_up(self)
        gc.collect()
        gc.freeze()

    @collecting_later
    def push(
        self, time: float, position: ArrayLike, sigma: ArrayLike | None = None, observations: Sequence[Observation] = ()
    ) -> OnlineState:
        """Takes in a measured position, and other measurements of that time; Python collects garbage after it.

        Args:
            time: s, later than the last.
            position: (3,) m.
            sigma: (3,) m, its standard deviation; None: the settings', or that of the stream's scatter.
            observations: of this moment, as of a track with this single sample, such as `RadarSpeed(0, 6.2, 0.1)`.
        Returns: the newest state, a copy that later samples do not change.
        Raises: ValueError: if the time does not increase, or a number is not finite.
        """
        own = None if sigma is None else check_array("sigma", sigma, most=np.inf)[None]
        if own is not None and not (np.isfinite(own) & (own > 0.0)).all():
            raise ValueError(
                f"sigma must be positive and finite, in m; got {shown(sigma)}. Leave it out if it is unknown."
            )
        point = check_array("position", position, remedy="Drop samples without a position.")
        stamp = as_float("time", time) if is_number(time) else float(check_array("time", time, (), "Give it in s."))
        if self._samples and not self._samples[-1].measured:
            raise ValueError("push must not follow push_sighting in one stream; call reset in between.")
        since = self._origin.elapsed(stamp)
        if self._samples and not since > self._samples[-1].time:
            last = self.stamp_of(self._samples[-1].time)
            raise ValueError(f"time must be finite and increase; got {stamp} s after {last} s. Sort the samples.")
        scatter = self.scatter if own is None else None
        spread = sample_sigmas(self.settings, 1, own)[0] if scatter is None else scatter.sigma
        sample = Sample(since, point, spread)
        check_iterable("observations", observations)
        if others := tuple(observations):
            moment = Track(np.array([sample.time]), point[None], spread[None], name="stream", observations=others)
            beside = measurements_beside(moment, self.model, self.settings, spread[None])
            sample.measurements += [measurement for found in beside.values() for _, measurement in found]
        state = self._observe(sample)
        if scatter is not None and scatter.take(since, point):
            state = self._again(spread, scatter.sigma, state)
        return replace(state, time=stamp)

    def _again(self, before: Array, noise: Array, state: OnlineState) -> OnlineState:
        """The newest state after all samples with a noise (3,) m had another one.

        The given one, if some of them left the window or pushes have a budget: only later samples have the new noise.
        """
        assert self.window is not None
        if self.window.first > 0 or self.budget_ms is not None:
            return state
        samples = self._samples
        self._begin()
        for one in samples:
            stated = noise if one.stated is before else one.stated
            state = self._observe(Sample(one.time, one.position, stated, measurements=one.measurements))
        return replace(state, revised=len(samples) - 1)

    def stamp_of(self, seconds: float) -> float:
        """The stamp on the clock of the stream, s, of a moment that the window counts from its first sample."""
        return self._origin.written(seconds)

    @collecting_later
    def push_sighting(self, time: float, camera: str, pixel: ArrayLike, covariance: ArrayLike) -> OnlineState | None:
        """Takes in one camera's sighting, at its own stamp.

        Args:
            time: s, the camera's stamp; less the camera's time offset it must not be earlier than the last one's.
            camera: its name, one of `cameras`.
            pixel: (2,) px, of the ball's centre.
            covariance: (2, 2) px^2.
        Returns: the newest state; None while rays do not determine the ball's place: with two cameras or more, for the
            first two or three frames of a flight.
        Raises: ValueError: an unknown camera, a time that runs backwards, a number that is not finite.
        """
        if self._stream is None:
            raise ValueError("cameras must be given to use push_sighting; got none. Pass them to Online.")
        if self._samples and self._samples[-1].measured:
            raise ValueError("push_sighting must not follow push in one stream; call reset in between.")
        since = self._origin.elapsed(as_float("time", time, "s"))
        samples, joined = self._stream.take(since, camera, pixel, covariance)
        state = None if joined is None else self._join(joined)
        for sample in samples:
            state = self._observe(sample)
        return state and replace(state, time=self.stamp_of(state.time))

    @np.errstate(over="ignore", invalid="ignore")  # samples that no ball flew give a status, not warnings
    def _observe(self, sample: Sample) -> OnlineState:
        """Takes in a sample."""
        self._tell_whole_error(sample)
        changed = self.events.push(sample.time, sample.position, sample.whole)  # also checks the numbers
        if self.window is None:
            if sample.label is None and self.settings.spins is not None:
                sample.label = self._undirected = undirected_spin(self.settings.spins, self.settings.group)
            self.window = self._new_window(sample)
        before = self.window.newest_in_order if len(self.window) else None
        self._samples.append(sample)
        status, rebuilt = Status.OK if len(self._samples) > 1 else Status.NO_VELOCITY, False
        try:
            revised, innovation = self._take_in(self.window, sample, changed)
        except (RuntimeError, ValueError) as error:  # GTSAM's, the bridge's or the model's
            rebuilt, revised = True, len(self._samples) - 1
            status, innovation = self._repair(error, status)
        newest = self._samples[-1]
        if status is Status.OK and not newest.motion.linked:  # a long gap before it
            status = Status.NO_VELOCITY
        assert self._newest is not None
        update = Update(status, innovation, revised, rebuilt)
        return self._newest.after(self.window, self._samples, None if rebuilt else before, update)

    def _new_window(self, sample: Sample) -> StreamWindow:
        """A window that begins with a sample; only measured positions have a tracker's bias."""
        biased = self.settings.has_memory and sample.measured
        kind: type[StreamWindow] = ChainWindow
        if self.settings.solver != "ballfg":
            from ballfg.estimation.online.windows.window import IsamWindow  # GTSAM takes a tenth of a second to import

            kind = IsamWindow
        self._keep_budget()
        window = kind(self.ball, self.settings, float(sample.stated.min()), biased, self.reach)
        self._newest = Newest(self, window.width - STATE_DIM)
        return window

    def _keep_budget(self) -> None:
        """Measures, once, how many states a push may linearise anew."""
        if self.budget_ms is not None and self.reach is None:
            self.reach = reach_within(self, self.budget_ms)

    def _tell_whole_error(self, sample: Sample) -> None:
        """Sets standard deviations of a new sample's whole error, and the rough velocity for its stamp's error."""
        sample.whole = sample.stated
        if not sample.measured:
            return
        last = [*self._samples[1 - WINDOW :], sample]
        in_order = len(last) > 1 and sample.time > last[-2].time and np.isfinite(sample.position).all()
        if self.settings.stamp_jitter > 0.0 and in_order:
            sample.velocity = window_velocities(*path_of(last))[-1]
        sample.whole = total_sigmas(self.settings, sample.stated, lambda: sample.velocity)

    @np.errstate(over="ignore", invalid="ignore")
    def _join(self, sighting: Measurement) -> OnlineState:
        """Takes in one more sighting of the newest sample."""
        assert self.window is not None
        self._samples[-1].measurements.append(sighting)
        try:
            update = Update(Status.OK, self.window.attach(sighting))
        except (RuntimeError, ValueError) as error:
            update = Update(*self._repair(error, Status.OK), rebuilt=True)
        assert self._newest is not None
        return self._newest.joined(self.window, self._samples, sighting, update)

    def _take_in(self, window: StreamWindow, sample: Sample, changed: bool) -> tuple[int, Array]:
        """Explains, goes back to where the explanation changed, appends, moves contacts, cuts the window.

        Returns: number of samples that were explained anew, and the whitened innovation of the newest one.
        """
        again = explain(window, self._samples, self.events) if changed else []
        if self.settings.stamp_jitter > 0.0 and sample.measured:
            tell_velocities(window, self._samples)
        innovation = window.append_all([*again, sample])
        moved = move_contacts(window, self._samples, self.events)
        if moved:
            window.append_all(moved)
        if window.first == 0 and self._undirected is not None and self._launch_shows():
            assert self.settings.spins is not None
            launch = Track(*path_of(self._samples), name="stream", part=True)
            self._samples[0].label = group_spin(self.settings.spins, launch, self.settings.group)
            innovation = window.start_anew(self._samples)
        assert self._newest is not None
        rolls = self._newest.rolls_at_first(self._samples, window.first)
        if window.first == 0 and rolls != self._samples[0].rolls:
            self._samples[0].rolls = rolls
            innovation = window.start_anew(self._samples)
        if len(window) > 2 * self.lag:
            if self._leaving is not None:
                self._leaving.take(window, self.events, len(window) - self.lag)
            window.shorten(self.lag)
            self._samples = list(window.samples)
        return max(len(again), len(moved)), innovation

    def _launch_shows(self) -> bool:
        """Whether the direction of the launch is known for the first time, or is final with this sample."""
        first, last = self._samples[0], self._samples[-1]
        sigma = float(np.maximum(first.sigma, last.sigma)[:2].max())
        way = float(np.hypot(*(last.position - first.position)[:2]))
        return (first.label is self._undirected and way > SHOWN * sigma) or len(self._samples) == FIRST_SAMPLES

    def _repair(self, error: Exception, status: Status) -> tuple[Status, Array]:
        """Rebuilds the window from its samples; if that fails as well, begins a new one with the newest sample."""
        assert self.window is not None
        try:
            return status, self.window.start_anew(self._samples)
        except (RuntimeError, ValueError):
            if self._leaving is not None:
                self._leaving.lose(self._samples[:-1], self.window.p)
            first = self.window.first + len(self._samples) - 1
            newest = replace(self._samples[-1], motion=FLIGHT, slots=(), bias_slot=None)
        self.window = self._new_window(newest)
        self.window.first = first
        self._samples = [newest]
        try:
            return Status.FAILED, self.window.append_all([newest])
        except (RuntimeError, ValueError):
            raise error from None

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = ()) -> Estimate:
        """The states of a track: all samples are pushed, then the window is minimised to a tight tolerance.

        States that left the window before the end stay as its minimum had them then. The innovations are those of the
        pushes. Events are found in the positions, even if these are rough.
        """
        stamps, track = track.times, self.prepared(track, factors).since_first()
        self.reset()
        leaving = self._leaving = Leaving(Smoother(self.model, self.surfaces, self.settings), track)
        label = self.settings.spin_label(track)
        if label is None and self.settings.spins is not None:
            label = spin_start(None, self.settings)  # else the first sample has the spins of a stream of any group
        sigma = sample_sigmas(self.settings, len(track), track.sigmas)
        samples = [
            Sample(float(t), position, spread, label=label if k == 0 else None, measured=not track.rough)
            for k, (t, position, spread) in enumerate(zip(track.times, track.positions, sigma, strict=True))
        ]
        beside = measurements_beside(track, self.model, self.settings, sigma)
        for k, measurement in chain.from_iterable(beside.values()):
            samples[k].measurements.append(measurement)
        states = [self._observe(sample) for sample in samples]
        innovations = {} if track.rough else {"position": np.array([state.innovation for state in states])}
        for name, measurements in beside.items():
            innovations[name] = np.array([measurement.innovation for _, measurement in measurements])
        assert self.window is not None
        first = self.window.first
        result = leaving.whole(self.window, self.events)
        self.reset()
        lost = any(state.status is Status.FAILED for state in states)
        status = Status.NOT_CONVERGED if lost and not result.status.failed else result.status
        result = replace(result, innovations=innovations, status=status)
        result = plausible(result, track, sigma, self.settings) if first else result
        return result.dated(stamps)

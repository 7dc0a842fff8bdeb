"""Makes tracks with known truth by two protocols, with the compared estimators, and computes their errors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.gaussian_settings import StepNoise, gaussian_settings
from ballfg.benchmarks.metrics import inside, nees, square_norms
from ballfg.benchmarks.results import in_processes
from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout
from ballfg.dynamics.motion.contact import contact_time
from ballfg.estimation import Estimator, ExtendedKalmanFilter, Online, Settings, SlidingWindow, Smoother, Status
from ballfg.estimation.filters.sliding_window import WINDOW
from ballfg.estimation.registry import ESTIMATORS
from ballfg.factors.noise import ProcessNoise
from ballfg.progress import progress
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, simulate, table_tennis
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ
from ballfg.tracks import Track
from ballfg.tracks.track import SPIN_LABELS

PAPER_SAMPLES = 80
PAPER_RATE = 100.0  # Hz
PAPER_NOISE = 0.005  # m. The paper gives none; triangulated detections of its cameras should be about that good.
KNOWN_SPIN = 0.01  # rad/s, and rad/s/sqrt(s): the spin is given, and does not change

FAIR_NOISE = 0.003  # m
FAIR_SPIN_NOISE = 4.0  # rad/s, of the spin labels

AT_BOUNCE = 1e-3
"""s. At a sample this close to a bounce the position, by its noise, does not tell whether the ball has bounced already.
The velocities before and after differ by several m/s, so that the error there would be decided by chance."""


@dataclass(frozen=True)
class Case:
    """A measured track and its truth."""

    track: Track  # all that an estimator sees
    true_states: Array  # (n, 9)
    away: NDArray[np.bool_]  # (n,) False for samples within `AT_BOUNCE` of a true bounce


@dataclass(frozen=True)
class Candidate:
    """An estimator in a comparison.

    Attributes:
        estimator: with its settings.
        newest: how its state at the newest of k samples is found. "pass": a state depends on no later sample, so that
            one pass over a track gives it for every k. "anew": the first k samples are estimated for each k.
            "none": it is not asked for.
    """

    estimator: Estimator
    newest: Literal["pass", "anew", "none"] = "anew"


@dataclass(frozen=True)
class Protocol:
    """Synthetic tracks and the estimators that are compared on them, with the same settings for all."""

    name: str  # the case in `results.json`
    settings: Settings  # of every estimator
    tracks: list[Case]  # with their truth
    candidates: Mapping[str, Candidate]  # by method
    surfaces: Surfaces  # that the ball bounces on


def paper_protocol(count: int, seed: int) -> Protocol:
    """Free flights of the analytic model from random states; everyone knows the true dynamics and the true spin.

    The paper sets the process noise equal to the noise that was added to the tracks, and gives the same covariance to
    the graph: here sigma^2 on each coordinate (m^2) and on each velocity component ((m/s)^2) at every step. The truth
    has none.

    In the paper filter and graph start from the mean velocity of the first five samples. To the filter that is a
    belief, in place of these samples; to the graph a place to start the minimisation from. `ekf-no-window` starts like
    the graph: it knows nothing and takes in every sample.

    Source: Xiao, Wu, Gombolay 2024, section IV, "Estimators".
    """
    model, surfaces = nominal_model(), Surfaces(-1e3)
    noise = StepNoise(spin=KNOWN_SPIN, step_position=PAPER_NOISE, step_velocity=PAPER_NOISE)
    settings = gaussian_settings(PAPER_NOISE, noise, KNOWN_SPIN)
    tracks = _free_flights(model, surfaces, count, np.random.default_rng([seed, 1]))
    given = (model, surfaces, settings)
    candidates = {
        "sliding-window": Candidate(SlidingWindow(*given), newest="pass"),
        "ekf": Candidate(ExtendedKalmanFilter(*given, initialise="window"), newest="pass"),
        "ekf-no-window": Candidate(ExtendedKalmanFilter(*given), newest="pass"),
        "smoother": Candidate(Smoother(*given)),
        **others(*given),
    }
    return Protocol("paper", settings, tracks, candidates, surfaces)


def others(model: BallModel, surfaces: Surfaces, settings: Settings) -> dict[str, Candidate]:
    """The registered estimators of the user and of other packages, by name; none unless such a package is installed."""
    own = (SlidingWindow, ExtendedKalmanFilter, Online, Smoother)
    return {name: Candidate(sort(model, surfaces, settings)) for name, sort in ESTIMATORS.items() if sort not in own}


def _free_flights(model: BallModel, surfaces: Surfaces, count: int, rng: np.random.Generator) -> list[Case]:
    """Random shots within table tennis's range: 3 to 12 m/s, up to 30 degrees up or down, up to 150 rad/s per axis."""
    start = np.zeros((count, STATE_DIM))
    speed, azimuth = rng.uniform(3.0, 12.0, count), rng.uniform(-np.pi, np.pi, count)
    elevation = np.deg2rad(rng.uniform(-30.0, 30.0, count))
    level = speed * np.cos(elevation)
    start[:, POSITION] = rng.uniform(-1.0, 1.0, (count, 3))
    start[:, VELOCITY] = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), speed * np.sin(elevation)), -1)
    start[:, SPIN] = rng.uniform(-150.0, 150.0, (count, 3))
    times = np.arange(PAPER_SAMPLES) / PAPER_RATE
    with torch.no_grad():
        truth = rollout(model, torch.from_numpy(start), torch.from_numpy(times), surfaces).numpy()
    measured = truth[..., POSITION] + PAPER_NOISE * rng.standard_normal((count, PAPER_SAMPLES, 3))
    labels = [dict(zip(SPIN_LABELS, map(float, spin), strict=True)) for spin in start[:, SPIN]]
    away = np.ones(PAPER_SAMPLES, dtype=bool)
    return [Case(Track(times, measured[i], labels=labels[i], name=f"{i:03d}"), truth[i], away) for i in range(count)]


def fair_protocol(count: int, seed: int, name: str = "fair") -> Protocol:
    """The launcher's tracks with their bounces; all estimators know the true noise.

    The truth is disturbed with exactly the process noise of the settings; spin labels carry noise; nothing is an
    outlier and nothing hits the ball, so the loss is squared and no such event is looked for. At the newest sample the
    RTS pass leaves the filter's state as it is, so that `ekf+rts` is not asked for it.
    """
    process, kind = ProcessNoise(), table_tennis()
    config = SimulationConfig(
        tracks=count,
        seed=seed,
        ball=kind,
        noise=MeasurementNoise(position=FAIR_NOISE, spin=FAIR_SPIN_NOISE),
        process=MotionNoise(
            acceleration=process.acceleration,
            spin=process.spin,
            contact_velocity=process.contact_velocity,
            contact_spin=process.contact_spin,
        ),
    )
    tracks = [
        Case(s.track, s.true_states, away_from_bounces(s.true_times, s.true_states, kind.model, kind.surfaces))
        for s in progress(simulate(config), count, "tracks simulated")
    ]
    settings = gaussian_settings(FAIR_NOISE, process, FAIR_SPIN_NOISE)
    given = (kind.model, kind.surfaces, settings)
    candidates = {
        "sliding-window": Candidate(SlidingWindow(*given), newest="pass"),
        "ekf": Candidate(ExtendedKalmanFilter(*given), newest="pass"),
        "ekf+rts": Candidate(ExtendedKalmanFilter(*given, smooth=True), newest="none"),
        "online": Candidate(Online(*given)),
        "smoother": Candidate(Smoother(*given)),
        **others(*given),
    }
    return Protocol(name, settings, tracks, candidates, kind.surfaces)


@torch.no_grad()
def away_from_bounces(times: Array, states: Array, model: BallModel, surfaces: Surfaces) -> NDArray[np.bool_]:
    """(n,) False for samples within `AT_BOUNCE` of a bounce, by flying each true state (n, 9) on to the next stamp."""
    state, dt = torch.from_numpy(states[:-1]), np.diff(times)
    tau = contact_time(model, state, surfaces.height_below(state, model.surface_offset(state))).numpy()
    rises = np.diff(states[:, VZ]) > 0.0
    bounces = rises & (tau > -AT_BOUNCE) & (tau < dt + AT_BOUNCE)
    away = np.ones(len(times), dtype=bool)
    away[:-1] &= ~(bounces & (tau < AT_BOUNCE))
    away[1:] &= ~(bounces & (dt - tau < AT_BOUNCE))
    return away


LEVELS = (0.5, 0.9)  # Levels of the intervals with a reported coverage


@dataclass(frozen=True)
class TrackScore:
    """The errors of one estimate of n samples."""

    velocity: Array  # (n,) m/s, length of the error
    position: Array  # (n,) m
    spin: Array  # (n,) rad/s
    nees: Array  # (n,) of the whole state, 9 degrees of freedom
    velocity_nees: Array  # (n,) 3 degrees of freedom
    covered: NDArray[np.bool_]  # (levels, n, 9) whether each component lies in the central interval of each of `LEVELS`
    away: NDArray[np.bool_]  # (n,) the sample is not at a bounce (`away_from_bounces`)
    newest: Array  # (k,) m/s, velocity error at the newest sample for each number of observations; NaN beyond the track
    ok: bool  # True if the estimate succeeded


Scores = dict[str, list[TrackScore]]  # By method, in the order of the tracks


def score_tracks(
    candidates: Mapping[str, Candidate], tracks: Sequence[Case], counts: Sequence[int], jobs: int, what: str
) -> Scores:
    """Scores of every candidate on every track.

    Args: counts: numbers of observations for `TrackScore.newest`.  what: for the progress line.
    """

    def scored(case: Case) -> dict[str, TrackScore]:
        return {name: score_track(candidate, case, counts) for name, candidate in candidates.items()}

    per_track = in_processes(scored, tracks, jobs, what)
    return {name: [scores[name] for scores in per_track] for name in candidates}


def score_track(candidate: Candidate, case: Case, counts: Sequence[int]) -> TrackScore:
    """Score of one estimator on one track. The estimator sees the measured track, never the truth."""
    estimate = candidate.estimator.estimate(case.track)
    errors, covariances = estimate.states - case.true_states, estimate.covariances
    speed_error = np.sqrt(square_norms(errors[:, VELOCITY]))
    return TrackScore(
        velocity=speed_error,
        position=np.sqrt(square_norms(errors[:, POSITION])),
        spin=np.sqrt(square_norms(errors[:, SPIN])),
        nees=nees(errors, covariances),
        velocity_nees=nees(errors[:, VELOCITY], covariances[:, VELOCITY, VELOCITY]),
        covered=np.stack([inside(errors, estimate.sigmas, level) for level in LEVELS]),
        away=case.away,
        newest=_newest(candidate, case, speed_error, counts),
        ok=estimate.status is Status.OK,
    )


def _newest(candidate: Candidate, case: Case, whole: Array, counts: Sequence[int]) -> Array:
    """(k,) m/s: velocity error at sample k - 1 when k samples were seen."""
    track = case.track
    found = np.full(len(counts), np.nan)
    for i, count in enumerate(counts):
        if count > len(track) or not case.away[count - 1] or candidate.newest == "none":
            continue
        if candidate.newest == "pass":
            found[i] = whole[count - 1]
        else:
            seen = candidate.estimator.estimate(track.until(float(track.times[count - 1])))
            found[i] = np.linalg.norm(seen.states[-1, VELOCITY] - case.true_states[count - 1, VELOCITY])
    return found


Selection = Callable[[TrackScore], NDArray[np.bool_]]  # (n,) True for samples that count


def judged(score: TrackScore) -> NDArray[np.bool_]:
    """(n,) the judged samples: the sliding window is full, and no bounce is at them."""
    mask = score.away.copy()
    mask[: WINDOW - 1] = False
    return mask


def every(score: TrackScore) -> NDArray[np.bool_]:
    """(n,) all samples."""
    return np.ones_like(score.away)


def sums_and_counts(values: Sequence[NDArray[np.generic]]) -> tuple[Array, Array]:
    """(m,) the sum of each track's values, and (m,) their number."""
    return np.array([float(v.sum()) for v in values]), np.array([float(v.size) for v in values])


def pooled(scores: Sequence[TrackScore], name: str, power: int, select: Selection = judged) -> tuple[Array, Array]:
    """For each track the sum of a field of its score to a power over the selected samples, and their number."""
    return sums_and_counts([getattr(score, name)[select(score)] ** power for score in scores])


def covered(scores: Sequence[TrackScore], level: int, block: slice) -> tuple[Array, Array]:
    """For each track how many components of a block lie in the interval of `LEVELS[level]`, and how many there are."""
    return sums_and_counts([score.covered[level, judged(score), block] for score in scores])

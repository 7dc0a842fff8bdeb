"""Makes tracks with known truth by the paper's and by the fair protocol, with the compared estimators."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.gaussian_settings import StepNoise, gaussian_settings
from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout
from ballfg.dynamics.motion.contact import contact_time
from ballfg.estimation import Estimator, ExtendedKalmanFilter, Online, Settings, SlidingWindow, Smoother
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

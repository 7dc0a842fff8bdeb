"""Tracks with known truth, and the settings that fit them: those of the paper's protocol and those of the fair one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.benchmarks.estimators.step_noise import StepNoise
from ballfg.dynamics import BallModel, Surfaces, contact_time, nominal_model, rollout
from ballfg.estimation import Settings
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate, table_tennis
from ballfg.simulation import ProcessNoise as TrueProcessNoise
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ
from ballfg.tracks import SPIN_LABELS, Track

Array = NDArray[np.float64]

PAPER_SAMPLES = 80
PAPER_RATE = 100.0
"""Hz."""
PAPER_NOISE = 0.005
"""m. The paper gives none; triangulated detections of its cameras should be about that good."""
KNOWN_SPIN = 0.01
"""rad/s, and rad/s/sqrt(s): the spin is given, and does not change."""

FAIR_NOISE = 0.003
"""m."""
FAIR_SPIN_NOISE = 4.0
"""rad/s, of the spin labels."""


AT_BOUNCE = 1e-3
"""s. At a sample this close to a bounce the position, by its noise, does not tell whether the ball has bounced already,
and the velocities before and after differ by several m/s: what would be judged is a coin's fall."""


@dataclass(frozen=True)
class Case:
    """A measured track and its truth.

    Attributes:
        track: all that an estimator sees.
        true_states: (n, 9).
        away: (n,) False for samples within `AT_BOUNCE` of a true bounce.
    """

    track: Track
    true_states: Array
    away: NDArray[np.bool_]


@dataclass(frozen=True)
class Protocol:
    """Synthetic tracks and what every estimator is told about them.

    Attributes:
        name: the case in `results.json`.
        model: the true dynamics, known to all.
        surfaces: what the ball bounces on.
        settings: the same for all.
        tracks: with their truth.
    """

    name: str
    model: BallModel
    surfaces: Surfaces
    settings: Settings
    tracks: list[Case]


def gaussian_settings(
    position: float, process: ProcessNoise, spin_label: float, coefficients: Mapping[str, float] | None = None
) -> Settings:
    """Settings for noise that is Gaussian and as declared: squared losses, nothing to look for but contacts.

    Args:
        position: m.  process: of the motion.  spin_label: rad/s.
        coefficients: prior standard deviations of those that are estimated with each track; none if left out.
    """
    squared = Loss("squared")
    return Settings(
        position_noise=(position,) * 3,
        process=process,
        spin_label_noise=spin_label,
        loss=squared,
        spin_loss=squared,
        label_loss=squared,
        find_events=False,
        coefficients=coefficients or {},
    )


def paper_protocol(count: int, seed: int) -> Protocol:
    """Free flights of the analytic model from random states; everyone knows the true dynamics and the true spin.

    The paper sets the process noise equal to the noise that was added to the tracks, and gives the same covariance to
    the graph: here sigma^2 on each coordinate (m^2) and on each velocity component ((m/s)^2) at every step. The truth
    has none.

    Source: Xiao, Wu, Gombolay 2024, section IV, "Estimators".
    """
    model, surfaces = nominal_model(), Surfaces(-1e3)
    noise = StepNoise(spin=KNOWN_SPIN, step_position=PAPER_NOISE, step_velocity=PAPER_NOISE)
    settings = gaussian_settings(PAPER_NOISE, noise, KNOWN_SPIN)
    rng = np.random.default_rng([seed, 1])
    return Protocol("paper", model, surfaces, settings, _free_flights(model, surfaces, count, rng))


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
    return [Case(Track(f"{i:03d}", times, measured[i], labels=labels[i]), truth[i], away) for i in range(count)]


def fair_protocol(count: int, seed: int, name: str = "fair") -> Protocol:
    """The launcher's tracks with their bounces; noise is what is declared, for everyone.

    The truth is disturbed with exactly the process noise of the settings; spin labels carry noise; nothing is an
    outlier and nothing hits the ball, so the loss is squared and no such event is looked for.
    """
    process = ProcessNoise()
    kind = table_tennis()
    config = SimulationConfig(
        tracks=count,
        seed=seed,
        ball=kind,
        noise=MeasurementNoise(position=FAIR_NOISE, spin=FAIR_SPIN_NOISE),
        process=TrueProcessNoise(
            acceleration=process.acceleration,
            spin=process.spin,
            contact_velocity=process.contact_velocity,
            contact_spin=process.contact_spin,
        ),
    )
    settings = gaussian_settings(FAIR_NOISE, process, FAIR_SPIN_NOISE)
    cases = [
        Case(s.track, s.true_states, away_from_bounces(s.true_times, s.true_states, kind.model, kind.surfaces))
        for s in simulate(config)
    ]
    return Protocol(name, kind.model, kind.surfaces, settings, cases)


@torch.no_grad()
def away_from_bounces(times: Array, states: Array, model: BallModel, surfaces: Surfaces) -> NDArray[np.bool_]:
    """(n,) False for samples within `AT_BOUNCE` of a bounce, by flying each true state on to the next stamp.

    Args: times: (n,) s.  states: (n, 9), the truth.  model: how it moves.  surfaces: on what it bounces.
    """
    state, dt = torch.from_numpy(states[:-1]), np.diff(times)
    tau = contact_time(model, state, surfaces.height_below(state)).numpy()
    rises = np.diff(states[:, VZ]) > 0.0
    bounces = rises & (tau > -AT_BOUNCE) & (tau < dt + AT_BOUNCE)
    away = np.ones(len(times), dtype=bool)
    away[:-1] &= ~(bounces & (tau < AT_BOUNCE))
    away[1:] &= ~(bounces & (dt - tau < AT_BOUNCE))
    return away

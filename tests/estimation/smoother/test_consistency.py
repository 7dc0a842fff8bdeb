"""The smoother's covariances are honest: NEES and NIS over simulated tracks whose noise is what the settings declare.

Process noise in flight, kicks in contacts, label noise, a bounce or two in every track. Per track the NEES is averaged
over its stamps; were they independent, the band would be narrower than the one used here, which counts each track once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import EFFECTS
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise as TrueNoise, SimulationConfig, simulate
from tests.estimation.nees import GAUSSIAN, band, inside, nees

TRACKS = 60
CONFIG = SimulationConfig(
    tracks=TRACKS,
    seed=3,
    process=TrueNoise(acceleration=0.1, spin=1.0, contact_velocity=0.02, contact_spin=5.0),
    noise=MeasurementNoise(position=0.003, spin=4.0),
)
SETTINGS = replace(
    GAUSSIAN,
    position_noise=(0.003,) * 3,
    process=ProcessNoise(acceleration=0.1, spin=1.0, contact_velocity=0.02, contact_spin=5.0),
    spin_label_noise=4.0,
)


@pytest.fixture(scope="module")
def runs():
    smoother = Smoother(CONFIG.ball.model, CONFIG.ball.surfaces, SETTINGS)
    return [(simulated, smoother.estimate(simulated.track)) for simulated in simulate(CONFIG)]


def test_all_converge_and_find_their_bounces(runs) -> None:
    for simulated, estimate in runs:
        assert estimate.status is Status.OK
        bounces = np.flatnonzero(np.diff(simulated.true_states[:, 5]) > 0.5)
        assert len(estimate.contacts) == len(bounces)


@pytest.mark.parametrize(
    ("part", "dimension"),
    [(slice(0, 9), 9), (slice(0, 3), 3), (slice(3, 6), 3), (slice(6, 9), 3)],
    ids=["state", "position", "velocity", "spin"],
)
def test_nees_is_inside_its_band(runs, part, dimension) -> None:
    means = [nees(estimate, simulated.true_states, part).mean() for simulated, estimate in runs]
    assert inside(np.mean(means), dimension, TRACKS)


@pytest.mark.parametrize("place", [0.0, 0.25, 0.5, 0.75, 1.0])
def test_nees_is_inside_its_band_at_one_stamp_a_track(runs, place) -> None:
    """Start, middle and end of the tracks: one stamp each, which are independent."""
    values = []
    for simulated, estimate in runs:
        values.append(nees(estimate, simulated.true_states)[round(place * (len(estimate.times) - 1))])
    assert inside(np.mean(values), 9, TRACKS)


def test_innovations_are_standard_normal(runs) -> None:
    """About 20,000 numbers: their standard deviation to 2 %, their mean to 0.02, none beyond 5."""
    whitened = np.concatenate([estimate.whitened for _, estimate in runs])
    np.testing.assert_allclose(whitened.std(axis=0), 1.0, atol=0.03)
    np.testing.assert_allclose(whitened.mean(axis=0), 0.0, atol=0.03)
    assert np.abs(whitened).max() < 5.5
    assert (np.abs(whitened) < 1.96).mean() == pytest.approx(0.95, abs=0.005)


def test_half_the_noise_is_noticed(runs) -> None:
    """The test has power: a smoother told half the measurement noise falls out of the band."""
    wrong = Settings(**{**vars(SETTINGS), "position_noise": (0.0015,) * 3})
    smoother = Smoother(CONFIG.ball.model, CONFIG.ball.surfaces, wrong)
    values = []
    for simulated, _ in runs[:15]:
        estimate = smoother.estimate(simulated.track)
        values.append(nees(estimate, simulated.true_states).mean())
    assert np.mean(values) > band(9, TRACKS)[1]


def test_coefficients_of_a_track_are_honest() -> None:
    """Truth drawn from the coefficients' priors; estimated with the track: their errors in their own covariance."""
    names = coefficient_sigmas(CONFIG.ball.model)
    rng = np.random.default_rng(8)
    settings = Settings(**{**vars(SETTINGS), "coefficients": names})
    smoother = Smoother(CONFIG.ball.model, CONFIG.ball.surfaces, settings)
    nominal = {n: float(p.detach()) for n, p in CONFIG.ball.model.named_parameters()}
    values, states = [], []
    for i in range(count := 12):
        truth = {name: nominal[name] + sigma * rng.standard_normal() for name, sigma in names.items()}
        effects = []
        for full, value in truth.items():
            _, effect, coefficient = full.split(".")
            effects.append(EFFECTS[effect](**{coefficient: min(value, 1.0)}))
        config = SimulationConfig(
            tracks=1, seed=100 + i, process=CONFIG.process, noise=CONFIG.noise, undeclared=tuple(effects)
        )
        simulated = next(simulate(config))
        estimate = smoother.estimate(simulated.track)
        assert estimate.status is Status.OK
        assert estimate.coefficient_names == tuple(names)
        error = estimate.coefficients - np.array(list(truth.values()))
        values.append(error @ np.linalg.solve(estimate.coefficient_covariance, error))
        states.append(nees(estimate, simulated.true_states).mean())
        assert estimate.cross_covariances.shape == (len(simulated.track), 9, len(names))
    assert inside(np.mean(values), len(names), count)
    assert inside(np.mean(states), 9, count)

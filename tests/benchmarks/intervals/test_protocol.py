"""Predictions judged both ways round, and the simulated trackers that a diagnosis should name."""

import numpy as np
import pytest

from ballfg.benchmarks.intervals.suite import (
    HORIZON,
    OBSERVED,
    PLANTED,
    USUAL,
    judge,
    judged_both_ways,
    planted_config,
    simulated_config,
)
from ballfg.dynamics import load_model
from ballfg.estimation import dataset_settings, dataset_surfaces
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from ballfg.tracks import read_dataset

SIGMA = 0.002


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """The true ball, surfaces, settings, and six tracks of 0.8 s with white noise alone."""
    folder = tmp_path_factory.mktemp("shots") / "made"
    write_simulation(folder, SimulationConfig(tracks=6, rate=100.0, seed=4, noise=MeasurementNoise(position=SIGMA)))
    dataset = read_dataset(folder)
    model = load_model(folder / "model.yaml", radius=dataset.ball.radius)
    return model, dataset_surfaces(dataset), dataset_settings(dataset, model), list(dataset)


def test_errors_of_the_true_model_are_those_that_it_foretells(shots) -> None:
    model, surfaces, settings, tracks = shots
    judged = judge(model, surfaces, settings, tracks, 1, first=10)
    assert judged.failed == 0
    assert np.unique(judged.tracks).tolist() == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]
    first = np.flatnonzero(np.diff(judged.tracks, prepend=0.0))  # of each track: the sample after the observed part
    assert np.abs(judged.errors[first]).max() < 6.0 * SIGMA
    assert 0.3 < np.median(judged.nis) < 5.0  # 2.37 of many with the noise of this ball, less with the usual one
    squares = (judged.errors**2).sum(axis=1)
    assert judged.rmse_by_track()[2] == pytest.approx(np.sqrt(squares[judged.tracks == 12.0].mean()))
    for number, track in enumerate(tracks, 10):
        since = track.times - track.times[0]
        assert (judged.tracks == number).sum() == ((since > OBSERVED) & (since <= OBSERVED + HORIZON)).sum()


def test_each_track_is_judged_once(shots) -> None:
    model, surfaces, settings, tracks = shots
    both = judged_both_ways(USUAL, model, surfaces, settings, tracks, 1, position_known=True)
    assert len(np.unique(both.tracks)) == len(tracks)
    assert len(both.errors) == len(judge(model, surfaces, settings, tracks, 1).errors)


@pytest.mark.parametrize("number", range(2 * len(PLANTED)))
def test_stamps_of_a_planted_tracker_stay_in_order(number) -> None:
    """Jitter of a 0.15th of a frame at most: the rate is lowered where it would be more, and only there."""
    config = planted_config(3, number, 8)
    share = config.noise.jitter * config.rate
    assert config.noise == PLANTED[number % len(PLANTED)]
    assert share <= 0.15 + 1e-12
    assert config.rate == 120.0 or share == pytest.approx(0.15)
    assert config.spin_labels is (number < len(PLANTED))


def test_simulated_trackers_differ_and_are_fixed() -> None:
    made = [simulated_config(3, number, 8) for number in range(20)]
    again = [simulated_config(3, number, 8) for number in range(20)]
    assert [(c.rate, c.noise, c.seed) for c in made] == [(c.rate, c.noise, c.seed) for c in again]
    assert len({config.seed for config in made}) == 20
    assert all(config.noise.jitter * config.rate <= 0.15 + 1e-12 for config in made)
    assert len({config.rate for config in made}) > 1
    assert all(0.001 <= config.noise.position <= 0.006 for config in made)
    assert all(config.noise.memory == 0.0 or 0.001 <= config.noise.memory <= 0.004 for config in made)

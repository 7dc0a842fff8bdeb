"""Predictions judged both ways round, and the simulated trackers that a diagnosis should name."""

import numpy as np
import pytest

from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE
from ballfg.benchmarks.intervals.suite import (
    PLANTED,
    USUAL,
    add_judged,
    judge,
    judged_both_ways,
    planted_config,
    simulated_config,
)
from ballfg.benchmarks.results import Results
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
    judged = judge(model, surfaces, settings, tracks, 1)
    assert [one.name for one in judged] == [track.name for track in tracks]
    errors = [one.measured - one.positions for one in judged]
    assert max(np.abs(each[0]).max() for each in errors) < 6.0 * SIGMA  # of the sample after the observed part
    results = Results("test", 0)
    add_judged(results, "made", USUAL, judged)
    assert results.value("made", USUAL, "failed") == 0
    assert 0.3 < results.value("made", USUAL, "nis_median") < 5.0  # 2.37 of many with the noise of this ball
    rmse = [1e3 * np.sqrt((each**2).sum(axis=1).mean()) for each in errors]
    assert results.value("made", USUAL, "prediction_rmse_median") == pytest.approx(np.median(rmse))
    for one, track in zip(judged, tracks, strict=True):
        since = track.times - track.times[0]
        assert len(one.times) == ((since > OBSERVE) & (since <= OBSERVE + HORIZON)).sum()


def test_each_track_is_judged_once(shots) -> None:
    model, surfaces, settings, tracks = shots
    both = judged_both_ways(USUAL, model, surfaces, settings, tracks, 1, position_known=True)
    assert sorted(one.name for one in both) == sorted(track.name for track in tracks)
    assert sum(len(one.times) for one in both) == sum(
        len(one.times) for one in judge(model, surfaces, settings, tracks, 1)
    )


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

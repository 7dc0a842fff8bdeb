"""The noise that tracks show: planted numbers come back, and intervals with them hold what they promise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import load_model, nominal_model
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces, estimate_noise, predict_tracks
from ballfg.estimation.noise.estimate import spread_over
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset
from ballfg.tracks.track import SPIN_LABELS
from tests.estimation.noise import intervals


def held(model, surfaces, settings, tracks):
    """Share of predicted coordinates inside their 90 % intervals, 0.3 s after 0.25 s are seen."""
    smoother = Smoother(model, surfaces, settings)
    found = list(predict_tracks(smoother, tracks, len(tracks), 0.25, horizon=0.3))
    errors = np.concatenate([(p.measured - p.positions) / p.sigmas for p in found])
    return float((np.abs(errors) < 1.645).mean())


@pytest.fixture(scope="module")
def lasting(recorded):
    """A tracker with a memory: 3 mm of lasting errors, 15 ms long, beside 1.5 mm of white ones."""
    return recorded(MeasurementNoise(position=0.0015, memory=0.003, memory_time=0.015), tracks=40)


@pytest.fixture(scope="module")
def found(lasting):
    model, surfaces, settings, tracks = lasting
    return estimate_noise(model, surfaces, settings, spread_over(tracks[1::2], 20), position_known=True)


def test_planted_memory_comes_back(found):
    noise = found.noise
    assert np.sqrt(np.mean(np.square(noise.memory))) == pytest.approx(0.003, rel=0.15)
    assert 0.0075 < noise.memory_time < 0.03  # forecasts hardly tell how long it lasts
    assert noise.stamp_jitter < 4e-4  # there is none; 4e-4 s along the flight are as large as the white errors
    assert noise.acceleration < 0.03  # the motion is exact


def test_error_bars_are_of_the_size_of_the_errors(found):
    for axis, value in zip("xyz", found.noise.memory, strict=True):
        assert abs(np.log(value / 0.003)) < 3.0 * found.relative_errors[f"memory.{axis}"]


@pytest.mark.thorough
def test_factors_hold_where_the_curvature_is_not_honest():
    """White noise of 0.5 mm beside 2 mm that last for 10 ms: upwards it is known, downwards hardly."""
    rows = []
    for world, tracks in intervals.worlds(2, 7, intervals.WORLDS["lasting"]):
        rows += list(intervals.rows_of(world, intervals.found_in(tracks)))
    white = [row for row in rows if row.name.startswith("position")]
    assert len(white) == 6
    assert intervals.rms(row.z for row in white) < 1.4
    assert intervals.rms(row.z for row in rows if row.true) < 1.4
    for row in white:
        assert row.low < row.found < row.high
        assert np.log(row.high / row.found) < row.error + 1e-9


def test_intervals_hold_with_it_on_other_tracks(lasting, found):
    model, surfaces, settings, tracks = lasting
    others = tracks[0::2]
    assert 0.84 < held(model, surfaces, found.settings, others) < 0.95
    plain = held(model, surfaces, settings, others)
    assert abs(plain - 0.9) > abs(held(model, surfaces, found.settings, others) - 0.9)


def test_planted_acceleration_comes_back(recorded):
    process = MotionNoise(acceleration=0.5)
    model, surfaces, settings, tracks = recorded(MeasurementNoise(position=0.002), process, tracks=20)
    found = estimate_noise(model, surfaces, settings, tracks, position_known=True, errors=False)
    assert found.noise.acceleration == pytest.approx(0.5, rel=0.25)
    whole = estimate_noise(model, surfaces, settings, tracks, position_known=True, errors=False, longest=math.inf)
    assert whole.starts > 1.3 * found.starts
    assert whole.noise.acceleration == pytest.approx(0.5, rel=0.2)
    with pytest.raises(ValueError, match=r"longest must be at least 0; got -1\. Correct it"):
        estimate_noise(model, surfaces, settings, tracks, longest=-1.0)


def test_drags_that_are_alike_say_nothing_of_a_bounce_ahead(tmp_path):
    """All drags are one, the table's restitution lies 1.5 usual spreads off, and no observed part has a bounce."""
    shots = SimulationConfig(
        24, 120.0, seed=3, noise=MeasurementNoise(position=0.001), undeclared=parse_effects(["restitution.e=0.90"])
    )
    write_simulation(tmp_path / "shots", shots)
    dataset = read_dataset(tmp_path / "shots")
    model, tracks = nominal_model(dataset.ball), list(dataset)
    surfaces, usual = dataset_surfaces(dataset), dataset_settings(dataset, model)
    parts = [track.opening(0.2) for track in tracks]
    found = estimate_noise(model, surfaces, usual, parts, errors=False)
    spreads = found.noise.coefficients
    assert spreads["flight.drag.k"] < 0.5 * usual.coefficients["flight.drag.k"]
    for name in ("bounce.restitution.e", "bounce.table_height.offset"):
        assert spreads[name] == pytest.approx(usual.coefficients[name], rel=0.05)
    ahead = predict_tracks(Smoother(model, surfaces, found.settings), tracks, len(tracks), 0.2, horizon=0.6)
    errors = np.concatenate([((one.measured - one.positions) / one.sigmas)[-10:, 2] for one in ahead])
    assert (np.abs(errors) < 1.645).mean() > 0.84


def test_nothing_to_tell(recorded):
    model, surfaces, settings, tracks = recorded(MeasurementNoise(position=0.002), tracks=2)
    short = [track.until(float(track.times[0]) + 0.03) for track in tracks]
    assert estimate_noise(model, surfaces, settings, short) is None


def test_measurement_effects_are_undone_first(tmp_path):
    """A tracker that lags by 5 ms is no noise to a model that says so."""
    config = SimulationConfig(8, 100.0, seed=3, undeclared=parse_effects(["velocity_lag.lag=0.005"]))
    write_simulation(tmp_path / "shots", config)
    dataset = read_dataset(tmp_path / "shots")
    text = (tmp_path / "shots" / "model.yaml").read_text()
    text = text.replace("measurement: {}", "measurement: {velocity_lag: {lag: 0.005}}")
    (tmp_path / "lagging.yaml").write_text(text)
    model = load_model(tmp_path / "lagging.yaml")
    settings = dataset_settings(dataset, model)
    found = estimate_noise(model, dataset_surfaces(dataset), settings, dataset, position_known=True, errors=False)
    assert found.noise.acceleration < 0.03
    assert 0.84 < found.held < 0.96


def test_noise_of_labels_is_in_their_own_unit(tmp_path):
    """Labels three times the spins, and as much less certain, are the same measurements."""
    write_simulation(tmp_path / "shots", SimulationConfig(8, 100.0, seed=3))
    dataset = read_dataset(tmp_path / "shots")
    model = load_model(tmp_path / "shots" / "model.yaml")
    settings = dataset_settings(dataset, model)
    text = (tmp_path / "shots" / "model.yaml").read_text()
    (tmp_path / "tripled.yaml").write_text(text.replace("measurement: {}", "measurement: {spin_label_scale: {s: 2.0}}"))
    tripled = load_model(tmp_path / "tripled.yaml")
    labels = [track.labels | {name: 3.0 * track.labels[name] for name in SPIN_LABELS} for track in dataset]
    large = [replace(track, labels=own) for track, own in zip(dataset, labels, strict=True)]
    wide = replace(settings, spin_label_noise=3.0 * settings.spin_label_noise)
    surfaces = dataset_surfaces(dataset)
    one = estimate_noise(model, surfaces, settings, dataset, errors=False)
    other = estimate_noise(tripled, surfaces, wide, large, errors=False)
    assert other.noise.spin_label == pytest.approx(3.0 * one.noise.spin_label, rel=0.02)
    assert other.noise.acceleration == pytest.approx(one.noise.acceleration, rel=0.02)

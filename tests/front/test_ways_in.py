"""The names of `import ballfg as bf` on arrays, tracks, datasets and folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.dynamics import save_model
from ballfg.estimation import dataset_settings
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.front import estimator_for
from ballfg.simulation import MeasurementNoise, SimulationConfig, tennis, write_simulation
from tests.front.my_shots import same, written
from tests.interpreter import fresh


def test_a_track_of_a_dataset_brings_ball_table_and_noise(shots: bf.Dataset, track: bf.Track) -> None:
    model = bf.nominal_model(shots.ball)
    by_hand = bf.Smoother(model, bf.Surfaces.table_tennis(shots.table), dataset_settings(shots, model))
    same(bf.estimate(track), by_hand.estimate(track))
    assert shots.table == pytest.approx(0.76)


def test_folder_and_dataset_give_the_estimates_of_their_tracks(folder: Path, shots: bf.Dataset) -> None:
    found = bf.estimate(folder, method="ekf")
    assert list(found) == shots.names
    for name, one in bf.estimate(shots, method="ekf", jobs=2).items():
        same(one, found[name])
        same(one, bf.estimate(shots[name], method="ekf"))
    assert list(bf.estimate(str(folder), method="sliding-window")) == shots.names


def test_arrays_are_a_track(track: bf.Track, shots: bf.Dataset, estimate: bf.Estimate) -> None:
    """With ball, table and noise named by hand it is the estimate of the dataset's track."""
    made = bf.Track(track.times, track.positions, labels=track.labels)
    settings = dataset_settings(shots, bf.nominal_model())
    same(bf.estimate(made, model=bf.nominal_model(), surfaces=shots.table, settings=settings), estimate)
    plain = bf.estimate(bf.Track(track.times, track.positions), surfaces=shots.table)
    assert (plain.name, plain.status) == ("track", bf.Status.OK)
    same(bf.estimate((track.times, track.positions), surfaces=shots.table), plain)
    rows = np.column_stack((track.times, track.positions))
    same(bf.estimate(rows, surfaces=shots.table), plain)
    np.testing.assert_array_equal(bf.predict(rows, surfaces=shots.table).positions, plain.predict(0.3).positions)


@pytest.mark.parametrize("noise", [0.0004, 0.004])
def test_arrays_have_the_noise_that_they_show(noise: float, tmp_path: Path) -> None:
    """Intervals of velocities are as narrow as the samples allow; of 90 % ones with 1.5 mm for all, 60 % hold 4 mm."""
    config = SimulationConfig(40, 100.0, seed=3, noise=MeasurementNoise(position=noise))
    write_simulation(tmp_path / "shots", config)
    truth = np.genfromtxt(tmp_path / "shots" / "truth.csv", delimiter=",", names=True)
    shots, held, narrower = bf.read(tmp_path / "shots"), [], []
    for track in shots:
        times, positions = (values[:26] for values in (track.seconds, track.positions))
        found, usual = (
            bf.estimate((times, positions), surfaces=shots.table, settings=settings).last
            for settings in (None, bf.Settings.for_measured(bf.nominal_model()))
        )
        row = truth[(truth["trajectory"] == int(track.name)) & (np.abs(truth["t"] - times[-1]) < 1e-6)]
        true = [float(row[name][0]) for name in ("vx", "vy", "vz")]
        sigmas = np.sqrt(np.diag(found.covariance)[3:6])
        held.append(np.abs(found.state[3:6] - true) < 1.645 * sigmas)
        narrower.append(sigmas / np.sqrt(np.diag(usual.covariance)[3:6]))
    assert np.mean(held) > 0.8
    assert (np.median(narrower) < 0.8) == (noise < 0.0015)


def thrown(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (60,) s and positions (60, 3) m of a ball in a vacuum, with a noise of 3 mm."""
    times = np.arange(60) / 100.0
    path = np.array([0.0, 0.0, 0.4]) + np.outer(times, [4.0, 0.3, 3.0]) - np.outer(times**2, [0.0, 0.0, 4.905])
    return times, path + rng.normal(0.0, 0.003, path.shape)


@pytest.mark.parametrize("noise", [0.0, 0.0003])
def test_arrays_have_the_noise_of_their_flights_not_that_of_rest(noise: float) -> None:
    """A ball that lies for longer than it flies; the last velocity in closed form."""
    rng, squares = np.random.default_rng(20), []
    for _ in range(4):
        times, flight = thrown(rng)
        still = [0.0, 0.0, 0.4] + rng.normal(0.0, 1.0, (150, 3)) * noise
        last = bf.estimate((np.arange(210) / 100.0, np.vstack((still, flight)))).last
        off = last.state[3:6] - [4.0, 0.3, 3.0 - 9.81 * times[-1]]
        squares.append(off @ np.linalg.solve(last.covariance[3:6, 3:6], off))
        assert np.sqrt(np.diag(last.covariance)[:3]) == pytest.approx([0.0017] * 3, rel=0.5)
    assert np.median(squares) < 6.0


def test_outliers_are_no_noise_of_arrays() -> None:
    """Of windows of 11 samples, of which a fifth are outliers, hardly one is without."""
    rng, found = np.random.default_rng(21), []
    for _ in range(9):
        times, positions = thrown(rng)
        positions[rng.choice(60, 12, replace=False)] += rng.normal(0.0, 0.2, (12, 3))
        found.append(estimator_for(bf.Track(times, positions)).settings.position_noise)
    assert np.median(found, axis=0) == pytest.approx([0.003] * 3, rel=0.3)


def test_a_model_file_takes_the_place_of_the_nominal_model(track: bf.Track, tmp_path: Path) -> None:
    model = bf.nominal_model()
    with_drag = dict(model.named_parameters())["flight.drag.k"]
    with_drag.data.fill_(0.15)
    save_model(model, tmp_path / "model.yaml")
    same(bf.estimate(track, model=tmp_path / "model.yaml"), bf.estimate(track, model=model))
    found = bf.estimate(track, model=str(tmp_path / "model.yaml"), method="ekf").world
    assert found is not None
    assert float(dict(found.model.named_parameters())["flight.drag.k"].detach()) == 0.15


def test_prediction_of_an_estimate_a_state_a_track_and_a_folder(
    folder: Path, track: bf.Track, estimate: bf.Estimate
) -> None:
    ahead = bf.predict(estimate, horizon=0.3)
    for other in (bf.predict(estimate.last, 0.3), bf.predict(track, 0.3), estimate.predict(0.3)):
        np.testing.assert_array_equal(ahead.positions, other.positions)
        np.testing.assert_array_equal(ahead.sigmas, other.sigmas)
    np.testing.assert_allclose(ahead.times, estimate.times[-1] + 0.01 * np.arange(1, 31), atol=1e-12)
    assert (np.diff(ahead.sigmas[:10].max(axis=1)) > 0.0).all()
    found = bf.predict(folder, 0.2, observe=0.35)
    assert list(found) == ["000", "001", "002"]
    assert isinstance(found["000"], TrackPrediction)
    miss = found["000"].measured - found["000"].positions
    assert np.abs(miss / found["000"].sigmas).max() < 5.0


@pytest.mark.thorough
def test_diagnosis_finds_a_model_that_can_be_saved(tmp_path: Path) -> None:
    shots = bf.read(written(tmp_path / "shots", 6))
    found = bf.diagnose(shots)
    found.model.save(tmp_path / "model.yaml")
    again = bf.load_model(tmp_path / "model.yaml")
    expected = dict(found.model.named_parameters())
    for name, value in again.named_parameters():
        assert float(value.detach()) == pytest.approx(float(expected[name].detach()), rel=1e-9)


def test_an_error_budget_of_a_folder_adds_up(tmp_path: Path) -> None:
    budget = bf.error_budget(written(tmp_path / "shots", 8))
    assert budget.named == 0.0
    assert budget.total**2 == pytest.approx(budget.floor**2 + budget.left * abs(budget.left), rel=1e-12)
    assert budget.floor > budget.samples > 3.0
    with pytest.raises(TypeError, match="model must be an AnalyticModel"):
        bf.error_budget(tmp_path / "shots", bf.dynamics.build(bf.dynamics.Architecture.of("mlp"), radius=0.02))


def test_tennis_balls_get_their_own_model(tmp_path: Path) -> None:
    shots = bf.read(written(tmp_path / "serves", 1, ball=tennis()))
    (track,) = shots
    estimate = bf.estimate(track)
    assert estimate.world is not None
    found = dict(estimate.world.model.named_parameters())
    for name, expected in bf.nominal_model(shots.ball).named_parameters():
        assert float(found[name].detach()) == float(expected.detach())
    table_tennis = dict(bf.nominal_model().named_parameters())
    assert float(found["flight.drag.k"].detach()) < 0.5 * float(table_tennis["flight.drag.k"].detach())
    assert estimate.world.model.radius == pytest.approx(0.033, abs=2e-3)


def test_a_ball_stands_for_its_nominal_model(track: bf.Track) -> None:
    found = bf.estimate(track, model=bf.Ball(0.033, 0.057)).world
    assert found is not None
    assert found.model.radius == 0.033


def test_the_door_itself_is_light() -> None:
    code = "import sys, ballfg as bf; bf.__version__; dir(bf); print({'torch', 'gtsam', 'numpy'} & sys.modules.keys())"
    assert fresh(code).stdout == "set()\n"
    for name in ("read", "estimate", "predict", "diagnose", "Online", "BallState", "RadarSpeed", "SpinReading"):
        assert name in dir(bf)

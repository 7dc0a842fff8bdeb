"""The front door: the names of `import ballfg as bf` on arrays, tracks, datasets and folders, and what they refuse."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import ballfg as bf
from ballfg.cli.main import run
from ballfg.dynamics import save_model
from ballfg.estimation import ConformalScales, TrackPrediction, dataset_settings
from ballfg.estimation.segmentation import Contact
from ballfg.factors.loss import Loss
from ballfg.prediction import Belief, Propagator, apex, next_contact, plane_crossing
from ballfg.simulation import MeasurementNoise, SimulationConfig, tennis, write_simulation
from ballfg.tracks import DatasetInfo, write_dataset

PANDAS = importlib.util.find_spec("pandas") is not None


def written(folder: Path, tracks: int = 3, **changes: object) -> Path:
    noise = MeasurementNoise(position=0.003)
    write_simulation(folder, SimulationConfig(tracks, 100.0, seed=1, noise=noise, **changes))
    (folder / "model.yaml").unlink()
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("front") / "my_shots")


@pytest.fixture(scope="module")
def shots(folder: Path) -> bf.Dataset:
    return bf.read(folder)


@pytest.fixture(scope="module")
def track(shots: bf.Dataset) -> bf.Track:
    return shots["000"].until(0.35)


@pytest.fixture(scope="module")
def estimate(track: bf.Track) -> bf.Estimate:
    return bf.estimate(track)


def same(one: bf.Estimate, other: bf.Estimate) -> None:
    np.testing.assert_array_equal(one.states, other.states)
    np.testing.assert_array_equal(one.covariances, other.covariances)


# --- the ways in


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


@pytest.mark.slow
def test_diagnosis_finds_a_model_that_can_be_saved(tmp_path: Path) -> None:
    shots = bf.read(written(tmp_path / "shots", 6))
    found = bf.diagnose(shots)
    found.model.save(tmp_path / "model.yaml")
    again = bf.load_model(tmp_path / "model.yaml")
    expected = dict(found.model.named_parameters())
    for name, value in again.named_parameters():
        assert float(value.detach()) == pytest.approx(float(expected[name].detach()), rel=1e-9)


# --- one type of state


def gaussian(shots: bf.Dataset) -> bf.Settings:
    """Squared losses and no events: what filter and smoother are told is then the same."""
    usual = dataset_settings(shots, bf.nominal_model())
    plain = Loss("squared")
    return replace(usual, loss=plain, spin_loss=plain, label_loss=plain, find_events=False)


def test_conformal_intervals_of_a_dataset(shots: bf.Dataset, track: bf.Track, tmp_path: Path) -> None:
    """From calibration tracks, from the scales that a prediction has, and from their file."""
    calibration = written(tmp_path / "calibration", tracks=12)
    options = {"observe": 0.35, "method": "ekf"}
    plain = bf.predict(shots, 0.2, **options)
    found = bf.predict(shots, 0.2, **options, conformal=calibration)
    scales = found["000"].conformal
    assert isinstance(scales, ConformalScales)
    assert scales.tracks.tolist() == [12] * 4
    assert 0.5 < scales.own_coverage <= 1.0
    assert 0.85 < scales.coverage <= 1.0
    factors = found["000"].sigmas / plain["000"].sigmas
    np.testing.assert_allclose(factors[[0, -1]], scales.scales[[0, -1]])
    np.testing.assert_array_equal(found["000"].positions, plain["000"].positions)
    scales.save(tmp_path / "scales.yaml")
    for again in (scales, tmp_path / "scales.yaml", bf.read(calibration)):
        same_sigmas = bf.predict(shots, 0.2, **options, conformal=again)["000"].sigmas
        np.testing.assert_array_equal(same_sigmas, found["000"].sigmas)
    with pytest.raises(ValueError, match="conformal must hold other tracks than those that are predicted"):
        bf.predict(shots, 0.2, conformal=shots)
    with pytest.raises(ValueError, match=r"with 0.25 s observed, by ekf; the scales from .* have 0.35 s by ekf"):
        bf.predict(shots, 0.2, method="ekf", conformal=scales)
    with pytest.raises(TypeError, match="conformal must be a dataset of calibration tracks"):
        bf.predict(shots, 0.2, conformal=track)
    for single in (track, bf.estimate(track)):
        with pytest.raises(ValueError, match="conformal must be None for a single ball; got ConformalScales"):
            bf.predict(single, 0.2, conformal=scales)


def test_states_of_all_estimators_predict_the_same(shots: bf.Dataset) -> None:
    """0.1 of a standard deviation, and 3 % of it: a filter does not go back to where it linearised."""
    model, surfaces, settings = bf.nominal_model(), bf.Surfaces.table_tennis(shots.table), gaussian(shots)
    track = shots["000"].until(0.35)
    live = bf.Online(model, surfaces, settings)
    label = bf.Track(track.times, track.positions, name="unlabelled")
    pushed = [live.push(float(t), p) for t, p in zip(label.times, label.positions, strict=True)][-1]
    sorts = (bf.Smoother, bf.Online, bf.ExtendedKalmanFilter)
    states = [sort(model, surfaces, settings).estimate(label).last for sort in sorts]
    smoother, *others = [state.predict(0.3) for state in [*states, pushed]]
    assert isinstance(pushed, bf.BallState)
    assert len({state.coefficient_names for state in [*states, pushed]}) == 1
    for ahead in others:
        np.testing.assert_allclose(ahead.times, smoother.times, atol=1e-12)
        assert (np.abs(ahead.positions - smoother.positions) / smoother.sigmas).max() < 0.1
        np.testing.assert_allclose(ahead.sigmas, smoother.sigmas, rtol=0.03)


def test_what_is_uncertain_of_the_coefficients_reaches_the_prediction(estimate: bf.Estimate) -> None:
    state = estimate.last
    assert "flight.drag.k" in state.coefficient_names
    exact = bf.BallState(state.time, state.state, state.covariance, (), state.world)
    assert (state.predict(0.5).sigmas[-1] > 1.05 * exact.predict(0.5).sigmas[-1]).any()


def test_live_balls_are_predicted(shots: bf.Dataset, track: bf.Track) -> None:
    live = bf.Online(shots.ball, shots.table)
    for time, position in zip(track.times, track.positions, strict=True):
        state = live.push(time, position)
    ahead = state.predict(0.3)
    measured = shots["000"].between(float(track.times[-1]), float(track.times[-1]) + 0.3)
    (row,) = np.flatnonzero(np.isclose(measured.times, ahead.times[9]))
    assert np.linalg.norm(ahead.positions[9] - measured.positions[row]) < 0.05


def test_a_state_without_a_model_says_so(estimate: bf.Estimate) -> None:
    homeless = replace(estimate.last, world=None)
    with pytest.raises(ValueError, match=r"a state must know its model to be predicted.*state.on"):
        homeless.predict(0.1)
    assert estimate.world is not None
    np.testing.assert_array_equal(homeless.on(estimate.world).predict(0.1).positions, estimate.predict(0.1).positions)


def test_events_ahead_are_those_of_the_room_prediction(shots: bf.Dataset) -> None:
    estimate = bf.estimate(shots["001"].until(0.15))
    ahead, world = estimate.predict(1.0), estimate.world
    assert world is not None
    propagator, belief = Propagator(world.surfaces, world.process), Belief.of(world.model, [estimate.last])
    across = float(ahead.positions[20, 0])
    pairs = (
        (ahead.next_contact, next_contact(propagator, belief, 1.0)),
        (ahead.apex, apex(propagator, belief, 1.0)),
        (ahead.crossing(x=across), plane_crossing(propagator, belief, [1.0, 0.0, 0.0], across, 1.0)),
        (ahead.crossing(z=0.9), plane_crossing(propagator, belief, [0.0, 0.0, 1.0], 0.9, 1.0)),
    )
    for found, expected in pairs:
        assert found is not None
        assert expected is not None
        assert (found.time, found.time_sigma) == (expected.time, expected.time_sigma)
        np.testing.assert_array_equal(found.state, expected.state)
        np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert ahead.crossing(x=100.0) is None
    for planes in ({}, {"x": 1.0, "y": 0.0}):
        with pytest.raises(ValueError, match="crossing takes exactly one of x, y, z"):
            ahead.crossing(**planes)


@pytest.mark.parametrize(("horizon", "step"), [(0.0, 0.01), (-1.0, 0.01), (float("nan"), 0.01), (0.3, 0.0)])
def test_horizons_are_checked(estimate: bf.Estimate, folder: Path, horizon: float, step: float) -> None:
    if step > 0.0:
        with pytest.raises(ValueError, match="horizon must be a positive number of seconds"):
            bf.predict(folder, horizon)
    with pytest.raises(ValueError, match=r"(horizon|step) must be finite and above 0"):
        estimate.predict(horizon, step)


# --- what is shown


@pytest.mark.skipif(not PANDAS, reason="pandas is not installed")
def test_tables(estimate: bf.Estimate) -> None:
    frame = estimate.to_frame()
    assert list(frame.columns[:4]) == ["t", "x", "y", "z"]
    np.testing.assert_array_equal(frame["sigma_vx"], estimate.sigmas[:, 3])
    np.testing.assert_array_equal(estimate.predict(0.1).to_frame()["sigma_z"], estimate.predict(0.1).sigmas[:, 2])


@pytest.mark.skipif(PANDAS, reason="pandas is installed")
def test_tables_need_pandas(estimate: bf.Estimate) -> None:
    for shown in (estimate, estimate.predict(0.1)):
        with pytest.raises(ImportError, match="pandas"):
            shown.to_frame()


def test_the_picture_has_units_and_the_numbers(estimate: bf.Estimate) -> None:
    figure = estimate.plot()
    assert isinstance(figure, Figure)
    assert [axes.get_ylabel() for axes in figure.axes] == ["position, m", "velocity, m/s", "spin, rad/s"]
    assert figure.axes[-1].get_xlabel() == "time, s"
    for k, axes in enumerate(figure.axes):
        for axis, line in enumerate(axes.lines[:3]):
            np.testing.assert_array_equal(line.get_ydata(), estimate.states[:, 3 * k + axis])
    turned = replace(estimate, hits=np.array([1]), contacts=(Contact(3, 0.5 * estimate.times[[3, 4]].sum(), 0.0),))
    for axes in turned.plot().axes:
        contact, hit = axes.lines[3:]
        assert (contact.get_linestyle(), set(contact.get_xdata())) == ("--", {turned.contacts[0].time})
        assert (hit.get_linestyle(), set(hit.get_xdata())) == (":", {estimate.times[[1, 2]].mean()})


def test_reprs_are_short_and_say_what_a_thing_holds(shots: bf.Dataset, track: bf.Track, estimate: bf.Estimate) -> None:
    smoother = bf.Smoother(shots.ball, shots.table)
    speeds = bf.RadarSpeed([0, 3], [5.0, 5.0], 0.1)
    crossing = estimate.predict(1.0).next_contact
    expected = {
        "Estimate": (estimate, ("'000'", f"{len(track)} states over 0.3", "ok", "up to")),
        "Smoother": (smoother, ("AnalyticModel", "table at 0.76 m", "noise 1.5 / 1.5 / 1.5 mm")),
        "Online": (bf.Online(shots.ball, shots.table), ("table at 0.76 m",)),
        "Track": (track.observed(speeds), ("'000'", f"{len(track)} samples", "RadarSpeed(2 of 2 samples)")),
        "Dataset": (shots, ("'simulated table-tennis'", "3 tracks", "my_shots")),
        "BallState": (estimate.last, ("t = ", "position (", ") m +- (", "velocity", "spin", "rad/s")),
        "Ahead": (estimate.predict(0.2), ("20 times to t = ", "+-")),
        "Crossing": (crossing, ("t = ", " ms, at (", ") mm")),
        "RadarSpeed": (speeds, ("2 of 2 samples",)),
    }
    for name, (shown, parts) in expected.items():
        text = repr(shown)
        assert text.startswith(f"{name}(")
        assert text.count("\n") <= 2
        assert "0x" not in text
        assert "array(" not in text
        for part in parts:
            assert part in text, text


# --- what is refused or doubted


def test_arrays_in_place_of_a_track_are_told_how_to_be_one(shots: bf.Dataset, track: bf.Track) -> None:
    with pytest.raises(TypeError, match=r"track must be a Track; got ndarray. Make one with Track\(times, positions\)"):
        bf.Smoother(shots.ball, shots.table).estimate(track.positions)  # type: ignore[arg-type]
    for wrong in (track.positions, 3, [1.0, 2.0], (track.times,)):
        with pytest.raises(TypeError, match=f"measured must be a Track, .* or arrays; got {type(wrong).__name__}. Arr"):
            bf.estimate(wrong)  # type: ignore[call-overload]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        bf.estimate("nowhere")
    with pytest.raises(ValueError, match=r"method must be one of smoother, online, ekf, sliding-window.*; got 'best'"):
        bf.estimate(track, method="best")


@pytest.mark.parametrize("sort", [bf.Smoother, bf.Online, bf.ExtendedKalmanFilter])
def test_millimetres_and_milliseconds_are_refused(sort: type, track: bf.Track, shots: bf.Dataset) -> None:
    estimator = sort(shots.ball, shots.table)
    slow = bf.Track(1e3 * track.times, track.positions, name="slow")
    with pytest.raises(ValueError, match=r"track 'slow': t must be in s.* The unit is probably ms: divide by 1000"):
        estimator.estimate(slow)
    long = bf.Track(track.times, 1e3 * track.positions, name="long")
    with pytest.raises(ValueError, match="track 'long': x, y, z must be in m"):
        estimator.estimate(long)


SWAPPED = "the ball falls along y, not along z: exchange the axes so that z points up."
TABLE = "the ball bounces at z = 0.7"


def test_swapped_axes_and_a_wrong_table_are_noted(shots: bf.Dataset) -> None:
    whole = shots["000"]
    swapped = bf.Track(whole.times, whole.positions[:, [0, 2, 1]])
    below = bf.Track(whole.times, whole.positions)
    assert bf.estimate(whole).notes == ()
    right = bf.Settings.for_measured(bf.nominal_model(), position_noise=(0.003,) * 3)  # that of the simulation
    for method in ("smoother", "online", "ekf", "sliding-window"):
        found = bf.estimate(swapped, surfaces=shots.table, method=method, settings=right)
        assert found.notes[0] == SWAPPED
        (note,) = bf.estimate(below, surfaces=0.0, method=method, settings=right).notes
        assert note.startswith(TABLE)
        assert "where no surface is declared (they are at 0 and -0.76 m). Correct the table's height." in note


@pytest.mark.parametrize(("wrong", "said"), [("axes", SWAPPED), ("table", TABLE)])
def test_the_command_says_so_too(
    tmp_path: Path, shots: bf.Dataset, capsys: pytest.CaptureFixture[str], wrong: str, said: str
) -> None:
    order, height = ([0, 2, 1], 0.76) if wrong == "axes" else ([0, 1, 2], 0.0)
    tracks = [replace(track, positions=track.positions[:, order], labels={}) for track in shots]
    (tmp_path / "data").mkdir()
    write_dataset(tmp_path / "data", replace(shots.info, table_height=height), tracks)
    with pytest.raises(SystemExit) as stopped:
        run(["estimate", str(tmp_path / "data"), "--out", str(tmp_path / "states.csv"), "--jobs", "1"])
    assert stopped.value.code == (3 if wrong == "axes" else 0)  # no ball flies along a table as fast as that
    assert f"note: track '000': {said}" in capsys.readouterr().err


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


def test_a_track_that_was_changed_is_refused_by_every_estimator() -> None:
    changed = bf.Track([0.0, 0.01, 0.02], np.zeros((3, 3)), name="mine")
    changed.positions[1, 2] = np.nan
    for method in ("smoother", "online", "ekf", "sliding-window"):
        with pytest.raises(ValueError, match="track 'mine': times and positions must be finite; they were"):
            bf.estimate(changed, method=method)


def test_states_are_equal_to_themselves_alone(estimate: bf.Estimate) -> None:
    first, second = estimate[0], estimate[0]
    assert first == first
    assert first != second
    assert first not in [second, estimate[1]]
    assert len({first, second, estimate}) == 3
    with pytest.raises(TypeError, match="slice"):
        estimate[1:3]  # type: ignore[index]


def test_a_model_beside_the_data_is_offered_where_it_is_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = written(tmp_path / "shots", 1)
    path, model = folder / "model.yaml", bf.nominal_model()
    model.save(path)
    assert bf.read(folder).notes == []
    dict(model.named_parameters())["flight.drag.k"].data.fill_(0.15)
    model.save(path)
    offer = f"{path} lies beside the tracks and is not used. Give it as the model to use it."
    assert bf.read(folder).notes == [offer]
    for words, said in (([], True), (["--model", str(path)], False)):
        with pytest.raises(SystemExit):
            run(["estimate", str(folder), "--out", str(tmp_path / "states.csv"), "--jobs", "1", *words])
        assert (f"note: {offer}\n" in capsys.readouterr().err) is said


def test_the_door_itself_is_light() -> None:
    code = "import sys, ballfg as bf; bf.__version__; dir(bf); print({'torch', 'gtsam', 'numpy'} & sys.modules.keys())"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "set()\n"
    for name in ("read", "estimate", "predict", "diagnose", "Online", "BallState", "RadarSpeed", "SpinReading"):
        assert name in dir(bf)


@pytest.mark.parametrize("jobs", [0, -1, 10_001])
def test_fewer_processes_than_one_are_refused_everywhere(jobs: int, tmp_path: Path) -> None:
    """Before anything is read: the folder is not there."""
    for call in (bf.estimate, bf.predict, bf.diagnose):
        with pytest.raises(ValueError, match=rf"jobs must lie in 1 .. 10000; got {jobs}"):
            call(tmp_path / "nowhere", jobs=jobs)


@pytest.mark.parametrize("observe", [math.inf, -math.inf, math.nan, 0.0, -1.0])
def test_an_observed_part_is_a_positive_time(observe: float, tmp_path: Path) -> None:
    write_dataset(tmp_path, DatasetInfo("d", 0.0, bf.Ball(0.02, 0.0027), position_noise=0.003), [_fall()])
    with pytest.raises(ValueError, match="observe must be a positive number of seconds; got"):
        bf.predict(tmp_path, observe=observe)


@pytest.mark.parametrize(("measured", "got"), [(None, "nothing"), (3, "int"), ([], "list")])
def test_what_cannot_be_diagnosed_is_told_as_what_it_is(measured: object, got: str) -> None:
    with pytest.raises(TypeError, match=f"measured must be a dataset or its folder; got {got}. Read one with bf.read"):
        bf.diagnose(measured)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="got one Track; effects show in many of them"):
        bf.diagnose(_fall())  # type: ignore[arg-type]


def _fall() -> bf.Track:
    t = np.arange(20) / 100.0
    return bf.Track(t, np.column_stack([t, 0.0 * t, 1.2 - 4.9 * t**2]))

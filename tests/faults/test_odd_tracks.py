"""Odd tracks through every estimator: nothing raises, all is finite, and what is called converged is near the truth."""

import warnings
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest

import ballfg as bf
from ballfg.diagnosis import diagnose
from ballfg.dynamics import nominal_model
from ballfg.estimation import Settings, Status
from ballfg.estimation.plausible import possible
from ballfg.factors.linear.definite import compatible, definite, raised, variances_positive, whitened
from ballfg.tracks import TABLE_TENNIS, Track
from ballfg.tracks.dataset import dataset_in_memory
from tests.commands import status
from tests.faults.odd_tracks import INFO, estimator_of, judged, realistic, sound, still, wild

FAST = ("smoother", "sliding-window", "ekf", "online")
COUNTS = {"smoother": 6, "sliding-window": 16, "ekf": 6, "online": 5}
"""Tracks of each sort; the slower estimators see fewer of them here, and all of them in the whole run."""
WILD = partial(wild, longest=0.7)
SLOW = [("smoother", WILD), ("online", WILD)]


def line(times: np.ndarray, velocity: list[float], start: list[float]) -> np.ndarray:
    return times[:, None] * np.array(velocity) + np.array(start)


@pytest.mark.parametrize(
    ("method", "tracks"),
    [
        *((method, tracks) for method in FAST for tracks in (realistic, WILD) if (method, tracks) not in SLOW),
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in SLOW),
    ],
)
def test_odd_tracks_end_with_finite_numbers(method, tracks):
    tally = judged(estimator_of(method), list(tracks(COUNTS[method], seed=5)), verbose=True)
    assert (tally.raised, tally.not_finite, tally.warned, tally.far) == (0, 0, 0, 0)
    assert tally.ok > tally.tracks / 3


def test_a_filter_that_is_lost_says_so_in_its_status_alone():
    """Its innovations spread over 29 powers of ten, which filterpy warned of."""
    (odd,) = islice(wild(871, seed=1), 870, None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate = estimator_of("ekf").estimate(odd.track)
    assert estimate.status.failed
    assert sound(estimate.states, estimate.covariances)


def test_the_same_seed_gives_the_same_tracks():
    for sort in (wild, realistic):
        one, other = list(sort(6, seed=3)), list(sort(6, seed=3))
        assert all((a.track.positions == b.track.positions).all() for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("method", FAST)
def test_a_track_faster_than_any_ball_is_not_converged(method):
    """300 m/s along a line: the reader lets it pass, no estimate may call it a ball."""
    times = np.arange(12) / 100.0
    track = Track(times, line(times, [300.0, 0.0, 0.0], [0.0, 0.0, 1.5]))
    estimate = estimator_of(method).estimate(track)
    assert estimate.status is not Status.OK
    assert possible(estimate.states).all()
    assert sound(estimate.states, estimate.covariances)
    ahead = estimate.predict(0.3)
    assert sound(ahead.states, ahead.covariances)


@pytest.mark.parametrize("method", FAST)
def test_two_samples_far_apart(method):
    """Two samples 0.667 s apart at 4 m/s once had NaN sigmas in the filter, and the status converged."""
    track = Track([0.0, 0.667], [[0.0, 0.0, 1.2], [2.668, 0.0, 1.2]])
    estimate = estimator_of(method).estimate(track)
    assert sound(estimate.states, estimate.covariances)
    assert sound(*(lambda ahead: (ahead.states, ahead.covariances))(estimate.predict(0.3)))


@pytest.mark.parametrize("value", [2001.0, -1e5, 1e200])
def test_a_spin_label_that_no_ball_has_is_refused(value):
    with pytest.raises(ValueError, match=r"label 'spin_y' must be within 2000 rad/s.*Correct it"):
        Track([0.0, 0.1], np.zeros((2, 3)), labels={"spin_x": 0.0, "spin_y": value, "spin_z": 0.0})


def test_a_speed_that_no_ball_has_is_refused():
    with pytest.raises(ValueError, match=r"values of 'speed' must be within 200"):
        bf.estimation.RadarSpeed([0], [201.0], 0.1)


@pytest.mark.parametrize("name", ["velocity_prior", "spin_prior", "spin_label_noise"])
def test_a_prior_wider_than_numbers_hold_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1e-06, at most 100000"):
        Settings(**{name: 1e150})


def test_a_part_of_a_track_is_not_refused_for_what_the_whole_may_have():
    """An outlier among the first three samples is no sign of another unit; only a whole track tells the unit."""
    times = np.arange(40) / 100.0
    positions = line(times, [4.0, 0.0, 0.0], [0.0, 0.0, 1.2])
    positions[1] += [30.0, 0.0, 0.0]
    (found,) = bf.predict(dataset_in_memory(INFO, [Track(times, positions)]), observe=0.02).values()
    assert np.isfinite(found.positions).all()
    assert np.isfinite(found.sigmas).all()


def test_one_bad_track_costs_no_other_and_is_listed(tmp_path, capsys):
    times = np.arange(30) / 50.0
    fast = Track(times, line(times, [300.0, 0.0, 100.0], [0.0, 0.0, 1.5]), name="fast")
    good = [replace(odd.track, name=f"good{k}", labels={}) for k, odd in enumerate(realistic(10, seed=2)) if k % 5 == 1]
    folder, out = tmp_path / "set", tmp_path / "states.csv"
    bf.tracks.write_dataset(folder, INFO, [fast, *good])
    assert status("estimate", folder, "--out", out, "--jobs", "1") == 3
    printed = capsys.readouterr()
    assert "1 of 3 tracks could not be estimated" in printed.err
    assert "fast" in printed.err
    rows = out.read_text().splitlines()
    assert len(rows) == 1 + sum(map(len, (fast, *good)))
    assert "nan" not in out.read_text()


def test_balls_that_are_dropped_are_diagnosed():
    """x and y are zero in every sample: two of three axes show no noise."""
    tracks = [replace(still(np.random.default_rng(k), dropped=True).track, name=str(k)) for k in range(8)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = diagnose(dataset_in_memory(INFO, tracks), nominal_model(TABLE_TENNIS))
    assert not found.findings
    assert np.isfinite(found.after.prediction_rmse_mm)


def test_resting_balls_cannot_be_diagnosed():
    times = np.arange(40) / 100.0
    low = INFO.table_height + TABLE_TENNIS.radius
    tracks = [Track(times, np.tile([0.1 * k, 0.0, low], (40, 1)), name=str(k)) for k in range(12)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="must hold free flights"):
            diagnose(dataset_in_memory(INFO, tracks), nominal_model(TABLE_TENNIS))


def test_definite_leaves_what_is_definite_and_keeps_standard_deviations():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 9, 9))
    good = root @ root.swapaxes(1, 2)
    np.testing.assert_allclose(definite(good), good, rtol=1e-15)
    flat = np.tile(np.outer(10.0 ** np.arange(-6, 3), 10.0 ** np.arange(-6, 3)), (2, 1, 1))  # rank one
    np.testing.assert_allclose(np.diagonal(definite(flat), axis1=1, axis2=2), np.diagonal(flat, axis1=1, axis2=2))
    assert sound(np.zeros((2, 9)), definite(flat))
    assert variances_positive(good).all()


def test_raised_and_compatible_and_whitened():
    least = np.array([1e-3, 1e-3])
    lifted = raised(np.array([[-1e-12, 0.0], [0.0, 4.0]]), least)
    np.testing.assert_allclose(np.sqrt(np.diagonal(lifted)), [1e-3, 2.0])
    own, shared = np.eye(2)[None], np.eye(1)
    cross = compatible(np.array([[[0.9], [0.9]]]), own, shared)  # correlations that contradict each other
    joint = np.block([[own[0], cross[0]], [cross[0].T, shared]])
    assert np.linalg.eigvalsh(joint)[0] > 0.0
    np.testing.assert_allclose(whitened(np.array([3.0, 8.0]), np.diag([9.0, 16.0])), [1.0, 2.0])

from collections.abc import Callable

import numpy as np
import pytest

from ballfg.benchmarks.estimators.protocols import (
    AT_BOUNCE,
    FAIR_NOISE,
    PAPER_NOISE,
    Candidate,
    Case,
    Scores,
    TrackScore,
    every,
    fair_protocol,
    judged,
    paper_protocol,
    pooled,
    score_track,
    score_tracks,
)
from ballfg.benchmarks.estimators.suite import _newest_sums, add_consistency, add_rows
from ballfg.benchmarks.results import Results
from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Estimate, Estimator, Settings, Status
from ballfg.state import POSITION, VELOCITY, VZ
from ballfg.tracks import Track


@pytest.mark.parametrize("protocol", [paper_protocol, fair_protocol])
def test_same_seed_same_tracks(protocol) -> None:  # type: ignore[no-untyped-def]
    one, two, other = protocol(3, 5), protocol(3, 5), protocol(3, 6)
    for a, b in zip(one.tracks, two.tracks, strict=True):
        assert a.track.positions.tobytes() == b.track.positions.tobytes()
        assert a.true_states.tobytes() == b.true_states.tobytes()
    assert not np.array_equal(one.tracks[0].track.positions, other.tracks[0].track.positions)


@pytest.mark.parametrize(("protocol", "noise"), [(paper_protocol, PAPER_NOISE), (fair_protocol, FAIR_NOISE)])
def test_measurements_have_the_declared_noise(protocol, noise: float) -> None:  # type: ignore[no-untyped-def]
    made = protocol(20, 0)
    errors = np.concatenate([c.track.positions - c.true_states[:, POSITION] for c in made.tracks])
    assert errors.std() == pytest.approx(noise, rel=0.04)
    assert made.settings.position_noise == (noise,) * 3


def test_paper_tells_the_true_spin_and_bounces_nowhere() -> None:
    made = paper_protocol(4, 0)
    for case in made.tracks:
        np.testing.assert_allclose(case.track.spin_label, case.true_states[0, 6:])
        assert np.ptp(case.true_states[:, 6:], axis=0).max() == 0.0
        assert case.away.all()


def test_fair_labels_are_noisy() -> None:
    made = fair_protocol(60, 0)
    errors = np.stack([c.track.spin_label - c.true_states[0, 6:] for c in made.tracks])
    assert errors.std() == pytest.approx(made.settings.spin_label_noise, rel=0.15)


def test_samples_at_a_bounce_are_few_and_next_to_one() -> None:
    made = fair_protocol(60, 0)
    excluded = [(c, int(i)) for c in made.tracks for i in np.flatnonzero(~c.away)]
    bounces = sum(int((np.diff(c.true_states[:, VZ]) > 0.5).sum()) for c in made.tracks)
    interval = 0.01
    assert 0.3 < len(excluded) / (bounces * 2 * AT_BOUNCE / interval) < 2.0  # a share 2 ms / 10 ms of the bounces
    for case, i in excluded:
        near = slice(max(i - 1, 0), i + 2)
        assert np.diff(case.true_states[near, VZ]).max() > 0.5
        assert case.true_states[i, 2] - made.surfaces.table_height < 0.03


SAMPLES = 10
SIGMA = 0.5


class Wrong(Estimator):
    """Off by a known velocity that depends on how many samples it sees; its truth is all zeros."""

    name = "wrong"

    def __init__(self, error: Callable[[int, int], float]) -> None:
        super().__init__(nominal_model(), Surfaces(-10.0), Settings())
        self.error = error

    def estimate(self, track: Track) -> Estimate:
        n = len(track)
        states = np.zeros((n, 9))
        states[:, VELOCITY] = np.array([[0.0, 0.0, self.error(k, n)] for k in range(n)])
        covariances = np.tile(SIGMA**2 * np.eye(9), (n, 1, 1))
        return Estimate(track.name, track.times, states, covariances, Status.OK, np.full((n, 3), np.nan))


@pytest.fixture
def case() -> Case:
    away = np.ones(SAMPLES, dtype=bool)
    away[7] = False
    return Case(Track(0.01 * np.arange(SAMPLES), np.zeros((SAMPLES, 3)), name="0"), np.zeros((SAMPLES, 9)), away)


def test_errors_and_nees_by_hand(case: Case) -> None:
    score = score_track(Candidate(Wrong(lambda k, n: float(k)), newest="pass"), case, (5, 8, 10, 11))
    assert score.velocity.tolist() == list(range(SAMPLES))
    assert score.position.tolist() == [0.0] * SAMPLES
    assert score.nees == pytest.approx((np.arange(SAMPLES) / SIGMA) ** 2)
    assert score.velocity_nees == pytest.approx(score.nees)
    # sample 7 is at a bounce, an eleventh sample is not there
    np.testing.assert_array_equal(score.newest, [4.0, np.nan, 9.0, np.nan])
    # one of nine components is wrong: 1 m/s is two sigma
    assert score.covered[1, 1].tolist() == [True] * 5 + [False] + [True] * 3


def test_newest_state_is_estimated_from_the_samples_seen(case: Case) -> None:
    score = score_track(Candidate(Wrong(lambda k, n: float(n))), case, (5, 9))
    assert score.newest.tolist() == [5.0, 9.0]
    assert np.isnan(score_track(Candidate(Wrong(lambda k, n: 1.0), newest="none"), case, (5,)).newest).all()


def test_selection_leaves_out_the_first_four_and_bounces(case: Case) -> None:
    score = score_track(Candidate(Wrong(lambda k, n: float(k))), case, ())
    assert np.flatnonzero(judged(score)).tolist() == [4, 5, 6, 8, 9]
    squares, count = pooled([score, score], "velocity", 2)
    assert squares.tolist() == [16 + 25 + 36 + 64 + 81] * 2
    assert count.tolist() == [5, 5]
    assert pooled([score], "velocity", 2, every)[1].tolist() == [SAMPLES]


def test_rows_hold_the_pooled_figures_and_ratios(case: Case) -> None:
    candidates = {
        "ekf": Candidate(Wrong(lambda k, n: 2.0), newest="pass"),
        "smoother": Candidate(Wrong(lambda k, n: 0.5)),
    }
    results = Results("test", 0)
    scores: Scores = score_tracks(candidates, [case] * 3, (5, 9), 1, "tracks")
    add_rows(results, "toy", scores, (5, 9))
    assert results.value("toy", "ekf", "velocity_rmse") == pytest.approx(2.0)
    assert results.value("toy", "smoother", "velocity_rmse_vs_ekf") == pytest.approx(0.25)
    assert results.value("toy", "smoother", "velocity_rmse_newest_vs_ekf") == pytest.approx(0.25)
    assert results.value("toy", "smoother", "velocity_mean_newest@9") == pytest.approx(0.5)
    assert results.value("toy", "smoother", "velocity_sd_newest@9") == pytest.approx(0.0)
    assert results.value("toy", "smoother", "nees") == pytest.approx(1.0)
    # 8 of 9 components are exact, the ninth is 4 sigma off
    assert results.value("toy", "ekf", "coverage_90_state") == pytest.approx(8 / 9)
    assert results.value("toy", "ekf", "coverage_90_velocity") == pytest.approx(2 / 3)


def test_consistency_tells_an_overconfident_smoother(case: Case) -> None:
    results = Results("test", 0)
    score = score_track(Candidate(Wrong(lambda k, n: 5.0 if k == SAMPLES - 1 else 1.5)), case, ())
    add_consistency(results, "toy", [score] * 20)
    assert results.value("toy", "smoother", "nees_last") == pytest.approx(100.0)
    assert results.value("toy", "smoother", "nees_first") == pytest.approx(9.0)
    assert results.value("toy", "smoother", "places_outside_99") == 1
    assert results.value("toy", "smoother", "samples_at_bounce") == 20


def test_newest_errors_are_pooled_once_a_filter_has_settled() -> None:
    """From twenty observations on: 1 and 2 m/s here, and 3 m/s of a track that has no more samples; not 9 m/s."""
    none = np.zeros(0)

    def score(*newest: float) -> TrackScore:
        return TrackScore(none, none, none, none, none, np.zeros((0, 0, 9), bool), none > 0, np.array(newest), True)

    squares, number = _newest_sums([score(9.0, 9.0, 1.0, 2.0), score(9.0, 9.0, 3.0, np.nan)], (5, 19, 20, 39))
    assert squares.tolist() == [5.0, 9.0]
    assert number.tolist() == [2.0, 1.0]
    squares, _ = _newest_sums([score(9.0, 2.0)], (5, 12))  # where fewer are asked for, the most
    assert squares.tolist() == [4.0]

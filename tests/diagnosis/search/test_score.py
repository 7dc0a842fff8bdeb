"""False alarms as rare as stated, and power near that of a test that knows the noise, on made-up linear tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import stats

from ballfg.diagnosis.hypotheses.signatures import Signatures
from ballfg.diagnosis.search.score import PRIOR_TRACKS, Pattern, _p_value, score_tests

SAMPLES, COMMON, COLUMNS, REPEATS = 40, 6, 6, 120
CANDIDATES = [[0], [1, 2], [3, 4, 5]]
PRECISION = np.full(COMMON, 1e-6)
SURE = 1e-4
"""Probability that a correct test fails here by chance: the seed is fixed, the bound holds for any."""


@dataclass(frozen=True)
class Tracks:
    """Columns of t tracks with each one's own start projected out: t, m, q + p."""

    columns: np.ndarray
    starts: np.ndarray

    def signatures(self, residual: np.ndarray) -> Signatures:
        """What a fit of everything common leaves of a residual (t, m)."""
        t, m = residual.shape
        residual = residual - residual @ np.linalg.pinv(self.starts).T @ self.starts.T
        common = self.columns[..., :COMMON].reshape(t * m, COMMON)
        shared = np.linalg.solve(common.T @ common + np.diag(PRECISION), common.T @ residual.ravel())
        left = residual - (common @ shared).reshape(t, m)
        every = np.concatenate((self.columns, left[..., None]), axis=-1)
        return Signatures(every.swapaxes(1, 2) @ every, PRECISION, COMMON)


def tracks_of(count, rng):
    """Smooth columns that differ from track to track, in size by a factor of three."""
    waves = np.cos(np.pi * np.outer(np.arange(SAMPLES) / SAMPLES, np.arange(8)))
    mixed = rng.normal(size=(8, COMMON + COLUMNS)) + rng.normal(size=(count, 8, COMMON + COLUMNS))
    columns = waves @ (mixed * rng.lognormal(0.0, 0.5, (count, 1, 1)))
    starts = waves[:, :3]
    return Tracks(columns - starts @ (np.linalg.pinv(starts) @ columns), starts)


def with_memory(white):
    drawn = white.copy()
    for i in range(1, drawn.shape[1]):
        drawn[:, i] = 0.7 * drawn[:, i - 1] + np.sqrt(0.51) * white[:, i]
    return drawn


NOISE = {
    "as stated": lambda white, rng: white,
    "a third larger": lambda white, rng: 1.3 * white,
    "twice as large": lambda white, rng: 2.0 * white,
    "half as large": lambda white, rng: 0.5 * white,
    "with a memory": lambda white, rng: with_memory(white),
    "of uneven tracks": lambda white, rng: white * rng.lognormal(0.0, 0.5, (len(white), 1)),
}


def p_values(count, kind, repeats=REPEATS, seed=0):
    """(repeats, 3) of candidates of one, two and three coefficients where there is nothing."""
    rng = np.random.default_rng(seed)
    tracks = tracks_of(count, rng)
    drawn = (NOISE[kind](rng.normal(size=(count, SAMPLES)), rng) for _ in range(repeats))
    return np.array([[s.p_value for s in score_tests(tracks.signatures(r), CANDIDATES)] for r in drawn])


def too_many(alarms, trials, level):
    """Whether so many alarms hardly ever happen at a level."""
    return stats.binom.sf(alarms - 1, trials, level) < SURE


@pytest.mark.parametrize("kind", NOISE)
@pytest.mark.parametrize("count", [6, 12, pytest.param(40, marks=pytest.mark.thorough)])
def test_false_alarms(count, kind):
    """At most a fifth more than stated at 10 %, half more at 2 %: few tracks cannot tell their scatter better."""
    found = p_values(count, kind)
    for alarms, slack, level in (((found < 0.1).sum(0), 1.2, 0.1), ((found < 0.02).sum(0), 1.5, 0.02)):
        assert not any(too_many(n, REPEATS, slack * level) for n in alarms), (level, alarms / REPEATS)


def test_p_values_of_many_tracks_are_uniform():
    found = p_values(40, "as stated", repeats=250, seed=3)
    for column in found.T:
        assert stats.kstest(column, "uniform").pvalue > SURE


@pytest.mark.parametrize(("count", "least"), [(12, 0.7), (40, 0.8)])
def test_power_where_the_ideal_test_has_ninety_percent(count, least):
    rng = np.random.default_rng(5)
    tracks = tracks_of(count, rng)
    efficient = tracks.signatures(np.zeros((count, SAMPLES))).efficient()
    information = (efficient.information.sum(0) + efficient.prior)[0, 0]
    size = (stats.norm.isf(0.025) + stats.norm.isf(0.1)) / np.sqrt(information)  # two-sided at 5 %
    found = np.array(
        [
            score_tests(
                tracks.signatures(size * tracks.columns[..., COMMON] + rng.normal(size=(count, SAMPLES))), CANDIDATES
            )[0].p_value
            for _ in range(REPEATS)
        ]
    )
    assert not stats.binom.cdf((found < 0.05).sum(), REPEATS, least) < SURE, (found < 0.05).mean()


@pytest.mark.parametrize(("candidate", "column"), [(0, 0), (2, 4)])
@pytest.mark.parametrize("alarm", [0.05, pytest.param(1e-4, marks=pytest.mark.thorough)])
def test_an_effect_of_the_stated_size_is_noticed_in_nine_of_ten_cases(candidate, column, alarm):
    """Exactly for a single coefficient; of several at least, for the others need not be free."""
    rng, count = np.random.default_rng(7), 40
    tracks = tracks_of(count, rng)
    place = CANDIDATES[candidate].index(column)
    quiet = [score_tests(tracks.signatures(rng.normal(size=(count, SAMPLES))), CANDIDATES) for _ in range(20)]
    size = float(np.mean([one[candidate].seen_from(alarm)[place] for one in quiet]))
    planted = tracks.columns[..., COMMON + column]
    drawn = (tracks.signatures(size * planted + rng.normal(size=(count, SAMPLES))) for _ in range(REPEATS))
    noticed = sum(score_tests(s, CANDIDATES)[candidate].p_value < alarm for s in drawn)
    assert stats.binom.cdf(noticed, REPEATS, 0.9) > SURE, noticed / REPEATS
    if candidate == 0:
        assert stats.binom.sf(noticed - 1, REPEATS, 0.95) > SURE, noticed / REPEATS


@pytest.mark.parametrize("tracks", [4, 12])
def test_several_directions_are_judged_by_hotelling_s_distribution(tracks):
    """Against drawn covariances of as many degrees of freedom: chi-square would give a tenth of these p-values."""
    rng, draws = np.random.default_rng(8), 60_000
    freedom = tracks + round(PRIOR_TRACKS) - 1
    rows = rng.standard_normal((draws, freedom, 3))
    drawn, scatter = rng.standard_normal((draws, 3)), rows.swapaxes(1, 2) @ rows / freedom
    squares = np.einsum("ni,ni->n", drawn, np.linalg.solve(scatter, drawn[..., None])[..., 0])
    for size in (2.0, 3.0, 4.0):
        found = _p_value(Pattern(3, np.array([size, 0.0, 0.0]), np.eye(3), np.eye(3), 1.0), tracks, 1.0)
        share = float((squares > size**2).mean())
        assert found == pytest.approx(share, abs=4.0 * np.sqrt(share / draws)), size


def test_one_step_finds_a_linear_effect_without_noise():
    rng = np.random.default_rng(1)
    tracks, planted = tracks_of(12, rng), np.array([0.7, -1.1, 0.4])
    signatures = tracks.signatures(tracks.columns[..., COMMON + 3 :] @ planted)
    score = score_tests(signatures, CANDIDATES)[2]
    np.testing.assert_allclose(score.estimate, planted, rtol=1e-4)  # the fitted common columns have weak priors
    efficient = signatures.efficient()
    information = (efficient.information.sum(0) + efficient.prior)[3:, 3:]
    assert score.explained == pytest.approx(planted @ information @ planted, rel=1e-4)
    assert score.rank == 3


def test_standard_deviations_are_those_of_repeated_estimates():
    rng = np.random.default_rng(2)
    tracks = tracks_of(40, rng)
    drawn = [
        score_tests(tracks.signatures(1.5 * rng.normal(size=(40, SAMPLES))), CANDIDATES)[1] for _ in range(REPEATS)
    ]
    spread = np.std([s.estimate for s in drawn], axis=0)
    stated = np.sqrt(np.mean([s.sigma**2 for s in drawn], axis=0))
    np.testing.assert_allclose(stated, spread, rtol=0.25)  # 6.5 % each from 120 repeats, and few tracks


def test_units_do_not_matter():
    rng = np.random.default_rng(4)
    tracks, residual = tracks_of(12, rng), rng.normal(size=(12, SAMPLES))
    scale = np.append(np.ones(COMMON), [1e5, 10.0, 0.1, 30.0, 1.0, 0.03])
    first = score_tests(tracks.signatures(residual), CANDIDATES)
    other = score_tests(Tracks(tracks.columns * scale, tracks.starts).signatures(residual), CANDIDATES)
    for one, two, chosen in zip(first, other, CANDIDATES, strict=True):
        assert two.p_value == pytest.approx(one.p_value, rel=1e-6)
        assert two.explained == pytest.approx(one.explained, rel=1e-6)
        np.testing.assert_allclose(two.estimate * scale[COMMON:][chosen], one.estimate, rtol=1e-6)


def test_a_direction_that_is_absorbed_has_no_part():
    """The second of two coefficients does what the first does and what is common: one direction is left."""
    rng = np.random.default_rng(6)
    tracks, residual = tracks_of(12, rng), rng.normal(size=(12, SAMPLES))
    doubled = tracks.columns.copy()
    doubled[..., COMMON + 2] = 2.0 * doubled[..., COMMON + 1] + 3.0 * doubled[..., 0]
    score = score_tests(Tracks(doubled, tracks.starts).signatures(residual), [[0], [1, 2]])[1]
    alone = score_tests(tracks.signatures(residual), [[0], [1]])[1]
    assert score.rank == 1
    assert score.explained == pytest.approx(alone.explained, rel=1e-5)


def test_a_candidate_that_changes_nothing_is_invisible():
    rng = np.random.default_rng(7)
    tracks, residual = tracks_of(12, rng), rng.normal(size=(12, SAMPLES))
    none = tracks.columns.copy()
    none[..., COMMON] = 0.0
    none[..., COMMON + 1] = none[..., 2]
    scores = score_tests(Tracks(none, tracks.starts).signatures(residual), [[0], [1], [2]])
    assert scores[0] is None
    assert scores[1] is None
    assert scores[2] is not None

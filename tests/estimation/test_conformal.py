"""Conformal scales: the guarantee on exchangeable tracks, too few of them, and the file that keeps the scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from ballfg.estimation import ConformalScales, Estimate, Status
from ballfg.estimation.conformal import BIN, HALF_WIDTH, load_conformal
from ballfg.estimation.track_prediction import TrackPrediction

ESTIMATE = Estimate("0", np.array([1.7e9]), np.zeros((1, 9)), np.eye(9)[None], Status.OK)
"""Ends at a stamp that is rounded to 2e-7 s."""


def prediction(ahead: Sequence[float], scores: Sequence[float] | np.ndarray, sigma: float = 0.01) -> TrackPrediction:
    """Of stamps (k,) s after the observed part; errors are (k,) or (k, 3) scores times sigma."""
    columns = scores if np.ndim(scores) == 2 else np.reshape(scores, (-1, 1))
    errors = sigma * np.broadcast_to(columns, (len(ahead), 3))
    times, sigmas = 1.7e9 + np.asarray(ahead), np.full((len(ahead), 3), sigma)
    return TrackPrediction("0", times, np.zeros((len(ahead), 3)), sigmas, errors, ESTIMATE)


def scales_of(predictions: Sequence[TrackPrediction]) -> ConformalScales:
    return ConformalScales.of(predictions, "toy", 0.25)


def heavy_tailed(rng: np.random.Generator) -> TrackPrediction:
    """1 to 8 samples in each of two bins; errors share most of a Student t with 2 degrees of freedom, and grow."""
    per_bin = rng.integers(1, 9, 2)
    ahead = np.concatenate([BIN * (b + rng.uniform(0.01, 0.99, n)) for b, n in enumerate(per_bin)])
    errors = rng.standard_t(2, 3) + 0.3 * rng.normal(size=(len(ahead), 3))
    return prediction(ahead, errors * (1.0 + 20.0 * ahead[:, None]), sigma=rng.uniform(0.002, 0.03))


@pytest.mark.parametrize("count", [9, pytest.param(25, marks=pytest.mark.thorough)])
def test_intervals_hold_for_exchangeable_tracks(count: int) -> None:
    """A random sample of a new track in each bin and along each axis, over 1,000 draws: good to 4 binomial sigmas."""
    rng, draws = np.random.default_rng(3), 1000
    held = np.zeros((2, 3))
    for _ in range(draws):
        scales, new = scales_of([heavy_tailed(rng) for _ in range(count)]), heavy_tailed(rng)
        inside = np.abs(new.measured) <= HALF_WIDTH * scales.scaled(new).sigmas
        late = new.times - ESTIMATE.times[-1] > BIN
        held += [inside[rng.choice(np.flatnonzero(mask))] for mask in (~late, late)]
    tolerance = 4 * np.sqrt(0.9 * 0.1 / draws)
    assert (held / draws >= 0.9 - tolerance).all()
    assert (held / draws <= 0.9 + 2.0 / (count + 1) + tolerance).all()


def test_coverage_on_the_calibration_tracks_is_told_beside_the_models_own() -> None:
    """Each track against the others: the same as of new tracks, to 4 sigmas of 200 tracks."""
    rng = np.random.default_rng(4)
    scales, new = scales_of([heavy_tailed(rng) for _ in range(200)]), [heavy_tailed(rng) for _ in range(200)]
    held = [(np.abs(p.measured) <= HALF_WIDTH * p.sigmas).mean() for p in map(scales.scaled, new)]
    own = [(np.abs(p.measured) <= HALF_WIDTH * p.sigmas).mean() for p in new]
    assert scales.coverage == pytest.approx(np.mean(held), abs=0.06)
    assert scales.own_coverage == pytest.approx(np.mean(own), abs=0.1)
    assert scales.own_coverage < 0.7 < 0.85 < scales.coverage
    assert scales.statuses == {Status.OK.value: 200}


def test_nine_tracks_give_the_largest_score_and_eight_none() -> None:
    tracks = [prediction([0.01], [[i, 2.0 * i, 0.5 * i]]) for i in range(1, 10)]
    scales = scales_of(tracks)
    np.testing.assert_allclose(scales.scales, [np.array([9.0, 18.0, 4.5]) / HALF_WIDTH])
    assert scales.tracks.tolist() == [9]
    assert np.isnan(scales.coverage)
    with pytest.raises(ValueError, match=r"at least 9 tracks with samples after their first 0.25 s.*got 8 in 'toy'"):
        scales_of([*tracks[:8], prediction([], np.zeros((0, 3)))])
    with pytest.raises(ValueError, match="got 0 in 'toy'"):
        scales_of([])


def test_a_track_counts_once_however_many_samples_it_has() -> None:
    """19 tracks, scores 1 to 19: 18 of 20 is the 18th. A hundred small scores in one track do not move it."""
    tracks = [prediction([0.01], [float(i)]) for i in range(1, 20)]
    tracks[0] = prediction(np.linspace(0.001, 0.049, 100), np.full(100, 1e-3))
    assert scales_of(tracks).scales[0] == pytest.approx(18.0 / HALF_WIDTH)
    assert scales_of(tracks).own[0] == pytest.approx(1 / 19)


def test_predictions_that_are_not_finite_are_misses() -> None:
    tracks = [prediction([0.01], [1.0]) for _ in range(18)]
    lost = replace(tracks[0], sigmas=np.full((1, 3), np.nan))
    assert np.isfinite(scales_of([*tracks, lost]).scales).all()
    assert np.isinf(scales_of([*tracks, lost, lost]).scales).all()


def test_bins_of_the_horizon() -> None:
    """A stamp at a bin's end belongs to it. A bin without samples, and all beyond the last bin, are infinite."""
    scales = scales_of([prediction([0.05, 0.12, 0.4 + 0.01 * i], [1.0, 3.0, 5.0]) for i in range(12)])
    assert scales.tracks.tolist() == [12, 0, 12]
    assert np.isnan(scales.own[1]).all()
    assert np.isfinite([scales.coverage, scales.own_coverage]).all()
    scaled = scales.scaled(prediction([0.02, 0.05, 0.0501, 0.15, 0.3, 9.0], np.zeros(6)))
    expected = np.array([1.0, 1.0, np.inf, 3.0, np.inf, np.inf]) * 0.01 / HALF_WIDTH
    np.testing.assert_allclose(scaled.sigmas, expected[:, None] * np.ones(3))
    assert scaled.conformal is scales


# --- the file ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kept() -> ConformalScales:
    rng = np.random.default_rng(5)
    return scales_of([*(heavy_tailed(rng) for _ in range(12)), prediction([0.12], [1.0])])


def test_a_file_keeps_the_scales(kept: ConformalScales, tmp_path: Path) -> None:
    kept.save(tmp_path / "scales.yaml")
    again = load_conformal(tmp_path / "scales.yaml")
    for name in ("tracks", "scales", "own", "held"):
        np.testing.assert_array_equal(getattr(again, name), getattr(kept, name))
    assert (again.source, again.observe, again.method, again.statuses) == ("toy", 0.25, "smoother", kept.statuses)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"level": 0.95}, "level and bin must be 0.9 and 0.05 s; got 0.95"),
        ({"scales": [[1.0, 2.0]]}, r"scales must have three numbers for each of the 2 bins; got \(1, 2\)"),
        ({"scales": [[1.0, 2.0, -3.0]] * 2}, "scales must be positive; got -3"),
        ({"tracks": "many"}, "must be as it was written"),
        ({"statuses": 3}, "must be as it was written"),
        ({"colour": "red"}, "fields must be among .*; got 'colour'"),
        ({"own": None}, "field 'own' is required"),
    ],
)
def test_another_content_is_refused(
    kept: ConformalScales, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    path = tmp_path / "scales.yaml"
    kept.save(path)
    content = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({"conformal": content["conformal"] | changes}))
    with pytest.raises(ValueError, match=message) as found:
        load_conformal(path)
    assert str(path) in str(found.value)


def test_a_file_that_is_none_of_scales(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_conformal(tmp_path / "none.yaml")
    (tmp_path / "model.yaml").write_text("flight: {gravity: {}}\nbounce: {}\n")
    with pytest.raises(ValueError, match="section 'conformal' must be a mapping"):
        load_conformal(tmp_path / "model.yaml")


def test_scales_are_of_one_observed_part_and_one_method(kept: ConformalScales) -> None:
    kept.check_fits(0.25, "smoother")
    for observe, method in ((0.3, "smoother"), (0.25, "ekf")):
        with pytest.raises(ValueError, match=r"the scales from 'toy' have 0.25 s by smoother"):
            kept.check_fits(observe, method)

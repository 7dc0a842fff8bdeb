from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation import Smoother, Status
from ballfg.learning.calibration import calibrate as module, run
from ballfg.learning.calibration.calibrate import TooManyFailures, calibrate, fitted_noise, has_converged
from ballfg.learning.calibration.coefficients import choose, values_of, with_values
from ballfg.learning.calibration.problem import Problem, Step, pose
from ballfg.learning.calibration.report import compare, table
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import TrackScore, judge_track, summary
from ballfg.learning.split import split_tracks
from ballfg.progress import unwatched
from ballfg.tracks import Ball, read_dataset, write_dataset
from ballfg.tracks.noise import TrackNoise
from tests.learning.conftest import PLANTED


def posed(folder: Path, **fields: Any) -> Problem:
    return pose(read_dataset(folder), nominal_model(), CalibrationConfig(**fields))


@pytest.fixture(scope="module")
def steps(many_tracks: Path) -> list[Step]:
    return list(calibrate(posed(many_tracks)))


def test_planted_coefficients_come_back(steps: list[Step]) -> None:
    last = steps[-1]
    assert has_converged(CalibrationConfig(), last)
    assert len(last.fits) == 12
    assert last.skipped == ()
    for found, sigma, (name, planted) in zip(last.mean, last.sigma, PLANTED.items(), strict=True):
        assert abs(found - planted) < 3.0 * sigma, name
    # the nominal values were far off: 0.12, 0.93, -0.003
    assert np.all(np.abs(np.array(last.mean) - [0.12, 0.93, -0.003]) > 5.0 * np.array(last.sigma))
    # all balls are one ball: less spread than half a prior
    assert np.all(np.array(last.spread) < 0.5 * np.array([0.035, 0.02, 0.004]))


def test_the_table_has_a_row_for_each_coefficient(steps: list[Step], many_tracks: Path) -> None:
    problem, last = posed(many_tracks), steps[-1]
    judged = table(problem, last, compare(steps[0].scores, *[last.scores] * 3)).splitlines()
    for k, name in enumerate(PLANTED):
        (row,) = (line.split() for line in judged if line.split()[:1] == [name])
        values = (problem.chosen.start[k], last.mean[k], last.sigma[k], last.spread[k])
        assert row[-4:] == [f"{value:.4g}" for value in values]


def test_other_tracks_are_predicted_better(steps: list[Step]) -> None:
    first, last = (summary([s for s in step.scores if s is not None]) for step in (steps[0], steps[-1]))
    assert first is not None
    assert last is not None
    assert first.tracks == last.tracks == 12
    assert last.rmse_median < 0.8 * first.rmse_median
    assert last.rmse_pooled < first.rmse_pooled


def test_same_seed_same_numbers_and_a_run_can_be_cut_anywhere(few_tracks: Path) -> None:
    whole = list(calibrate(posed(few_tracks, max_iterations=2, tolerance=1e-12)))
    assert [step.number for step in whole] == [0, 1, 2]
    again = list(calibrate(posed(few_tracks, max_iterations=2, tolerance=1e-12), whole[:2]))
    assert again == whole[2:]  # floats and all, bit for bit
    assert list(calibrate(posed(few_tracks, max_iterations=2), whole)) == []


def failing(monkeypatch: pytest.MonkeyPatch, names: set[str]) -> None:
    real = module.estimate_tracks

    def estimates(*arguments: Any) -> Iterator[Any]:
        for estimate in real(*arguments):
            yield replace(estimate, status=Status.FAILED) if estimate.name in names else estimate

    monkeypatch.setattr(module, "estimate_tracks", estimates)


def test_a_failed_track_is_skipped_and_named(few_tracks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = posed(few_tracks, max_iterations=1, failure_limit=0.4)
    failing(monkeypatch, {problem.split.fit[1]})
    last = list(calibrate(problem))[-1]
    assert last.skipped == ((problem.split.fit[1], Status.FAILED.value),)
    assert [fit.name for fit in last.fits] == [problem.split.fit[0], problem.split.fit[2]]


def test_too_many_failed_tracks_stop_the_run(few_tracks: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = posed(few_tracks, max_iterations=1)
    failing(monkeypatch, {problem.split.fit[1]})
    with pytest.raises(TooManyFailures, match=f"more than 20 % of the 3 fitted tracks failed.*{problem.split.fit[1]}"):
        list(calibrate(problem))


def test_spin_coefficients_need_spin_labels(no_spin_labels: Path, few_tracks: Path) -> None:
    names = ("flight.drag.k", "flight.magnus.k")
    with pytest.raises(ValueError, match="needs tracks with spin labels"):
        posed(no_spin_labels, coefficients=names)
    assert posed(few_tracks, coefficients=names).chosen.needs_spin


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["bounce.restitution.k"], r"'bounce.restitution.k' is not\. Did you mean 'bounce.restitution.e'"),
        (["flight.wind.x"], "'flight.wind.x' is not"),
        (["flight.drag.k", "flight.drag.k"], "'flight.drag.k' stands twice"),
        (["flight.gravity.g"], "'flight.gravity.g' is taken as known"),
    ],
)
def test_bad_coefficients(names: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        choose(nominal_model(), names)


def test_values_go_into_a_copy() -> None:
    model = nominal_model()
    changed = with_values(model, ["flight.drag.k"], np.array([0.2]))
    assert values_of(changed, ["flight.drag.k"]).tolist() == [0.2]
    assert values_of(model, ["flight.drag.k"]).tolist() == [0.12]


def test_stated_noise_is_no_prior_of_the_noise_of_the_same_tracks(few_tracks: Path, tmp_path: Path) -> None:
    """It counts as the noise of the estimates, and where these tracks say nothing: every spin has a label."""
    dataset = read_dataset(few_tracks)
    stated = TrackNoise(memory=(0.004,) * 3, memory_time=0.2, acceleration=0.5, spin_prior=7.0, contact_velocity=0.3)
    write_dataset(tmp_path, replace(dataset.info, noise=stated), dataset, "csv")
    plain, noted = posed(few_tracks), posed(tmp_path)
    assert noted.settings.memory_time == 0.2
    found, again = (fitted_noise(one, one.model, one.settings, errors=False) for one in (plain, noted))
    assert found is not None
    assert again is not None
    assert again.noise == found.noise
    assert found.noise.spin_prior is None
    assert again.settings.spin_prior == 7.0
    assert again.settings.memory_time == found.settings.memory_time == found.noise.memory_time


def test_splits(few_tracks: Path, tmp_path: Path) -> None:
    dataset = read_dataset(few_tracks)
    one, other = (split_tracks(dataset, "random", seed, needs_spin=False) for seed in (0, 1))
    assert len(one.fit) == len(one.judge) == 3
    assert sorted(one.fit + one.judge) == dataset.names
    assert one.fit != other.fit
    assert one.digest == other.digest
    rough = [replace(track, sigmas=np.full((len(track), 3), 0.002)) for track in dataset]
    digests = set()
    for name, scale in (("plain", None), ("rough", 1.0), ("rougher", 2.0)):
        given = dataset if scale is None else (replace(t, sigmas=scale * t.sigmas) for t in rough)
        write_dataset(tmp_path / name, dataset.info, given, "csv")
        digests.add(split_tracks(read_dataset(tmp_path / name), "random", 0, needs_spin=False).digest)
    for k, change in enumerate(({"position_noise": 0.01}, {"ball": Ball(0.021, 0.0027)}, {"table_height": 0.01})):
        write_dataset(tmp_path / str(k), replace(dataset.info, **change), dataset, "csv")
        digests.add(split_tracks(read_dataset(tmp_path / str(k)), "random", 0, needs_spin=False).digest)
    assert len(digests) == 6  # a training on the same positions with other errors, or another ball, is another one
    with pytest.raises(ValueError, match="needs a column 'split'"):
        split_tracks(dataset, "label", 0, needs_spin=False)


def test_split_by_label(few_tracks: Path, tmp_path: Path) -> None:
    for name in ("dataset.yaml", "tracks.csv"):
        (tmp_path / name).write_bytes((few_tracks / name).read_bytes())
    rows = ["trajectory,split", "000,train", "001,test", "002,train", "003,test", "004,validation", "005,"]
    (tmp_path / "labels.csv").write_text("\n".join(rows) + "\n")
    found = split_tracks(read_dataset(tmp_path), "label", 0, needs_spin=False)
    assert (found.fit, found.judge) == (("000", "002"), ("001", "003"))
    assert list(found.left_out) == ["004", "005"]
    (tmp_path / "labels.csv").write_text("\n".join(rows[:3]) + "\n")
    with pytest.raises(ValueError, match="needs 2 tracks to fit and 1 to judge; got 1 and 1"):
        split_tracks(read_dataset(tmp_path), "label", 0, needs_spin=False)


def test_a_track_with_nothing_left_is_not_judged(few_tracks: Path) -> None:
    problem = posed(few_tracks)
    estimator = Smoother(problem.model, problem.surfaces, problem.settings)
    track = next(iter(problem.dataset))
    assert judge_track(estimator, track.until(track.times[0]), 0.4, np.inf) is None
    assert judge_track(estimator, track, 0.9999, np.inf) is not None
    assert judge_track(estimator, track, 0.4, 1e-6) is None
    assert summary([]) is None


def test_a_summary_weighs_tracks_by_their_samples() -> None:
    few = TrackScore(name="a", samples=10, rmse=0.01, covered=1.0, prediction_nis=2.0, log_score=2.0, nis=3.0)
    found = summary(
        [few, TrackScore(name="b", samples=30, rmse=0.03, covered=0.5, prediction_nis=4.0, log_score=1.0, nis=5.0)]
    )
    assert found is not None
    assert (found.tracks, found.rmse_median) == (2, 0.02)
    assert found.rmse_pooled == pytest.approx(np.sqrt((10 * 0.01**2 + 30 * 0.03**2) / 40))
    assert (found.coverage_90, found.prediction_nis, found.nis) == pytest.approx((0.625, 3.5, 4.0))


def test_the_time_left_is_that_of_the_steps_left(
    few_tracks: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step takes ten seconds of this clock."""
    moments = iter(range(1000, 10**6, 10))
    monkeypatch.setattr(run, "time", SimpleNamespace(monotonic=lambda: float(next(moments))))
    problem = posed(few_tracks, max_iterations=4)
    run.take_steps(problem, [], tmp_path, unwatched)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("iteration 1: ")
    assert lines[1].endswith("; at most about 30 s left")

"""A small run: records, rows, pictures. A training that was stopped goes on, although a best model is there."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.dynamics.contenders import Job, Record, fan_of, nominal_contender, task_digest, truth_contender
from ballfg.benchmarks.dynamics.measured import measured_shot
from ballfg.benchmarks.dynamics.suite import METHODS, Plan, _installed, add_rows, collect_records, run_dynamics
from ballfg.benchmarks.dynamics.trained import _finished
from ballfg.benchmarks.dynamics.truth import synthetic_task
from ballfg.benchmarks.results import Results
from ballfg.estimation import Estimate, Status
from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run.run_folder import Epoch, write_metrics
from ballfg.tracks import Track

SMALL = Plan(tracks=12, measured=None, seeds=2, quick=True)
CONTROLS = ("truth", "nominal")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Results, Path, list[Path]]:
    results, out = Results("test", 1), tmp_path_factory.mktemp("out")
    return results, out, run_dynamics(results, None, out, SMALL, 1, CONTROLS)


def test_run_has_both_controls_and_pictures(small: tuple[Results, Path, list[Path]]) -> None:
    results, _, pictures = small
    assert {row.method for row in results.rows} == {"truth", "nominal"}
    assert {row.case for row in results.rows} == {"synthetic"}
    assert [p.name for p in pictures] == ["dynamics_rmse.png", "dynamics_apex.png", "dynamics_fan.png"]
    assert all(p.stat().st_size > 10_000 for p in pictures)
    assert results.value("synthetic", "truth", "not_converged") == 0


def test_truth_is_the_floor(small: tuple[Results, Path, list[Path]]) -> None:
    results, *_ = small
    for metric in ("track_rmse", "rest_rmse", "apex_1_2_mean", "apex_2_3_mean"):
        truth, nominal = (results.value("synthetic", m, metric) for m in ("truth", "nominal"))
        assert truth < 0.5 * nominal, metric  # type: ignore[operator]
    assert results.value("synthetic", "truth", "track_rmse") < 0.04  # type: ignore[operator]


def test_finished_methods_are_not_repeated(small: tuple[Results, Path, list[Path]]) -> None:
    results, out, _ = small
    again, runs = Results("test", 1), out / "runs"
    stamps = {path: path.stat().st_mtime_ns for path in runs.glob("*.json")}
    assert len(stamps) == len(CONTROLS)
    run_dynamics(again, None, out, SMALL, 1, CONTROLS)
    assert again.rows == results.rows
    assert {path: path.stat().st_mtime_ns for path in runs.glob("*.json")} == stamps


def test_the_record_of_another_task_does_not_count(small: tuple[Results, Path, list[Path]], tmp_path: Path) -> None:
    kept = tmp_path / "nominal-1.json"
    kept.write_bytes((small[1] / "runs" / kept.name).read_bytes())
    collect_records([synthetic_task(2, 4)], ("nominal",), [1], tmp_path, 1, quick=True)
    assert kept.read_bytes() != (small[1] / "runs" / kept.name).read_bytes()


def test_a_broken_record_is_named(small: tuple[Results, Path, list[Path]], tmp_path: Path) -> None:
    path = tmp_path / "nominal-1.json"
    path.write_text("{")
    with pytest.raises(ValueError, match=r"nominal-1.json: must be a finished run .* Delete it"):
        Record.read(path, "any")
    assert Record.read(tmp_path / "absent.json", "any") is None
    content = json.loads((small[1] / "runs" / "nominal-1.json").read_text())
    del content["scores"][0]["apex"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="must be a finished run"):
        Record.read(path, content["digest"])


def test_digest_tells_tasks_apart() -> None:
    task = synthetic_task(1, 6)
    moved = replace(task, validation=(*task.validation[:-1], replace(task.validation[-1], observed=70)))
    settings = replace(task, settings=replace(task.settings, spin_prior=50.0))
    digests = [
        task_digest(task, "long"),
        task_digest(task, "short"),
        task_digest(moved, "long"),
        task_digest(settings, "long"),
    ]
    assert len(set(digests)) == 4
    assert task_digest(synthetic_task(1, 6), "long") == digests[0]


def test_seeds_are_averaged_and_shown(small: tuple[Results, Path, list[Path]]) -> None:
    task = synthetic_task(1, 12)
    found = Record.read(small[1] / "runs" / "nominal-1.json", task_digest(task, "untrained"))
    assert found is not None
    slower = replace(found, seed=2, training_time=10.0)
    results = Results("test", 1)
    add_rows(results, task, [found, slower])
    row = next(r for r in results.rows if r.metric == "training_time")
    assert (row.value, row.low, row.high) == (5.0, 0.0, 10.0)
    assert results.value("synthetic", "nominal", "training_time@2") == 10.0


def test_predictions_see_nothing_later_and_do_not_depend_on_the_batch() -> None:
    task = synthetic_task(1, 8)
    job = Job((task,), "nominal", 0, Path(), True)
    shots = task.validation
    together = nominal_contender(job, task).predict([s.seen for s in shots], [s.track.times for s in shots])
    for shot, path in zip(shots, together, strict=True):
        alone = nominal_contender(job, task).predict([shot.seen], [shot.track.times])[0]
        np.testing.assert_allclose(alone, path, atol=1e-9)
        assert shot.seen.times[-1] == shot.track.times[79]


def test_fan_is_a_mirror_image_in_sidespin_and_returns_from_its_file(tmp_path: Path) -> None:
    task = synthetic_task(1, 4)
    fan = fan_of(truth_contender(Job((task,), "truth", 0, Path(), True), task))
    assert list(fan.topspin) == list(range(-3, 6))
    assert list(fan.sidespin) == list(range(-5, 6))
    for level in range(1, 6):
        np.testing.assert_allclose(np.multiply(fan.sidespin[level], [1, -1, 1]), fan.sidespin[-level], atol=1e-9)
    assert fan.sidespin[5][-1][1] > fan.sidespin[2][-1][1] > 0.1  # turns to the left
    record = Record("d", "truth", 0, 0, 0.0, 0.0, 0, (), fan)
    record.save(tmp_path / "truth.json")
    again = Record.read(tmp_path / "truth.json", "d")
    assert again is not None
    assert again.fan is not None
    assert again.fan.topspin.keys() == fan.topspin.keys()
    np.testing.assert_array_equal(again.fan.topspin[3], fan.topspin[3])


def test_truth_needs_simulated_tracks() -> None:
    task = replace(synthetic_task(1, 4), truth=None, case="aimy")
    with pytest.raises(ValueError, match=r"needs simulated tracks; got measured ones \(aimy\)"):
        truth_contender(Job((task,), "truth", 0, Path(), True), task)


def test_a_measured_shot_ends_at_a_hit() -> None:
    times = np.arange(100) / 100
    track = Track(times, np.stack((times, times, 1 + times), axis=-1), name="hit")
    blank = Estimate("hit", times, np.zeros((100, 9)), np.zeros((100, 9, 9)), Status.OK, np.zeros((100, 3)))
    whole = measured_shot(track, blank)
    cut = measured_shot(track, replace(blank, hits=np.array([40])))
    assert whole is not None
    assert cut is not None
    assert (len(whole.track), len(cut.track)) == (100, 41)
    assert measured_shot(track, replace(blank, hits=np.array([20]))) is None  # within the observed part


def test_the_command_has_help_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    from ballfg.benchmarks.cli import run

    with pytest.raises(SystemExit) as ended:
        run(["dynamics", "--help"])
    assert ended.value.code == 0
    assert "ballfg-bench dynamics --quick" in " ".join(capsys.readouterr().out.split())


def test_a_method_whose_package_is_missing_is_left_out_and_said_to_be(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "diffusers" else find(name))
    assert "diffusion+aug" not in _installed(None)
    assert set(_installed(None)) == set(METHODS) - {"diffusion+aug"}
    assert "note: diffusion+aug is left out: it needs the package diffusers" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"--method diffusion\+aug .* pip install 'ballfg\[diffusion\]'"):
        _installed(["nominal", "diffusion+aug"])
    assert _installed(["nominal"]) == ("nominal",)


def test_a_stopped_training_is_not_finished(tmp_path: Path) -> None:
    config = TrainConfig(kind="mlp", optimizer=OptimizerConfig(epochs=2))
    rows = [Epoch(i, None, None, 0.05, 1e-3, None, 0, 0, 0, 1.0) for i in range(3)]
    assert not _finished(tmp_path, config)
    write_metrics(tmp_path / "metrics.csv", rows)
    assert not _finished(tmp_path, config)
    (tmp_path / "model.yaml").write_text("{}")
    assert _finished(tmp_path, config)
    write_metrics(tmp_path / "metrics.csv", rows[:2])
    assert not _finished(tmp_path, config)

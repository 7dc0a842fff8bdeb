"""One model on several datasets, judged on each and on one that it never saw; all of them small simulations."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.dynamics.contenders import Job, adapting_contender, job_digest, nominal_contender, task_digest
from ballfg.benchmarks.dynamics.measured import Measured, measured_task, measured_tasks
from ballfg.benchmarks.dynamics.suite import Plan, collect_records, judged, record_path, run_dynamics
from ballfg.benchmarks.dynamics.task import Task, TaskShot
from ballfg.benchmarks.dynamics.trained import config_of, recipe, trained_contender
from ballfg.benchmarks.estimators.measured import run_measured
from ballfg.benchmarks.results import Results
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Dataset, read_dataset, write_dataset

SMALL = Plan(tracks=0, measured=None, seeds=1, quick=True)


def simulated(folder: Path, name: str, tracks: int, seed: int, *, spin_labels: bool = False) -> Dataset:
    write_simulation(folder / f"{name}-made", SimulationConfig(tracks=tracks, seed=seed, spin_labels=spin_labels))
    made = read_dataset(folder / f"{name}-made")
    write_dataset(folder / name, replace(made.info, name=name), (track.until(0.6) for track in made))
    return read_dataset(folder / name)


def ten(task: Task) -> list[TaskShot]:
    """As many shots to learn from as have one that validates."""
    return [task.train[0]] * 10


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Measured:
    folder = tmp_path_factory.mktemp("data")
    first, second = (simulated(folder, name, 5, seed) for name, seed in (("first", 1), ("second", 2)))
    return Measured([first, second], simulated(folder, "other", 6, 3, spin_labels=True), 4)


@pytest.fixture(scope="module", params=["a-tune+aug", pytest.param("analytic+mnn", marks=pytest.mark.thorough)])
def trained(request: pytest.FixtureRequest) -> str:
    """The method that is trained: of a network machine code is made first."""
    return str(request.param)


@pytest.fixture(scope="module")
def small(data: Measured, trained: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Results, Path, list[Path]]:
    results, out = Results("test", 0), tmp_path_factory.mktemp("out")
    return results, out, run_dynamics(results, data, out, SMALL, 1, ("nominal", "nominal+track", trained))


def test_every_dataset_is_a_case_with_rows_and_a_picture(small: tuple[Results, Path, list[Path]], trained: str) -> None:
    results, out, pictures = small
    assert {row.case for row in results.rows} == {"first", "second", "other"}
    for case, count in (("first", 2), ("second", 2), ("other", 4)):
        rows = {row.method: row for row in results.rows if (row.case, row.metric) == (case, "prediction_rmse_median")}
        assert list(rows) == ["nominal", "nominal+track", trained]
        assert {row.n for row in rows.values()} == {count}
        assert {row.unit for row in rows.values()} == {"mm"}
        for method in rows:
            expected = results.value(case, method, "rest_rmse_median")
            assert expected is not None
            assert rows[method].value == pytest.approx(1e3 * expected)
            assert 0.0 < expected < 0.2
    names = {picture.name for picture in pictures}
    assert {f"dynamics_rmse_{case}.png" for case in ("first", "second", "other")} <= names
    assert not any(name.startswith("dynamics_fan") for name in names)
    assert (out / "runs" / f"{trained}-0-on-2.json").is_file()


def test_one_model_learns_from_every_second_shot_of_all(small: tuple[Results, Path, list[Path]], trained: str) -> None:
    folder = small[1] / "runs" / f"{trained}-0"
    names = []
    for part, expected in (("data-0", "first"), ("data-1", "second")):
        written = read_dataset(folder / part)
        assert written.info.name == expected
        labels = {track.name: track.labels["split"] for track in written}
        assert labels == {"000": "train", "001": "test", "002": "train", "003": "test", "004": "train"}
        names += [track.labels["group"] for track in written]
    assert set(names) == {"first", "second"}
    assert not (folder / "data-2").exists()


def test_few_shots_all_train_unless_a_sequence_model_needs_some_to_choose_by(data: Measured, tmp_path: Path) -> None:
    task = measured_task(data.datasets[0], 1)
    task = replace(
        task, train=tuple(replace(s, track=replace(s.track, name=f"{k:02d}")) for k, s in enumerate(ten(task)))
    )
    for validate, expected in ((True, 1), (False, 0)):
        task.write(tmp_path / str(validate), validate=validate)
        labels = [track.labels["split"] for track in read_dataset(tmp_path / str(validate))]
        assert (labels.count("validation"), labels.count("train")) == (expected, 10 - expected)


def test_nothing_finished_is_repeated_and_another_recipe_is_refused(
    small: tuple[Results, Path, list[Path]], trained: str, data: Measured
) -> None:
    tasks = measured_tasks(data, 1, None)
    runs = small[1] / "runs"
    stamps = {path: path.stat().st_mtime_ns for path in runs.glob("*.json")}
    collect_records(tasks, ("nominal", trained), [0], runs, 1, quick=True)
    assert {path: path.stat().st_mtime_ns for path in runs.glob("*.json")} == stamps
    job = Job(tuple(tasks), trained, 0, runs / f"{trained}-0", quick=False)
    with pytest.raises(ValueError, match="must be a training of these tracks by this recipe"):
        trained_contender(job, tasks[0])


def test_errors_are_those_of_the_comparison_of_estimators(data: Measured) -> None:
    dataset = data.datasets[0]
    task = measured_task(dataset, 1, learn=False)
    job = Job((task,), "nominal+track", 0, Path(), True)
    shots = task.validation
    paths = adapting_contender(job, task).predict([s.seen for s in shots], [s.track.times for s in shots])
    squares = [
        np.square(path - s.track.positions)[s.observed : s.judged].sum(axis=1)
        for path, s in zip(paths, shots, strict=True)
    ]
    here = 1e3 * np.median([np.sqrt(each.mean()) for each in squares])
    there = Results("test", 0)
    run_measured(there, dataset, None, 1)
    assert here == pytest.approx(there.value("first", "smoother", "prediction_rmse_median"), rel=1e-6)


def test_the_split_alternates_and_the_parts_last_as_told(data: Measured) -> None:
    task = measured_task(data.datasets[0], 1)
    assert [s.track.name for s in task.train] == ["000", "002", "004"]
    assert [s.track.name for s in task.validation] == ["001", "003"]
    for shot in task.validation:
        since = shot.track.times - shot.track.times[0]
        assert since[shot.observed - 1] == pytest.approx(0.25)
        assert since[shot.judged - 1] == pytest.approx(0.55)
    path = nominal_contender(Job((task,), "nominal", 0, Path(), True), task).predict(
        [task.validation[0].seen], [task.validation[0].track.times]
    )[0]
    assert path.shape == task.validation[0].track.positions.shape


def test_transfer_is_judged_only_and_not_by_models_that_know_nothing_of_spin(data: Measured) -> None:
    tasks = measured_tasks(data, 1, None)
    assert [len(task.train) for task in tasks] == [3, 3, 0]
    assert [shot.track.name for shot in tasks[2].validation] == ["000", "001", "002", "003"]
    assert all(shot.seen.spin_label is not None for shot in tasks[2].validation)
    graph, sequence = (Job(tuple(tasks), name, 0, Path("x"), True) for name in ("mlp+gs", "lstm+aug"))
    assert judged(graph) == [0, 1, 2]
    assert judged(sequence) == [0, 1]
    assert record_path(graph, 1) == Path("x-on-1.json")
    assert record_path(Job(tuple(tasks[:1]), "mlp+gs", 0, Path("x"), True), 0) == Path("x.json")


def test_digest_of_one_task_is_its_own_and_of_several_tells_what_was_learned(data: Measured) -> None:
    first, second, other = measured_tasks(data, 1, None)
    assert job_digest(first, (first,), "r") == task_digest(first, "r")
    assert job_digest(first, (first, other), "r") == task_digest(first, "r")
    assert len({job_digest(first, (first, second), "r"), job_digest(second, (first, second), "r")}) == 2
    assert job_digest(other, (first, second, other), "r") != job_digest(other, (first, other), "r")


def test_all_graph_models_have_one_recipe(data: Measured) -> None:
    tasks = tuple(measured_tasks(Measured(data.datasets), 1, None))
    configs = {
        name: config_of(Job(tasks, name, 3, Path(), False), [Path("a"), Path("b")])
        for name in ("a-tune+aug", "mlp+aug", "mlp+gs", "mnn+gs", "analytic+mnn")
    }
    same = ("loss", "noise", "optimizer", "observe", "launcher", "split", "data", "seed")
    assert len({tuple(repr(getattr(config, name)) for name in same) for config in configs.values()}) == 1
    assert configs["analytic+mnn"].architecture.residual
    assert not configs["mnn+gs"].architecture.residual
    assert configs["mnn+gs"].data == ("a", "b")
    assert configs["mnn+gs"].launcher.labels == ("group",)


def test_finished_trainings_keep_their_mark(data: Measured) -> None:
    job = Job(tuple(measured_tasks(data, 1, None)), "mnn+gs", 0, Path(), False)
    assert recipe(job).startswith("{'kind': 'mnn+gs', 'split': {'by': 'label'}, 'workers': 1, 'optimizer': ")
    assert config_of(job, [Path("a")]).jobs == 1


def test_bad_combinations_are_named(data: Measured) -> None:
    first = data.datasets[0]
    with pytest.raises(ValueError, match="must have names that differ; got first, first"):
        measured_tasks(Measured([first], first), 1, None)


def test_the_command_refuses_a_transfer_without_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from ballfg.benchmarks.cli import run

    for words, message in (
        (["--transfer", "x"], "--transfer needs a model trained on measured tracks"),
        (["--data", "x", "--transfer-tracks", "5"], "--transfer-tracks is of --transfer"),
        (["--method", "mpl"], "--method must be one of truth, nominal"),
    ):
        with pytest.raises(SystemExit) as ended:
            run(["dynamics", *words, "--out", str(tmp_path)])
        assert ended.value.code == 2
        assert message in capsys.readouterr().err


def test_the_command_names_all_its_datasets(data: Measured, tmp_path: Path) -> None:
    from ballfg.benchmarks.cli import run

    assert data.transfer is not None
    words = [word for one in data.datasets for word in ("--data", str(one.path))]
    words += ["--transfer", str(data.transfer.path), "--transfer-tracks", "2", "--method", "nominal"]
    words += ["--jobs", "1", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as ended:
        run(["dynamics", *words])
    assert ended.value.code == 0
    content = json.loads((tmp_path / "results.json").read_text())
    expected = "ballfg-bench dynamics --data first --data second --transfer other --transfer-tracks 2"
    assert content["command"] == f"{expected} --method nominal --seed 0"
    assert {row["case"] for row in content["rows"]} == {"first", "second", "other"}

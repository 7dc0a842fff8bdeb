"""Real clusters on this machine: two dask workers, one of them killed in the middle; and ray where it is installed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation import Estimate, Estimator, dataset_settings, dataset_surfaces, predict_tracks
from ballfg.estimation.batch import do_all, estimate_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.parallel import on_cluster
from ballfg.parallel.same_versions import HERE, differences, own_versions
from ballfg.tracks import Dataset, read_dataset
from tests.commands import printed, refused, status
from tests.parallel.conftest import TRACKS

needs_dask = pytest.mark.skipif(not find_spec("distributed"), reason="dask is not installed (pip install ballfg[dask])")
needs_ray = pytest.mark.skipif(not find_spec("ray"), reason="ray is not installed (pip install ballfg[ray])")


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Dataset:
    return read_dataset(folder)


@pytest.fixture(scope="module")
def estimator(dataset: Dataset) -> Estimator:
    model = nominal_model(dataset.ball)
    return make_estimator("smoother", model, dataset_surfaces(dataset), dataset_settings(dataset, model))


@pytest.fixture(scope="module")
def alone(dataset: Dataset, estimator: Estimator) -> list[bytes]:
    """What one process finds."""
    return [content(one) for one in estimate_tracks(estimator, dataset, len(dataset), 1)]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    import distributed

    options = {"threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(n_workers=2, **options) as found:
        yield found


def content(one: Estimate) -> bytes:
    return one.name.encode() + one.states.tobytes() + one.covariances.tobytes() + one.status.value.encode()


@needs_dask
def test_a_dask_cluster_finds_the_same_to_the_last_bit(cluster: Any, folder: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("one.parquet", "dask.parquet")]
    assert status("estimate", folder, "--out", files[0], "--jobs", 1) == 0
    where = "--cluster", "dask", "--address", cluster.scheduler_address
    said = printed("estimate", folder, "--out", files[1], *where)
    assert f"  {TRACKS} tracks: converged\n" in said.out
    assert "dask cluster: 2 workers\n" in said.err
    assert files[0].read_bytes() == files[1].read_bytes()


@needs_dask
@pytest.mark.thorough  # a quicker one: test_stream.py
def test_a_killed_dask_worker_loses_and_doubles_nothing(
    cluster: Any, dataset: Dataset, estimator: Estimator, alone: list[bytes]
) -> None:
    from distributed import Client

    with Client(cluster, set_as_default=False) as client:
        pids = client.run(os.getpid)
        with on_cluster("dask", cluster.scheduler_address) as workers:
            assert workers == 2
            found = []
            for one in estimate_tracks(estimator, dataset, len(dataset), 1):
                if not found:
                    os.kill(next(iter(pids.values())), signal.SIGKILL)
                found.append(content(one))
        client.wait_for_workers(2, timeout=20)
        assert set(client.run(os.getpid).values()) != set(pids.values())
    assert found == alone


@needs_dask
def test_predictions_and_long_tasks_go_to_the_cluster(cluster: Any, dataset: Dataset, estimator: Estimator) -> None:
    here = list(predict_tracks(estimator, dataset, len(dataset), 0.25))
    with on_cluster("dask", cluster.scheduler_address):
        there = list(predict_tracks(estimator, dataset, len(dataset), 0.25))
        pids = do_all([os.getpid] * 4, 1)
    assert [one.name for one in there] == dataset.names
    for one, other in zip(here, there, strict=True):
        assert one.positions.tobytes() == other.positions.tobytes()
        assert one.sigmas.tobytes() == other.sigmas.tobytes()
        assert one.estimate.predict(0.1).positions.tobytes() == other.estimate.predict(0.1).positions.tobytes()
    assert os.getpid() not in pids


@needs_dask
def test_an_error_on_a_worker_is_that_of_the_function(cluster: Any) -> None:
    with on_cluster("dask", cluster.scheduler_address), pytest.raises(ValueError, match="invalid literal"):
        do_all([_bad, _bad], 1)


def _bad() -> int:
    return int("no number")


@needs_dask
def test_a_cluster_that_is_not_there_is_one_line(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ballfg.parallel.clusters.CONNECT", 0.5)
    out = tmp_path / "states.csv"
    assert "nothing usable answers at tcp://127.0.0.1:9" in refused(
        "estimate", folder, "--out", out, "--cluster", "dask", "--address", "tcp://127.0.0.1:9"
    )
    assert "such as tcp://10.0.0.1:8786; got somewhere" in refused(
        "estimate", folder, "--out", out, "--cluster", "dask", "--address", "somewhere"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [("--cluster", "dusk"), ("--address", "tcp://10.0.0.1:8786")])
def test_options_that_make_no_sense(folder: Path, tmp_path: Path, words: tuple[str, str]) -> None:
    assert words[1] in refused("estimate", folder, "--out", tmp_path / "states.csv", *words)


@pytest.mark.parametrize("kind", ["dask", "ray"])
def test_a_library_that_is_missing_names_its_extra(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, {"dask": "distributed", "ray": "ray"}[kind], None)
    with pytest.raises(ValueError, match=rf'pip install "ballfg\[{kind}\]"'), on_cluster(kind, "tcp://10.0.0.1:1"):
        pass


def test_versions_are_compared() -> None:
    assert eval(HERE) == own_versions()
    assert differences(own_versions()) is None
    other = own_versions() | {"torch": "1.0", "source of ballfg": "abc"}
    text = differences(other, "the worker w")
    assert text is not None
    assert text.startswith("the worker w must have the versions of the process that sends work; got torch ")
    assert "source of ballfg" in text
    assert "numpy" not in text
    assert "must be able to import ballfg" in (differences({}) or "")


@pytest.mark.thorough
@needs_ray
def test_a_killed_ray_worker_loses_and_doubles_nothing(
    dataset: Dataset, estimator: Estimator, alone: list[bytes]
) -> None:
    import ray

    ray.init("local", num_cpus=2, include_dashboard=False, logging_level="CRITICAL", log_to_driver=False)
    try:
        with on_cluster("ray") as workers:
            assert workers == 2
            pids = do_all([os.getpid] * 4, 1)
            found = []
            for one in estimate_tracks(estimator, dataset, len(dataset), 1):
                if not found:
                    os.kill(pids[0], signal.SIGKILL)
                found.append(content(one))
    finally:
        ray.shutdown()
    assert found == alone

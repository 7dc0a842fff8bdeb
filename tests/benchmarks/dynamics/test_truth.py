"""The synthetic task: its truth, its parts, and what is written of it."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.benchmarks.dynamics.task import Task
from ballfg.benchmarks.dynamics.truth import (
    LABEL_NOISE,
    MOST_SAMPLES,
    NOISE,
    OBSERVED,
    RATE,
    split,
    synthetic_task,
)
from ballfg.dynamics import nominal_model, rollout
from ballfg.state import POSITION, VELOCITY
from ballfg.tracks import read_dataset

G = 9.81


@pytest.fixture(scope="module")
def task() -> Task:
    return synthetic_task(3, 60)


def test_same_seed_same_task_other_seed_another(task: Task) -> None:
    again, other = synthetic_task(3, 60), synthetic_task(4, 60)
    for part in ("train", "validation"):
        for a, b in zip(getattr(task, part), getattr(again, part), strict=True):
            assert a.track.name == b.track.name
            assert a.track.positions.tobytes() == b.track.positions.tobytes()
    assert [s.track.name for s in task.validation] != [s.track.name for s in other.validation]


def test_parts_are_disjoint_and_of_the_papers_size() -> None:
    train, validation = split(717, 0)
    assert (len(train), len(validation)) == (573, 144)
    assert sorted(train + validation) == list(range(717))
    assert split(717, 0) == (train, validation)


def test_tracks_are_long_enough_and_labelled_with_settings_only(task: Task) -> None:
    for shot in (*task.train, *task.validation):
        assert OBSERVED == shot.observed < len(shot.track) == shot.judged <= MOST_SAMPLES
        assert set(shot.track.labels) == {"topspin", "sidespin", "speed"}
        assert len(shot.seen) == OBSERVED
        assert 1 <= len(shot.bounces) <= 3
    errors = np.concatenate([s.track.positions - s.reference for s in task.train])
    assert errors.std() == pytest.approx(NOISE, rel=0.03)


@torch.no_grad()
def test_bounces_and_apexes_are_those_of_a_dense_rollout(task: Task) -> None:
    shots, step = task.validation[:6], 2e-3
    times = np.arange(0.0, 1.4, step)
    start = torch.from_numpy(np.stack([s.states[0] for s in shots if s.states is not None]))
    dense = rollout(task.truth, start, torch.from_numpy(times), task.surfaces).numpy()  # type: ignore[arg-type]
    compared = 0
    for shot, path in zip(shots, dense, strict=True):
        end = min(times[-1], shot.track.times[-1])
        up = np.flatnonzero((path[:-1, 5] < 0) & (path[1:, 5] > 0) & (times[1:] < end))
        early = shot.bounces[shot.bounces < end - step]
        np.testing.assert_allclose(times[up][: len(early)], early, atol=1.01 * step)
        edges = [0.0, *early]
        for flight, (low, high) in enumerate(pairwise(edges)):
            rows = (times > low + step) & (times < high)
            top = path[rows][path[rows, 2].argmax()]
            if np.isnan(shot.apex_times[flight]):
                assert abs(top[5]) > G * step / 2  # highest at the launch
                continue
            # the densest sample is within half a step of the top: lower by g h^2 / 8, along the way by v h / 2
            assert 0.0 <= shot.apexes[flight, 2] - top[2] < 2 * G * step**2 / 8
            assert np.linalg.norm(shot.apexes[flight, :2] - top[:2]) < np.hypot(*top[3:5]) * step / 2 * 1.2
            compared += 1
    assert compared >= 4


@torch.no_grad()
def test_truth_is_far_from_nominal_but_close_to_its_own_rollout(task: Task) -> None:
    moved = []
    for shot in task.validation[:5]:
        assert shot.states is not None
        start, times = torch.from_numpy(shot.states[:1]), torch.from_numpy(shot.track.times)
        own = rollout(task.truth, start, times, task.surfaces)[0].numpy()  # type: ignore[arg-type]
        np.testing.assert_allclose(own, shot.states, atol=1e-9)  # without the table's edges, as models are told
        nominal = rollout(nominal_model(), start, times, task.surfaces)[0].numpy()
        moved.append(np.sqrt(((nominal - shot.states)[:, POSITION] ** 2).sum(-1).mean()))
    assert 0.03 < np.median(moved) < 0.3  # m; known spin and start: the dynamics alone


@torch.no_grad()
def test_air_forces_have_the_declared_coefficients(task: Task) -> None:
    spin = np.array([0.0, 200.0, 0.0])
    state = torch.tensor([[0.0, 0.0, 2.0, 4.0, 0.0, 0.0, *spin]], dtype=torch.float64)
    acceleration, spin_rate = task.truth.rates(state)  # type: ignore[union-attr]
    ratio = 0.02 * 200.0 / 4.0  # S = 1
    lift = 0.0056 / (1 + ratio) * np.cross(spin, state[0, VELOCITY].numpy())
    drag = -0.12 * (1 + 0.025 * (4.0 - 5.0) + 0.3 * ratio) * 4.0 * state[0, VELOCITY].numpy()
    np.testing.assert_allclose(acceleration[0].numpy(), lift + drag + [0, 0, -9.81], atol=1e-12)
    np.testing.assert_allclose(spin_rate[0].numpy(), -0.1 * spin, atol=1e-12)


def test_label_noise_is_that_of_the_labels() -> None:
    made = synthetic_task(0, 256)
    errors = [made.launcher.labelled(s.seen).spin_label - s.states[0, 6:] for s in made.train]  # type: ignore
    assert float(np.sqrt(np.square(errors).mean())) == pytest.approx(LABEL_NOISE, rel=0.1)


def test_written_task_reads_back_with_its_parts(task: Task, tmp_path: Path) -> None:
    task.write(tmp_path / "tracks")
    dataset = read_dataset(tmp_path / "tracks")
    assert dataset.info.rate == RATE
    assert dataset.info.position_noise == NOISE
    parts = {track.name: track.labels["split"] for track in dataset}
    assert {name for name, part in parts.items() if part == "test"} == {s.track.name for s in task.validation}
    assert {name for name, part in parts.items() if part == "validation"} == {s.track.name for s in task.train[9::10]}
    shots = {s.track.name: s for s in (*task.train, *task.validation)}
    for track in dataset:
        np.testing.assert_array_equal(track.positions, shots[track.name].track.positions)

"""Solving batches of shots: the smoother's estimates, warm starts, places that shots are seen from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.estimation import Smoother, SpinReading
from ballfg.factors.graph import LevenbergMarquardt
from ballfg.learning.augment import augmentation
from ballfg.learning.end_to_end.learnables import Learnables, NoiseScales
from ballfg.learning.end_to_end.solving import BatchSolver, Pose, WarmStarts
from ballfg.tracks import Track
from ballfg.tracks.track import SPIN_LABELS
from tests.learning.estimates import NOISE, OBSERVED, SETTINGS, TABLE, TIGHT, launcher, measured, shots, usual_ball

POSE = Pose(*augmentation(3, 1, 4))
TELLS = replace(SETTINGS, launcher=launcher())


def solver(*, noise: NoiseScales | None = None) -> BatchSolver:
    made = shots(measured(usual_ball(), lengths=(24, 20, 26)), usual_ball(), TELLS)
    noise = noise or NoiseScales(NOISE, learned=False)
    return BatchSolver(made, Learnables(usual_ball(), TELLS.launcher.embedding, noise), TIGHT)


def states_of(solved) -> list[np.ndarray]:
    return [s.solution.minimum.values.states for s in solved]


def test_estimates_are_the_smoother_s() -> None:
    """Each by itself, from the samples that are observed and from no other, with the noise as it is learned so far."""
    noise = NoiseScales(NOISE, learned=True)
    with torch.no_grad():
        noise.process += torch.tensor([0.3, 0.1, -0.2, 0.1, 0.2])
        noise.position.fill_(0.4)
        noise.spin.fill_(-0.5)
    batch = solver(noise=noise)
    solved, failed = batch((2, 0, 1), {})
    assert not failed
    assert [s.number for s in solved] == [2, 0, 1]
    for one in solved:
        shot = batch.shots[one.number]
        settings = noise.settings(TELLS)
        seen = replace(shot.track, times=shot.track.times[:OBSERVED], positions=shot.track.positions[:OBSERVED])
        smoother = Smoother(usual_ball(), TABLE, settings, TIGHT)
        sigma = settings.position_scale * np.tile(settings.position_noise, (OBSERVED, 1))
        assert sigma[0, 0] == pytest.approx(0.002 * np.exp(0.4))
        alone = smoother.settle(smoother.problem(seen, shot.segmentation, sigma))
        np.testing.assert_allclose(
            one.solution.minimum.values.states, alone.minimum.values.states, rtol=1e-7, atol=1e-7
        )
        np.testing.assert_array_equal(one.positions, shot.track.positions)


def test_a_warm_start_saves_iterations_and_changes_nothing() -> None:
    batch = solver()
    cold, _ = batch((0, 1, 2), {})
    again, _ = batch((2, 1, 0), {})
    assert max(s.solution.minimum.iterations for s in again) <= 2 < min(s.solution.minimum.iterations for s in cold)
    for a, b in zip(states_of(cold), reversed(states_of(again)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)
    batch.warm.forget(1)
    third, _ = batch((0, 1), {})
    assert [s.solution.minimum.iterations > 2 for s in third] == [False, True]


def test_a_warm_start_with_a_tracker_s_memory() -> None:
    """Biases start from zero again and are at their minimum after a step; a turn mixes the memory of x and y."""
    tells = replace(TELLS, memory=(0.003, 0.004, 0.002), stamp_jitter=0.0005)
    made = shots(measured(usual_ball(), lengths=(24, 20, 26)), usual_ball(), tells)
    batch = BatchSolver(
        made, Learnables(usual_ball(), tells.launcher.embedding, NoiseScales(NOISE, learned=False)), TIGHT
    )
    cold, _ = batch((0, 1, 2), {})
    again, _ = batch((0, 1, 2), {})
    for one, other in zip(cold, again, strict=True):
        first, second = (s.solution.minimum.values for s in (one, other))
        np.testing.assert_allclose(first.states, second.states, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(first.biases, second.biases, atol=1e-9)
    turned, failed = batch((1,), {1: POSE})
    assert not failed
    moved = turned[0].solution.minimum.values.biases
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(cold[1].solution.minimum.values.biases), rel=0.5)


def test_a_warm_start_follows_the_pose() -> None:
    """Kept as measured, so that it serves wherever the shot is seen from the next time."""
    batch = solver()
    plain, _ = batch((0, 1), {})
    turned, _ = batch((0, 1), {1: POSE})
    assert max(s.solution.minimum.iterations for s in turned) <= 2
    np.testing.assert_allclose(states_of(turned)[1], POSE.states(states_of(plain)[1]), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(turned[1].positions, POSE.positions(batch.shots[1].track.positions), rtol=0, atol=0)
    back, _ = batch((0, 1), {})
    assert max(s.solution.minimum.iterations for s in back) <= 2


def test_what_does_not_converge_is_named_and_forgotten() -> None:
    batch = solver()
    batch((0, 1, 2), {})
    batch.warm.forget(2)
    batch.optimizer = LevenbergMarquardt(tolerance=1e-5, max_iterations=3)
    solved, failed = batch((0, 1, 2), {})
    assert [s.number for s in solved] == [0, 1]
    assert failed == [("track 2", "the iteration limit was reached")]
    assert batch.warm.get(2, None) is None
    assert batch.warm.get(1, None) is not None


def test_warm_starts_to_tensors_and_back() -> None:
    """To the bit, contacts too."""
    batch, other = solver(), WarmStarts()
    batch((0, 2), {})
    tensors = batch.warm.tensors()
    assert sorted(tensors) == sorted(f"{k}.{part}" for k in (0, 2) for part in ("states", "coefficients", "contacts"))
    other.take(tensors)
    assert other.get(1, None) is None
    for number in (0, 2):
        (values, contacts), (expected, places) = other.get(number, None), batch.warm.get(number, None)
        np.testing.assert_array_equal(values.states, expected.states)
        np.testing.assert_array_equal(values.coefficients, expected.coefficients)
        assert contacts == places
        assert len(contacts) == 1
    values.states[:] = 0.0  # of a copy
    assert bool((tensors["0.states"] != 0.0).any())


def test_pose_there_and_back() -> None:
    states = np.random.default_rng(0).standard_normal((5, 9))
    there = POSE.states(states)
    np.testing.assert_allclose(POSE.states(there, back=True), states, rtol=0, atol=1e-14)
    np.testing.assert_allclose(there[:, :3], POSE.positions(states[:, :3]), rtol=0, atol=0)
    quarter = Pose(torch.tensor(np.pi / 2, dtype=torch.float64), torch.tensor([10.0, 20.0], dtype=torch.float64))
    np.testing.assert_allclose(
        quarter.states(np.arange(1.0, 10.0)[None])[0], [8, 21, 3, -5, 4, 6, -8, 7, 9], atol=1e-14
    )


def test_a_pose_turns_the_spin_label() -> None:
    """And leaves other labels, stamps and what is not told as they are."""
    track = Track(
        np.arange(3.0), np.ones((3, 3)), labels={"topspin": 2.0, "spin_x": 1.0, "spin_y": 2.0, "spin_z": 3.0}, name="t"
    )
    quarter = Pose(torch.tensor(np.pi / 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    seen = quarter.track(track)
    np.testing.assert_allclose(seen.spin_label, [-2.0, 1.0, 3.0], atol=1e-14)
    np.testing.assert_allclose(seen.positions, [[-1.0, 1.0, 1.0]] * 3, atol=1e-14)
    assert seen.labels["topspin"] == 2.0
    plain = replace(track, labels={"topspin": 2.0})
    assert quarter.track(plain).labels == {"topspin": 2.0}
    assert not set(SPIN_LABELS) & set(quarter.track(plain).labels)


def test_sigmas_of_a_turned_shot_do_not_depend_on_the_axes() -> None:
    """A turn mixes x and y; their own sigmas become the mean of the two, whatever the angle."""
    batch = solver()
    sigmas = np.tile((0.001, 0.007, 0.002), (len(batch.shots[0].track), 1))
    batch.shots[0] = replace(batch.shots[0], track=replace(batch.shots[0].track, sigmas=sigmas))
    poses = [
        Pose(torch.tensor(angle, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)) for angle in (0.0, 2.0)
    ]
    found = []
    for pose in poses:
        batch.warm.forget(0)
        (one,), _ = batch((0,), {0: pose})
        root = one.solution.graph.batches[0].information_root
        np.testing.assert_allclose(root, np.tile((200.0, 200.0, 500.0), (OBSERVED, 1)), rtol=1e-12)
        found.append(pose.states(one.solution.minimum.values.states, back=True))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-7, atol=1e-7)


def test_measurements_beside_the_positions_turn_along() -> None:
    """A spin is turned and not shifted; an observation is told the shift in space, which has no part along z."""
    told: list[tuple[torch.Tensor, torch.Tensor]] = []

    class Heard(SpinReading):
        def turned(self, rotation, shift):
            told.append((rotation, shift))
            return super().turned(rotation, shift)

    track = measured(usual_ball())[0]
    quarter = Pose(torch.tensor(np.pi / 2, dtype=torch.float64), torch.tensor([10.0, 20.0], dtype=torch.float64))
    seen = quarter.track(track.observed(Heard(3, [[10.0, 20.0, 30.0]], 1.0)))
    np.testing.assert_allclose(seen.observations[0].values, [[-20.0, 10.0, 30.0]], atol=1e-12)
    ((rotation, shift),) = told
    np.testing.assert_allclose(rotation.numpy(), [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)
    np.testing.assert_array_equal(shift.numpy(), [10.0, 20.0, 0.0])

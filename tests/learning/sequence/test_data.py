from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.learning.augment import apply, augmentation
from ballfg.learning.sequence.data import collate, example
from ballfg.tracks import Track

NO_SETTINGS = torch.zeros(0, dtype=torch.float64)


def line(count: int, *, start: float = 5.0) -> Track:
    """A sample every 10 ms, moving at 1, 2, 3 m/s."""
    times = start + 0.01 * np.arange(count)
    return Track(times, (times - start)[:, None] * np.array([1.0, 2.0, 3.0]), name=f"line {count}")


def test_times_count_from_the_last_observed_sample() -> None:
    cut = example(line(5), 3, NO_SETTINGS)
    torch.testing.assert_close(cut.observed_times, torch.tensor([-0.02, -0.01, 0.0]).double())
    torch.testing.assert_close(cut.times, torch.tensor([0.01, 0.02]).double())
    torch.testing.assert_close(cut.rest, torch.tensor([[0.03, 0.06, 0.09], [0.04, 0.08, 0.12]]).double())


def test_asked_times_are_in_the_track_s_own_time_and_nothing_is_known_there() -> None:
    cut = example(line(5), 3, NO_SETTINGS, [5.025, 7.0])
    torch.testing.assert_close(cut.times, torch.tensor([0.005, 1.98]).double())
    assert cut.rest.isnan().all()


def test_padding_repeats_the_last_time_and_is_marked() -> None:
    batch = collate([example(line(5), 3, NO_SETTINGS), example(line(9), 2, NO_SETTINGS)])
    assert batch.observed_count.tolist() == [3, 2]
    assert batch.seen.tolist() == [[True, True, True], [True, True, False]]
    assert batch.asked.sum(dim=1).tolist() == [2, 7]
    torch.testing.assert_close(batch.times[0], torch.tensor([0.01] + 6 * [0.02]).double())
    torch.testing.assert_close(batch.last_observed, torch.tensor([[0.02, 0.04, 0.06], [0.01, 0.02, 0.03]]).double())


def test_augmentation_moves_observed_part_and_rest_alike() -> None:
    track, (angle, shift) = line(6), augmentation(0, 0, 0)
    moved = Track(track.times, apply(torch.from_numpy(track.positions), angle, shift).numpy(), name="moved")
    a, b = example(track, 4, NO_SETTINGS).seen_from(angle, shift), example(moved, 4, NO_SETTINGS)
    assert torch.equal(a.observed, b.observed)
    assert torch.equal(a.rest, b.rest)
    assert torch.equal(a.times, b.times)


@pytest.mark.parametrize("observed", [1, 6])
def test_observed_must_be_among_the_samples(observed: int) -> None:
    with pytest.raises(ValueError, match=rf"observed must lie in 2 .. 5, .* 'line 5'; got {observed}"):
        example(line(5), observed, NO_SETTINGS)


def test_nothing_to_predict_is_refused() -> None:
    with pytest.raises(ValueError, match=r"times of track 'line 5' must have shape \(m,\) with m >= 1; got \(0,\)"):
        example(line(5), 5, NO_SETTINGS)


@pytest.mark.parametrize(("times", "at"), [([5.02], 0), ([5.03, 5.03], 1), ([5.03, np.nan], 1)])
def test_times_must_increase_from_the_last_observed_one(times: list[float], at: int) -> None:
    with pytest.raises(ValueError, match=rf"must increase from the last observed stamp 5.02 s; times\[{at}\]="):
        example(line(5), 3, NO_SETTINGS, times)

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from ballfg.learning.augment import apply, augmentation
from ballfg.learning.sequence.data import Batch, Example, collate, example
from ballfg.learning.sequence.model import Frame
from ballfg.tracks import Track


def example_of(times: np.ndarray, observed: int, settings: float = 0.0, offset: float = 0.0) -> Example:
    """A ball on the path (2 t, -t, 1 + 0.5 t), shifted along x."""
    positions = np.stack([2 * times + offset, -times, 1 + 0.5 * times], axis=1)
    return example(Track(times, positions, name="t"), observed, torch.tensor([settings, 7.0], dtype=torch.float64))


@pytest.fixture
def examples() -> list[Example]:
    return [example_of(0.01 * np.arange(count), 10, count) for count in (20, 30, 51)]


@pytest.fixture
def batch(examples: list[Example]) -> Batch:
    return collate(examples)


@pytest.fixture
def frame(examples: list[Example]) -> Frame:
    made = Frame(2)
    assert made.fit(examples) == 41
    return made


def test_scales_are_those_of_the_examples(frame: Frame, batch: Batch) -> None:
    away = np.concatenate([0.01 * np.arange(1, count - 9) for count in (20, 30, 51)])
    assert float(frame.step) == pytest.approx(0.01)
    assert float(frame.horizontal) == pytest.approx(np.sqrt(2.5 * np.mean(away**2)))
    heights = np.concatenate([1 + 0.005 * np.arange(count) for count in (20, 30, 51)])
    np.testing.assert_allclose(frame.height, [heights.mean(), heights.std(ddof=1)])
    expected = (np.array([20, 30, 51]) - 101 / 3) / np.std([20, 30, 51])
    np.testing.assert_allclose(frame.settings(batch), np.stack([expected, np.zeros(3)], axis=1), atol=1e-15)


def test_outward_is_the_inverse_of_inward(frame: Frame, batch: Batch) -> None:
    torch.testing.assert_close(frame.outward(frame.inward(batch.rest, batch), batch), batch.rest)


def test_a_horizontal_shift_is_not_seen(frame: Frame) -> None:
    here, there = (collate([example_of(0.01 * np.arange(20), 10, offset=offset)]) for offset in (0.0, 3.0))
    torch.testing.assert_close(frame.inward(here.rest, here), frame.inward(there.rest, there))


def test_a_path_is_straight_between_grid_points_and_beyond_the_last(frame: Frame) -> None:
    path = torch.tensor([[[0.0], [1.0], [4.0]]]).double().expand(1, 3, 3)
    times = torch.tensor([[0.0, 0.0025, 0.01, 0.015, 0.02, 0.03]]).double()
    expected = torch.tensor([0.0, 0.25, 1.0, 2.5, 4.0, 7.0]).double()
    torch.testing.assert_close(frame.at_times(path, times)[0, :, 0], expected)


def test_samples_between_grid_points_are_interpolated(frame: Frame) -> None:
    uneven = np.concatenate([0.01 * np.arange(10), 0.09 + np.array([0.007, 0.021, 0.035, 0.04])])
    batch = collate([example_of(uneven, 10)])
    values, known = frame.on_grid(frame.inward(batch.rest, batch), batch, 6)
    assert known[0].tolist() == [True, True, True, True, False, False]
    times = 0.09 + 0.01 * np.arange(1, 5)
    expected = np.stack([2 * times, -times, 1 + 0.5 * times], axis=1)
    np.testing.assert_allclose(frame.outward(values, batch)[0, :4], expected, atol=1e-12)


def test_grid_points_in_a_long_gap_are_unknown(frame: Frame) -> None:
    kept = np.delete(np.arange(30), [13, 16, 17])
    batch = collate([example_of(0.01 * kept, 10)])
    _, known = frame.on_grid(frame.inward(batch.rest, batch), batch, 20)
    unknown = (10 + torch.arange(20))[~known[0]].tolist()
    assert unknown == [16, 17]


def test_the_grid_of_a_track_does_not_depend_on_padding(frame: Frame, batch: Batch, examples: list[Example]) -> None:
    together, known = frame.on_grid(frame.inward(batch.rest, batch), batch, 41)
    for row, alone in enumerate(examples):
        single = collate([dataclasses.replace(alone)])
        values, reached = frame.on_grid(frame.inward(single.rest, single), single, 41)
        assert torch.equal(known[row], reached[0])
        torch.testing.assert_close(together[row][reached[0]], values[0][reached[0]])


def test_tracks_that_rest_have_no_scale() -> None:
    times = 0.01 * np.arange(20)
    resting = example(Track(times, np.ones((20, 3)), name="rest"), 10, torch.zeros(0, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"tracks must move horizontally and in height; their scales are \[0.0"):
        Frame(0).fit([resting])


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

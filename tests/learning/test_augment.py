from __future__ import annotations

import math

import pytest
import torch

from ballfg.learning.augment import SHIFT, apply, augmentation, rotate, undo


def test_a_quarter_turn_takes_x_to_y_and_the_shift_comes_after() -> None:
    moved = apply(torch.tensor([1.0, 0.0, 0.5]).double(), torch.tensor(math.pi / 2), torch.tensor([0.2, 0.3]).double())
    torch.testing.assert_close(moved, torch.tensor([0.2, 1.3, 0.5]).double())


def test_height_and_distances_stay() -> None:
    positions = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = apply(positions, *augmentation(3, 1, 4))
    torch.testing.assert_close(moved[:, 2], positions[:, 2], rtol=0, atol=0)
    torch.testing.assert_close(torch.cdist(moved, moved), torch.cdist(positions, positions))


def test_vectors_turn_as_differences_of_positions_do() -> None:
    a, b = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    angle, shift = augmentation(0, 2, 9)
    torch.testing.assert_close(rotate(a - b, angle), apply(a, angle, shift) - apply(b, angle, shift))


def test_undo_goes_back_for_a_batch_of_tracks() -> None:
    positions = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    drawn = [augmentation(0, 0, track) for track in range(2)]
    angle = torch.stack([angle for angle, _ in drawn])[:, None]
    shift = torch.stack([shift for _, shift in drawn])[:, None]
    moved = apply(positions, angle, shift)
    torch.testing.assert_close(moved[1], apply(positions[1], *drawn[1]))
    torch.testing.assert_close(undo(moved, angle, shift), positions)


def test_draws_depend_on_seed_epoch_and_track_and_on_nothing_else() -> None:
    numbers = [(seed, epoch, track) for seed in range(3) for epoch in range(3) for track in range(3)]
    angles = {float(augmentation(*each)[0]) for each in numbers}
    assert len(angles) == len(numbers)
    first, again = augmentation(1, 2, 0), augmentation(1, 2, 0)
    assert torch.equal(first[0], again[0])
    assert torch.equal(first[1], again[1])


def test_draws_are_uniform() -> None:
    drawn = [augmentation(0, epoch, track) for epoch in range(20) for track in range(50)]
    angles = torch.stack([angle for angle, _ in drawn])
    shifts = torch.stack([shift for _, shift in drawn])
    # standard error of a mean of 1000: range / sqrt(12 * 1000); four of them
    assert abs(float(angles.mean())) < 4 * 2 * math.pi / math.sqrt(12_000)
    assert shifts.mean(dim=0).abs().max() < 4 * 2 * SHIFT / math.sqrt(12_000)
    assert float(angles.std()) == pytest.approx(math.pi / math.sqrt(3), rel=0.05)
    assert shifts.abs().max() <= SHIFT


def test_negative_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match=r"epoch must be at least 0; got -1"):
        augmentation(0, -1, 0)

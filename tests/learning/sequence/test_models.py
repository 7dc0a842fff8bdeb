"""What both models promise, trained or not; each can learn: four tracks are known to millimetres."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from ballfg.learning.sequence.data import Example, LauncherSettings, collate, example
from ballfg.learning.sequence.model import SequenceModel
from ballfg.learning.sequence.predictor import SequenceArchitecture, SequenceKind
from ballfg.tracks import Track

LABELS = ("topspin", "sidespin", "speed")
FLOAT32 = 1e-5
"""m, what float32 leaves of a position over some tens of steps."""

kinds = pytest.mark.parametrize("kind", ["lstm", "diffusion"])


def examples_of(tracks: Sequence[Track], observed: int = 25) -> list[Example]:
    launcher = LauncherSettings(LABELS)
    return [example(track, observed, launcher.of(track)) for track in tracks]


def untrained(kind: SequenceKind, tracks: Sequence[Track], seed: int = 0, width: int = 16) -> SequenceModel:
    return SequenceArchitecture(kind, width).untrained(examples_of(tracks), seed)


def predicted(model: SequenceModel, examples: Sequence[Example]) -> torch.Tensor:
    with torch.no_grad():
        return model.predict(collate(examples))


@kinds
def test_a_padded_batch_gives_what_single_tracks_give(kind: SequenceKind, tracks: list[Track]) -> None:
    model = untrained(kind, tracks)
    examples = [cut for observed in (25, 31, 12) for cut in examples_of(tracks[:3], observed)]
    together = predicted(model, examples)
    for row, alone in enumerate(examples):
        assert together.shape[1] >= len(alone.times)
        single = predicted(model, [alone])[0]
        torch.testing.assert_close(together[row, : len(single)], single, rtol=0, atol=FLOAT32)


@kinds
def test_losses_do_not_depend_on_the_batch(kind: SequenceKind, tracks: list[Track]) -> None:
    model = untrained(kind, tracks)
    examples = examples_of(tracks[:4])
    draws = [(0, 5, number) for number in range(4)]
    together, positions = model.losses(collate(examples), draws)
    for row, alone in enumerate(examples):
        single, path = model.losses(collate([alone]), draws[row : row + 1])
        torch.testing.assert_close(together[row : row + 1], single, rtol=1e-5, atol=0)
        torch.testing.assert_close(positions[row, : path.shape[1]], path[0], rtol=0, atol=FLOAT32)


@kinds
def test_a_prediction_does_not_depend_on_which_other_times_are_asked(kind: SequenceKind, tracks: list[Track]) -> None:
    model = untrained(kind, tracks)
    full = examples_of(tracks[:1])[0]
    kept = torch.tensor([2, 3, 7, 12])
    few = dataclasses.replace(full, times=full.times[kept], rest=full.rest[kept])
    torch.testing.assert_close(predicted(model, [few])[0], predicted(model, [full])[0, kept], rtol=0, atol=FLOAT32)


@kinds
def test_a_horizontal_shift_moves_the_prediction_with_it(kind: SequenceKind, tracks: list[Track]) -> None:
    model = untrained(kind, tracks)
    cut = examples_of(tracks[:1])[0]
    shift = torch.tensor([0.7, -1.3], dtype=torch.float64)
    moved = predicted(model, [cut.seen_from(torch.zeros((), dtype=torch.float64), shift)])
    expected = predicted(model, [cut]) + torch.tensor([0.7, -1.3, 0.0])
    torch.testing.assert_close(moved, expected, rtol=0, atol=FLOAT32)


@kinds
def test_dropped_frames_are_taken(kind: SequenceKind, tracks: list[Track]) -> None:
    model = untrained(kind, tracks)
    whole = tracks[0]
    kept = np.delete(np.arange(len(whole)), [4, 5, 11, 30, 31, 32, 33])
    dropped = Track(whole.times[kept], whole.positions[kept], labels=whole.labels, name=whole.name)
    cut = example(dropped, 25 - 3, LauncherSettings(LABELS).of(dropped))
    losses, positions = model.losses(collate([cut]), [(0, 0, 0)])
    assert torch.isfinite(losses).all()
    assert torch.isfinite(positions).all()
    losses.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


@kinds
def test_weights_come_from_the_seed_and_leave_global_randomness_alone(kind: SequenceKind, tracks: list[Track]) -> None:
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    one, same, other = untrained(kind, tracks, 3), untrained(kind, tracks, 3), untrained(kind, tracks, 4)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), same.parameters(), strict=True))
    assert any(not torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    cut = examples_of(tracks[:2])
    assert torch.equal(predicted(one, cut), predicted(same, cut))


def test_diffusion_noise_comes_from_seed_epoch_and_track(tracks: list[Track]) -> None:
    model = untrained("diffusion", tracks)
    batch = collate(examples_of(tracks[:1]))
    losses = [float(model.losses(batch, [draw])[0].detach()) for draw in [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]]
    assert len(set(losses)) == 4
    assert float(model.losses(batch, [(0, 0, 0)])[0].detach()) == losses[0]


def test_a_saved_diffusion_model_has_weights_of_these_shapes(tracks: list[Track]) -> None:
    """Files of trained models hold them: four heads of pooling, eight blocks, conditions twice as wide as the paths."""
    shapes = {name: tuple(p.shape) for name, p in untrained("diffusion", tracks, width=16).named_parameters()}
    assert shapes["encoder.score.weight"] == (4, 24)
    assert shapes["encoder.outward.weight"] == (24, 4 * 24)
    assert shapes["encoder.inward.weight"] == (24, 3 + 17 + len(LABELS))
    assert shapes["denoiser.inward.weight"] == (16, 3 + 17, 1)
    assert shapes["denoiser.blocks.7.modulate.weight"] == (2 * 16, 2 * 16)
    assert "denoiser.blocks.8.modulate.weight" not in shapes


def test_the_decoder_tells_strides_from_its_hidden_state(tracks: list[Track]) -> None:
    """The first from the state that the encoder leaves, each further one from the cell's output."""
    model = untrained("lstm", tracks)
    batch = collate(examples_of(tracks[:3]))
    heard: dict[str, list[torch.Tensor]] = {"head": [], "cell": []}
    model.head.register_forward_pre_hook(lambda _, given: heard["head"].append(given[0]))
    model.cell.register_forward_hook(lambda _, given, found: heard["cell"].append(found[0]))
    with torch.no_grad():
        first, _ = model._read(batch, model.frame.settings(batch).float())
        model.predict(batch)
    assert float(first.abs().max()) < 1.0
    for asked, wanted in zip(heard["head"], [first, *heard["cell"]], strict=True):
        torch.testing.assert_close(asked, wanted, rtol=0, atol=0)


G, RESTITUTION, START = 9.81, 0.9, 0.5


def bouncing(number: int) -> Track:
    """A ball on parabolas that bounces once at z = 0, without noise."""
    times = 0.04 * np.arange(15)
    vx, vy, vz = 1.0 + number, 0.5 * (number - 1.5), 0.3 * number
    fall = (vz + np.sqrt(vz**2 + 2 * G * START)) / G
    up, after = RESTITUTION * (G * fall - vz), times - fall
    z = np.where(after < 0, START + vz * times - G / 2 * times**2, up * after - G / 2 * after**2)
    return Track(times, np.stack([vx * times, vy * times, z], axis=1), name=str(number))


@pytest.mark.parametrize(
    ("kind", "width", "steps", "rate"),
    [("lstm", 64, 500, 1e-2), pytest.param("diffusion", 16, 300, 4e-3, marks=pytest.mark.thorough)],
)
def test_four_tracks_are_learned_to_millimetres(kind: SequenceKind, width: int, steps: int, rate: float) -> None:
    examples = [example(bouncing(number), 5, torch.zeros(0, dtype=torch.float64)) for number in range(4)]
    batch = collate(examples)
    model = SequenceArchitecture(kind, width).untrained(examples, seed=0)
    optimizer = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for step in range(steps):
        losses, _ = model.losses(batch, [(0, step, number) for number in range(4)])
        optimizer.zero_grad()
        losses.mean().backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        error = (model.predict(batch) - batch.rest)[batch.asked]
    assert float(error.square().sum(-1).mean().sqrt()) < 0.012

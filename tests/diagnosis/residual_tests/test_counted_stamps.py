"""Stamps that count kept frames: how far they are off is known, and predictions from them have that as noise."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.diagnosis import diagnose
from ballfg.diagnosis.budget import EXPECTED
from ballfg.diagnosis.error_budget import error_budget
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.residual_tests.counted_stamps import noise_of_all_frames, with_all_frames, with_errors_of_counting
from ballfg.dynamics import EFFECTS, load_model
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import Ball, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.noise import TrackNoise
from ballfg.tracks.track import SPIN_LABELS

RATE, EVERY = 120.0, 10


def without_frames(folder: Path, lost: Callable[[int], bool]) -> None:
    """Drops frames of each track by their number; the stamps go on as if none were."""
    with (folder / "tracks.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with (folder / "tracks.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        for _, own in itertools.groupby(rows, key=lambda row: row["trajectory"]):
            kept = [row for frame, row in enumerate(own) if not lost(frame)]
            writer.writerows({**row, "t": number / RATE} for number, row in enumerate(kept))


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """Twelve shots of which every tenth frame is lost; the stamps go on as if none were."""
    folder = tmp_path_factory.mktemp("counted") / "shots"
    write_simulation(folder, SimulationConfig(tracks=12, rate=RATE, seed=4))
    without_frames(folder, lambda frame: frame % EVERY == EVERY - 1)
    return read_dataset(folder), load_model(folder / "model.yaml")


def test_how_far_the_stamps_are_off_is_stated(shots):
    """With frames counted rightly: each kept frame falls a tenth of a frame further behind, until one is lost."""
    dataset, model = shots
    halves = hold_out(dataset, model)
    assert set(halves.stamps.found) == {"counted_frames"}
    kept = np.array([frame for frame in range(400) if frame % EVERY != EVERY - 1])
    right = {t.name: kept[: len(t)] * (1.0 - 1.0 / EVERY) / RATE for t in dataset}
    halves = replace(halves, stamps=replace(halves.stamps, missing=1.0 / (EVERY - 1.0), counted=right))
    stated = with_errors_of_counting(halves).dataset.info.noise
    sawtooth = np.arange(EVERY - 1) / EVERY
    assert stated.stamp_jitter == pytest.approx(np.std(sawtooth) / RATE, rel=0.05)
    assert dataset.info.noise is None


def test_good_stamps_get_no_error(shots, tmp_path):
    write_simulation(tmp_path / "even", SimulationConfig(tracks=6, rate=RATE, seed=3))
    halves = hold_out(read_dataset(tmp_path / "even"), shots[1])
    assert with_errors_of_counting(halves) is halves


def test_predictions_do_not_take_lost_frames_for_hits(shots):
    """At 3 to 6 m/s the stamps are off by 6 to 13 mm, more than all else: the noise is 3 mm."""
    budget = error_budget(*shots)
    assert budget.measured < 25.0
    assert max(EXPECTED, key=budget.squares.__getitem__) == "tracker"
    assert 0.5 < budget.measured / budget.floor < 1.5


def test_flights_are_checked_with_all_frames(shots):
    """Their stamps are corrected, so that of jitter only what the file states is left."""
    dataset, model = shots
    halves = hold_out(dataset, model)
    checked = with_all_frames(with_errors_of_counting(halves), dataset)
    whole = {track.name: track for track in halves.tracks}
    for part in (*checked.search_tracks, *checked.held_out_tracks):
        track = whole[part.track.name]
        kept = [np.flatnonzero((track.positions == place).all(axis=1))[0] for place in part.track.positions]
        np.testing.assert_allclose(part.track.times, track.seconds[kept], atol=1e-12)
    assert checked.dataset.info.noise is None
    found = TrackNoise(position=(0.003,) * 3, memory=(0.002,) * 3, memory_time=0.02, stamp_jitter=0.0024)
    own = noise_of_all_frames(found, halves.stamps, dataset)
    assert (own.memory, own.stamp_jitter) == (found.memory, None)
    assert noise_of_all_frames(replace(found, memory=None, memory_time=None), halves.stamps, dataset) is None
    assert noise_of_all_frames(found, Stamps(), dataset) is found


def test_right_labels_are_not_accused_where_frames_are_lost(make_ball, make_launches, make_shots, tmp_path):
    """A fifth of the frames of balls at 4.5 to 6.5 m/s: with the stamps of the file nine of 16 labels seemed wrong."""
    rng, states = np.random.default_rng(4), make_launches(16, 4)
    states[:, 3:5] *= 1.3
    flown = make_shots(make_ball(), states, 4, rate=RATE).stretches
    tracks = []
    for name, places, label in zip(flown.names, flown.positions.numpy(), flown.labels.numpy(), strict=True):
        kept = places[rng.random(len(places)) > 0.2]
        labels = dict(zip(SPIN_LABELS, label.tolist(), strict=True))
        tracks.append(Track(np.arange(len(kept)) / RATE, kept, None, labels, name=name))
    info = DatasetInfo("lossy", 0.76, Ball(0.02, 0.0027), rate=RATE, position_noise=0.003, spin_noise=4.0)
    write_dataset(tmp_path / "lossy", info, tracks)
    found = diagnose(read_dataset(tmp_path / "lossy"), make_ball(), catalogue=[EFFECTS["wind"]])
    assert [finding.name for finding in found.findings] == ["counted_frames"]
    assert found.labels.contradicted == ()
